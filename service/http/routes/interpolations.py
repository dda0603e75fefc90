"""Animations between latent codes, whole or frame by frame."""

from __future__ import annotations

from collections.abc import AsyncGenerator
from contextlib import aclosing
from functools import partial
from itertools import count
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Request, Response
from fastapi.responses import StreamingResponse

from shapespace.model.latent_space import Codes
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.dependencies import (
    Format,
    MeshQuery,
    Model,
    Service,
    ServiceDependency,
    limit_frames,
    one_of,
)
from shapespace.service.http.messages.bodies import JSONBody
from shapespace.service.http.messages.color_query import NO_COLOR, ColorQuery, choose_mesh
from shapespace.service.http.messages.schemas import InterpolationAnswer
from shapespace.service.http.negotiation import choose
from shapespace.service.http.problems import DOMAIN_ERRORS, ProblemError, domain_problem
from shapespace.service.http.responses import (
    binary,
    cache_headers,
    entity_tag,
    file_headers,
    in_pieces,
    mesh_answers,
    not_modified,
    problems,
    shape_response,
    shapes,
    size_of,
    solve,
)
from shapespace.service.use_cases.animation import Animation, UnknownInterpolationError
from shapespace.service.use_cases.sequence_formats import (
    JSON_LINES,
    MEDIA_TYPES,
    SEQUENCE_FORMATS,
    UNAVAILABLE,
    Frames,
    json_line,
    sequence_types,
)
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, worst
from shapespace.solve.deadline import Deadline

router = APIRouter(prefix="/v1", tags=["interpolations"])

Id = Annotated[str, Path(description="An interpolation's id.")]


@router.post(
    "/models/{name}/interpolations",
    status_code=201,
    responses=problems(400, 404, 413, 415, 422),
)
async def create_interpolation(
    service: ServiceDependency,
    model: Model,
    body: Annotated[Animation, Depends(JSONBody(Animation))],
    response: Response,
    mesh: MeshQuery = None,
) -> InterpolationAnswer:
    """An address for the animation along a path of codes. Nothing is stored: the id holds it all."""
    limit_frames(service, body.frames)
    body = body.model_copy(update={"mesh": mesh or body.mesh})
    id = body.to_id(model.digest, model.latents)
    model.latents.codes(body.codes(model.latents))  # every frame must be a code
    path = f"/v1/interpolations/{id}"
    response.headers["Location"] = path
    links = {"self": path} | {name: f"{path}?format={name}" for name in sequence_types()}
    return InterpolationAnswer(id=id, frames=body.frame_count, links=links | {"frames": f"{path}/frames/{{k}}"})


@router.get(
    "/interpolations/{id}",
    responses=binary(MEDIA_TYPES, "The animation.") | problems(404, 406, 422, 503, 504, 507),
    response_class=Response,
)
async def get_interpolation(
    service: ServiceDependency,
    request: Request,
    id: Id,
    format: Annotated[Format, one_of([*MEDIA_TYPES, "obj"])] = None,
) -> Response:
    """The animation: GLB, arrays, a zip of OBJ files, a point cache, USD, or JSON lines as they get ready."""
    # Who asks for OBJ gets one a frame, in a zip.
    accept = request.headers.get("accept")
    chosen = choose(sequence_types(), "zip" if format == "obj" else format, accept, UNAVAILABLE)
    animation, model = _find(service, id)
    tag = entity_tag("animation", id, chosen)
    if answer := not_modified(request, tag):
        return answer
    codes, inside = model.latents.codes(animation.codes(model.latents))
    if chosen == "jsonl":
        lines = _stream(service, request, model, animation, codes, inside)
        first = await anext(lines)  # what goes wrong up to here still has a status of its own
        return StreamingResponse(_resume(request, first, lines), headers=cache_headers(tag), media_type=JSON_LINES)

    size = size_of(model, len(codes), animation.mesh)
    with service.workers.holding(request, size) as held:
        async with service.workers.admit(request) as call:
            found = await shapes(service, model, codes, inside, animation.mesh, call)
            faces = model.mesh(animation.mesh).faces
            frames = Frames(found.vertices, found.diagnostics, faces, animation.positions, codes)
            pieces, facts = await service.workers.run(lambda _: SEQUENCE_FORMATS[chosen].encode(frames), call)
            headers = file_headers(worst(found.diagnostics) | facts, f"{model.manifest.name}-animation.{chosen}")
            headers |= cache_headers(tag)
            return await in_pieces(service, call, pieces, size, held, headers, found.seconds, MEDIA_TYPES[chosen])


@router.get(
    "/interpolations/{id}/frames/{k}",
    responses=mesh_answers("The frame as a mesh.") | problems(404, 406, 422, 503, 504),
    response_class=Response,
)
async def get_frame(
    service: ServiceDependency,
    request: Request,
    id: Id,
    k: Annotated[int, Path(description="Number of the frame, from 0.", json_schema_extra={"minimum": 0})],
    color: ColorQuery = NO_COLOR,
    format: Annotated[Format, one_of(SHAPE_FORMATS)] = None,
) -> Response:
    """One frame of an animation in any mesh format."""
    chosen = choose_mesh(format, request, color)
    animation, model = _find(service, id)
    if not 0 <= k < animation.frame_count:
        raise ProblemError("unknown-frame", f"There is no frame {k}. Choose one from 0 to {animation.frame_count - 1}.")
    code = model.latents.code(animation.codes(model.latents, slice(k, k + 1))[0])
    return await shape_response(service, request, model, code, animation.mesh, chosen, color.on(model.latents))


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


async def _stream(
    service: Service, request: Request, model: ShapeModel, animation: Animation, codes: Codes, inside: Any
) -> AsyncGenerator[bytes, None]:
    faces = model.mesh(animation.mesh).faces

    def line(frame: tuple[int, float, Codes, bool], deadline: Deadline) -> bytes:
        k, t, code, inside = frame
        shape = solve(service.workers, model, animation.mesh, (code, inside), deadline)
        return json_line(k, t, shape, None if k else faces)

    frames = zip(count(), animation.positions.tolist(), codes, map(bool, inside))
    # Each frame has the deadline to itself: a stream may take as long as its reader likes.
    with service.workers.stream(request):
        # The first alone: beside the second, with which it would share the interpreter, it takes half as long again.
        yield await service.workers.piece(partial(line, next(frames)), None)
        async with aclosing(service.workers.map(line, frames, None)) as lines:
            async for ready in lines:
                yield ready


async def _resume(request: Request, first: bytes, rest: AsyncGenerator[bytes, None]) -> AsyncGenerator[bytes, None]:
    async with aclosing(rest):
        yield first
        try:
            async for line in rest:
                yield line
        except DOMAIN_ERRORS as error:  # too late for a status
            yield b'{"problem":%b}\n' % bytes((await domain_problem(request, error)).body)
