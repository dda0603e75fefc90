"""How much of a thing all clients together may have, and one of them alone."""

from __future__ import annotations

import ipaddress
import math
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

#: Share of a resource that the address of one client may take, so that the others always have some left.
SHARE = 0.75
#: Number of bodies of the largest size that may be in memory, being received or read, at one time.
UPLOADS = 4
#: Leading bits of an IPv6 address that one customer of a provider usually has to himself.
_IPV6_NETWORK = 64


class QuotaError(RuntimeError):
    """There is no more of it."""


class Quota:
    """A limited thing, counted by the address of the client that uses it.

    Touched from the event loop only.

    Args:
        limit: most of it for all clients together.

    Attributes:
        limit: the same.
        used: how much of it is used.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.used = limit, 0
        self._share = max(1, math.ceil(SHARE * limit))
        self._of: Counter[str | None] = Counter()

    def take(self, client: str | None, amount: int = 1) -> None:
        """Count a client's use in; raises QuotaError where that would be too much, and counts nothing then.

        None is a client that stands for many, and may have all there is.
        """
        if self.used + amount > self.limit or (client is not None and self._of[client] + amount > self._share):
            raise QuotaError
        self.used += amount
        self._of[client] += amount

    def give_back(self, client: str | None, amount: int = 1) -> None:
        """Count it out again."""
        self.used -= amount
        self._of[client] -= amount
        if not self._of[client]:
            del self._of[client]

    @contextmanager
    def taken(self, client: str | None, amount: int = 1) -> Iterator[None]:
        """``take`` for the duration of a block."""
        self.take(client, amount)
        try:
            yield
        finally:
            self.give_back(client, amount)


def client_name(address: str) -> str:
    """Whom an address stands for: itself, or for IPv6 the network that belongs to one customer."""
    try:
        parsed = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(parsed, ipaddress.IPv6Address):
        if parsed.ipv4_mapped:
            return str(parsed.ipv4_mapped)
        return str(ipaddress.ip_network((parsed, _IPV6_NETWORK), strict=False))
    return address
