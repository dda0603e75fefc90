"""Connections within limits: how many there are, how long a head may be, and how long a client may be silent.

Uvicorn leaves these to a proxy. What is refused here gets a problem like every other answer.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import logging
import os
import socket
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum, auto
from typing import Any, Self
from uuid import uuid4

from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from shapespace.service.http.problems import KINDS, MEDIA_TYPE, description
from shapespace.service.limits.quota import Quota, QuotaError, client_name

logger = logging.getLogger(__name__)

#: Longest head of a request, or trailers, in bytes and lines; other servers have 8 to 64 KiB.
HEAD_BYTES, HEAD_LINES = 32 * 2**10, 100
#: Pipelined requests that are parsed ahead on one connection, and bytes that may wait behind them.
PIPELINED, WAITING_BYTES = 32, 2**20
#: Bytes given to the parser at once; a head may exceed its limit by as much.
PIECE = 8 * 2**10
#: Seconds within which a client has to send a whole head, and to accept at least a part of what is written to it.
HEAD_SECONDS, STALL_SECONDS = 10.0, 30.0
#: Bytes that the kernel may buffer unsent for one connection; by default it buffers megabytes.
UNSENT = 128 * 2**10
#: Seconds between two checks of all connections.
SWEEP_SECONDS = 1.0
#: Seconds after a refusal during which further bytes are read and dropped: closing at once could lose the answer.
LINGER_SECONDS = 1.0
#: File handles that are reserved for other uses than connections.
SPARE_HANDLES = 100
#: Least number of seconds between two equal log lines.
LOG_SECONDS = 1.0
#: Errors of an address that the machine doesn't have, as `localhost` by IPv6 in a container without it.
_NO_SUCH_ADDRESS = frozenset({errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL})
_OUT_OF_HANDLES = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class _RareLine:
    """A line of the log that many events share, once in LOG_SECONDS at most."""

    def __init__(self, level: int, text: str) -> None:
        self._level, self._text = level, text
        self._events, self._next = 0, 0.0

    def __call__(self) -> None:
        self._events += 1
        now = time.monotonic()
        if now >= self._next:
            logger.log(self._level, "%s (%d × since the last such line)", self._text, self._events)
            self._events, self._next = 0, now + LOG_SECONDS


class Connections:
    """All connections of a server.

    Args:
        most: of them at once; file handles may allow fewer.
        seconds: that a request's body may take.
        proxies: networks of proxies, whose connections belong to many clients.
    """

    def __init__(self, most: int, seconds: float, proxies: Sequence[str] = ()) -> None:
        self.quota, self.seconds = Quota(max(1, min(most, _file_handles() - SPARE_HANDLES))), seconds
        self._proxies = [ipaddress.ip_network(proxy) for proxy in proxies]
        self._open: set[Connection] = set()
        #: Told the kind of every refusal, for somebody to count them.
        self.refused: Callable[[str], None] = lambda kind: None
        self._lines: dict[str, _RareLine] = {}

    def name(self, address: str) -> str | None:
        """Whom a connection counts for; nobody in particular where it is a proxy's."""
        try:
            parsed = ipaddress.ip_address(address)
        except ValueError:
            return address
        return None if any(parsed in network for network in self._proxies) else client_name(address)

    def enter(self, connection: Connection, client: str | None) -> bool:
        """Count a connection in, if there is room for it."""
        try:
            self.quota.take(client)
        except QuotaError:
            return False
        self._open.add(connection)
        return True

    def leave(self, connection: Connection, client: str | None) -> None:
        """Count it out."""
        if connection in self._open:
            self._open.remove(connection)
            self.quota.give_back(client)

    def tell(self, kind: str, detail: str) -> None:
        """Count and log a refusal."""
        self.refused(kind)
        self._lines.setdefault(kind, _RareLine(logging.WARNING, f"refused without a whole request: {detail}"))()

    async def sweep(self) -> None:
        """End, again and again, what has been silent for too long."""
        while True:
            await asyncio.sleep(SWEEP_SECONDS)
            now = time.monotonic()
            for connection in tuple(self._open):
                connection.look(now)


def _file_handles() -> int:
    """How many files this process may have open."""
    if sys.platform == "win32":
        return 2**20
    import resource

    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return 2**20 if limit == resource.RLIM_INFINITY else limit


class _Phase(Enum):
    """What a connection waits for."""

    REQUEST = auto()
    HEAD = auto()
    BODY = auto()


