"""Bodies of requests: JSON, counted before it is parsed, checked away from the event loop, refused with a few faults.

Files are gathered in pieces, for whoever reads them.
"""

from __future__ import annotations

import asyncio
import json
import mmap
from collections import deque
from typing import Generic, TypeVar

import orjson
from fastapi import Request
from fastapi.exceptions import RequestValidationError
from pydantic import BaseModel, ValidationError

from shapespace.service.http.negotiation import declared_type
from shapespace.service.http.problems import ProblemError
from shapespace.service.use_cases.shape_formats import holds_more_values

M = TypeVar("M", bound=BaseModel)
#: Most values in a body, counted by their separators; parsed, they take at most 20 MB.
MOST_VALUES = 2**18
#: Bodies up to this many bytes are parsed on the event loop, which is faster than handing them to a thread.
SMALL = 2**12
#: NaN is accepted in bodies up to this many bytes: the parser that knows it holds the interpreter's lock, up to 40 ms
#: for a MiB.
LENIENT = 2**20
#: Size of the pieces, in bytes, in which a body is received and passed on.
_PIECE = 4 * 2**20


class JSONBody(Generic[M]):
    """A dependency of a route: its request's body as a model.

    FastAPI's own would parse any number of values on the event loop, and describe each fault of millions.

    Args:
        model: whose lists fail at their first fault.
    """

    def __init__(self, model: type[M]) -> None:
        self.model = model

    async def __call__(self, request: Request) -> M:
        """Read it.

        Raises:
            ProblemError: not declared as JSON, or too many values.
            RequestValidationError: not JSON, or not of the model.
        """
        declared = declared_type(request.headers)
        if declared != "application/json" and not (declared.startswith("application/") and declared.endswith("+json")):
            raise ProblemError(
                "unsupported-media-type",
                f"The body is {request.headers.get('content-type') or 'of no declared type'}. Send JSON, and the "
                "header Content-Type: application/json with it.",
            )
        body = await request.body()
        return read(body, self.model) if len(body) <= SMALL else await asyncio.to_thread(read, body, self.model)


def read(text: bytes, model: type[M]) -> M:
    """JSON as a model; raises as ``JSONBody`` does."""
    message = parse(text) if text.strip() else None
    try:
        return model.model_validate(message)
    except ValidationError as error:
        faults = error.errors(include_url=False, include_input=False)
        raise RequestValidationError([{**fault, "loc": ("body", *fault["loc"])} for fault in faults]) from None


def parse(text: bytes) -> object:
    """JSON with a bounded number of values; NaN and infinities are for the model to refuse. Raises as ``JSONBody``."""
    if holds_more_values(text, MOST_VALUES):
        raise ProblemError(
            "body-too-large", f"The body holds more than {MOST_VALUES} values. Send fewer in each request."
        )
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError as error:
        where, why = error.pos, error.msg
    try:
        if len(text) <= LENIENT:
            return json.loads(text)  # which knows NaN
    except json.JSONDecodeError as error:
        where, why = error.pos, error.msg
    except UnicodeDecodeError as error:
        where, why = error.start, "no UTF-8"
    except RecursionError:
        where, why = 0, "nested too deeply"
    except ValueError:
        where, why = 0, "a number of thousands of digits"
    raise RequestValidationError([{"type": "json_invalid", "loc": ("body", where), "ctx": {"error": why}}])


async def gather(request: Request) -> deque[memoryview]:
    """A request's body in pieces, however small those were in which it came.

    Each has pages of its own: a piece that has been given on takes no memory any more, as on the heap it would until
    everything after it is gone.
    """
    pages: list[mmap.mmap] = []
    async for part in request.stream():
        rest = memoryview(part)
        while rest:
            if not pages or pages[-1].tell() == _PIECE:
                pages.append(mmap.mmap(-1, _PIECE))
            rest = rest[pages[-1].write(rest[: _PIECE - pages[-1].tell()]) :]
    return deque(memoryview(piece)[: piece.tell()] for piece in pages)
