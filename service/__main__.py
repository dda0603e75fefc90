"""``shapespace-serve``: the server as a command, set up by environment variables ``SHAPESPACE_*``."""

from __future__ import annotations

import logging
import signal
import socket
import sys

import uvicorn
from pydantic import ValidationError

from service.app import create_app
from service.settings import Settings


class _Server(uvicorn.Server):
    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=sockets)
        if self.started:
            # The port may have been left to the system.
            host, port = self.servers[0].sockets[0].getsockname()[:2]
            host = f"[{host}]" if ":" in host else host
            print(f"shapespace is at http://{host}:{port}/", flush=True)


def main() -> None:
    """Serve until SIGTERM or SIGINT; running requests are finished."""
    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors():
            print(f"SHAPESPACE_{str(fault['loc'][0]).upper()}: {fault['msg']}", file=sys.stderr)
        raise SystemExit(2) from None
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s: %(message)s")
    config = uvicorn.Config(
        create_app(settings),
        host=settings.host,
        port=settings.port,
        log_config=None,
        server_header=False,
        timeout_graceful_shutdown=round(settings.deadline) + 1,
    )
    # Uvicorn raises the signal once more when everything is finished: that is a success.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    _Server(config).run()


if __name__ == "__main__":
    main()
