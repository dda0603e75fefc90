"""Connections within limits: their number, the size of heads, and the time that a client may stay silent.

Uvicorn leaves these limits to a proxy. A refusal here is a problem like every other error.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
import resource
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum, auto
from typing import Any
from uuid import uuid4

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from shapespace.service.http.problems import KINDS, MEDIA_TYPE, description
from shapespace.service.limits.quota import Quota, QuotaError, client_name
from shapespace.service.logs import RateLimitedLog

logger = logging.getLogger(__name__)

#: File handles that are reserved for other uses than connections.
SPARE_HANDLES = 100
#: Seconds between two checks of all connections for timeouts.
CHECK_INTERVAL = 1.0


#: Most bytes and lines of a request's head, and of its trailers; other servers have 8 to 64 KiB.
HEAD_BYTES, HEAD_LINES = 32 * 2**10, 100
#: Bytes given to the parser at once; a head may exceed its limit by this much.
PARSE_BYTES = 8 * 2**10
#: Pipelined requests that are parsed ahead of their answers, and most bytes that may wait behind them.
PIPELINED, WAITING_BYTES = 32, 2**20
#: Seconds in which a client has to send a whole head, and in which it has to read at least a part of its answer.
HEAD_SECONDS, STALL_SECONDS = 10.0, 30.0
#: Bytes that the kernel may buffer unsent; its default is megabytes.
UNSENT_BYTES = 128 * 2**10
#: Seconds after a refusal in which further bytes are read and dropped: closing at once could lose the answer.
LINGER_SECONDS = 1.0


class Connections:
    """All connections of a server.

    Args:
        most: limit on the number of connections; file handles may allow fewer.
        seconds: time that the body of a request may take.
        proxies: networks of proxies, whose connections belong to many clients.
    """

    def __init__(self, most: int, seconds: float, proxies: Sequence[str] = ()) -> None:
        self.quota, self.seconds = Quota(max(1, min(most, _file_handles() - SPARE_HANDLES))), seconds
        #: Called with the kind of problem of every refusal, to count it.
        self.on_refusal: Callable[[str], None] = lambda kind: None
        self._proxies = [ipaddress.ip_network(proxy) for proxy in proxies]
        self._open: set[Connection] = set()
        self._logs: dict[str, RateLimitedLog] = {}

    def client(self, address: str) -> str | None:
        """Return the client that a connection counts for; None for the connection of a proxy."""
        try:
            parsed = ipaddress.ip_address(address)
        except ValueError:
            return address
        return None if any(parsed in network for network in self._proxies) else client_name(address)

    def add(self, connection: Connection, client: str | None) -> bool:
        """Count a connection in, and return whether there is room for it."""
        try:
            self.quota.take(client)
        except QuotaError:
            return False
        self._open.add(connection)
        return True

    def remove(self, connection: Connection, client: str | None) -> None:
        """Count a connection out."""
        if connection in self._open:
            self._open.remove(connection)
            self.quota.give_back(client)

    def report(self, kind: str, detail: str) -> None:
        """Count and log a refusal."""
        self.on_refusal(kind)
        if kind not in self._logs:
            self._logs[kind] = RateLimitedLog(logger, logging.WARNING, f"refused without a whole request: {detail}")
        self._logs[kind].event()

    async def check_timeouts(self) -> None:
        """Close connections that have been silent for too long; runs until it is cancelled."""
        while True:
            await asyncio.sleep(CHECK_INTERVAL)
            now = time.monotonic()
            for connection in tuple(self._open):
                connection.check_timeouts(now)


def _file_handles() -> int:
    """Return the number of files that this process may open."""
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return 2**20 if limit == resource.RLIM_INFINITY else limit


class _Phase(Enum):
    REQUEST = auto()
    HEAD = auto()
    BODY = auto()


class Connection(HttpToolsProtocol):
    """One connection within these limits; takes the arguments of uvicorn too."""

    def __init__(self, connections: Connections, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._all, self._refused = connections, False
        self._client: str | None = None
        self._phase, self._since = _Phase.HEAD, time.monotonic()
        # Bytes since the last part of a body or the last change of phase; lines of the head and the trailers.
        self._bytes, self._lines = 0, 0
        self._unsent, self._unsent_since = 0, 0.0
        self._waiting = b""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection, or refuse it where there are too many."""
        super().connection_made(transport)
        if hasattr(socket, "TCP_NOTSENT_LOWAT"):
            with suppress(OSError):
                own = transport.get_extra_info("socket")
                own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        self._client = self._all.client(self.client[0] if self.client else "")
        if not self._all.add(self, self._client):
            self._refuse("busy", "There are too many connections. Try again after the time in Retry-After.")

    def connection_lost(self, exc: Exception | None) -> None:
        """Count the connection out."""
        self._all.remove(self, self._client)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse data piece by piece, and refuse heads and trailers without end."""
        if self._phase is _Phase.REQUEST:
            self._begin(_Phase.HEAD)
        if self._waiting:
            data, self._waiting = self._waiting + data, b""
        for start in range(0, len(data), PARSE_BYTES):
            if self._refused or self.transport.is_closing():
                return
            if len(self.pipeline) >= PIPELINED:
                self._postpone(data[start:])
                return
            piece = data[start : start + PARSE_BYTES]
            self._bytes += len(piece)
            super().data_received(piece)
            if not self._refused and (self._bytes > HEAD_BYTES or self._lines > HEAD_LINES):
                self._refuse(
                    "head-too-large",
                    "The head of the request, or the trailers after its body, are over the limit of "
                    f"{HEAD_BYTES} bytes or {HEAD_LINES} lines. Send less in headers and address; "
                    "codes go into the body of a POST.",
                )

    def on_response_complete(self) -> None:
        """Go on with the next request, and parse the bytes that wait."""
        super().on_response_complete()
        if self._waiting and not self.transport.is_closing():
            self.data_received(b"")

    def on_message_begin(self) -> None:
        """Begin a request."""
        super().on_message_begin()
        self._lines = 0
        if self._phase is _Phase.REQUEST:  # its bytes came together with the last request
            self._begin(_Phase.HEAD)

    def on_header(self, name: bytes, value: bytes) -> None:
        """Take a line of the head. Trailers are counted and dropped: the server needs none."""
        self._lines += 1
        if self._phase is _Phase.HEAD and self._lines <= HEAD_LINES:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """End the head."""
        self._begin(_Phase.BODY)
        if self._lines <= HEAD_LINES:
            super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Take a part of the body."""
        self._bytes = 0
        if self._lines <= HEAD_LINES:
            super().on_body(body)

    def on_message_complete(self) -> None:
        """End the request."""
        self._begin(_Phase.REQUEST)
        if self._lines <= HEAD_LINES:
            super().on_message_complete()

    def send_400_response(self, msg: str) -> None:
        """Refuse bytes that are not HTTP."""
        self._refuse("malformed-request", "The request is not HTTP/1.1 as RFC 9112 has it. Correct its head.")

    def check_timeouts(self, now: float) -> None:
        """Close the connection if its client has been silent for too long, or does not read its answer."""
        if self._refused:
            return
        waited = now - self._since
        answering = self.cycle is not None and not self.cycle.response_complete
        if self.flow.read_paused or (answering and self._phase is _Phase.HEAD):  # the server is slow, not the client
            self._since = now
        elif self._phase is _Phase.HEAD and waited > HEAD_SECONDS:
            if self._bytes:
                detail = f"The head of the request took over {HEAD_SECONDS:g} s. Send it again."
                self._refuse("request-timeout", detail)
            else:
                self.transport.close()
        elif self._phase is _Phase.BODY and waited > self._all.seconds:
            self._refuse("request-timeout", f"The body took over {self._all.seconds:g} s. Send it faster, or less.")
        unsent = self.transport.get_write_buffer_size()
        if unsent != self._unsent:
            self._unsent, self._unsent_since = unsent, now
        elif unsent and now - self._unsent_since > STALL_SECONDS:
            self.transport.abort()

    def _begin(self, phase: _Phase) -> None:
        self._phase, self._since, self._bytes = phase, time.monotonic(), 0

    def _postpone(self, data: bytes) -> None:
        """Keep data to parse it once some earlier requests have been answered."""
        self.flow.pause_reading()
        self._waiting = data
        if len(data) > WAITING_BYTES:
            self._drop()

    def _drop(self) -> None:
        self._refused = True
        self.pipeline.clear()
        self.transport.close()

    def _refuse(self, kind: str, detail: str) -> None:
        self._all.report(kind, detail)
        if self.pipeline:  # the refusal would stand inside the answer to an earlier request
            self._drop()
            return
        self._refused = True
        if (cycle := self.cycle) is not None and not cycle.response_complete:
            cycle.disconnected = True  # the route learns that its client waits no more
            cycle.message_event.set()
            if cycle.response_started:
                self.transport.abort()
                return
        body, headers = description(kind, detail)
        headers |= {"Content-Type": MEDIA_TYPE, "Content-Length": str(len(body)), "Connection": "close"}
        headers |= {"X-Request-ID": uuid4().hex, "X-Content-Type-Options": "nosniff"}
        lines = b"".join(f"{name}: {value}\r\n".encode() for name, value in headers.items())
        self.transport.write(STATUS_LINE[KINDS[kind].status] + lines + b"\r\n" + body)
        self.transport.write_eof()
        self.flow.resume_reading()
        self.loop.call_later(LINGER_SECONDS, self.transport.abort)
