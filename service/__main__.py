"""``shapespace-serve``: the server as a command, set up by environment variables ``SHAPESPACE_*``."""

from __future__ import annotations

import asyncio
import logging
import signal
import socket
import sys
import time
from types import FrameType

import uvicorn
from fastapi import FastAPI
from pydantic import ValidationError

from service import logs
from service.app import create_app
from service.settings import PREFIX, Settings, unknown_variables

logger = logging.getLogger(__name__)
#: Seconds for a client to send the request for which it has opened a connection or kept one open.
LINGER = 1.0


class _Server(uvicorn.Server):
    """Uvicorn with a reload, and with an end that loses nothing.

    Uvicorn alone closes its port and every connection between two requests at once, in the face of whoever is
    sending. Here SIGTERM first makes readiness 503 and each answer the last of its connection, while everything
    is still answered; after a time the port is closed; and connections are closed when they have been silent.
    """

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        # What then still runs has had its deadline.
        timeout = round(settings.deadline) + 1
        super().__init__(
            uvicorn.Config(
                app,
                host=settings.host,
                port=settings.port,
                log_config=None,
                access_log=False,
                server_header=False,
                timeout_graceful_shutdown=timeout,
            )
        )
        self._app, self._settings = app, settings
        self._reloads: set[asyncio.Task[None]] = set()
        self._terminal = sys.stdin is not None and sys.stdin.isatty()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        if not self.started:
            return
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
        super().handle_exit(sig, frame)
        if self.started:
            self._app.state.service.draining = True

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        if signal.SIGINT not in self._captured_signals:  # a person doesn't want to wait
            await self._drain()
        await super().shutdown(sockets)

    async def _drain(self) -> None:
        logger.info("no longer ready, still answering for %g s", self._settings.drain)
        end = time.monotonic() + self._settings.drain
        while time.monotonic() < end and len(self._captured_signals) < 2:
            await asyncio.sleep(0.05)
        for server in self.servers:
            server.close()
        end = time.monotonic() + LINGER
        while self.server_state.connections and time.monotonic() < end:
            await asyncio.sleep(0.05)


def main() -> None:
    """Serve until SIGTERM or SIGINT; running requests are finished."""
    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors():
            print(f"{PREFIX}{str(fault['loc'][0]).upper()}: {fault['msg']}", file=sys.stderr)
        raise SystemExit(2) from None
    logs.configure(settings.log_format)
    for name in unknown_variables():
        logger.warning("%s is no setting: the README lists those there are", name)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until the server can reload
    # Uvicorn raises the signal once more when everything is finished: that is a success.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(0))
    _Server(create_app(settings), settings).run()


if __name__ == "__main__":
    main()
