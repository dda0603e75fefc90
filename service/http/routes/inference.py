"""The Open Inference Protocol: metadata, readiness and inference."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Path, Request, Response

from shapespace import __version__
from shapespace.files.formats import OCTET_STREAM
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.dependencies import ModelName, Service, ServiceDependency, limit_codes
from shapespace.service.http.messages.inference_messages import (
    HEADER,
    InferenceAnswer,
    InferenceRequest,
    ModelMetadata,
    ModelReadiness,
    OutputName,
    ServerMetadata,
    answer,
    model_metadata,
    parse,
)
from shapespace.service.http.messages.inference_messages import codes as codes_of
from shapespace.service.http.responses import in_pieces, nric_size_of, predictions, problems, shapes, size_of
from shapespace.service.use_cases.shape_formats import dump_json, worst

router = APIRouter(prefix="/v2", tags=["inference"])


async def _newest(service: ServiceDependency, name: ModelName) -> ShapeModel:
    return service.repository.get(name)


async def _versioned(
    service: ServiceDependency,
    name: ModelName,
    version: Annotated[str, Path(description="Version of the model.", examples=["1"])],
) -> ShapeModel:
    return service.repository.get(name, version)


Newest = Annotated[ShapeModel, Depends(_newest)]
Versioned = Annotated[ShapeModel, Depends(_versioned)]

_NEWEST, _VERSIONED = "/models/{name}", "/models/{name}/versions/{version}"
_BYTES = {OCTET_STREAM: {"schema": {"type": "string", "format": "binary"}}}
_REQUEST = {"$ref": f"#/components/schemas/{InferenceRequest.__name__}"}
_INFER: dict[str, Any] = {
    "response_model": InferenceAnswer,
    "response_model_exclude_none": True,
    "responses": {
        200: {
            "description": "The outputs, as JSON or as JSON with bytes after it.",
            "content": _BYTES,
            "headers": {
                HEADER: {"description": "Length of the JSON part, where bytes follow.", "schema": {"type": "integer"}}
            },
        }
    }
    | problems(400, 404, 413, 415, 422, 503, 504),
    "openapi_extra": {
        "requestBody": {
            "required": True,
            "content": {"application/json": {"schema": _REQUEST}, **_BYTES},
        },
        "parameters": [
            {
                "name": HEADER,
                "in": "header",
                "description": "Length of the JSON part of the body, where the input's bytes follow it.",
                "schema": {"type": "integer", "minimum": 0},
            }
        ],
    },
}


@router.get("")
async def server_metadata() -> ServerMetadata:
    """What this server is."""
    return ServerMetadata(name="shapespace", version=__version__, extensions=["binary_tensor_data"])


@router.get(_NEWEST, responses=problems(404), name="model_metadata")
async def newest_metadata(service: ServiceDependency, model: Newest) -> ModelMetadata:
    """The tensors of a model's newest version."""
    return model_metadata(model, service.repository.versions(model.manifest.name))


@router.get(_VERSIONED, responses=problems(404), name="version_metadata")
async def versioned_metadata(service: ServiceDependency, model: Versioned) -> ModelMetadata:
    """The tensors of one version of a model."""
    return model_metadata(model, service.repository.versions(model.manifest.name))


@router.get(f"{_NEWEST}/ready", responses=problems(404), name="model_ready")
async def newest_ready(model: Newest) -> ModelReadiness:
    """Whether a model answers; 404 where it isn't served."""
    return ModelReadiness(name=model.manifest.name, ready=True)


@router.get(f"{_VERSIONED}/ready", responses=problems(404), name="version_ready")
async def versioned_ready(model: Versioned) -> ModelReadiness:
    """Whether a version of a model answers; 404 where it isn't served."""
    return ModelReadiness(name=model.manifest.name, ready=True)


@router.post(f"{_NEWEST}/infer", name="infer", **_INFER)
async def newest_infer(service: ServiceDependency, request: Request, model: Newest) -> Response:
    """Lengths and angles, and vertices, of codes, by a model's newest version."""
    return await _infer(service, request, model)


@router.post(f"{_VERSIONED}/infer", name="infer_version", **_INFER)
async def versioned_infer(service: ServiceDependency, request: Request, model: Versioned) -> Response:
    """Lengths and angles, and vertices, of codes, by one version of a model."""
    return await _infer(service, request, model)


async def _infer(service: Service, request: Request, model: ShapeModel) -> Response:
    message, tail = await asyncio.to_thread(parse, await request.body(), request.headers.get(HEADER))
    limit_codes(service, message.inputs[0].shape[0])
    values = codes_of(message, tail)
    codes, inside = model.latents.codes(values, message.parameters.bounds)
    headers: dict[str, str] = {}
    seconds: dict[str, float] = {}
    outputs: dict[OutputName, np.ndarray] = {}
    mesh = message.parameters.mesh
    size = size_of(model, len(codes), mesh) + nric_size_of(model, len(codes))
    with service.workers.holding(request, size) as held:
        async with service.workers.admit(request) as call:
            for name in message.wanted:
                if name == "vertices":
                    found = await shapes(service, model, codes, inside, mesh, call)
                    outputs[name] = found.vertices
                    headers["Shape-Diagnostics"] = dump_json(worst(found.diagnostics)).decode()
                    seconds |= found.seconds
                else:
                    outputs[name] = (await predictions(service, model, codes, call)).nric
            pieces, length = answer(message, model, outputs)
            if length is not None:
                headers[HEADER] = str(length)
            media_type = "application/json" if length is None else OCTET_STREAM
            return await in_pieces(service, call, pieces, size, held, headers, seconds, media_type)
