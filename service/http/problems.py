"""Errors as problem details (RFC 9457): a stable type, and a sentence that says what to do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from fastapi import Response
from starlette.types import Scope

from shapespace.service.use_cases.shape_formats import dump_json

MEDIA_TYPE = "application/problem+json"
TYPE_PREFIX = "urn:shapespace:problem:"


class ProblemKind(NamedTuple):
    """HTTP status of a kind of problem, and its title, the same in every release."""

    status: int
    title: str


#: Every kind of problem, by the last part of its ``type``.
KINDS = {
    "malformed-request": ProblemKind(400, "The request can't be read"),
    "unauthorized": ProblemKind(401, "No valid API key"),
    "cross-origin": ProblemKind(400, "Not allowed to this page"),
    "not-found": ProblemKind(404, "Nothing is here"),
    "unknown-model": ProblemKind(404, "Unknown model"),
    "unknown-version": ProblemKind(404, "Unknown version of the model"),
    "unknown-interpolation": ProblemKind(404, "Unknown interpolation"),
    "unknown-frame": ProblemKind(404, "Unknown frame"),
    "method-not-allowed": ProblemKind(405, "Method not allowed"),
    "not-acceptable": ProblemKind(406, "No such format"),
    "request-timeout": ProblemKind(408, "The request came too slowly"),
    "body-too-large": ProblemKind(413, "Body too large"),
    "unsupported-media-type": ProblemKind(415, "Unsupported media type"),
    "no-such-range": ProblemKind(416, "No such part of the file"),
    "misdirected": ProblemKind(421, "Another server's name"),
    "invalid-request": ProblemKind(422, "Invalid request"),
    "wrong-length": ProblemKind(422, "Wrong number of latent coordinates"),
    "not-finite": ProblemKind(422, "Not a finite number"),
    "out-of-bounds": ProblemKind(422, "Code out of bounds"),
    "invalid-mesh": ProblemKind(422, "Mesh can't be used"),
    "invalid-scan": ProblemKind(422, "Scan can't be used"),
    "no-tangent-space": ProblemKind(422, "Model without a tangent space"),
    "periodic": ProblemKind(422, "Coordinates without ends"),
    "too-many-codes": ProblemKind(422, "Too many codes"),
    "too-many-frames": ProblemKind(422, "Too many frames"),
    "path-too-long": ProblemKind(422, "Too many keyframes"),
    "head-too-large": ProblemKind(431, "Head too large"),
    "client-closed": ProblemKind(499, "The client closed the connection"),
    "internal-error": ProblemKind(500, "Internal error"),
    "busy": ProblemKind(503, "Busy"),
    "not-ready": ProblemKind(503, "Not ready"),
    "model-failed": ProblemKind(503, "Model failed"),
    "deadline-passed": ProblemKind(504, "Deadline passed"),
    "no-room": ProblemKind(507, "No room for a temporary file"),
}

#: Longest detail in characters; a detail may quote the request.
_LONGEST = 1000
_HEADERS = {
    "busy": {"Retry-After": "1"},
    "not-ready": {"Retry-After": "1"},
    "unauthorized": {"WWW-Authenticate": "Bearer"},
}


def problem(
    scope: Scope, kind: str, detail: str, headers: Mapping[str, str] | None = None, **extensions: Any
) -> Response:
    """Return a problem as the answer to a request."""
    if scope["path"].startswith("/v2"):  # also in the form of the Open Inference Protocol
        extensions["error"] = shortened(detail)
    content, own = description(kind, detail, **extensions)
    return Response(content, KINDS[kind].status, {**own, **(headers or {})}, MEDIA_TYPE)


def description(kind: str, detail: str, **extensions: Any) -> tuple[bytes, dict[str, str]]:
    """Return the body and the headers of a problem."""
    content = {
        "type": TYPE_PREFIX + kind,
        "title": KINDS[kind].title,
        "status": KINDS[kind].status,
        "detail": shortened(detail),
    }
    return dump_json(content | extensions), dict(_HEADERS.get(kind, {}))


def shortened(text: str) -> str:
    """Return a text cut to the length of a detail, with characters replaced that UTF-8 cannot encode."""
    start = text[:_LONGEST].encode(errors="replace").decode()
    return start if len(text) <= _LONGEST else f"{start} …"
