"""Uvicorn with reloads, and with a shutdown that loses no request."""

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

from shapespace.service.http.connections import Connection
from shapespace.service.http.listener import Listener
from shapespace.service.operation.metrics_port import MetricsPort
from shapespace.service.settings import Settings

logger = logging.getLogger(__name__)
#: Exit status of a process that could not start, as in uvicorn.
STARTUP_FAILURE = 3
#: A classic BPF program (code, jt, jf, k) that drops TCP segments with SYN, and its socket option on Linux.
_DROP_SYN = ((0x30, 0, 0, 13), (0x45, 0, 1, 0x02), (0x06, 0, 0, 0), (0x06, 0, 0, 0xFFFFFFFF))
_SO_ATTACH_FILTER = 26


#: Seconds from the end of the drain in which requests on open connections are still accepted, after which running
#: requests get 503, and after which the process ends, whatever it does.
LINGER, FINISH, EXIT = 1.0, 1.5, 2.3


class Server(uvicorn.Server):
    """The server process of an application.

    On SIGTERM, uvicorn alone closes its port and all idle connections at once, although a client may be sending
    (uvicorn#2414). This server shuts down in steps:

    1. During the drain it answers everything. Readiness is 503, and each answer is the last of its connection.
    2. It takes no new connections, and closes open ones once they are silent.
    3. Running requests get a moment to finish, and 503 after that. Then the process ends.

    SIGHUP reloads the models.
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
        """Begin to listen, and print the address."""
        host, port, metrics_port = self._settings.host, self._settings.port, self._settings.metrics_port
        try:
            listeners = Listener.bound(host, port)
            metrics = None
            if metrics_port is not None:
                port = metrics_port
                metrics = MetricsPort(host, port)
        except OSError as error:
            logger.error("can't listen on %s, port %d: %s", host, port, error.strerror)
            raise SystemExit(STARTUP_FAILURE) from None
        await super().startup(sockets=list(listeners))
        if metrics:
            metrics.serve(self._app.state.service.metrics.registry)
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._hang_up)
        # Port 0 lets the system choose one.
        host, port = self.servers[0].sockets[0].getsockname()[:2]
        host = f"[{host}]" if ":" in host else host
        print(f"shapespace is at http://{host}:{port}/", flush=True)

    def _hang_up(self) -> None:
        if self._terminal and not sys.stdin.isatty():  # the terminal was closed, which is no request to reload
            self.handle_exit(signal.SIGINT, None)
            return
        task = asyncio.ensure_future(self._app.state.service.reloader.reload())
        self._reloads.add(task)
        task.add_done_callback(self._reloads.discard)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin the shutdown; a second signal ends the drain."""
        if not self.started:
            os._exit(0)  # nothing is served yet, and loading models may take long
        super().handle_exit(sig, frame)
        self._signals.append(sig)
        self._app.state.service.draining = True
        drain = self._settings.drain if sig == signal.SIGTERM and len(self._signals) == 1 else 0.0
        leave = threading.Timer(drain + EXIT, os._exit, [0])
        leave.daemon = True
        leave.start()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Drain, then let running requests finish."""
        loop = asyncio.get_running_loop()
        # SIGINT comes from a person, who does not want to wait.
        drained = loop.time() if signal.SIGINT in self._signals else await self._drain()
        loop.call_at(drained + FINISH, self._app.state.service.workers.end)
        await super().shutdown(sockets)

    def _connection(self, **arguments: Any) -> Connection:
        return Connection(self._app.state.service.connections, **arguments)

    async def _drain(self) -> float:
        """Wait for the end of the drain and then for silent connections. Return the time at which the drain ended."""
        logger.info("no longer ready, and still answering for %g s", self._settings.drain)
        time = asyncio.get_running_loop().time
        end = time() + self._settings.drain
        while time() < end and len(self._signals) < 2:
            await asyncio.sleep(0.05)
        drained = time()
        for server in self.servers:
            for listener in server.sockets:
                _drop_new_connections(listener)
        await asyncio.sleep(0.05)  # connections that are being opened are still accepted
        while self.server_state.connections and time() < drained + LINGER:
            await asyncio.sleep(0.05)
        return drained


def _drop_new_connections(listener: socket.socket) -> None:
    """Let no new connection begin, while connections that have begun can still be accepted.

    Closing the port would reset connections that the system has made and the program has not accepted yet. Their
    clients would lose a request, even behind a proxy, which must not send a POST twice. Once SYN segments are dropped,
    no further connections are made. A client that tries again after a second finds the port closed. A last ``accept``
    before ``close`` is no substitute, because a connection can arrive between the two. Only Linux has this filter.
    """
    instructions = array("B", b"".join(struct.pack("HBBI", *instruction) for instruction in _DROP_SYN))
    address, _ = instructions.buffer_info()
    program = struct.pack("HP", len(_DROP_SYN), address)
    try:
        listener.setsockopt(socket.SOL_SOCKET, _SO_ATTACH_FILTER, program)
    except OSError as error:
        logger.debug("the port is closed without a filter: %s", error)
