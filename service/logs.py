"""The log: one line for each event, for people or as JSON, with the id of the request that it belongs to."""

from __future__ import annotations

import logging
import time
from contextvars import ContextVar
from typing import Any

from pythonjsonlogger.orjson import OrjsonFormatter

from shapespace.service.settings import LogFormat

#: The id of the request at work, for every line that is logged on its behalf.
request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def printable(text: str) -> str:
    """Text in one line: what isn't for reading, line breaks and codes of terminals among it, as escapes."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class _RequestId(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        record.request_id = request_id.get()
        return True


class _Text(logging.Formatter):
    """An event is one line, whatever it quotes; lines of tracebacks are indented, so that none looks like an event."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        id = getattr(record, "request_id", None)
        return f"{text} [{id}]" if id else text

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        return printable(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - logging's name
        return "\n".join(f"    {printable(line)}" for line in super().formatException(ei).splitlines())


class _JSON(OrjsonFormatter):
    converter = staticmethod(time.gmtime)
    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        # Names of files that are no UTF-8 hold half characters, which JSON has no place for.
        for name, value in log_data.items():
            if isinstance(value, str):
                log_data[name] = value.encode(errors="backslashreplace").decode()
        return super().process_log_record(log_data)


def configure(format: LogFormat) -> None:
    """Send everything from INFO on to standard error."""
    formatter: logging.Formatter
    if format is LogFormat.JSON:
        formatter = _JSON(
            ["asctime", "levelname", "name", "message"],
            rename_fields={"asctime": "time", "levelname": "level", "name": "logger"},
        )
    else:
        formatter = _Text("%(levelname)s %(name)s: %(message)s")
    handler = logging.StreamHandler()
    handler.setFormatter(formatter)
    handler.addFilter(_RequestId())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
