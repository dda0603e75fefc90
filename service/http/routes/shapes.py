"""Calls that answer meshes, positions, and lengths and angles of latent codes."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response

from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Bounds
from shapespace.model.shape import Quality
from shapespace.service.http.caching import entity_tag
from shapespace.service.http.dependencies import (
    AskedDependency,
    ExamplesOfBody,
    ExamplesQuery,
    Format,
    MeshOfBody,
    MeshQuery,
    Model,
    QualityOfBody,
    QualityQuery,
    one_of,
)
from shapespace.service.http.description import binary, mesh_answers, problems
from shapespace.service.http.messages.bodies import JSONBody
from shapespace.service.http.messages.mesh_query import Numbers, PlaceQuery, SingleMeshQuery, numbers
from shapespace.service.http.messages.schemas import (
    MeshRequest,
    NRICAnswer,
    NRICRequest,
    VerticesAnswer,
    VerticesRequest,
)
from shapespace.service.http.negotiation import choose, listed
from shapespace.service.http.responses import cached_response, encoded_response, file_headers, shape_response
from shapespace.service.use_cases.batch import require_count
from shapespace.service.use_cases.many_shapes import VERTICES_TYPES, blend_shapes_file, nric_file, vertices_file
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS

router = APIRouter(prefix="/v1/models/{name}", tags=["shapes"])

_GLB = {"glb": SHAPE_FORMATS["glb"].media_type}
_MESH_RESPONSES = mesh_answers("The mesh, with its diagnostics in `Shape-Diagnostics`.")


@router.get("/mesh", responses=_MESH_RESPONSES | problems(404, 406, 422, 503, 504), response_class=Response)
async def get_mesh(
    asked: AskedDependency,
    model: Model,
    options: SingleMeshQuery,
    latent: Annotated[
        Numbers,
        Query(
            description="Coordinates separated by commas; by default the reference shape.",
            openapi_examples={"a code": {"value": [1, 2, 3, 4]}},
        ),
    ] = None,
    mesh: MeshQuery = MeshChoice.FINE,
    bounds: Annotated[Bounds, Query(description="What to do with a code outside the bounds.")] = Bounds.ALLOW,
    quality: QualityQuery = Quality.AUTO,
    examples: ExamplesQuery = True,
) -> Response:
    """The shape of a code as a mesh file, by an address for links and browsers."""
    code = None if latent is None else model.latents.code(numbers(latent, "latent"), bounds)
    wanted = options.shape(model, code, mesh, quality, bounds, examples=examples)
    return await shape_response(asked, model, wanted)


@router.post(
    "/mesh", responses=_MESH_RESPONSES | problems(400, 404, 406, 413, 415, 422, 503, 504), response_class=Response
)
async def post_mesh(
    asked: AskedDependency,
    model: Model,
    body: Annotated[MeshRequest, Depends(JSONBody(MeshRequest))],
    options: SingleMeshQuery,
    mesh: MeshOfBody = None,
    quality: QualityOfBody = None,
    examples: ExamplesOfBody = None,
) -> Response:
    """The shape of a code as a mesh file."""
    code = model.latents.code(body.latent, body.bounds)
    how = mesh or body.mesh, quality or body.quality, body.bounds, body.covariance
    remembered = body.examples if examples is None else examples
    wanted = options.shape(model, code, *how, remembered)
    return await shape_response(asked, model, wanted)


@router.post(
    "/vertices",
    responses=binary(VERTICES_TYPES, "Positions and diagnostics of every shape.", cached=False)
    | problems(400, 404, 406, 413, 415, 422, 503, 504),
    response_model=VerticesAnswer,
)
async def post_vertices(
    asked: AskedDependency,
    model: Model,
    body: Annotated[VerticesRequest, Depends(JSONBody(VerticesRequest))],
    mesh: MeshOfBody = None,
    quality: QualityOfBody = None,
    exact: Annotated[
        bool, Query(description="Also answer the true discrete exponentials, as `exact` in the body does.")
    ] = False,
    place: PlaceQuery = None,
    format: Annotated[Format, one_of(VERTICES_TYPES)] = None,
) -> Response:
    """Positions of many shapes."""
    chosen = choose(VERTICES_TYPES, format, listed(asked.request.headers, "accept"))
    require_count(len(body.latents), asked.service.settings.max_codes)
    written = await vertices_file(
        asked.caller,
        model,
        body.latents,
        body.bounds,
        mesh or body.mesh,
        chosen,
        quality=quality or body.quality,
        exponentials=exact or body.exact,
        place=place,
        faces=body.faces,
    )
    headers = {"Vary": "Accept", **file_headers(written, f"{model.manifest.name}.{chosen}")}
    return encoded_response(asked.service, written, VERTICES_TYPES[chosen], headers)


@router.post(
    "/nric",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=NRICAnswer,
    response_model_exclude_none=True,
)
async def post_nric(
    asked: AskedDependency,
    model: Model,
    body: Annotated[NRICRequest, Depends(JSONBody(NRICRequest))],
) -> Response:
    """Lengths and angles as the networks predict them, before reconstruction."""
    require_count(len(body.latents), asked.service.settings.max_codes)
    written = await nric_file(asked.caller, model, body.latents, body.bounds, factors=body.factors)
    return encoded_response(asked.service, written, "application/json")


@router.get(
    "/blendshapes",
    responses=binary(_GLB, "A GLB with morph targets.") | problems(404, 422, 503, 504),
    response_class=Response,
)
async def get_blend_shapes(
    asked: AskedDependency,
    model: Model,
    mesh: MeshQuery = MeshChoice.FINE,
) -> Response:
    """The shape of code 0 with a morph target for each bound of each coordinate: sliders without this server.

    `asset.extras.error` of the file is the distance of the linear blend from the model's shapes.
    """
    tag, name = entity_tag("blend shapes", model.digest, mesh), f"{model.manifest.name}-blendshapes.glb"
    return await cached_response(asked, tag, _GLB["glb"], name, partial(blend_shapes_file, asked.caller, model, mesh))
