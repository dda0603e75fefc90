"""Latent codes to meshes, positions, lengths and angles."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response
from numpy.typing import NDArray

from shapespace.files.archives import Buffer, npz_pieces
from shapespace.files.formats import OCTET_STREAM
from shapespace.model.decoder import MeshChoice
from shapespace.model.exact_shapes import Exact, require_tangent_space
from shapespace.model.exact_shapes import exact as exponential
from shapespace.model.latent_space import Bounds, Codes
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.dependencies import (
    Format,
    MeshQuery,
    Model,
    Service,
    ServiceDependency,
    limit_codes,
    one_of,
)
from shapespace.service.http.messages.bodies import JSONBody
from shapespace.service.http.messages.color_query import NO_COLOR, NUMBERS, ColorQuery, choose_mesh, numbers
from shapespace.service.http.messages.schemas import (
    MeshRequest,
    NRICAnswer,
    NRICRequest,
    VerticesAnswer,
    VerticesRequest,
)
from shapespace.service.http.negotiation import choose
from shapespace.service.http.responses import (
    Shapes,
    binary,
    file_headers,
    gather,
    in_pieces,
    mesh_answers,
    nric_size_of,
    predictions,
    problems,
    shape_response,
    shapes,
    size_of,
)
from shapespace.service.limits.workers import Call
from shapespace.service.use_cases.shape_formats import (
    SHAPE_FORMATS,
    diagnostics_arrays,
    exact_arrays,
    exact_lists,
    float32,
    json_pieces,
    worst,
)
from shapespace.solve.deadline import Deadline

router = APIRouter(prefix="/v1/models/{name}", tags=["shapes"])

_VERTICES_TYPES = {"json": "application/json", "npz": OCTET_STREAM}
_MESH_RESPONSES = mesh_answers("The mesh. `Shape-Diagnostics` says how well it was found.")


@router.get("/mesh", responses=_MESH_RESPONSES | problems(404, 406, 422, 503, 504), response_class=Response)
async def get_mesh(
    service: ServiceDependency,
    request: Request,
    model: Model,
    latent: Annotated[
        str | None,
        Query(
            description="Coordinates separated by commas; without them the reference shape.",
            openapi_examples={"a code": {"value": "1,2,3,4"}},
            json_schema_extra={"pattern": NUMBERS},
        ),
    ] = None,
    mesh: Annotated[MeshChoice, Query(description="Which mesh, where the model has a finer one.")] = MeshChoice.FINE,
    bounds: Annotated[Bounds, Query(description="What to do with a code outside the bounds.")] = Bounds.ALLOW,
    color: ColorQuery = NO_COLOR,
    format: Annotated[Format, one_of(SHAPE_FORMATS)] = None,
) -> Response:
    """The shape of a code as a mesh file, for a link or a browser."""
    chosen = choose_mesh(format, request, color)
    code = None if latent is None else model.latents.code(numbers(latent, "latent"), bounds)
    return await shape_response(service, request, model, code, mesh, chosen, color.on(model.latents, bounds))


@router.post(
    "/mesh",
    responses=_MESH_RESPONSES | problems(400, 404, 406, 413, 415, 422, 503, 504),
    response_class=Response,
)
async def post_mesh(
    service: ServiceDependency,
    request: Request,
    model: Model,
    body: Annotated[MeshRequest, Depends(JSONBody(MeshRequest))],
    mesh: MeshQuery = None,
    color: ColorQuery = NO_COLOR,
    format: Annotated[Format, one_of(SHAPE_FORMATS)] = None,
) -> Response:
    """The shape of a code as a mesh file."""
    chosen = choose_mesh(format, request, color)
    code = model.latents.code(body.latent, body.bounds)
    comparison = color.on(model.latents, body.bounds)
    return await shape_response(service, request, model, code, mesh or body.mesh, chosen, comparison)


@router.post(
    "/vertices",
    responses=binary(_VERTICES_TYPES, "Positions and diagnostics of every shape.", cached=False)
    | problems(400, 404, 406, 413, 415, 422, 503, 504),
    response_model=VerticesAnswer,
)
async def post_vertices(
    service: ServiceDependency,
    request: Request,
    model: Model,
    body: Annotated[VerticesRequest, Depends(JSONBody(VerticesRequest))],
    mesh: MeshQuery = None,
    exact: Annotated[bool, Query(description="As in the body: also the true discrete exponentials.")] = False,
    format: Annotated[Format, one_of(_VERTICES_TYPES)] = None,
) -> Response:
    """The positions of many shapes at once."""
    chosen = choose(_VERTICES_TYPES, format, request.headers.get("accept"))
    limit_codes(service, len(body.latents))
    wanted, which = exact or body.exact, mesh or body.mesh
    if wanted:
        require_tangent_space(model)
    codes, inside = model.latents.codes(body.latents, body.bounds)
    size = size_of(model, (2 if wanted else 1) * len(codes), which)
    with service.workers.holding(request, size) as held:
        async with service.workers.admit(request) as call:
            found = await shapes(service, model, codes, inside, which, call)
            true = await _exact(service, model, codes, found, which, call) if wanted else None
            pieces: Iterator[Buffer]
            if chosen == "json":
                diagnostics = map(asdict, found.diagnostics)
                lists: dict[str, Iterable[Any]] = {"vertices": found.vertices, "diagnostics": diagnostics}
                pieces = json_pieces(lists | (exact_lists(true) if true else {}))
            else:
                arrays = diagnostics_arrays(found.diagnostics)
                arrays |= exact_arrays(true, found.vertices.shape[1]) if true else {}
                pieces = npz_pieces(vertices=found.vertices, faces=model.mesh(which).faces, latents=codes, **arrays)
            headers = {"Vary": "Accept", **file_headers(worst(found.diagnostics), f"{model.manifest.name}.{chosen}")}
            media_type = _VERTICES_TYPES[chosen]
            return await in_pieces(service, call, pieces, size, held, headers, found.seconds, media_type)


async def _exact(
    service: Service,
    model: ShapeModel,
    codes: Codes,
    found: Shapes,
    mesh: MeshChoice,
    deadline: Call,
) -> list[Exact]:
    """Exponentials of codes (n, m), side by side."""

    def work(item: tuple[Codes, NDArray[np.float32]], deadline: Deadline) -> Exact:
        return exponential(model, *item, mesh, deadline)

    return await gather(service, work, zip(codes, found.vertices, strict=True), deadline)


@router.post(
    "/nric",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=NRICAnswer,
    response_model_exclude_none=True,
)
async def post_nric(
    service: ServiceDependency,
    request: Request,
    model: Model,
    body: Annotated[NRICRequest, Depends(JSONBody(NRICRequest))],
) -> Response:
    """Lengths and angles as the networks predict them, before any reconstruction."""
    limit_codes(service, len(body.latents))
    codes, _ = model.latents.codes(body.latents, body.bounds)
    size = nric_size_of(model, len(codes), factors=body.factors)
    with service.workers.holding(request, size) as held:
        async with service.workers.admit(request) as call:
            began = time.perf_counter()
            found = await predictions(service, model, codes, call, factors=body.factors)
            seconds = {"network": time.perf_counter() - began}
            lengths, angles = np.split(found.nric, 2, axis=1)
            lists: dict[str, Iterable[Any]] = {"lengths": map(float32, lengths), "angles": map(float32, angles)}
            if found.factors is not None:
                lists["factors"] = found.factors
            return await in_pieces(service, call, json_pieces(lists), size, held, {}, seconds, "application/json")
