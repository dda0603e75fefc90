"""Animations between latent codes, whole or frame by frame."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator
from contextlib import aclosing
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi.responses import StreamingResponse

from service.animation import Animation, UnknownInterpolationError
from service.dependencies import Format, Model, Service, ServiceDependency, limit_frames, require_json
from service.encodings import JSON_LINES, SEQUENCE_FORMATS, SHAPE_FORMATS, Frames, json_line, worst
from service.negotiation import choose
from service.problems import ProblemError
from service.responses import (
    binary,
    cache_headers,
    entity_tag,
    file_headers,
    not_modified,
    problems,
    shape_response,
    shapes,
    solve,
    total_seconds,
)
from service.schemas import InterpolationAnswer, MeshAnswer
from service.shape_model import ShapeModel

router = APIRouter(prefix="/v1", tags=["interpolations"])

_TYPES = {name: format.media_type for name, format in SEQUENCE_FORMATS.items()} | {"jsonl": JSON_LINES}
_FRAME_TYPES = {name: format.media_type for name, format in SHAPE_FORMATS.items()}
_FRAME_RESPONSES = binary(_FRAME_TYPES, "The frame as a mesh.")
_FRAME_RESPONSES[200]["model"] = MeshAnswer

Id = Annotated[str, Path(description="An interpolation's id.")]


@router.post(
    "/models/{name}/interpolations",
    status_code=201,
    responses=problems(400, 404, 413, 415, 422),
    dependencies=[Depends(require_json)],
)
async def create_interpolation(
    service: ServiceDependency, model: Model, body: Animation, response: Response
) -> InterpolationAnswer:
    """An address for the animation along a path of codes. Nothing is stored: the id holds it all."""
    limit_frames(service, body.frames)
    model.latents.codes(body.codes(model.latents))  # every frame must be a code
    id = body.to_id(model.digest, model.latents)
    path = f"/v1/interpolations/{id}"
    response.headers["Location"] = path
    links = {"self": path} | {name: f"{path}?format={name}" for name in _TYPES}
    return InterpolationAnswer(id=id, frames=body.frame_count, links=links | {"frames": f"{path}/frames/{{k}}"})


@router.get(
    "/interpolations/{id}",
    responses=binary(_TYPES, "The animation.") | problems(404, 406, 422, 503, 504),
    response_class=Response,
)
async def get_interpolation(service: ServiceDependency, request: Request, id: Id, format: Format = None) -> Response:
    """The animation: GLB with morph targets, arrays, a zip of OBJ files, or JSON lines as they get ready."""
    # Who asks for OBJ gets one a frame, in a zip.
    chosen = choose(_TYPES, "zip" if format == "obj" else format, request.headers.get("accept"))
    animation, model = _find(service, id)
    tag = entity_tag("animation", id, chosen)
    if answer := not_modified(request, tag):
        return answer
    codes, inside = model.latents.codes(animation.codes(model.latents))
    if chosen == "jsonl":
        lines = _stream(service, animation, model)
        first = await anext(lines)  # what goes wrong up to here still has a status of its own
        return StreamingResponse(_resume(first, lines), headers=cache_headers(tag), media_type=JSON_LINES)

    with service.workers.admit() as deadline:
        found = await shapes(service, model, codes, inside, animation.mesh, deadline)
        frames = Frames(found, model.mesh(animation.mesh).faces, animation.positions, codes)
        began = time.perf_counter()
        content, facts = await service.workers.run(lambda _: SEQUENCE_FORMATS[chosen].encode(frames), deadline)
    diagnostics = worst([shape.diagnostics for shape in found]) | facts
    seconds = {**total_seconds(found), "encode": time.perf_counter() - began}
    headers = file_headers(diagnostics, seconds, f"{model.manifest.name}-animation.{chosen}")
    return Response(content, headers=cache_headers(tag) | headers, media_type=_TYPES[chosen])


@router.get(
    "/interpolations/{id}/frames/{k}",
    responses=_FRAME_RESPONSES | problems(404, 406, 422, 503, 504),
    response_class=Response,
)
async def get_frame(
    service: ServiceDependency,
    request: Request,
    id: Id,
    k: Annotated[int, Path(description="Number of the frame, from 0.")],
    format: Format = None,
) -> Response:
    """One frame of an animation in any mesh format."""
    chosen = choose(_FRAME_TYPES, format, request.headers.get("accept"))
    animation, model = _find(service, id)
    if not 0 <= k < animation.frame_count:
        raise ProblemError("unknown-frame", f"There is no frame {k}. Choose one from 0 to {animation.frame_count - 1}.")
    codes, inside = model.latents.codes([animation.codes(model.latents)[k]])
    return await shape_response(service, request, model, (codes[0], bool(inside[0])), animation.mesh, chosen)


def _find(service: Service, id: str) -> tuple[Animation, ShapeModel]:
    animation, digest = Animation.from_id(id)
    limit_frames(service, animation.frames)
    model = service.repository.by_digest(digest)
    if model is None:
        raise UnknownInterpolationError(
            "The model of this interpolation is not served here any more. POST the keyframes to the "
            "interpolations of a model that /v1/models lists."
        )
    return animation, model


async def _stream(service: Service, animation: Animation, model: ShapeModel) -> AsyncGenerator[bytes, None]:
    codes, inside = model.latents.codes(animation.codes(model.latents))
    work = partial(solve, service.workers, model, animation.mesh)
    faces = model.mesh(animation.mesh).faces
    with service.workers.admit():
        # Each frame has the deadline to itself: a stream may take as long as its reader likes.
        results = service.workers.map(work, zip(codes, map(bool, inside), strict=True), None)
        async with aclosing(results):
            k = 0
            async for shape in results:
                yield json_line(k, float(animation.positions[k]), shape, None if k else faces)
                k += 1


async def _resume(first: bytes, rest: AsyncGenerator[bytes, None]) -> AsyncGenerator[bytes, None]:
    async with aclosing(rest):
        yield first
        async for line in rest:
            yield line
