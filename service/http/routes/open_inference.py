"""The Open Inference Protocol: metadata, readiness and inference."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from fastapi import APIRouter, Request, Response

from shapespace import __version__
from shapespace.files.formats import OCTET_STREAM
from shapespace.service.http.dependencies import CallerDependency, Model, ServiceDependency
from shapespace.service.http.description import problems
from shapespace.service.http.messages.open_inference import (
    HEADER,
    InferenceAnswer,
    InferenceRequest,
    ModelMetadata,
    ModelReadiness,
    ServerMetadata,
    answer,
    model_metadata,
    parse,
)
from shapespace.service.http.messages.open_inference import codes as codes_of
from shapespace.service.http.responses import diagnostics_header, written_response
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


@router.get(_VERSION, responses=problems(404, 422), name="version_metadata")
@router.get(_NEWEST, responses=problems(404, 422), name="model_metadata")
async def metadata(service: ServiceDependency, model: Model) -> ModelMetadata:
    """The tensors of a model."""
    return model_metadata(model, service.repository.versions(model.manifest.name))


@router.get(f"{_VERSION}/ready", responses=problems(404, 422), name="version_ready")
@router.get(f"{_NEWEST}/ready", responses=problems(404, 422), name="model_ready")
async def model_ready(model: Model) -> ModelReadiness:
    """Whether a model answers; 404 where it isn't served."""
    return ModelReadiness(name=model.manifest.name, ready=True)


@router.post(f"{_VERSION}/infer", name="infer_version", **_INFER)
@router.post(f"{_NEWEST}/infer", name="infer", **_INFER)
async def infer(service: ServiceDependency, request: Request, caller: CallerDependency, model: Model) -> Response:
    """Lengths and angles, vertices, or both, of latent codes."""
    message, tail = await asyncio.to_thread(parse, await request.body(), request.headers.get(HEADER))
    require_count(message.inputs[0].shape[0], service.settings.max_codes)
    options, write = message.parameters, partial(answer, message, model)
    written = await infer_file(
        service.workers,
        caller,
        model,
        codes_of(message, tail),
        options.bounds,
        options.mesh,
        options.quality,
        message.wanted,
        write,
    )
    headers = diagnostics_header(written.diagnostics) if written.diagnostics else {}
    if HEADER not in written.facts:
        return written_response(service, written, headers, "application/json")
    return written_response(service, written, headers | {HEADER: str(written.facts[HEADER])}, OCTET_STREAM)
