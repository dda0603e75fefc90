"""Latent codes to meshes, positions, lengths and angles."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response

from geometry.formats import OCTET_STREAM, npz
from service.comparison import NO_COLOR, NUMBERS, ColorQuery, choose_mesh, numbers
from service.dependencies import Format, Model, Service, ServiceDependency, limit_codes, one_of, require_json
from service.encodings import SHAPE_FORMATS, diagnostics_arrays, dump_json, exact_arrays, exact_lists, float32, worst
from service.exact import Exact, require_tangent_space
from service.exact import exact as exponential
from service.latent_space import Bounds, Codes
from service.negotiation import choose
from service.responses import (
    binary,
    file_headers,
    gather,
    mesh_answers,
    predictions,
    problems,
    server_timing,
    shape_response,
    shapes,
    total_seconds,
)
from service.schemas import MeshRequest, NRICAnswer, NRICRequest, VerticesAnswer, VerticesRequest
from service.shape_model import MeshChoice, Shape, ShapeModel

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
    dependencies=[Depends(require_json)],
)
async def post_mesh(
    service: ServiceDependency,
    request: Request,
    model: Model,
    body: MeshRequest,
    color: ColorQuery = NO_COLOR,
    format: Annotated[Format, one_of(SHAPE_FORMATS)] = None,
) -> Response:
    """The shape of a code as a mesh file."""
    chosen = choose_mesh(format, request, color)
    code = model.latents.code(body.latent, body.bounds)
    comparison = color.on(model.latents, body.bounds)
    return await shape_response(service, request, model, code, body.mesh, chosen, comparison)


@router.post(
    "/vertices",
    responses=binary(_VERTICES_TYPES, "Positions and diagnostics of every shape.", cached=False)
    | problems(400, 404, 406, 413, 415, 422, 503, 504),
    response_model=VerticesAnswer,
    dependencies=[Depends(require_json)],
)
async def post_vertices(
    service: ServiceDependency,
    request: Request,
    model: Model,
    body: VerticesRequest,
    exact: Annotated[bool, Query(description="As in the body: also the true discrete exponentials.")] = False,
    format: Annotated[Format, one_of(_VERTICES_TYPES)] = None,
) -> Response:
    """The positions of many shapes at once."""
    chosen = choose(_VERTICES_TYPES, format, request.headers.get("accept"))
    limit_codes(service, len(body.latents))
    wanted = exact or body.exact
    if wanted:
        require_tangent_space(model)
    codes, inside = model.latents.codes(body.latents, body.bounds)
    with service.workers.admit() as deadline:
        found = await shapes(service, request, model, codes, inside, body.mesh, deadline)
        diagnostics = [shape.diagnostics for shape in found]
        true = await _exact(service, request, model, codes, found, body.mesh, deadline) if wanted else None
        began = time.perf_counter()

        def encode(_: float) -> bytes:
            vertices = float32(np.stack([shape.vertices for shape in found]))
            if chosen == "json":
                more = exact_lists(true) if true else {}
                return dump_json({"vertices": vertices, "diagnostics": list(map(asdict, diagnostics)), **more})
            arrays = diagnostics_arrays(diagnostics) | (exact_arrays(true, vertices.shape[1]) if true else {})
            return npz(vertices=vertices, faces=model.mesh(body.mesh).faces, latents=codes, **arrays)

        content = await service.workers.run(encode, deadline)
    seconds = {**total_seconds(found), "encode": time.perf_counter() - began}
    headers = file_headers(worst(diagnostics), seconds, f"{model.manifest.name}.{chosen}")
    return Response(content, headers={"Vary": "Accept", **headers}, media_type=_VERTICES_TYPES[chosen])


async def _exact(
    service: Service,
    request: Request,
    model: ShapeModel,
    codes: Codes,
    found: list[Shape],
    mesh: MeshChoice,
    deadline: float,
) -> list[Exact]:
    """Exponentials of codes (n, m), side by side."""

    def work(item: tuple[Codes, Shape], _: float) -> Exact:
        return exponential(model, *item, mesh)

    return await gather(service, request, work, zip(codes, found, strict=True), deadline)


@router.post(
    "/nric",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=NRICAnswer,
    response_model_exclude_none=True,
    dependencies=[Depends(require_json)],
)
async def post_nric(service: ServiceDependency, request: Request, model: Model, body: NRICRequest) -> Response:
    """Lengths and angles as the networks predict them, before any reconstruction."""
    limit_codes(service, len(body.latents))
    codes, _ = model.latents.codes(body.latents, body.bounds)
    with service.workers.admit() as deadline:
        began = time.perf_counter()
        found = await predictions(service, request, model, codes, deadline)
        predicted = time.perf_counter()

        def encode(_: float) -> bytes:
            names = ("lengths", "angles", *(("factors",) if body.factors else ()))
            return dump_json({name: float32(np.stack([getattr(z, name) for z in found])) for name in names})

        content = await service.workers.run(encode, deadline)
    seconds = {"network": predicted - began, "encode": time.perf_counter() - predicted}
    return Response(content, headers={"Server-Timing": server_timing(seconds)}, media_type="application/json")
