"""Animations between latent codes, whole or frame by frame."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import Field

from shapespace.files.animated_gltf import FRAMES_PER_SECOND
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.caching import cache_headers, entity_tag, not_modified
from shapespace.service.http.dependencies import (
    AskedDependency,
    ExamplesOfBody,
    ExamplesQuery,
    Format,
    MeshOfBody,
    Model,
    QualityQuery,
    Service,
    ServiceDependency,
    note_model,
    one_of,
)
from shapespace.service.http.description import binary, mesh_answers, problems
from shapespace.service.http.error_handlers import resumed
from shapespace.service.http.messages.bodies import JSONBody
from shapespace.service.http.messages.mesh_query import (
    NO_COLOR,
    ColorQuery,
    ColourParameters,
    FrameQuery,
    TopologyQuery,
    choose_topology,
)
from shapespace.service.http.messages.schemas import InterpolationAnswer
from shapespace.service.http.negotiation import choose, listed
from shapespace.service.http.responses import encoded_response, file_headers, shape_response, tag_options
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.animation import Animation
from shapespace.service.use_cases.fields import DIGITS, WholeText
from shapespace.service.use_cases.sequence import (
    find_interpolation,
    frame_code,
    frame_memory,
    interpolation_id,
    sequence_file,
    sequence_lines,
)
from shapespace.service.use_cases.sequence_formats import JSON_LINES, MEDIA_TYPES, SEQUENCE_FORMATS
from shapespace.service.use_cases.shape_formats import UNAVAILABLE, writable

router = APIRouter(prefix="/v1", tags=["interpolations"])

#: Reason why a format cannot hold a coloured animation.
_UNCOLOURED = {
    name: f"Whole animations in {name.upper()} carry no colours; single frames do"
    for name in MEDIA_TYPES
    if name not in SEQUENCE_FORMATS or not SEQUENCE_FORMATS[name].timed
}
#: Most frames per second, more than any screen shows.
MOST_FPS = 240
Id = Annotated[str, Path(description="Id of an interpolation.")]


@router.post("/models/{name}/interpolations", status_code=201, responses=problems(400, 404, 413, 415, 422))
async def create_interpolation(
    service: ServiceDependency,
    model: Model,
    body: Annotated[Animation, Depends(JSONBody(Animation))],
    response: Response,
    mesh: MeshOfBody = None,
    examples: ExamplesOfBody = None,
) -> InterpolationAnswer:
    """Address of the animation along a path of codes. Nothing is stored: the id holds the whole animation."""
    body = body.model_copy(
        update={"mesh": mesh or body.mesh, "examples": body.examples if examples is None else examples}
    )
    id = interpolation_id(model, body, service.settings.max_frames)
    path = f"/v1/interpolations/{id}"
    response.headers["Location"] = path
    links = {"self": path} | {name: f"{path}?format={name}" for name in writable(MEDIA_TYPES)}
    return InterpolationAnswer(id=id, frames=body.frame_count, links=links | {"frames": f"{path}/frames/{{k}}"})


@router.get(
    "/interpolations/{id}",
    responses=binary(MEDIA_TYPES, "The animation.", coloured=True) | problems(404, 406, 422, 503, 504, 507),
    response_class=Response,
)
async def get_interpolation(
    asked: AskedDependency,
    id: Id,
    quality: QualityQuery = Quality.AUTO,
    examples: ExamplesQuery = True,
    color: ColorQuery = NO_COLOR,
    topology: TopologyQuery = None,
    fps: Annotated[
        Annotated[float, Field(ge=1, le=MOST_FPS)] | None,
        DIGITS,
        Query(description="Frames per second of GLB, USD and USDZ; by default 30."),
    ] = None,
    format: Annotated[Format, one_of([*MEDIA_TYPES, "obj"])] = None,
) -> Response:
    """The animation: GLB, arrays, a zip of OBJ files, a point cache, USD, or a stream of JSON lines."""
    chosen = _choose_format(asked.request, format, color)
    animation, model = _found(asked.service, id, examples=examples)
    note_model(asked.request, model)
    written_as = SEQUENCE_FORMATS.get(chosen)
    if fps is not None and not (written_as and written_as.timed):
        timed = ", ".join(name for name, each in SEQUENCE_FORMATS.items() if each.timed)
        said = f"{chosen.upper()} files don't say when a frame is shown."
        raise RefusedError("invalid-request", f"{said} For fps ask for one of {timed}.")
    polygons = bool(written_as and written_as.polygons)
    faces = choose_topology(topology, chosen, model, animation.mesh, polygons=polygons)
    colour_by = color.on(model)
    options = tag_options(quality, colour_by, faces, animation.examples)
    options += [] if fps is None else [f"{fps} frames a second"]
    tag = entity_tag("animation", id, chosen, *options)
    if answer := not_modified(asked.request, tag):
        return answer
    if chosen == "jsonl":
        lines = sequence_lines(asked.caller, model, animation, quality)
        first = await anext(lines)  # an error up to here still has its own status
        return StreamingResponse(
            resumed(asked.request, first, lines, b"%b\n"), headers=cache_headers(tag), media_type=JSON_LINES
        )
    written = await sequence_file(
        asked.caller, model, animation, quality, chosen, faces, fps or FRAMES_PER_SECOND, colour_by
    )
    told = replace(written, diagnostics={**(written.diagnostics or {}), **written.facts})
    headers = cache_headers(tag) | file_headers(told, f"{model.manifest.name}-animation.{chosen}")
    return encoded_response(asked.service, written, MEDIA_TYPES[chosen], headers)


@router.get(
    "/interpolations/{id}/frames/{k}",
    responses=mesh_answers("The frame as a mesh.") | problems(404, 406, 422, 503, 504),
    response_class=Response,
)
async def get_frame(
    asked: AskedDependency,
    id: Id,
    k: Annotated[WholeText, Path(description="Index of the frame, from 0.", json_schema_extra={"minimum": 0})],
    options: FrameQuery,
    quality: QualityQuery = Quality.AUTO,
    examples: ExamplesQuery = True,
) -> Response:
    """One frame of an animation in any mesh format."""
    animation, model = _found(asked.service, id, examples=examples)
    note_model(asked.request, model)
    code, memory = frame_code(model, animation, k), frame_memory(model, animation, k)
    wanted = options.shape(model, code, animation.mesh, quality, examples=memory)
    return await shape_response(asked, model, wanted)


def _found(service: Service, id: str, *, examples: bool) -> tuple[Animation, ShapeModel]:
    animation, model = find_interpolation(service.repository, id, service.settings.max_frames)
    return animation.model_copy(update={"examples": animation.examples and examples}), model


def _choose_format(request: Request, format: str | None, color: ColourParameters) -> str:
    """Return the format of an animation, one that carries colours where the query asks for some."""
    types = {name: kind for name, kind in MEDIA_TYPES.items() if color.quantity is None or name not in _UNCOLOURED}
    why = UNAVAILABLE if color.quantity is None else _UNCOLOURED | UNAVAILABLE
    # OBJ holds one frame, so an animation is a zip of OBJ files.
    return choose(writable(types), "zip" if format == "obj" else format, listed(request.headers, "accept"), why)
