"""Shapes as HTTP answers: entity tags, diagnostics and timings in headers, problems in the description."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import aclosing
from dataclasses import asdict
from functools import partial
from typing import Any, TypeVar

from fastapi import Request, Response

from geometry.colouring import Colouring
from geometry.status import Status
from service import __version__
from service.comparison import Comparison
from service.dependencies import Service
from service.encodings import SHAPE_FORMATS, dump_json
from service.latent_space import CheckedCode, Codes
from service.problems import KINDS, MEDIA_TYPE
from service.recent import Answer
from service.schemas import MeshAnswer
from service.shape_model import LengthsAndAngles, MeshChoice, Shape, ShapeModel
from service.workers import DisconnectedError, Workers

Timings = dict[str, float]
#: Of an answer that was there already.
_NO_TIME = {"network": 0.0, "reconstruct": 0.0, "encode": 0.0}
S = TypeVar("S")
T = TypeVar("T")
_HEADERS = {
    name: {"description": description, "schema": {"type": "string"}}
    for name, description in {
        "ETag": "Strong; the same from every replica. Sent back as `If-None-Match` it saves the work.",
        "Shape-Diagnostics": (
            "JSON: `status`, `iterations`, `residual`, `flipped_faces`, `integrability`, `plausibility`, "
            "`inside_bounds`, `model`."
        ),
        "Server-Timing": "Milliseconds by stage: `network`, `reconstruct`, `encode`.",
    }.items()
}


def entity_tag(*parts: str | bytes) -> str:
    """A strong entity tag of all that the bytes of an answer depend on; the product's version is added."""
    digest = hashlib.sha256()
    for part in (__version__, *parts):
        data = part.encode() if isinstance(part, str) else part
        digest.update(len(data).to_bytes(8, "big") + data)
    return f'"{digest.hexdigest()[:32]}"'


def cache_headers(tag: str) -> dict[str, str]:
    """Headers that let a client keep an answer and ask whether it still holds."""
    return {"ETag": tag, "Vary": "Accept", "Cache-Control": "no-cache"}


def not_modified(request: Request, tag: str) -> Response | None:
    """304 where the client has the answer already."""
    known = {part.strip().removeprefix("W/") for part in request.headers.get("if-none-match", "").split(",")}
    return Response(status_code=304, headers=cache_headers(tag)) if tag in known or "*" in known else None


def server_timing(seconds: Timings) -> str:
    """The ``Server-Timing`` header, in milliseconds."""
    return ", ".join(f"{stage};dur={1e3 * duration:.3f}" for stage, duration in seconds.items())


def file_headers(diagnostics: Mapping[str, Any], seconds: Timings, filename: str) -> dict[str, str]:
    """Headers of an answer that is a file."""
    return {
        "Shape-Diagnostics": dump_json(diagnostics).decode(),
        "Server-Timing": server_timing(seconds),
        "Content-Disposition": f'inline; filename="{filename}"',
    }


def solve(workers: Workers, model: ShapeModel, mesh: MeshChoice, code: CheckedCode, deadline: float) -> Shape:
    """A code to its shape; raises DeadlineError."""
    shape = model.shape(*code, mesh, deadline)
    if shape.diagnostics.status is Status.DEADLINE:
        raise workers.late()
    return shape