class Connection(HttpToolsProtocol):
    """One connection.

    Args:
        connections: it is one of these.
        arguments: uvicorn's own.
    """

    def __init__(self, connections: Connections, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._all, self._refused = connections, False
        self._name: str | None = None
        self._phase, self._since = _Phase.HEAD, time.monotonic()
        # Bytes that were neither a body's nor the end of anything; lines of the head and the trailers together.
        self._bytes, self._lines = 0, 0
        self._unsent, self._unsent_since = 0, 0.0
        self._waiting = b""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin, unless there are too many."""
        super().connection_made(transport)
        if hasattr(socket, "TCP_NOTSENT_LOWAT"):
            with suppress(OSError):
                transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT)
        self._name = self._all.name(self.client[0] if self.client else "")
        if not self._all.enter(self, self._name):
            self._refuse("busy", "There are too many connections. Try again after the time in Retry-After.")

    def connection_lost(self, exc: Exception | None) -> None:
        """End."""
        self._all.leave(self, self._name)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse a piece at a time, and give up on heads and trailers without end."""
        if self._phase is _Phase.REQUEST:
            self._enter(_Phase.HEAD)
        if self._waiting:
            data, self._waiting = self._waiting + data, b""
        for start in range(0, len(data), PIECE):
            if self._refused or self.transport.is_closing():
                return
            if len(self.pipeline) >= PIPELINED:
                self._wait(data[start:])
                return
            piece = data[start : start + PIECE]
            self._bytes += len(piece)
            super().data_received(piece)
            if not self._refused and (self._bytes > HEAD_BYTES or self._lines > HEAD_LINES):
                self._refuse(
                    "head-too-large",
                    f"The head of the request, or the trailers after its body, are over the limit of {HEAD_BYTES} "
                    f"bytes or {HEAD_LINES} lines. Send less in headers and address; codes go into the body of a POST.",
                )

    def on_response_complete(self) -> None:
        """Go on with the next request, and with what waits to be parsed."""
        super().on_response_complete()
        if self._waiting and not self.transport.is_closing():
            self.data_received(b"")

    def on_message_begin(self) -> None:
        """A request begins."""
        super().on_message_begin()
        self._lines = 0
        if self._phase is _Phase.REQUEST:  # in one piece with the last one
            self._enter(_Phase.HEAD)

    def on_header(self, name: bytes, value: bytes) -> None:
        """A line of the head. Trailers are counted and dropped: nothing here needs any."""
        self._lines += 1
        if self._phase is _Phase.HEAD and self._lines <= HEAD_LINES:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """The head is over."""
        self._enter(_Phase.BODY)
        if self._lines <= HEAD_LINES:
            super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """A part of the body."""
        self._bytes = 0
        if self._lines <= HEAD_LINES:
            super().on_body(body)

    def on_message_complete(self) -> None:
        """The request is over."""
        self._enter(_Phase.REQUEST)
        if self._lines <= HEAD_LINES:
            super().on_message_complete()

    def send_400_response(self, msg: str) -> None:
        """Refuse what isn't HTTP."""
        self._refuse("malformed-request", "The request is not HTTP/1.1 as RFC 9112 has it. Correct its head.")

    def look(self, now: float) -> None:
        """Give up on a client that has been silent for too long, or takes nothing of its answer."""
        if self._refused:
            return
        waited = now - self._since
        answering = self.cycle is not None and not self.cycle.response_complete
        if self.flow.read_paused or (answering and self._phase is _Phase.HEAD):  # it is the server that takes its time
            self._since = now
        elif self._phase is _Phase.HEAD and waited > HEAD_SECONDS:
            if self._bytes:
                self._refuse("request-timeout", f"The head of the request took over {HEAD_SECONDS:g} s. Send it again.")
            else:
                self.transport.close()
        elif self._phase is _Phase.BODY and waited > self._all.seconds:
            self._refuse("request-timeout", f"The body took over {self._all.seconds:g} s. Send it faster, or less.")
        unsent = self.transport.get_write_buffer_size()
        if unsent != self._unsent:
            self._unsent, self._unsent_since = unsent, now
        elif unsent and now - self._unsent_since > STALL_SECONDS:
            self.transport.abort()

    def _enter(self, phase: _Phase) -> None:
        self._phase, self._since, self._bytes = phase, time.monotonic(), 0

    def _wait(self, data: bytes) -> None:
        """Parse the rest once some of the requests before it have been answered."""
        self.flow.pause_reading()
        self._waiting = data
        if len(data) > WAITING_BYTES:
            self._break_off()

    def _break_off(self) -> None:
        self._refused = True
        self.pipeline.clear()
        self.transport.close()

    def _refuse(self, kind: str, detail: str) -> None:
        self._all.tell(kind, detail)
        if self.pipeline:  # an answer to an earlier request is under way, and this one would stand in its midst
            self._break_off()
            return
        self._refused = True
        if (cycle := self.cycle) is not None and not cycle.response_complete:
            cycle.disconnected = True  # whoever works on it learns that nobody waits
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


class Listener(socket.socket):
    """A listening socket that copes where file handles run out.

    asyncio would log a traceback and set a timer for each of the connections that wait, again and again (2000 lines
    in a second), while these wait in vain. Here they are closed, one at a time, by means of a handle kept for that,
    and one line a second says so.
    """

    _spare = -1

    @classmethod
    def bound(cls, host: str, port: int) -> list[Self]:
        """Sockets for every address of a host that this machine has; raises OSError where it has none."""
        found = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        listeners: list[Self] = []
        missing: OSError | None = None
        try:
            for family, kind, protocol, _, address in dict.fromkeys(found):
                try:
                    listeners.append(cls._bound(family, kind, protocol, address))
                except OSError as error:
                    if error.errno not in _NO_SUCH_ADDRESS:
                        raise
                    missing = error
        except BaseException:
            for listener in listeners:
                listener.close()
            raise
        if missing and not listeners:
            raise missing
        return listeners

    @classmethod
    def _bound(cls, family: int, kind: int, protocol: int, address: Any) -> Self:
        listener = cls(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if family == socket.AF_INET6:
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            listener.bind(address)
        except BaseException:
            listener.close()
            raise
        listener._spare = os.open(os.devnull, os.O_RDONLY)
        listener._shed = _RareLine(logging.ERROR, "out of file handles: a connection is closed unanswered")
        return listener

    _shed: _RareLine

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection; raises BlockingIOError where there is none, or no handle for it."""
        try:
            return super().accept()
        except OSError as error:
            if error.errno not in _OUT_OF_HANDLES:
                raise
        if self._spare >= 0:
            os.close(self._spare)
        with suppress(OSError):
            super().accept()[0].close()
        try:
            self._spare = os.open(os.devnull, os.O_RDONLY)
        except OSError:
            self._spare = -1
        self._shed()
        raise BlockingIOError
