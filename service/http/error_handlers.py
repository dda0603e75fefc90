"""Exceptions of the models, the use cases and the framework as problems."""

from __future__ import annotations

import re
from collections.abc import AsyncGenerator, Mapping
from contextlib import aclosing
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.requests import ClientDisconnect
from starlette.routing import Match

from shapespace.model.blend_shapes import PeriodicError
from shapespace.model.correspondence import InvalidMeshError
from shapespace.model.edit import InvalidTargetError
from shapespace.model.exact_shapes import NoTangentSpaceError
from shapespace.model.latent_space import InvalidFixedError, NotFiniteError, OutOfBoundsError, WrongLengthError
from shapespace.model.networks import ModelFailedError, NetworkTimeError
from shapespace.model.scan import InvalidScanError
from shapespace.model.vertex_uncertainty import InvalidCovarianceError
from shapespace.refused_values import WANTED
from shapespace.service.http.problems import problem, shortened
from shapespace.service.refusals import RefusedError

#: Kind of problem of each exception of the model and of the framework; the message becomes the detail.
_KINDS: dict[type[Exception], str] = {
    WrongLengthError: "wrong-length",
    NotFiniteError: "not-finite",
    OutOfBoundsError: "out-of-bounds",
    InvalidFixedError: "invalid-request",
    InvalidCovarianceError: "invalid-request",
    InvalidTargetError: "invalid-request",
    InvalidMeshError: "invalid-mesh",
    InvalidScanError: "invalid-scan",
    NoTangentSpaceError: "no-tangent-space",
    PeriodicError: "periodic",
    ModelFailedError: "model-failed",
    NetworkTimeError: "model-failed",
    ClientDisconnect: "client-closed",
}
DOMAIN_ERRORS: tuple[type[Exception], ...] = (RefusedError, *_KINDS)


def install(app: FastAPI) -> None:
    """Let an application answer every error as a problem."""
    app.add_exception_handler(RefusedError, domain_problem)
    for exception in _KINDS:
        app.add_exception_handler(exception, domain_problem)
    app.add_exception_handler(StarletteHTTPException, _http)
    app.add_exception_handler(RequestValidationError, _validation)


async def domain_problem(request: Request, error: Exception) -> Response:
    """Return one of the DOMAIN_ERRORS as a problem."""
    if isinstance(error, RefusedError):
        return problem(request.scope, error.kind, str(error), error.headers, **error.extensions)
    return problem(request.scope, _KINDS[type(error)], str(error))


async def resumed(
    request: Request, first: bytes, rest: AsyncGenerator[bytes, None], form: bytes
) -> AsyncGenerator[bytes, None]:
    """Yield the pieces of a streamed answer in a form such as a line; an error is the last, as the status is sent."""
    async with aclosing(rest):
        yield form % first
        try:
            async for piece in rest:
                yield form % piece
        except DOMAIN_ERRORS as error:
            yield form % (b'{"problem":%b}' % bytes((await domain_problem(request, error)).body))


async def _http(request: Request, error: Exception) -> Response:
    assert isinstance(error, StarletteHTTPException)  # noqa: S101 - narrows the type that the handler is registered for
    path, method = request.url.path, request.method
    if error.status_code == HTTPStatus.NOT_FOUND:
        return problem(request.scope, "not-found", f"Nothing answers at {path}. /openapi.json lists every call.")
    if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:
        methods = _methods(request)
        # HEAD is answered as GET, by the middleware.
        allowed = {"Allow": ", ".join([*methods, *(["HEAD"] if "GET" in methods else []), "OPTIONS"])}
        if method == "OPTIONS":
            return Response(status_code=HTTPStatus.NO_CONTENT, headers=allowed)
        return problem(
            request.scope, "method-not-allowed", f"{path} does not take {method}. Use {', '.join(methods)}.", allowed
        )
    detail = "The body can't be read. Send one JSON object in UTF-8, as /openapi.json describes it."
    return problem(request.scope, "malformed-request", detail)


def _methods(request: Request) -> list[str]:
    # The router names the methods of the first route only, but a path may have several routes.
    routes = request.app.router.routes
    scopes = {method: {**request.scope, "method": method} for method in ("GET", "POST")}
    found = [m for m, scope in scopes.items() if any(route.matches(scope)[0] is Match.FULL for route in routes)]
    return found or ["GET"]  # the page's files, which no route here names


async def _validation(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)  # noqa: S101 - as above
    faults = [{**fault, "loc": _place(fault)} for fault in error.errors()]
    if any(fault["type"] == "json_invalid" for fault in faults):
        place = f"character {faults[0]['loc'][-1]}: {faults[0].get('ctx', {}).get('error', '')}"
        detail = f"The body is not JSON ({place}). Send one valid JSON object."
        return problem(request.scope, "malformed-request", detail)
    kind = "not-finite" if all(fault["type"] == "finite_number" for fault in faults) else "invalid-request"
    places = [fault["loc"][1:] if fault["loc"][:1] == ("body",) else fault["loc"] for fault in faults[:10]]
    errors = [
        {"pointer": shortened(_pointer(place)), "detail": shortened(_advice(fault))}
        for place, fault in zip(places, faults, strict=False)
    ]
    more = f" ({len(faults) - 1} more under errors.)" if len(faults) > 1 else ""
    return problem(request.scope, kind, errors[0]["detail"] + more, errors=errors)


def _place(fault: Mapping[str, Any]) -> tuple[str | int, ...]:
    """Return the members and indices that lead to a fault, without names of types such as ``list[float]``."""
    *way, last = fault["loc"]
    ends = [last] if fault["type"] == "extra_forbidden" or not _TYPE.fullmatch(str(last)) else []
    return tuple(part for part in way if not _TYPE.fullmatch(str(part))) + tuple(ends)


def _pointer(place: tuple[str | int, ...]) -> str:
    """Return a JSON pointer (RFC 6901); ``#`` is the whole body."""
    return "#" + "".join(f"/{part}" for part in (str(part).replace("~", "~0").replace("/", "~1") for part in place))


#: Name of a type in the place of a fault.
_TYPE = re.compile(r"[a-z-]+\[.*\]")
#: How to correct a fault that pydantic found, by its type.
_ADVICE = {kind: f"Send {wanted} for {{name}}." for kind, wanted in WANTED.items()} | {
    "extra_forbidden": "Remove {name!r}: there is no such field. /openapi.json lists all fields.",
    "finite_number": "Send finite numbers only: {name} is NaN or infinite.",
    "too_short": "Send {min_length} or more entries for {name}, not {actual_length}.",
    "too_long": "Send {max_length} or fewer entries for {name}, not {actual_length}.",
    "string_unicode": "Correct {name}: it has a text that is no Unicode.",
    "value_error": "Correct {name}: {error}.",
    **dict.fromkeys(("model_attributes_type", "model_type", "dict_type"), "Send a JSON object for {name}."),
}


def _advice(fault: Mapping[str, Any]) -> str:
    """Return a sentence that says how to correct one fault."""
    where, *place = fault["loc"]
    name = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).lstrip(".")
    name = name or f"the {where}"
    if fault["type"] == "missing":
        return f"Add {name!r}: it is required." if place else "Send a JSON object as the body."
    advice = _ADVICE.get(fault["type"], "Correct {name}: {msg}.")
    return advice.format(**{**fault.get("ctx", {}), "name": name, "msg": fault["msg"]})
