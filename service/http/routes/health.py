"""Health of the server, at the paths of the Open Inference Protocol."""

from __future__ import annotations

from fastapi import APIRouter

from shapespace.service.http.dependencies import ServiceDependency
from shapespace.service.http.description import problems
from shapespace.service.http.messages.schemas import Health, Readiness
from shapespace.service.http.problems import ProblemError

router = APIRouter(prefix="/v2/health", tags=["health"])


@router.get("/live")
async def live() -> Health:
    """Whether the process answers."""
    return Health(live=True)


@router.get("/ready", responses=problems(503))
async def ready(service: ServiceDependency) -> Readiness:
    """Whether the server has a model and is not shutting down."""
    if service.draining:
        raise ProblemError("not-ready", "The server is about to end. Send requests to another one.", ready=False)
    if len(service.repository) == 0:
        detail = "No model is served. Put a bundle into the models folder; the log says more."
        raise ProblemError("not-ready", detail, ready=False)
    return Readiness(ready=True)
