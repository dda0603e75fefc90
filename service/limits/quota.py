"""Quotas: how much of a resource all clients together, and one client alone, may use."""

from __future__ import annotations

import ipaddress
import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from shapespace.service.refusals import RefusedError

#: Share of a resource that the address of one client may use, so that other clients always have some.
SHARE = 0.75
#: Number of uploads of the largest size that may be in memory at one time.
UPLOADS = 4
#: Leading bits of an IPv6 address. A provider usually gives all addresses with the same bits to one customer.
_IPV6_NETWORK = 64


class Quota:
    """A limited resource, counted for each client, of an amount for all together; for the event loop only.

    Args:
        limit: amount for all together.
        full: what to say when it is used up, without a full stop.
    """

    def __init__(self, limit: int, full: str) -> None:
        self.limit, self.used, self._full = limit, 0, full
        self._share = max(1, math.ceil(SHARE * limit))
        self._by_client: Counter[str | None] = Counter()

    def take(self, client: str | None, amount: int = 1) -> None:
        """Take an amount for a client; raises RefusedError, busy, and takes nothing, if that is too much.

        The client None stands for many clients and may use the whole resource.
        """
        full = self.used + amount > self.limit
        if full or (client is not None and self._by_client[client] + amount > self._share):
            whose = "" if full else " for this client"
            raise RefusedError("busy", f"{self._full}{whose}. Try again after the time in Retry-After.")
        self.used += amount
        self._by_client[client] += amount

    def give_back(self, client: str | None, amount: int = 1) -> None:
        """Give an amount back."""
        self.used -= amount
        self._by_client[client] -= amount
        if not self._by_client[client]:
            del self._by_client[client]

    @contextmanager
    def held(self, client: str | None, amount: int = 1) -> Iterator[None]:
        """Hold an amount for the duration of the block; raises as ``take``."""
        self.take(client, amount)
        try:
            yield
        finally:
            self.give_back(client, amount)


def client_name(address: str) -> str:
    """Return the client for an address: the address itself, or for IPv6 the network of one customer."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address):
        if parsed.ipv4_mapped:
            return str(parsed.ipv4_mapped)
        return str(ipaddress.ip_network((parsed, _IPV6_NETWORK), strict=False))
    return address
