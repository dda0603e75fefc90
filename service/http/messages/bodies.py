"""Bodies of requests, and JSON in queries and forms.

JSON is counted before it is parsed, and a few faults suffice to refuse it. Large bodies are checked in a thread. Files
are gathered in pieces.
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
from pydantic import BaseModel, TypeAdapter, ValidationError

from shapespace.service.http.negotiation import declared_type
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.json_names import repeated_member
from shapespace.service.use_cases.shape_formats import holds_more_values

M = TypeVar("M", bound=BaseModel)
T = TypeVar("T")
#: Maximum number of values in a body, counted by separators; after parsing they take at most 20 MB.
MOST_VALUES = 2**18
#: Bodies up to this size in bytes are parsed on the event loop, which is faster than in a thread.
SMALL = 2**12
#: NaN is accepted in bodies up to this size in bytes: the parser that knows NaN holds the interpreter's lock, up to
#: 40 ms for a MiB.
LENIENT = 2**20
#: Size in bytes of the pieces in which a body is received and passed on.
_PIECE = 4 * 2**20


class JSONBody(Generic[M]):
    """Dependency of a route that reads the request's body as a model.

    FastAPI's own body parameter would parse any number of values on the event loop, and describe millions of faults.

    Args:
        model: model whose lists fail at their first fault.
    """

    def __init__(self, model: type[M]) -> None:
        self.model = model

    async def __call__(self, request: Request) -> M:
        """Read the body.

        Raises:
            RefusedError: the body is not declared as JSON, or has too many values.
            RequestValidationError: the body is not JSON, or does not match the model.
        """
        declared = declared_type(request.headers)
        if declared != "application/json" and not (declared.startswith("application/") and declared.endswith("+json")):
            raise RefusedError(
                "unsupported-media-type",
                f"The body is {request.headers.get('content-type') or 'of no declared type'}. Send JSON, and the "
                "header Content-Type: application/json with it.",
            )
        body = await request.body()
        return read(body, self.model) if len(body) <= SMALL else await asyncio.to_thread(read, body, self.model)


def read(text: bytes, model: type[M]) -> M:
    """Read JSON as a model; raises as ``JSONBody`` does."""
    message = parse(text) if text.strip() else None
    try:
        return model.model_validate(message)
    except ValidationError as error:
        faults = error.errors(include_url=False, include_input=False)
        raise RequestValidationError([{**fault, "loc": ("body", *fault["loc"])} for fault in faults]) from None


def parse(text: bytes) -> object:
    """Parse JSON with a bounded number of values; the model must refuse NaN and infinities. Raises as ``JSONBody``."""
    message = _parse(text)
    if name := repeated_member(text):
        raise RefusedError("invalid-request", f"The JSON has the member {name!r} twice in one object. Send it once.")
    return message


def _parse(text: bytes) -> object:
    if holds_more_values(text, MOST_VALUES):
        raise RefusedError(
            "body-too-large", f"The body holds more than {MOST_VALUES} values. Send fewer in each request."
        )
    try:
        return orjson.loads(text)
    except orjson.JSONDecodeError as error:
        where, why = error.pos, error.msg
    try:
        if len(text) <= LENIENT:
            return json.loads(text.decode("utf-8-sig"))  # accepts NaN
    except json.JSONDecodeError as error:
        where, why = error.pos, error.msg
    except UnicodeDecodeError as error:
        where, why = error.start, "no UTF-8"
    except RecursionError:
        where, why = 0, "nested too deeply"
    except ValueError:
        where, why = 0, "a number of thousands of digits"
    raise RequestValidationError([{"type": "json_invalid", "loc": ("body", where), "ctx": {"error": why}}])


def read_query(text: str, name: str, model: TypeAdapter[T]) -> T:
    """Return the value of a parameter; raises RequestValidationError, or RefusedError if the text is not JSON."""
    try:
        return model.validate_python(parse(text.encode()))
    except ValidationError as error:
        faults = error.errors(include_url=False, include_input=False)
        raise RequestValidationError([{**fault, "loc": ("query", name, *fault["loc"])} for fault in faults]) from None
    except RequestValidationError:
        raise RefusedError("invalid-request", f"{name} is not JSON. Send one valid JSON value.") from None


async def gather(request: Request) -> deque[memoryview]:
    """Return a request's body in large pieces.

    Each piece has its own pages, so its memory is free once it is passed on. On the heap it would be free only after
    all later pieces. A second call for a request returns the same pieces.
    """
    if hasattr(request.state, "gathered"):
        gathered: deque[memoryview] = request.state.gathered
        return gathered
    pages: list[mmap.mmap] = []
    async for part in request.stream():
        rest = memoryview(part)
        while rest:
            if not pages or pages[-1].tell() == _PIECE:
                pages.append(mmap.mmap(-1, _PIECE))
            rest = rest[pages[-1].write(rest[: _PIECE - pages[-1].tell()]) :]
    request.state.gathered = deque(memoryview(piece)[: piece.tell()] for piece in pages)
    return request.state.gathered