async def shape_response(
    service: Service,
    request: Request,
    model: ShapeModel,
    code: CheckedCode | None,
    mesh: MeshChoice,
    format: str,
    comparison: Comparison | None = None,
) -> Response:
    """One shape as a file; without a code the reference."""
    tag = entity_tag(
        "shape",
        model.digest,
        b"" if code is None else code[0].tobytes(),
        mesh,
        format,
        *(comparison.key if comparison else ()),
    )
    if unchanged := not_modified(request, tag):
        return unchanged

    def find(code: CheckedCode | None, deadline: float) -> Shape:
        return model.reference_shape(mesh) if code is None else solve(service.workers, model, mesh, code, deadline)

    def make(deadline: float) -> tuple[bytes, dict[str, str]]:
        found = [find(code, deadline)]
        began, colouring, legend = time.perf_counter(), None, {}
        if comparison:
            found.append(find(comparison.code, deadline))
            began = time.perf_counter()
            vertices, against = (shape.vertices for shape in found)
            colouring = Colouring.between(comparison.quantity, vertices, against, model.mesh(mesh).connectivity)
            legend = {"Shape-Color": dump_json(colouring.legend).decode()}
        content = SHAPE_FORMATS[format].encode(found[0].vertices, model.mesh(mesh).faces, colouring)
        seconds = {**total_seconds(found), "encode": time.perf_counter() - began}
        filename = f"{model.manifest.name}.{format}"
        return content, file_headers(asdict(found[0].diagnostics), seconds, filename) | legend

    if answer := service.recent.get(tag):
        content, headers = answer.content, {**answer.headers, "Server-Timing": server_timing(_NO_TIME)}
    else:
        with service.workers.admit() as deadline:
            content, headers = await service.workers.run(make, deadline)
        service.recent.put(tag, Answer(content, headers))
    return Response(content, headers=cache_headers(tag) | headers, media_type=SHAPE_FORMATS[format].media_type)


async def shapes(
    service: Service,
    request: Request,
    model: ShapeModel,
    codes: Codes,
    inside: Any,
    mesh: MeshChoice,
    deadline: float,
) -> list[Shape]:
    """Shapes of codes (n, m), side by side; raises DisconnectedError where the client doesn't wait for them."""
    work = partial(solve, service.workers, model, mesh)
    return await gather(service, request, work, zip(codes, map(bool, inside), strict=True), deadline)


async def predictions(
    service: Service, request: Request, model: ShapeModel, codes: Codes, deadline: float
) -> list[LengthsAndAngles]:
    """What the networks say to codes (n, m), side by side; raises DisconnectedError as ``shapes`` does."""
    return await gather(service, request, lambda code, _: model.lengths_and_angles(code), codes, deadline)


async def gather(
    service: Service, request: Request, work: Callable[[S, float], T], items: Iterable[S], deadline: float
) -> list[T]:
    """Results of work on every item, side by side; raises DisconnectedError where the client doesn't wait for them."""
    found = []
    async with aclosing(service.workers.map(work, items, deadline)) as results:
        async for result in results:
            found.append(result)
            if await request.is_disconnected():
                raise DisconnectedError("The client closed the connection before its answer was ready.")
    return found


def total_seconds(shapes: list[Shape]) -> Timings:
    """Time of several shapes by stage."""
    return {stage: sum(shape.seconds[stage] for shape in shapes) for stage in ("network", "reconstruct")}


def binary(media_types: Mapping[str, str], description: str, *, cached: bool = True) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of an answer in one of several binary formats, with an entity tag where ``cached``."""
    schema = {"schema": {"type": "string", "format": "binary"}}
    others = {media_type: schema for media_type in media_types.values() if media_type != "application/json"}
    headers = {name: header for name, header in _HEADERS.items() if cached or name != "ETag"}
    answers: dict[int | str, dict[str, Any]] = {
        200: {"description": description, "content": others, "headers": headers}
    }
    if cached:
        answers[304] = {"description": "The client has this answer already, by `If-None-Match`."}
    return answers


def mesh_answers(description: str) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of a mesh in one of its formats."""
    answers = binary({name: format.media_type for name, format in SHAPE_FORMATS.items()}, description)
    answers[200]["model"] = MeshAnswer
    answers[200]["headers"] |= {
        "Shape-Color": {
            "description": "JSON, with `color`: `quantity`, `range` of the legend, `map`.",
            "schema": {"type": "string"},
        }
    }
    return answers


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI's description of the problems that a call may answer."""
    reference = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {
            "description": "; ".join(
                f"{kind.title} (`{name}`)" for name, kind in KINDS.items() if kind.status == status
            ),
            "content": reference,
        }
        for status in statuses
    }
