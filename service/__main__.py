"""The command ``serve``, also as ``shapespace-serve``; its settings are environment variables ``SHAPESPACE_*``."""

from __future__ import annotations

import logging
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import click

from shapespace.command_line import Subcommand, call

if TYPE_CHECKING:
    from shapespace.service.repository.validation import BundleValidator

#: Seconds after which a thread that computes lets another one run, so that the event loop and short calls wait less.
SWITCH_SECONDS = 0.0005
#: Length in characters below which a key is reported as short.
SHORT_KEY = 16
#: Packages of the extra ``serve`` by the names of their modules, without those that are only faster.
NEEDED = (
    "cachetools", "fastapi", "h11", "onnx", "onnxruntime", "orjson", "prometheus_client", "pydantic",
    "pydantic_settings", "python_multipart", "pythonjsonlogger", "starlette", "trimesh", "uvicorn",
)  # fmt: skip


def serve(unknown: Sequence[str]) -> None:
    """Serve until SIGTERM or SIGINT, and finish running requests."""
    if unknown:
        click.get_current_context().fail(f"unrecognized arguments: {' '.join(unknown)}")
    from shapespace.service.limits.process_memory import tune_malloc
    from shapespace.service.repository.validation import BundleValidator

    tune_malloc()
    sys.setswitchinterval(SWITCH_SECONDS)
    validator = BundleValidator()
    try:
        validator.prepare()  # imports in a second process while this one imports
        _serve(validator)
    finally:
        validator.close()


def _serve(validator: BundleValidator) -> None:
    from pydantic import ValidationError

    from shapespace.bundle.finding import BUNDLED
    from shapespace.refused_values import in_short
    from shapespace.service.repository.validation import bundle_folders
    from shapespace.service.settings import PREFIX, Settings, is_loopback, unknown_variables

    try:
        settings = Settings()
    except ValidationError as error:
        for fault in error.errors():
            name = f"{PREFIX}{str(fault['loc'][0]).upper()}"
            print(*in_short([{**fault, "loc": (name,)}], {}), file=sys.stderr)
        raise SystemExit(2) from None
    with suppress(OSError):  # loading the models reports the reason
        validator.begin(bundle_folders(settings.models_dir)[0])

    from shapespace.service import logs
    from shapespace.service.http.app import create_app
    from shapespace.service.http.server import Server

    logs.configure(settings.log_format)
    log = logging.getLogger(__name__)
    for name in unknown_variables():
        log.warning("%s is not a setting and has no effect: docs/reference/settings.md lists all settings", name)
    if settings.models_dir == BUNDLED:
        log.info(
            "serving the models of the package, because there is no folder models here; SHAPESPACE_MODELS_DIR "
            "names another folder"
        )
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until the server can reload
    # Uvicorn raises the signal again after the shutdown, which is a success.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: sys.exit(0))
    if settings.api_key is None and not is_loopback(settings.host):
        log.warning(
            "there is no API key, so everybody who reaches %s may call: set SHAPESPACE_API_KEY to require a key",
            settings.host,
        )
    elif settings.api_key is not None and len(settings.api_key.get_secret_value()) < SHORT_KEY:
        log.warning("SHAPESPACE_API_KEY is short and may be guessed: make a better key with `openssl rand -hex 16`")
    Server(create_app(settings, validator), settings).run()


COMMAND = Subcommand(
    "serve",
    serve,
    help="Start the server: web page and HTTP interface.",
    epilog="Settings are environment variables. SHAPESPACE_HOST and SHAPESPACE_PORT set the address, and "
    "SHAPESPACE_MODELS_DIR the folder of models. docs/reference/settings.md lists all settings.",
    # All that is unknown together, so that the message names all of it.
    params=[click.Argument(["unknown"], nargs=-1, type=click.UNPROCESSED, metavar="")],
    context_settings={"ignore_unknown_options": True},
    examples=[""],
    needs=NEEDED,
    extra="serve",
    advice="Settings are environment variables, as in: SHAPESPACE_HOST=127.0.0.1 SHAPESPACE_PORT=8001 shapespace serve",
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve, with the arguments of the program by default."""
    return call("shapespace-serve", COMMAND, arguments)


if __name__ == "__main__":
    sys.exit(main())
