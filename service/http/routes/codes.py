"""Finding latent codes: of meshes, of vertices pulled elsewhere, at random."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import TypeAdapter

from shapespace.model.edit import Target
from shapespace.model.encode import Objective
from shapespace.model.latent_space import Bounds
from shapespace.service.http.dependencies import CallerDependency, MeshQuery, Model, ServiceDependency, one_of
from shapespace.service.http.description import problems, upload
from shapespace.service.http.messages.bodies import JSONBody, gather
from shapespace.service.http.messages.json_query import read_query
from shapespace.service.http.messages.schemas import (
    FIXED,
    SAMPLES,
    SEED,
    EditAnswer,
    EditRequest,
    EncodeAnswer,
    SampleAnswer,
    SampleRequest,
)
from shapespace.service.http.responses import found_response
from shapespace.service.use_cases import codes
from shapespace.service.use_cases.fields import NumbersByIndex
from shapespace.service.use_cases.shape_formats import dump_json
from shapespace.service.use_cases.uploads import FORMATS

router = APIRouter(prefix="/v1/models/{name}", tags=["codes"])

_FIXED: TypeAdapter[dict[int, float]] = TypeAdapter(NumbersByIndex)


@router.post(
    "/encode",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=EncodeAnswer,
    openapi_extra=upload("A mesh file."),
)
async def encode(
    service: ServiceDependency,
    request: Request,
    caller: CallerDependency,
    model: Model,
    format: Annotated[
        str | None,
        one_of(FORMATS),
        Query(description="Format of the file, which wins over `Content-Type`."),
    ] = None,
    bounds: Annotated[
        Bounds, Query(description="Whether the code may lie outside the bounds, is looked for inside, or is refused.")
    ] = Bounds.ALLOW,
    objective: Annotated[
        Objective,
        Query(description="What comes closest: vertices after rigid alignment, or lengths and angles (`nric`)."),
    ] = Objective.VERTICES,
    fixed: Annotated[str | None, Query(description=f"{FIXED} A JSON object.", examples=['{"0": 0.5}'])] = None,
    samples: Annotated[int, Query(ge=0, description=SAMPLES)] = 0,
    seed: Annotated[int, Query(ge=0, lt=2**63, description=SEED)] = 0,
) -> Response:
    """The code whose shape comes closest to a mesh in correspondence, in any rigid pose.

    The file holds the fine or the coarse mesh of the model in its vertex order (STL: in its order of faces), in the
    units of the training meshes: one of less than a third or more than three times their size is refused.
    """
    file = codes.Upload(await gather(request), request.headers.get("content-type", ""), format)
    held = {} if fixed is None else read_query(fixed, "fixed", _FIXED)
    wishes = codes.SearchOptions(held, samples, seed, service.settings.max_codes)
    found = await codes.encode(service.workers, service.sandbox, caller, model, file, bounds, objective, wishes)
    return found_response(service, found)


@router.post(
    "/edit",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=EditAnswer,
)
async def edit(
    service: ServiceDependency,
    caller: CallerDependency,
    model: Model,
    body: Annotated[EditRequest, Depends(JSONBody(EditRequest))],
    mesh: MeshQuery = None,
) -> Response:
    """The code inside the bounds whose shape comes closest to having some vertices at some places.

    What is not asked to move stays where it is, as far as it can, in the frame of the mesh that `latent` is answered
    with; `placement` takes the mesh of the new code there.
    """
    targets = [Target(target.vertex, target.position, target.sigma) for target in body.targets]
    wishes = codes.SearchOptions(body.fixed, body.samples, body.seed, service.settings.max_codes)
    found = await codes.edit(
        service.workers,
        caller,
        model,
        body.latent,
        targets,
        body.prior,
        body.prior_kind,
        mesh or body.mesh,
        wishes,
        body.anchored,
    )
    return found_response(service, found)


@router.post(
    "/sample",
    responses=problems(400, 404, 413, 415, 422),
    response_model=SampleAnswer,
)
async def sample(
    service: ServiceDependency, model: Model, body: Annotated[SampleRequest, Depends(JSONBody(SampleRequest))]
) -> Response:
    """Random codes, inside the bounds or as those of the training shapes; one seed gives the same everywhere."""
    most = service.settings.max_codes
    latents = codes.sample(model, body.count, body.seed, body.distribution, body.temperature, most)
    return Response(dump_json({"latents": latents}), media_type="application/json")
