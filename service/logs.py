"""The log: one line for each event, for people or as JSON, with the id of the request that it belongs to."""

from __future__ import annotations

import logging
import time
from contextvars import ContextVar

from pythonjsonlogger.orjson import OrjsonFormatter

from service.settings import LogFormat

#: The id of the request at work, for every line that is logged on its behalf.
request_id: ContextVar[str | None] = ContextVar("request_id", default=None)


class _RequestId(logging.Filter):
    def filter(self, record: logging.LogRecord) -> bool:
        record.request_id = request_id.get()
        return True


class _Text(logging.Formatter):
    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        id = getattr(record, "request_id", None)
        return f"{text} [{id}]" if id else text


class _JSON(OrjsonFormatter):
    converter = staticmethod(time.gmtime)
    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"


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
