"""Calls of the Open Inference Protocol: metadata, readiness and inference."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from fastapi import APIRouter, Request, Response

from shapespace import __version__
from shapespace.files.reading import OCTET_STREAM
from shapespace.service.http.dependencies import CallerDependency, Model, ServiceDependency
from shapespace.service.http.description import problems
from shapespace.service.http.messages.binary_tensors import HEADER, read_codes, read_request, write_answer
from shapespace.service.http.messages.open_inference import (
    InferenceAnswer,
    InferenceRequest,
    ModelMetadata,
    ModelReadiness,
    ServerMetadata,
    model_metadata,
)
from shapespace.service.http.responses import diagnostics_header, encoded_response
from shapespace.service.use_cases.batch import require_count
from shapespace.service.use_cases.many_shapes import infer as infer_file

router = APIRouter(prefix="/v2", tags=["inference"])


_NEWEST, _VERSION = "/models/{name}", "/models/{name}/versions/{version}"
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
    return ServerMetadata(name="shapespace", version=__version__, extensions=["binary_tensor_data"])


@router.get(_VERSION, responses=problems(404, 422), name="version_metadata")
@router.get(_NEWEST, responses=problems(404, 422), name="model_metadata")
async def metadata(service: ServiceDependency, model: Model) -> ModelMetadata:
    """Description of a model with its input and output tensors."""
    return model_metadata(model, service.repository.versions(model.manifest.name))


@router.get(f"{_VERSION}/ready", responses=problems(404, 422), name="version_ready")
@router.get(f"{_NEWEST}/ready", responses=problems(404, 422), name="model_ready")
async def model_ready(model: Model) -> ModelReadiness:
    """Whether a model is served; 404 if it is not."""
    return ModelReadiness(name=model.manifest.name, ready=True)


@router.post(f"{_VERSION}/infer", name="infer_version", **_INFER)
@router.post(f"{_NEWEST}/infer", name="infer", **_INFER)
async def infer(service: ServiceDependency, request: Request, caller: CallerDependency, model: Model) -> Response:
    """Lengths and angles, vertices, or both, for latent codes."""
    message, tail = await asyncio.to_thread(read_request, await request.body(), request.headers.get(HEADER))
    require_count(message.inputs[0].shape[0], service.settings.max_codes)
    options, write = message.parameters, partial(write_answer, message, model)
    written = await infer_file(
        service.workers,
        caller,
        model,
        read_codes(message, tail),
        options.bounds,
        options.mesh,
        options.quality,
        message.output_names,
        write,
    )
    headers = diagnostics_header(written.diagnostics) if written.diagnostics else {}
    if HEADER not in written.facts:
        return encoded_response(service, written, headers, "application/json")
    return encoded_response(service, written, headers | {HEADER: str(written.facts[HEADER])}, OCTET_STREAM)
