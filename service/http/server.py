"""Uvicorn with reloads, and with a shutdown that loses no request."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import signal
import socket
import sys
import threading
import time
from contextlib import suppress
from functools import partial
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from prometheus_client import start_http_server

from shapespace.service.http.connections import HEAD_BYTES, IDLE_SECONDS, Connection
from shapespace.service.logs import RateLimitedLog
from shapespace.service.repository.repository import ModelRepository
from shapespace.service.settings import PREFIX, Settings

logger = logging.getLogger(__name__)
#: Exit status of a process that could not start, as in uvicorn.
STARTUP_FAILURE = 3
#: Errors of an address that the machine does not have, as `localhost` by IPv6 in a container without IPv6.
_NO_SUCH_ADDRESS = frozenset({errno.EAFNOSUPPORT, errno.EADDRNOTAVAIL})
#: What to do about a port that can't be used.
_REMEDIES = {
    errno.EADDRINUSE: "; another program has this port, so stop it or set {setting} to another port",
    errno.EACCES: "; set {setting} to a port from 1024 on",
    errno.EADDRNOTAVAIL: f"; set {PREFIX}HOST to an address of this machine",
}
_OUT_OF_HANDLES = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})
#: Bytes of an answer that the kernel may buffer unsent; its default is megabytes.
UNSENT_BYTES = 128 * 2**10
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
                h11_max_incomplete_event_size=HEAD_BYTES,
                ws="none",
                loop="asyncio",
                log_config=None,
                access_log=False,
                server_header=False,
                proxy_headers=bool(settings.trusted_proxies),
                forwarded_allow_ips=list(settings.trusted_proxies),
                timeout_keep_alive=IDLE_SECONDS,
                timeout_graceful_shutdown=1,
            )
        )
        self._app, self._settings = app, settings
        self._tasks: set[asyncio.Task[Any]] = set()
        self._signals: list[int] = []
        self._listeners: list[socket.socket] = []
        text = "out of file handles, so that new connections wait"
        self._no_handles = RateLimitedLog(logger, logging.ERROR, text)
        self._terminal = sys.stdin is not None and sys.stdin.isatty()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Begin to listen, and print the address."""
        host, port, setting = self._settings.host, self._settings.port, "PORT"
        try:
            self._listeners = _bound(host, port)
            if self._settings.metrics_port is not None:
                port, setting = self._settings.metrics_port, "METRICS_PORT"
                metrics, _ = start_http_server(port, host, self._app.state.metrics)
                logger.info("/metrics is at port %d too, without a key", metrics.server_port)
        except OSError as error:
            why = os.strerror(error.errno) if error.errno in _REMEDIES else error.strerror
            remedy = _REMEDIES.get(error.errno or 0, "").format(setting=f"{PREFIX}{setting}")
            logger.error("can't listen on %s, port %d: %s%s", host, port, why, remedy)
            raise SystemExit(STARTUP_FAILURE) from None
        await super().startup(sockets=self._listeners)
        loop = asyncio.get_running_loop()
        loop.add_signal_handler(signal.SIGHUP, self._hang_up)
        loop.set_exception_handler(self._report)
        # Port 0 lets the system choose one.
        host, port = self._listeners[0].getsockname()[:2]
        host = f"[{host}]" if ":" in host else host
        address = f"http://{host}:{port}"
        print(f"shapespace is at {address}/", flush=True)
        if call := _first_call(address, self._app.state.service.repository, self._settings.api_key is not None):
            print(f"Your first shape, from another terminal: {call}", flush=True)
        else:
            logger.warning(
                "no model is served: %s has no folder NAME/VERSION with a model; %sMODELS_DIR names another folder",
                self._settings.models_dir,
                PREFIX,
            )

    def _hang_up(self) -> None:
        if self._terminal and not sys.stdin.isatty():  # the terminal was closed, which is no request to reload
            self.handle_exit(signal.SIGINT, None)
            return
        task = asyncio.ensure_future(self._app.state.service.reloader.reload())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _report(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in _OUT_OF_HANDLES:  # asyncio tells it thousands of times
            self._no_handles.event()
        elif not (self.should_exit and isinstance(error, ValueError)):  # it tries a port again that is closed by now
            loop.default_exception_handler(context)

    async def on_tick(self, counter: int) -> bool:
        """Look after the connections once a second."""
        if counter % 10 == 0:
            for connection in tuple(self.server_state.connections):
                assert isinstance(connection, Connection)  # noqa: S101 - narrows the type
                connection.check_timeouts(time.monotonic())
        return await super().on_tick(counter)

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
        drained = loop.time() - LINGER if signal.SIGINT in self._signals else await self._drain()
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
        self._close_listeners()
        while self.server_state.connections and time() < drained + LINGER:
            await asyncio.sleep(0.05)
        return drained

    def _close_listeners(self) -> None:
        """Close the port, after a last look for connections that the system has made already.

        Closing resets the connections that the program has not accepted, and so loses their requests.
        """
        make = partial(
            self._connection, config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        loop = asyncio.get_running_loop()
        for listener, server in zip(self._listeners, self.servers, strict=True):
            with suppress(OSError):
                while True:
                    self._tasks.add(loop.create_task(loop.connect_accepted_socket(make, listener.accept()[0])))
            server.close()


def _bound(host: str, port: int) -> list[socket.socket]:
    """Return listening sockets for every address of a host that this machine has; raises OSError if it has none."""
    found = socket.getaddrinfo(host or None, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    listeners: list[socket.socket] = []
    missing: OSError | None = None
    for family, _, _, _, address in dict.fromkeys(found):
        try:
            listener = socket.create_server(address, family=family)
        except OSError as error:
            if error.errno not in _NO_SUCH_ADDRESS:
                raise
            missing = error
            continue
        listener.setblocking(False)
        if hasattr(socket, "TCP_NOTSENT_LOWAT"):
            listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)  # connections inherit it
        listeners.append(listener)
    if missing and not listeners:
        raise missing
    return listeners


def _first_call(address: str, models: ModelRepository, has_key: bool) -> str | None:
    """Return a curl command that saves a shape of the model with the fewest coordinates; None if there is no model."""
    if not len(models):
        return None
    model = min(models, key=lambda model: model.dimension)
    name = model.manifest.name
    code = ",".join(f"{(3 * low + 5 * high) / 8:.2g}" for low, high in zip(model.lower, model.upper, strict=True))
    key = ' -H "X-API-Key: $SHAPESPACE_API_KEY"' if has_key else ""
    return f"curl -o {name}.glb{key} '{address}/v1/models/{name}/mesh?latent={code}'"
