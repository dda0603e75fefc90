"""Calls for operators: health, as the Open Inference Protocol has it, metrics, and the description of every call."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from prometheus_client import CONTENT_TYPE_PLAIN_0_0_4, generate_latest

from shapespace.service.http.dependencies import ServiceDependency
from shapespace.service.http.description import problems
from shapespace.service.http.messages.schemas import Health, Readiness
from shapespace.service.refusals import RefusedError

router = APIRouter()


@router.get("/v2/health/live", tags=["health"])
async def live() -> Health:
    """Whether the process answers."""
    return Health(live=True)


@router.get("/v2/health/ready", tags=["health"], responses=problems(503), response_model_exclude_none=True)
async def ready(service: ServiceDependency) -> Readiness:
    """Whether the server has a model and is not shutting down; names faults of the default versions."""
    if service.draining:
        raise RefusedError("not-ready", "The server is about to end. Send requests to another one.", ready=False)
    if len(service.repository) == 0:
        detail = "No model is served. Put a bundle into the models folder; the log says more."
        raise RefusedError("not-ready", detail, ready=False)
    return Readiness(ready=True, faults=service.repository.faults or None)


@router.get(
    "/metrics",
    tags=["operation"],
    response_class=Response,
    responses={
        200: {"description": "Prometheus's text format.", "content": {"text/plain": {"schema": {"type": "string"}}}}
    },
)
async def metrics(request: Request) -> Response:
    """Metrics of the server since its start."""
    return Response(generate_latest(request.app.state.metrics), media_type=CONTENT_TYPE_PLAIN_0_0_4)


@router.get("/openapi.json", include_in_schema=False)
async def openapi(request: Request) -> dict[str, object]:
    """Description of this interface as OpenAPI 3.1."""
    described: dict[str, object] = request.app.openapi()
    return described
