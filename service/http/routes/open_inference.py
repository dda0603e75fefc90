"""Calls of the Open Inference Protocol: metadata, readiness and inference."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Iterable
from functools import partial
from typing import Any

from fastapi import APIRouter, Request, Response

from shapespace import __version__
from shapespace.files.reading import OCTET_STREAM
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.dependencies import AskedDependency, Model, Service, ServiceDependency
from shapespace.service.http.description import problems
from shapespace.service.http.messages.binary_tensors import HEADER, read_codes, read_request, write_answer
from shapespace.service.http.messages.bodies import read
from shapespace.service.http.messages.open_inference import (
    PLATFORM,
    IndexedModel,
    IndexRequest,
    InferenceAnswer,
    InferenceRequest,
    ModelConfiguration,
    ModelLimits,
    ModelMetadata,
    ModelReadiness,
    ModelStatistics,
    ServerMetadata,
    StatisticsAnswer,
    model_configuration,
    model_metadata,
)
from shapespace.service.http.responses import encoded_response, file_headers
from shapespace.service.use_cases.batch import require_count
from shapespace.service.use_cases.many_shapes import infer as infer_file
from shapespace.service.use_cases.many_shapes import most_inferred

router = APIRouter(prefix="/v2", tags=["inference"])


_DEFAULT, _VERSION = "/models/{name}", "/models/{name}/versions/{version}"
EXTENSIONS = ["binary_tensor_data", "model_configuration", "model_repository", "statistics"]
_REFUSED = "The bundle was refused. The log of the server names the fault."
_INDEX_REQUEST = {"$ref": f"#/components/schemas/{IndexRequest.__name__}"}
_BYTES = {OCTET_STREAM: {"schema": {"type": "string", "format": "binary"}}}
_REQUEST = {"$ref": f"#/components/schemas/{InferenceRequest.__name__}"}
_INFER: dict[str, Any] = {
    "response_model": InferenceAnswer,
    "response_model_exclude_none": True,
    "responses": {
        200: {
            "description": "The outputs, as JSON or as JSON followed by bytes.",
            "content": _BYTES,
            "headers": {
                HEADER: {"description": "Length of the JSON part, if bytes follow.", "schema": {"type": "integer"}}
            },
        }
    }
    | problems(400, 404, 413, 415, 422, 503, 504),
    "openapi_extra": {
        "requestBody": {"required": True, "content": {"application/json": {"schema": _REQUEST}, **_BYTES}},
        "parameters": [
            {
                "name": HEADER,
                "in": "header",
                "description": "Length of the JSON part of the body, if the bytes of the input follow it.",
                "schema": {"type": "integer", "minimum": 0},
            }
        ],
    },
}


@router.get("")
async def server_metadata() -> ServerMetadata:
    """Name, version and extensions of the server."""
    return ServerMetadata(name=PLATFORM, version=__version__, extensions=EXTENSIONS)


@router.post(
    "/repository/index",
    responses=problems(400, 413, 422),
    openapi_extra={"requestBody": {"content": {"application/json": {"schema": _INDEX_REQUEST}}}},
)
async def repository_index(service: ServiceDependency, request: Request) -> list[IndexedModel]:
    """Every version of every model in the models folder, and whether it is served."""
    body = await request.body()
    asked = read(body, IndexRequest) if body else IndexRequest()
    served = [(model.manifest.name, model.manifest.version) for model in service.repository.all()]
    found = [IndexedModel(name=name, version=version, state="READY", reason="") for name, version in sorted(served)]
    refused = {tuple(place.split("/")) for place in service.repository.refused} - {*served}
    return found + [
        IndexedModel(name=name, version="".join(version), state="UNAVAILABLE", reason=_REFUSED)
        for name, *version in sorted(refused)
        if not asked.ready
    ]


@router.get("/models/stats", responses=problems(404, 422), name="all_statistics")
async def all_statistics(service: ServiceDependency) -> StatisticsAnswer:
    """Numbers and times of the inferences of every version of every model."""
    return _all_statistics(service, service.repository.all())


@router.get(f"{_VERSION}/stats", responses=problems(404, 422), name="version_statistics")
@router.get(f"{_DEFAULT}/stats", responses=problems(404, 422), name="model_statistics")
async def statistics(service: ServiceDependency, request: Request, model: Model) -> StatisticsAnswer:
    """Numbers and times of the inferences of a model, for each version unless one is named."""
    named = "version" in request.path_params or "version" in request.query_params
    every = (each for each in service.repository.all() if each.manifest.name == model.manifest.name)
    return _all_statistics(service, [model] if named else every)


@router.get(f"{_VERSION}/config", responses=problems(404, 422), name="version_configuration")
@router.get(f"{_DEFAULT}/config", responses=problems(404, 422), name="model_configuration")
async def configuration(service: ServiceDependency, model: Model) -> ModelConfiguration:
    """Configuration of a model, with its tensors for one code and the most codes of a request."""
    return model_configuration(model, _limits(service, model))


@router.get(_VERSION, responses=problems(404, 422), name="version_metadata")
@router.get(_DEFAULT, responses=problems(404, 422), name="model_metadata")
async def metadata(service: ServiceDependency, model: Model) -> ModelMetadata:
    """Description of a model with its input and output tensors, and limits on a request."""
    return model_metadata(model, service.repository.versions(model.manifest.name), _limits(service, model))


@router.get(f"{_VERSION}/ready", responses=problems(404, 422), name="version_ready")
@router.get(f"{_DEFAULT}/ready", responses=problems(404, 422), name="model_ready")
async def model_ready(model: Model) -> ModelReadiness:
    """Whether a model is served; 404 if it is not."""
    return ModelReadiness(name=model.manifest.name, ready=True)


@router.post(f"{_VERSION}/infer", name="infer_version", **_INFER)
@router.post(f"{_DEFAULT}/infer", name="infer", **_INFER)
async def infer(asked: AskedDependency, model: Model) -> Response:
    """Lengths and angles, vertices, or both, for latent codes."""
    service, request = asked.service, asked.request
    message, tail = await asyncio.to_thread(read_request, await request.body(), request.headers.get(HEADER))
    require_count(message.inputs[0].shape[0], service.settings.max_codes, "inputs[0].shape")
    options, write = message.parameters, partial(write_answer, message, model)
    tally, began = _statistics(service, model), time.perf_counter()
    try:
        written = await infer_file(
            asked.caller,
            model,
            read_codes(message, tail),
            options.bounds,
            options.mesh,
            options.quality,
            message.output_names,
            write,
        )
    except Exception:
        tally.inference_stats.fail.add(time.perf_counter() - began)
        raise
    tally.succeed(message.inputs[0].shape[0], time.perf_counter() - began, written.seconds)
    media_type = OCTET_STREAM if HEADER in written.facts else "application/json"
    headers = file_headers(written) | {name: str(value) for name, value in written.facts.items()}
    return encoded_response(service, written, media_type, headers)


def _limits(service: Service, model: ShapeModel) -> ModelLimits:
    settings = service.settings
    codes = min(settings.max_codes, most_inferred(model))
    return ModelLimits(max_codes=codes, max_body=settings.max_body, deadline=settings.deadline)


def _statistics(service: Service, model: ShapeModel) -> ModelStatistics:
    key = model.manifest.name, model.manifest.version
    if key not in service.inferences:
        service.inferences[key] = ModelStatistics.of(model)
    return service.inferences[key]


def _all_statistics(service: Service, models: Iterable[ShapeModel]) -> StatisticsAnswer:
    ordered = sorted(models, key=lambda model: (model.manifest.name, int(model.manifest.version)))
    return StatisticsAnswer(model_stats=[_statistics(service, model) for model in ordered])
