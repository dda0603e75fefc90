"""Uvicorn with a reload, and with an end that loses nothing."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import socket
import struct
import sys
import threading
from array import array
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI

from shapespace.service.http.connections import Connection, Listener
from shapespace.service.settings import Settings

logger = logging.getLogger(__name__)
#: Seconds from the end of the drain: until when requests on open connections are still accepted, until when running
#: ones have to finish, and until when the process ends.
LINGER, FINISH, GONE = 1.0, 1.5, 2.3
#: Status of a process that could not start; uvicorn's own.
STARTUP_FAILURE = 3
#: A classic BPF program (code, jt, jf, k) that drops TCP segments with SYN, and its socket option on Linux.
_DROP_SYN = ((0x30, 0, 0, 13), (0x45, 0, 1, 0x02), (0x06, 0, 0, 0), (0x06, 0, 0, 0xFFFFFFFF))
_SO_ATTACH_FILTER = 26


class Server(uvicorn.Server):
    """The server process of an application.

    Uvicorn alone closes its port and every connection between two requests at once, in the face of whoever is
    sending (uvicorn#2414). Here SIGTERM first makes readiness 503 and each answer the last of its connection, while
    everything is still answered; after a time no new connections are taken; and the old ones are closed when they
    have been silent. What runs then gets a moment, and a 503 after that: whatever anything is busy with, the process
    ends. SIGHUP reloads the models.
    """

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        super().__init__(
            uvicorn.Config(
                app,
                http=self._connection,  # type: ignore[arg-type]
                ws="none",
                loop="asyncio",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=bool(settings.trusted_proxies),
                forwarded_allow_ips=list(settings.trusted_proxies),
                timeout_graceful_shutdown=1,
            )
        )
        self._app, self._settings = app, settings
        self._reloads: set[asyncio.Task[None]] = set()
        self._signals: list[int] = []
        self._terminal = sys.stdin is not None and sys.stdin.isatty()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to listen, and say where."""
        try:
            listeners = Listener.bound(self._settings.host, self._settings.port)
        except OSError as error:
            logger.error("can't listen on %s, port %d: %s", self._settings.host, self._settings.port, error.strerror)
            raise SystemExit(STARTUP_FAILURE) from None
        await super().startup(sockets=list(listeners))
        if hasattr(signal, "SIGHUP"):
            asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._hang_up)
        # The port may have been left to the system.
        host, port = self.servers[0].sockets[0].getsockname()[:2]
        host = f"[{host}]" if ":" in host else host
        print(f"shapespace is at http://{host}:{port}/", flush=True)

    def _hang_up(self) -> None:
        if self._terminal and not sys.stdin.isatty():  # the terminal was closed: nobody asks for a reload
            self.handle_exit(signal.SIGINT, None)
            return
        task = asyncio.ensure_future(self._app.state.service.reloader.reload())
        self._reloads.add(task)
        task.add_done_callback(self._reloads.discard)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin the end; the second time, hurry."""
        if not self.started:
            os._exit(0)  # nothing has begun, and what loads models may take its time
        super().handle_exit(sig, frame)
        self._signals.append(sig)
        self._app.state.service.draining = True
        drain = self._settings.drain if sig == signal.SIGTERM and len(self._signals) == 1 else 0.0
        leave = threading.Timer(drain + GONE, os._exit, [0])
        leave.daemon = True
        leave.start()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain, then finish what runs."""
        loop = asyncio.get_running_loop()
        # A person doesn't want to wait.
        drained = loop.time() if signal.SIGINT in self._signals else await self._drain()
        loop.call_at(drained + FINISH, self._app.state.service.workers.end)
        await super().shutdown(sockets)

    def _connection(self, **arguments: Any) -> Connection:
        return Connection(self._app.state.service.connections, **arguments)

    async def _drain(self) -> float:
        """Wait for the end of the drain and for the last requests of open connections; gives the first of the two."""
        logger.info("no longer ready, and still answering for %g s", self._settings.drain)
        time = asyncio.get_running_loop().time
        end = time() + self._settings.drain
        while time() < end and len(self._signals) < 2:
            await asyncio.sleep(0.05)
        drained = time()
        for server in self.servers:
            for listener in server.sockets:
                _drop_new_connections(listener)
        await asyncio.sleep(0.05)  # whoever was half-way through is accepted
        while self.server_state.connections and time() < drained + LINGER:
            await asyncio.sleep(0.05)
        return drained


def _drop_new_connections(listener: socket.socket) -> None:
    """Let no further connection begin, and those that have begun be accepted.

    Closing the port resets the connections that the system has made and the program not yet accepted: their clients
    would lose a request, also behind a proxy, which must not send a POST twice. With SYN segments dropped none are
    made any more, and a client that tries finds the port closed when it tries again after a second. A last ``accept``
    before ``close`` is no substitute: between the two other threads run. Systems other than Linux do without.
    """
    instructions = array("B", b"".join(struct.pack("HBBI", *instruction) for instruction in _DROP_SYN))
    address, _ = instructions.buffer_info()
    program = struct.pack("HP", len(_DROP_SYN), address)
    try:
        listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
    except OSError as error:
        logger.debug("the port is closed without a filter: %s", error)
