"""Errors as problem details (RFC 9457): a stable type, and a sentence that says what to do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match
from starlette.types import Scope

from shapespace.model.blend_shapes import PeriodicError
from shapespace.model.correspondence import InvalidMeshError
from shapespace.model.decoder import ModelFailedError, NetworkTimeError
from shapespace.model.edit import InvalidTargetError
from shapespace.model.exact_shapes import NoTangentSpaceError
from shapespace.model.latent_space import InvalidFixedError, NotFiniteError, OutOfBoundsError, WrongLengthError
from shapespace.model.scan import InvalidScanError
from shapespace.model.vertex_uncertainty import InvalidCovarianceError
from shapespace.service.limits.workers import BusyError, DeadlineError, DisconnectedError, EndingError
from shapespace.service.repository.repository import UnknownModelError, UnknownVersionError
from shapespace.service.use_cases.animation import PathTooLongError, UnknownInterpolationError
from shapespace.service.use_cases.batch import NoCodesError, TooManyCodesError
from shapespace.service.use_cases.sequence import TooManyFramesError, UnknownFrameError
from shapespace.service.use_cases.shape_formats import NoRoomError, dump_json
from shapespace.service.use_cases.uploads import UnknownFormatError, UnreadableFormError, UnusableMeshError

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:shapespace:problem:"


@dataclass(frozen=True)
class Kind:
    """A kind of problem: its status, and a title that never changes."""

    status: int
    title: str


#: Every kind by the name that ends its ``type``.
KINDS = {
    "malformed-request": Kind(400, "The request can't be read"),
    "unauthorized": Kind(401, "No valid API key"),
    "no-host": Kind(400, "No Host, or several"),
    "not-found": Kind(404, "Nothing is here"),
    "unknown-model": Kind(404, "Unknown model"),
    "unknown-version": Kind(404, "Unknown version of the model"),
    "unknown-interpolation": Kind(404, "Unknown interpolation"),
    "unknown-frame": Kind(404, "Unknown frame"),
    "method-not-allowed": Kind(405, "Method not allowed"),
    "not-acceptable": Kind(406, "No such format"),
    "request-timeout": Kind(408, "The request came too slowly"),
    "body-too-large": Kind(413, "Body too large"),
    "unsupported-media-type": Kind(415, "Unsupported media type"),
    "misdirected": Kind(421, "Another server's name"),
    "invalid-request": Kind(422, "Invalid request"),
    "wrong-length": Kind(422, "Wrong number of latent coordinates"),
    "not-finite": Kind(422, "Not a finite number"),
    "out-of-bounds": Kind(422, "Code out of bounds"),
    "invalid-mesh": Kind(422, "Mesh can't be used"),
    "invalid-scan": Kind(422, "Scan can't be used"),
    "no-tangent-space": Kind(422, "Model without a tangent space"),
    "periodic": Kind(422, "Coordinates without ends"),
    "too-many-codes": Kind(422, "Too many codes"),
    "too-many-frames": Kind(422, "Too many frames"),
    "path-too-long": Kind(422, "Too many keyframes"),
    "head-too-large": Kind(431, "Head too large"),
    "client-closed": Kind(499, "The client closed the connection"),
    "internal-error": Kind(500, "Internal error"),
    "busy": Kind(503, "Busy"),
    "not-ready": Kind(503, "Not ready"),
    "model-failed": Kind(503, "Model failed"),
    "deadline-passed": Kind(504, "Deadline passed"),
    "no-room": Kind(507, "No room for a temporary file"),
}

#: What the model and the use cases raise, and its kind of problem; the message becomes the detail.
_OF_EXCEPTION: dict[type[Exception], str] = {
    UnknownModelError: "unknown-model",
    UnknownVersionError: "unknown-version",
    UnknownInterpolationError: "unknown-interpolation",
    UnknownFrameError: "unknown-frame",
    WrongLengthError: "wrong-length",
    NotFiniteError: "not-finite",
    OutOfBoundsError: "out-of-bounds",
    InvalidFixedError: "invalid-request",
    InvalidCovarianceError: "invalid-request",
    NoCodesError: "invalid-request",
    TooManyCodesError: "too-many-codes",
    TooManyFramesError: "too-many-frames",
    PathTooLongError: "path-too-long",
    InvalidTargetError: "invalid-request",
    UnreadableFormError: "malformed-request",
    UnknownFormatError: "unsupported-media-type",
    UnusableMeshError: "invalid-mesh",
    InvalidMeshError: "invalid-mesh",
    InvalidScanError: "invalid-scan",
    NoTangentSpaceError: "no-tangent-space",
    PeriodicError: "periodic",
    BusyError: "busy",
    DeadlineError: "deadline-passed",
    NoRoomError: "no-room",
    ModelFailedError: "model-failed",
    NetworkTimeError: "model-failed",
    DisconnectedError: "client-closed",
    ClientDisconnect: "client-closed",
    EndingError: "not-ready",
}
DOMAIN_ERRORS = tuple(_OF_EXCEPTION)
#: Longest detail, in characters: it may quote what was sent.
_LONGEST = 1000
_HEADERS = {
    "busy": {"Retry-After": "1"},
    "not-ready": {"Retry-After": "1"},
    "unauthorized": {"WWW-Authenticate": "Bearer"},
}
#: Under this path answers to errors also have the member ``error`` of the Open Inference Protocol.
_INFERENCE_PATHS = "/v2"


class ProblemError(HTTPException):
    """A problem that a route or a middleware finds itself.

    Args:
        kind: one of KINDS.
        detail: a sentence that says what to do.
        extensions: further members of the answer.
    """

    def __init__(self, kind: str, detail: str, **extensions: Any) -> None:
        super().__init__(KINDS[kind].status, detail)
        self.kind, self.extensions = kind, extensions


def problem(
    scope: Scope, kind: str, detail: str, headers: Mapping[str, str] | None = None, **extensions: Any
) -> Response:
    """A problem as the answer to the request of a scope."""
    if scope["path"].startswith(_INFERENCE_PATHS):
        extensions["error"] = shortened(detail)
    content, own = description(kind, detail, **extensions)
    return Response(content, KINDS[kind].status, {**own, **(headers or {})}, MEDIA_TYPE)


def description(kind: str, detail: str, **extensions: Any) -> tuple[bytes, dict[str, str]]:
    """Body and headers of a problem."""
    content = {
        "type": TYPE_PREFIX + kind,
        "title": KINDS[kind].title,
        "status": KINDS[kind].status,
        "detail": shortened(detail),
    }
    return dump_json(content | extensions), dict(_HEADERS.get(kind, {}))


def shortened(text: str) -> str:
    """A text that isn't as long as what it quotes, and is Unicode even where that isn't."""
    start = text[:_LONGEST].encode(errors="replace").decode()
    return start if len(text) <= _LONGEST else f"{start} …"


def install(app: FastAPI) -> None:
    """Make every error of an application a problem."""
    for exception in _OF_EXCEPTION:
        app.add_exception_handler(exception, domain_problem)
    app.add_exception_handler(StarletteHTTPException, _http)
    app.add_exception_handler(RequestValidationError, _validation)


async def domain_problem(request: Request, error: Exception) -> Response:
    """One of the DOMAIN_ERRORS as a problem."""
    return problem(request.scope, _OF_EXCEPTION[type(error)], str(error))


async def _http(request: Request, error: Exception) -> Response:
    assert isinstance(error, StarletteHTTPException)  # noqa: S101 - narrows the type that the handler is registered for
    if isinstance(error, ProblemError):
        return problem(request.scope, error.kind, error.detail, error.headers, **error.extensions)
    path, method = request.url.path, request.method
    if error.status_code == HTTPStatus.NOT_FOUND:
        return problem(request.scope, "not-found", f"Nothing answers at {path}. /openapi.json lists every call.")
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        allowed = ", ".join(_allowed(request)) or (error.headers or {}).get("Allow", "")
        detail = f"{path} does not take {method}. Use {allowed}."
        return problem(request.scope, "method-not-allowed", detail, {"Allow": allowed})
    return problem(
        request.scope,
        "malformed-request",
        "The body can't be read. Send one JSON object in UTF-8, as /openapi.json describes it.",
    )


def _allowed(request: Request) -> list[str]:
    # The router names the methods of the first route only; a path may have several.
    routes = request.app.router.routes
    scopes = {
        method: {**request.scope, "method": method} for method in ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE")
    }
    return [m for m, scope in scopes.items() if any(route.matches(scope)[0] is Match.FULL for route in routes)]


def internal_error(scope: Scope) -> Response:
    """What a mistake of the server looks like from outside; the traceback is for the log only."""
    return problem(
        scope,
        "internal-error",
        "The server made a mistake, which its log describes. Try again, and report it if it happens again.",
    )


async def _validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101 - as above
    faults = error.errors()
    if any(fault["type"] == "json_invalid" for fault in faults):
        where = faults[0]["loc"][-1]
        reason = faults[0].get("ctx", {}).get("error", "")
        return problem(
            request.scope,
            "malformed-request",
            f"The body is not JSON (character {where}: {reason}). Send one valid JSON object.",
        )
    kind = "not-finite" if all(fault["type"] == "finite_number" for fault in faults) else "invalid-request"
    errors = [
        {"pointer": shortened(_pointer(fault["loc"])), "detail": shortened(_advice(fault))} for fault in faults[:10]
    ]
    more = f" ({len(faults) - 1} more under errors.)" if len(faults) > 1 else ""
    return problem(request.scope, kind, errors[0]["detail"] + more, errors=errors)


def _pointer(loc: tuple[Any, ...]) -> str:
    place = loc[1:] if loc and loc[0] == "body" else loc
    return "#/" + "/".join(map(str, place))


def _advice(fault: Mapping[str, Any]) -> str:
    """One sentence on one fault that pydantic found, saying what to do."""
    where, *place = fault["loc"]
    name = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")
    name = name or f"the {where}"
    limits = fault.get("ctx", {})
    match fault["type"]:
        case "missing":
            return f"Add {name!r}: it is required." if place else "Send a JSON object as the body."
        case "extra_forbidden":
            return f"Remove {name!r}: there is no such field. /openapi.json lists those there are."
        case "finite_number":
            return f"Send finite numbers only: {name} is NaN or infinite."
        case "float_type" | "float_parsing":
            return f"Send a number for {name}."
        case "int_type" | "int_from_float" | "int_parsing":
            return f"Send a whole number for {name}."
        case "bool_type" | "bool_parsing":
            return f"Send true or false for {name}."
        case "list_type":
            return f"Send a list for {name}."
        case "model_attributes_type" | "model_type" | "dict_type":
            return f"Send a JSON object for {name}."
        case "enum" | "literal_error":
            return f"Send {limits['expected']} for {name}."
        case "too_short":
            return f"Send at least {limits['min_length']} entries for {name}, not {limits['actual_length']}."
        case "greater_than_equal":
            return f"Send a number of at least {limits['ge']} for {name}."
        case "value_error":
            return f"Correct {name}: {limits['error']}."
        case _:
            return f"Correct {name}: {fault['msg']}."
