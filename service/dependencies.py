"""What routes share: the parts of the running service, and the parameters they have in common."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path, Query, Request
from pydantic import WithJsonSchema

from service.metrics import Metrics
from service.negotiation import declared_type
from service.problems import ProblemError
from service.recent import RecentAnswers
from service.reloading import Reloader
from service.repository import ModelRepository
from service.settings import Settings
from service.shape_model import ShapeModel
from service.workers import Workers


@dataclass
class Service:
    """The parts of a running service.

    Attributes:
        draining: whether it is about to end, so that nobody should send anything more.
    """

    settings: Settings
    repository: ModelRepository
    workers: Workers
    metrics: Metrics
    reloader: Reloader
    recent: RecentAnswers
    draining: bool = False


# Coroutines, all of them: plain functions would each take a turn in a pool of threads.
async def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


ServiceDependency = Annotated[Service, Depends(_service)]

ModelName = Annotated[str, Path(description="Name of a model.", examples=["freaky-torus"])]
Version = Annotated[str | None, Query(description="Version of the model; by default the newest.")]
Format = Annotated[
    str | None, Query(description="Format of the answer, which wins over `Accept`; 406 lists the choices.")
]


# Not by ServiceDependency: FastAPI goes through a dependency's own ones every time, also where it knows the result.
async def _model(request: Request, name: ModelName, version: Version = None) -> ShapeModel:
    return (await _service(request)).repository.get(name, version)


Model = Annotated[ShapeModel, Depends(_model)]


def one_of(names: Iterable[str]) -> WithJsonSchema:
    """Names that a parameter takes, for the description only: any other gets an answer that lists them."""
    return WithJsonSchema({"type": "string", "enum": [*names]})


async def require_json(request: Request) -> None:
    """Refuse bodies that aren't declared as JSON; raises ProblemError, unsupported-media-type."""
    declared = declared_type(request.headers)
    if declared != "application/json" and not (declared.startswith("application/") and declared.endswith("+json")):
        raise ProblemError(
            "unsupported-media-type",
            f"The body is {request.headers.get('content-type') or 'of no declared type'}. Send JSON, and the header "
            "Content-Type: application/json with it.",
        )


def limit_codes(service: Service, count: int, field: str = "latents") -> None:
    """Refuse requests for no shape or too many; raises ProblemError, too-many-codes or invalid-request."""
    if count > service.settings.max_codes:
        raise ProblemError(
            "too-many-codes",
            f"{field} asks for {count} codes; the limit is {service.settings.max_codes}. Send several requests.",
        )
    if count == 0:
        raise ProblemError("invalid-request", f"{field} asks for no code. Send at least one code.")


def limit_frames(service: Service, frames: int) -> None:
    """Refuse too long animations; raises ProblemError, too-many-frames."""
    if frames > service.settings.max_frames:
        raise ProblemError(
            "too-many-frames",
            f"frames is {frames}; the limit is {service.settings.max_frames}. Ask for fewer, or for "
            "parts of the path by start and stop.",
        )
