"""The listening socket of the server."""

from __future__ import annotations

import errno
import logging
import os
import socket
from contextlib import suppress
from typing import Any, Self

from shapespace.service.logs import RateLimitedLog

logger = logging.getLogger(__name__)
#: Errors of an address that the machine does not have, as `localhost` by IPv6 in a container without IPv6.
_NO_SUCH_ADDRESS = frozenset({errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL})
_OUT_OF_HANDLES = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


class Listener(socket.socket):
    """A listening socket that closes waiting connections when file handles run out.

    asyncio would log a traceback and set a timer for each waiting connection, again and again: 2000 lines a second,
    while the connections wait in vain. This socket keeps one file handle in reserve. With it, it accepts and closes
    one connection after the other, and logs at most one line a second.
    """

    _spare = -1
    _log: RateLimitedLog

    @classmethod
    def bound(cls, host: str, port: int) -> list[Self]:
        """Return sockets for every address of a host that this machine has; raises OSError if it has none."""
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
        text = "out of file handles: a connection is closed unanswered"
        listener._log = RateLimitedLog(logger, logging.ERROR, text)
        return listener

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection; raises BlockingIOError if there is none, or no file handle for it."""
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
        self._log.event()
        raise BlockingIOError
