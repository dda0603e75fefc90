"""Calls that answer latent codes: of meshes, of edited vertices, of scans, and random ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Annotated, TypeVar

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel

from shapespace.model.options import EditOptions, EncodeOptions, FitOptions, Target
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.dependencies import (
    Asked,
    AskedDependency,
    MeshOfBody,
    Model,
    ServiceDependency,
    note_model,
    one_of,
    query_names,
)
from shapespace.service.http.description import problems, upload
from shapespace.service.http.error_handlers import resumed
from shapespace.service.http.messages.bodies import JSONBody, gather
from shapespace.service.http.messages.fit import FitAnswer, FitQuery, FitRequest
from shapespace.service.http.messages.options import options_of, options_with_fields
from shapespace.service.http.messages.schemas import (
    EditAnswer,
    EditRequest,
    EncodeAnswer,
    EncodeQuery,
    EncodeRequest,
    SampleAnswer,
    SampleRequest,
)
from shapespace.service.http.responses import encoded_response
from shapespace.service.use_cases import codes
from shapespace.service.use_cases.batch import require_count
from shapespace.service.use_cases.shape_formats import dump_json
from shapespace.service.use_cases.uploads import ARCHIVE, FORMATS, POINT_FORMATS

K = TypeVar("K")
#: Media type of server-sent events.
EVENTS = "text/event-stream"

router = APIRouter(prefix="/v1/models/{name}", tags=["codes"])

_FORMAT = Query(description="Format of the file, in any case. Without it the server finds it out.")


async def _upload(request: Request, format: str | None) -> codes.Upload:
    known = query_names(request) or ()
    return codes.Upload(await gather(request), request.headers.get("content-type", ""), format, known)


def _options(
    asked: Asked,
    model: ShapeModel,
    kind: type[K],
    query: BaseModel,
    body: type[BaseModel],
    fields: Mapping[str, str],
) -> tuple[ShapeModel, K]:
    """Return the model and the options that the query and the fields of a form ask for."""
    if version := fields.get("version"):
        model = asked.service.repository.get(asked.request.path_params["name"], version)
        note_model(asked.request, model)
    return model, options_with_fields(kind, query, body, fields)


@router.post(
    "/encode",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=EncodeAnswer,
    openapi_extra=upload("A mesh file."),
)
async def encode(
    asked: AskedDependency,
    model: Model,
    options: Annotated[EncodeQuery, Query()],
    format: Annotated[str | None, one_of((*FORMATS, ARCHIVE)), _FORMAT] = None,
) -> Response:
    """Find the code whose shape comes closest to a mesh in correspondence, in any rigid pose.

    The file holds the fine or the coarse mesh of the model in its vertex order (STL: in its order of faces), in the
    units of the training meshes. A mesh with less than a third or more than three times their size is refused. A ZIP
    archive with several meshes is answered with `{"meshes": […]}`: this answer for each, with the `name` of its file.
    """
    wanted = partial(_options, asked, model, EncodeOptions, options, EncodeRequest)
    file, most = await _upload(asked.request, format), asked.service.settings.max_codes
    found = await codes.encode(asked.caller, asked.service.sandbox, wanted, file, most)
    return encoded_response(asked.service, found, "application/json")


@router.post("/edit", responses=problems(400, 404, 413, 415, 422, 503, 504), response_model=EditAnswer)
async def edit(
    asked: AskedDependency,
    model: Model,
    body: Annotated[EditRequest, Depends(JSONBody(EditRequest))],
    mesh: MeshOfBody = None,
) -> Response:
    """Find the code inside the bounds whose shape comes closest to having some vertices at given positions.

    Vertices without a target stay in place as far as possible, in the frame of the mesh that `latent` is answered with.
    `placement` takes the mesh of the new code there.
    """
    targets = [options_of(Target, target) for target in body.targets]
    wanted, most = options_of(EditOptions, body), asked.service.settings.max_codes
    wanted = wanted if mesh is None else replace(wanted, mesh=mesh)
    found = await codes.edit(asked.caller, model, body.latent, targets, wanted, most)
    return encoded_response(asked.service, found, "application/json")


@router.post("/sample", responses=problems(400, 404, 413, 415, 422), response_model=SampleAnswer)
async def sample(
    service: ServiceDependency, model: Model, body: Annotated[SampleRequest, Depends(JSONBody(SampleRequest))]
) -> Response:
    """Draw random codes, inside the bounds or from the population; one seed gives the same codes everywhere."""
    require_count(body.count, service.settings.max_codes, "count")
    latents = model.sample(body.count, body.seed, body.distribution, body.temperature)
    return Response(dump_json({"latents": latents}), media_type="application/json")


@router.post(
    "/fit",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=FitAnswer,
    openapi_extra=upload("A mesh or a point cloud."),
)
async def fit(
    asked: AskedDependency,
    model: Model,
    options: Annotated[FitQuery, Query()],
    format: Annotated[str | None, one_of((*POINT_FORMATS, ARCHIVE)), _FORMAT] = None,
) -> Response:
    """Find the code, the placement and the size that explain a scan without correspondence, with their covariance.

    The file holds a mesh of any connectivity or points without faces, in any rigid pose, whole or in part. With
    `Accept: text/event-stream` each event has JSON: `{"progress": 0.4}` while the search goes on, and this answer or
    `{"problem": …}` as the last.
    """
    wanted = partial(_options, asked, model, FitOptions, options, FitRequest)
    fit = partial(codes.fit, asked.caller, asked.service.sandbox, wanted, await _upload(asked.request, format))
    if EVENTS in asked.request.headers.get("accept", ""):
        found = codes.events(fit)
        first = await anext(found)  # an error up to here still has its own status
        return StreamingResponse(resumed(asked.request, first, found, b"data: %b\n\n"), media_type=EVENTS)
    return encoded_response(asked.service, await fit(), "application/json")
