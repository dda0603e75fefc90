"""What use cases return, as HTTP: files with diagnostics and timings in their headers, answered again from a cache."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from fastapi import Request, Response
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from shapespace.mesh.attributes import Topology
from shapespace.model.decoder import Quality
from shapespace.model.latent_space import CheckedCode
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.caching import CachedAnswer, cache_headers, entity_tag, not_modified
from shapespace.service.http.dependencies import Service
from shapespace.service.limits.workers import Caller
from shapespace.service.use_cases.batch import PiecewiseFile, Timings, Written
from shapespace.service.use_cases.codes import Found
from shapespace.service.use_cases.one_shape import WantedShape, shape_file
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, dump_json

#: Of an answer that was there already.
_NO_TIME = {"network": 0.0, "reconstruct": 0.0, "encode": 0.0}


def timing(service: Service, seconds: Timings) -> dict[str, str]:
    """The header ``Server-Timing``, in milliseconds; the metrics count the same."""
    service.metrics.timed(seconds)
    return {"Server-Timing": ", ".join(f"{stage};dur={1e3 * duration:.3f}" for stage, duration in seconds.items())}


def draft_option(quality: Quality) -> list[str]:
    """What tells a draft's entity tag from that of the shape."""
    return [quality] if quality is Quality.DRAFT else []


def file_headers(diagnostics: Mapping[str, Any], filename: str) -> dict[str, str]:
    """Headers of an answer that is a file."""
    return {**diagnostics_header(diagnostics), "Content-Disposition": f'inline; filename="{filename}"'}


def diagnostics_header(diagnostics: Mapping[str, Any]) -> dict[str, str]:
    """The header ``Shape-Diagnostics``."""
    return {"Shape-Diagnostics": dump_json(diagnostics).decode()}


def found_response(service: Service, found: Found) -> Response:
    """What a search found, with the time that it took."""
    return Response(found.content, headers=timing(service, found.seconds), media_type="application/json")


async def shape_response(
    service: Service, request: Request, caller: Caller, model: ShapeModel, wanted: WantedShape
) -> Response:
    """One shape as a file, as it was answered before where it was."""
    options: list[str | bytes] = [*draft_option(wanted.quality)]
    if colour_by := wanted.colour_by:
        covariance = colour_by.covariance
        told = _bytes_of(colour_by.against) if covariance is None else covariance.tobytes()
        options += [colour_by.quantity, told]
    if place := wanted.place:
        options += ["place", *(np.asarray(part).tobytes() for part in (place.rotation, place.translation, place.scale))]
    if wanted.topology is Topology.TRIANGLES:
        options.append(wanted.topology)
    tag = entity_tag("shape", model.digest, _bytes_of(wanted.code), wanted.mesh, wanted.format, *options)
    if unchanged := not_modified(request, tag):
        return unchanged
    answer, seconds = service.answers.get(tag), _NO_TIME
    if answer is None:
        found = await shape_file(service.workers, caller, model, wanted)
        headers = file_headers(asdict(found.diagnostics), f"{model.manifest.name}.{wanted.format}")
        if found.legend:
            headers["Shape-Color"] = dump_json(found.legend).decode()
        answer, seconds = CachedAnswer(found.content, headers), found.seconds
        service.answers.keep(tag, answer)
    headers = {**cache_headers(tag), **answer.headers, **timing(service, seconds)}
    return Response(answer.content, headers=headers, media_type=SHAPE_FORMATS[wanted.format].media_type)


def _bytes_of(code: CheckedCode | None) -> bytes:
    return b"" if code is None else code[0].tobytes()


def written_response(service: Service, written: Written, headers: Mapping[str, str], media_type: str) -> Response:
    """A file made from many codes: whole where it is small, otherwise as fast as it is read."""
    headers = {**headers, **timing(service, written.seconds)}
    if isinstance(written.content, bytes):
        return Response(written.content, headers=headers, media_type=media_type)
    return _PiecewiseResponse(written.content, headers, media_type)


class _PiecewiseResponse(StreamingResponse):
    """A file that is written as fast as it is read, and holds its memory until then."""

    def __init__(self, file: PiecewiseFile, headers: Mapping[str, str], media_type: str) -> None:
        super().__init__(file, headers=headers, media_type=media_type)
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        with self._file:
            await super().__call__(scope, receive, send)
