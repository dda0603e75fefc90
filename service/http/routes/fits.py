"""The call that fits a model to a scan."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from shapespace.service.http.dependencies import CallerDependency, Model, ServiceDependency, one_of
from shapespace.service.http.description import problems, upload
from shapespace.service.http.messages.bodies import gather
from shapespace.service.http.messages.fit import FitAnswer, FitQuery, fit_options
from shapespace.service.http.responses import found_response
from shapespace.service.use_cases import fit as fits
from shapespace.service.use_cases.codes import Upload
from shapespace.service.use_cases.uploads import POINT_FORMATS

router = APIRouter(prefix="/v1/models/{name}", tags=["codes"])

_OPTIONS = {
    "type": "string",
    "contentMediaType": "application/json",
    "description": "The parameters of the query as one JSON object, which has priority.",
}


@router.post(
    "/fit",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=FitAnswer,
    openapi_extra=upload("A mesh or a point cloud.", {"options": _OPTIONS}),
)
async def fit(
    service: ServiceDependency,
    request: Request,
    caller: CallerDependency,
    model: Model,
    options: Annotated[FitQuery, Query()],
    format: Annotated[
        str | None,
        one_of(POINT_FORMATS),
        Query(description="Format of the file, which wins over `Content-Type`."),
    ] = None,
) -> Response:
    """Find the code, the placement and the size that explain a scan without correspondence, with their covariance.

    The file holds a mesh of any connectivity or points without faces, in any rigid pose, whole or in part.
    """
    file = Upload(await gather(request), request.headers.get("content-type", ""), format)
    found = await fits.fit(service.workers, service.sandbox, caller, model, file, partial(fit_options, options))
    return found_response(service, found)
