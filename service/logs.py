"""The log: one line for each event, as text or as JSON, with the id of its request."""

from __future__ import annotations

import logging
import time
from contextvars import ContextVar
from typing import Any

from pythonjsonlogger.orjson import OrjsonFormatter

from shapespace.service.settings import LogFormat

#: Least number of seconds between two log lines of one RateLimitedLog.
LOG_INTERVAL = 1.0
#: Id of the current request, for the log lines that belong to it.
request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


def printable(text: str) -> str:
    """Return text as one line: characters that cannot be printed, as line breaks and terminal codes, are escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class RateLimitedLog:
    """One log line for many similar events, at most once in LOG_INTERVAL, with their number and the latest detail."""

    def __init__(self, logger: logging.Logger, level: int, text: str) -> None:
        self._logger, self._level, self._text = logger, level, text
        self._events, self._next = 0, 0.0

    def event(self, detail: str = "") -> None:
        """Count an event, and log a line if the last one is old enough."""
        self._events += 1
        now = time.monotonic()
        if now >= self._next:
            text = f"{self._text}: {detail}" if detail else self._text
            self._logger.log(self._level, "%s (%d × since the last such line)", text, self._events)
            self._events, self._next = 0, now + LOG_INTERVAL


class _RequestIdFilter(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        record.request_id = request_id.get()
        return True


class _TextFormatter(logging.Formatter):
    """Formats each event as one line. Lines of a traceback are indented, so that none looks like an event."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        id = getattr(record, "request_id", None)
        return f"{text} [{id}]" if id else text

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802 - logging's name
        return printable(super().formatMessage(record))

    def formatException(self, ei: Any) -> str:  # noqa: N802 - logging's name
        return "\n".join(f"    {printable(line)}" for line in super().formatException(ei).splitlines())


class _JSONFormatter(OrjsonFormatter):
    converter = staticmethod(time.gmtime)
    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"

    def process_log_record(self, log_data: dict[str, Any]) -> dict[str, Any]:
        # File names that are not UTF-8 hold surrogates, which JSON cannot express.
        for name, value in log_data.items():
            if isinstance(value, str):
                log_data[name] = value.encode(errors="backslashreplace").decode()
        return super().process_log_record(log_data)


def configure(format: LogFormat) -> None:
    """Send everything from level INFO to standard error."""
    formatter: logging.Formatter
    if format is LogFormat.JSON:
        formatter = _JSONFormatter(
            ["asctime", "levelname", "name", "message"],
            rename_fields={"asctime": "time", "levelname": "level", "name": "logger"},
        )
    else:
        formatter = _TextFormatter("%(levelname)s %(name)s: %(message)s")
    handler = logging.StreamHandler()
    handler.setFormatter(formatter)
    handler.addFilter(_RequestIdFilter())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    # The connection counts and logs the same event, at most once a second.
    logging.getLogger("uvicorn.error").addFilter(lambda record: "Invalid HTTP request" not in record.msg)
