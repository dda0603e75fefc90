"""JSON in query parameters and fields of forms: ``fixed``, ``landmarks``, ``place`` and ``options``."""

from __future__ import annotations

from typing import TypeVar

from fastapi.exceptions import RequestValidationError
from pydantic import TypeAdapter, ValidationError

from shapespace.service.http.messages.bodies import parse
from shapespace.service.http.problems import ProblemError

T = TypeVar("T")


def read_query(text: str, name: str, model: TypeAdapter[T]) -> T:
    """Return the value of a parameter; raises RequestValidationError, or ProblemError if the text is not JSON."""
    try:
        return model.validate_python(parse(text.encode()))
    except ValidationError as error:
        faults = error.errors(include_url=False, include_input=False)
        raise RequestValidationError([{**fault, "loc": ("query", name, *fault["loc"])} for fault in faults]) from None
    except RequestValidationError:
        raise ProblemError("invalid-request", f"{name} is not JSON. Send one valid JSON value.") from None
