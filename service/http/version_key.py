"""What requests without a version are divided by, where several versions of a model answer: their first code."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Sequence

import numpy as np
from fastapi import Request
from fastapi.exceptions import RequestValidationError

from shapespace.service.http.messages.binary_tensors import HEADER
from shapespace.service.http.messages.bodies import SMALL, gather, parse
from shapespace.service.refusals import RefusedError

#: Calls whose body is a file, by the end of their path.
UPLOADS = ("/encode", "/fit")
_FLOAT = np.dtype("<f4")


async def version_key(request: Request) -> bytes | None:
    """Return the first code of a request as bytes, without a code its whole body, and None without both.

    A code has the same key in every call: in the query, as JSON and in binary tensors.
    """
    if request.method == "GET":
        given = request.query_params.get("latent")
        return None if given is None else (_bytes(given.split(",")) or given.encode())
    if request.url.path.endswith(UPLOADS):
        return await asyncio.to_thread(_digest, await gather(request))
    body = await request.body()
    length = request.headers.get(HEADER, "")
    json = body[: int(length)] if length.isdecimal() and len(length) < len("1000000000") else body
    return _key(json, body) if len(body) <= SMALL else await asyncio.to_thread(_key, json, body)


def _key(json: bytes, body: bytes) -> bytes:
    """Return the key of a body, which begins with JSON."""
    code: Sequence[object] | None = None
    try:
        message = parse(json)
    except (RefusedError, RequestValidationError):
        return body  # the route reports the fault
    match message:
        case {"latent": list(first)} | {"latents": [list(first), *_]} | {"keyframes": [list(first), *_]}:
            code = first
        case {"inputs": [{"data": [list(first), *_]}, *_]}:
            code = first
        case {"inputs": [{"shape": [_, int(size)], "data": list(flat)}, *_]}:
            code = flat[: max(size, 0)]
        case {"inputs": [{"shape": [_, int(size)]}, *_]}:
            first_bytes = body[len(json) : len(json) + _FLOAT.itemsize * max(size, 0)]
            if len(first_bytes) % _FLOAT.itemsize == 0:
                code = np.frombuffer(first_bytes, _FLOAT).tolist()
    return (_bytes(code) if code else None) or body


def _bytes(code: Sequence[object]) -> bytes | None:
    """Return a code as bytes of float32, or None for what is no code."""
    try:
        with np.errstate(over="ignore"):
            numbers = np.array(code, dtype=np.float64).astype(_FLOAT)
    except (TypeError, ValueError, OverflowError):
        return None
    return (numbers + np.float32(0)).tobytes() if numbers.ndim == 1 else None  # −0 becomes 0


def _digest(pieces: Sequence[memoryview]) -> bytes:
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return digest.digest()
