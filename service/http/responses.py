"""HTTP answers from the results of use cases: files with diagnostics and timings in their headers, and a cache."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Mapping
from functools import partial
from http import HTTPStatus
from types import MappingProxyType

import numpy as np
from fastapi import Response
from fastapi.responses import FileResponse, StreamingResponse
from starlette.types import Message, Receive, Scope, Send

from shapespace.mesh.attributes import Topology
from shapespace.model.latent_space import CheckedCode
from shapespace.model.memory import Examples, Fade
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.caching import cache_headers, entity_tag, not_modified
from shapespace.service.http.dependencies import Asked, Service
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.batch import EncodedFile, PiecewiseFile, Timings
from shapespace.service.use_cases.one_shape import ColourOptions, ShapeRequest, shape_file
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, dump_json

#: Seconds by stage of an answer from the cache.
_CACHED = {"network": 0.0, "reconstruct": 0.0, "encode": 0.0}


def file_headers(written: EncodedFile, filename: str = "") -> dict[str, str]:
    """Return headers with the diagnostics and the legend of a file, if there are any, and its name."""
    told = {"Shape-Diagnostics": written.diagnostics, "Shape-Color": written.legend}
    headers = {name: dump_json(each).decode() for name, each in told.items() if each}
    return headers | ({"Content-Disposition": f'inline; filename="{filename}"'} if filename else {})


def _timing(seconds: Timings) -> dict[str, str]:
    """Return the header ``Server-Timing``, in milliseconds."""
    return {"Server-Timing": ", ".join(f"{stage};dur={1e3 * duration:.3f}" for stage, duration in seconds.items())}


async def cached_response(
    asked: Asked, tag: str, media_type: str, filename: str, compute: Callable[[], Awaitable[EncodedFile]]
) -> Response:
    """Return a file from the cache, computed first where it is not there; 304 where the client has it already."""
    if unchanged := not_modified(asked.request, tag):
        return unchanged
    service = asked.service
    kept = service.answers.get(tag)
    service.metrics.looked_up(found=kept is not None)
    written = kept or await compute()
    if not kept:
        service.answers.keep(tag, written)
        service.metrics.timed(written.seconds)
    headers = {**cache_headers(tag), **file_headers(written, filename), **_timing(_CACHED if kept else written.seconds)}
    return Response(written.content, headers=headers, media_type=media_type)


async def shape_response(asked: Asked, model: ShapeModel, wanted: ShapeRequest) -> Response:
    """Return one shape as a file, from the cache where it is there."""
    options = tag_options(wanted.quality, wanted.colour_by, wanted.topology, wanted.examples)
    if place := wanted.place:
        options += ["place", *(np.asarray(part).tobytes() for part in (place.rotation, place.translation, place.scale))]
    tag = entity_tag("shape", model.digest, _code_bytes(wanted.code), wanted.mesh, wanted.format, *options)
    media_type, filename = SHAPE_FORMATS[wanted.format].media_type, f"{model.manifest.name}.{wanted.format}"
    return await cached_response(asked, tag, media_type, filename, partial(shape_file, asked.caller, model, wanted))


def tag_options(
    quality: Quality, colour_by: ColourOptions | None, topology: Topology, examples: Examples = True
) -> list[str | bytes]:
    """Return the parts of an entity tag that distinguish options of the same shapes; none for the defaults."""
    options: list[str | bytes] = [] if quality is Quality.FULL else [quality]
    if colour_by:
        covariance = colour_by.covariance
        against = _code_bytes(colour_by.against) if covariance is None else covariance.tobytes()
        options += [colour_by.quantity, against]
    if examples is not True:
        options += ["examples", bytes(examples) if examples else b""]
        if isinstance(examples, Fade) and quality is not Quality.FULL:
            options.append(examples.row.tobytes())
    return options if topology is Topology.ORIGINAL else [*options, topology]


def _code_bytes(code: CheckedCode | None) -> bytes:
    return b"" if code is None else code[0].tobytes()


def encoded_response(
    service: Service, written: EncodedFile, media_type: str, headers: Mapping[str, str] = MappingProxyType({})
) -> Response:
    """Return a file with its time, which the metrics count. A large file is sent as fast as the client reads it."""
    service.metrics.timed(written.seconds)
    headers = {**headers, **_timing(written.seconds)}
    if isinstance(written.content, bytes):
        return Response(written.content, headers=headers, media_type=media_type)
    return _PiecewiseResponse(written.content, headers, media_type)


class RangedFile(FileResponse):
    """A file of which clients may ask for parts. Starlette refuses a wrong ``Range`` in plain text."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file or a part of it; raises RefusedError for a part that it does not have."""

        async def checked(message: Message) -> None:
            if message.get("status") in (HTTPStatus.BAD_REQUEST, HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE):
                size = self.headers["content-length"]
                error = RefusedError(
                    "no-such-range", f"The file has bytes 0 to {int(size) - 1}. Correct the header Range."
                )
                error.headers = {"Content-Range": f"bytes */{size}"}
                raise error
            await send(message)

        await super().__call__(scope, receive, checked)


class _PiecewiseResponse(StreamingResponse):
    """An answer written piece by piece, which keeps its reservation of memory until its end."""

    def __init__(self, file: PiecewiseFile, headers: Mapping[str, str], media_type: str) -> None:
        super().__init__(file, headers=headers, media_type=media_type)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._file:
            await super().__call__(scope, receive, send)
