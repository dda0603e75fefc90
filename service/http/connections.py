"""Connections within limits: their number, and the time that a client may stay silent.

h11 limits heads and trailers, and reads one request after the other. Uvicorn leaves the limits here to a proxy. A
refusal here is a problem like every other error.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import resource
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any
from uuid import uuid4

import h11
from uvicorn.protocols.http.h11_impl import STATUS_PHRASES, H11Protocol

from shapespace.service.http.problems import KINDS, MEDIA_TYPE, description
from shapespace.service.limits.quota import Quota, client_name
from shapespace.service.logs import RateLimitedLog
from shapespace.service.refusals import RefusedError

#: File handles that are reserved for other uses than connections.
SPARE_HANDLES = 100
#: Most bytes of a request's head, and of its trailers; other servers have 8 to 64 KiB.
HEAD_BYTES = 32 * 2**10
#: Bytes that are read and parsed at once; a head may exceed its limit by this much.
PARSE_BYTES = 2**14
#: Seconds in which a client has to send a whole head, and in which it has to read at least a part of its answer.
HEAD_SECONDS, STALL_SECONDS = 10.0, 30.0
#: Seconds after an answer in which a client may use its connection again. They are more than clients keep one, which is
#: 5 s in httpx and 15 s in aiohttp: a request on a connection that is just being closed is lost.
IDLE_SECONDS = 20
#: Seconds after a refusal in which further bytes are read and dropped: closing at once could lose the answer.
LINGER_SECONDS = 1.0
#: Most bytes that are read and dropped after an answer that came before the end of its request.
LINGER_BYTES = 4 * 2**20


class Connections:
    """All connections of a server.

    Args:
        most: limit on the number of connections; file handles may allow fewer.
        seconds: time that the body of a request may take.
        proxies: networks of proxies, whose connections belong to many clients.
    """

    def __init__(self, most: int, seconds: float, proxies: Sequence[str] = ()) -> None:
        self.quota = Quota(max(1, min(most, _file_handles() - SPARE_HANDLES)), "There are too many connections")
        self.seconds = seconds
        #: Called with the kind of problem of every refusal, to count it.
        self.on_refusal: Callable[[str], None] = lambda kind: None
        self._proxies = [ipaddress.ip_network(proxy) for proxy in proxies]
        self._log = RateLimitedLog(logging.getLogger(__name__), logging.WARNING, "refused without a whole request")

    def client(self, address: str) -> str | None:
        """Return the client that a connection counts for; None for the connection of a proxy."""
        with suppress(ValueError):
            if any(ipaddress.ip_address(address) in network for network in self._proxies):
                return None
        return client_name(address)

    def report(self, kind: str, detail: str) -> None:
        """Count and log a refusal."""
        self.on_refusal(kind)
        self._log.event(detail)


def _file_handles() -> int:
    """Return the number of files that this process may open."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return 2**20 if limit == resource.RLIM_INFINITY else limit


class Connection(H11Protocol):
    """One connection within these limits; takes the arguments of uvicorn too."""

    def __init__(self, connections: Connections, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._all, self._counted, self._refused = connections, False, False
        self._client: str | None = None
        # What the client is expected to do, and bytes that it has not read, each since when.
        self._phase: object = None
        self._since = self._unsent_since = time.monotonic()
        self._unsent = self._dropped = 0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection, or refuse it where there are too many."""
        transport.max_size = PARSE_BYTES  # type: ignore[attr-defined]
        super().connection_made(transport)
        self._client = self._all.client(self.client[0] if self.client else "")
        try:
            self._all.quota.take(self._client)
            self._counted = True
        except RefusedError as error:
            self._refuse(error.kind, str(error))

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection out."""
        if self._counted:
            self._all.quota.give_back(self._client)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse data. After an early answer, drop the rest of the request, up to a limit."""
        if self._refused or (self._answered and self.conn.their_state is h11.SEND_BODY):
            self._dropped += len(data)
            if self._dropped > LINGER_BYTES:
                self._end()
                self.flow.pause_reading()
                return
        if not self._refused:
            super().data_received(data)

    def on_response_complete(self) -> None:
        """Go on with the next request."""
        self._dropped = 0
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Refuse bytes that are not HTTP, or a head or trailers without end."""
        if getattr(sys.exception(), "error_status_hint", 0) == KINDS["head-too-large"].status:
            detail = f"The head of the request, or the trailers after its body, are over the limit of {HEAD_BYTES} "
            detail += "bytes. Send less in headers and address; codes go into the body of a POST."
            self._refuse("head-too-large", detail)
        else:
            self._refuse("malformed-request", "The request is not HTTP/1.1 as RFC 9112 has it. Correct its head.")

    def shutdown(self) -> None:
        """Close the connection, after the answer to a running request."""
        if self._refused:
            self.transport.close()
        else:
            super().shutdown()

    def check_timeouts(self, now: float) -> None:
        """Close the connection if its client has been silent for too long, or does not read its answer."""
        phase = (self.conn.their_state, self.cycle)
        if self._refused or phase != self._phase or self.flow.read_paused:  # when paused, the server is slow
            self._phase, self._since = phase, now
        elif self.conn.their_state is h11.SEND_BODY and now - self._since > self._all.seconds:
            self._refuse("request-timeout", f"The body took over {self._all.seconds:g} s. Send it faster, or less.")
        elif self.conn.their_state is h11.IDLE and now - self._since > HEAD_SECONDS:
            if self.conn.trailing_data[0]:
                detail = f"The head of the request took over {HEAD_SECONDS:g} s. Send it again."
                self._refuse("request-timeout", detail)
            elif self.timeout_keep_alive_task is None:  # else it has IDLE_SECONDS
                self.transport.close()
        unsent = self.transport.get_write_buffer_size()
        if unsent != self._unsent:
            self._unsent, self._unsent_since = unsent, now
        elif unsent and now - self._unsent_since > STALL_SECONDS:
            self.transport.abort()

    @property
    def _answered(self) -> bool:
        return self.cycle is not None and self.cycle.response_complete

    def _unsupported_upgrade_warning(self) -> None:
        """Say nothing: curl and Java offer HTTP/2 with every request, and a server may ignore that."""

    def _refuse(self, kind: str, detail: str) -> None:
        self._all.report(kind, detail)
        self._refused = True
        if self.cycle is not None and not self.cycle.response_complete:
            self.cycle.disconnected = True  # the route learns that its client waits no more
            self.cycle.message_event.set()
        crowd = len(self.connections) > self._all.quota.limit + SPARE_HANDLES // 2
        if self.conn.our_state not in {h11.IDLE, h11.SEND_RESPONSE} or crowd:
            self.transport.abort()
            return
        body, headers = description(kind, detail)
        headers |= {"Content-Type": MEDIA_TYPE, "Content-Length": str(len(body)), "Connection": "close"}
        headers |= {"X-Request-ID": uuid4().hex, "X-Content-Type-Options": "nosniff"}
        status = KINDS[kind].status
        head = h11.Response(status_code=status, headers=[*headers.items()], reason=STATUS_PHRASES[status])
        with suppress(h11.LocalProtocolError):  # HEAD has no body
            for event in (head, h11.Data(data=body), h11.EndOfMessage()):
                self.transport.write(self.conn.send(event) or b"")
        self._end()
        self.flow.resume_reading()

    def _end(self) -> None:
        """Close the connection in a moment; closing at once could take an answer from a client that still sends."""
        self.transport.write_eof()
        self.loop.call_later(LINGER_SECONDS, self.transport.abort)
