"""``shapespace-serve``: the server as a command, set up by environment variables ``SHAPESPACE_*``."""

from __future__ import annotations

import logging
import signal
import sys

from pydantic import ValidationError

from service import logs, memory
from service.app import create_app
from service.server import Server
from service.settings import PREFIX, Settings, unknown_variables


def main() -> None:
    """Serve until SIGTERM or SIGINT; running requests are finished."""
    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors():
            print(f"{PREFIX}{str(fault['loc'][0]).upper()}: {fault['msg']}", file=sys.stderr)
        raise SystemExit(2) from None
    memory.be_frugal()
    logs.configure(settings.log_format)
    for name in unknown_variables():
        logging.getLogger(__name__).warning("%s is no setting: the README lists those there are", name)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until the server can reload
    # Uvicorn raises the signal once more when everything is finished: that is a success.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(0))
    Server(create_app(settings), settings).run()


if __name__ == "__main__":
    main()
