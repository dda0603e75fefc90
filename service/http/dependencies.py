"""What routes share: the parts of the running service, and the parameters they have in common."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Depends, Path, Query, Request
from pydantic import WithJsonSchema

from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.connections import Connections
from shapespace.service.http.problems import ProblemError
from shapespace.service.http.recent import RecentAnswers
from shapespace.service.limits.sandbox import Sandbox
from shapespace.service.limits.workers import Workers
from shapespace.service.operation.metrics import Metrics
from shapespace.service.operation.reloading import Reloader
from shapespace.service.repository.repository import ModelRepository
from shapespace.service.settings import Settings


@dataclass
class Service:
    """The parts of a running service.

    Attributes:
        draining: whether it is about to end, so that nobody should send anything more.
    """

    settings: Settings
    repository: ModelRepository
    workers: Workers
    connections: Connections
    metrics: Metrics
    reloader: Reloader
    recent: RecentAnswers
    sandbox: Sandbox
    draining: bool = False


# Coroutines, all of them: plain functions would each take a turn in a pool of threads.
async def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


ServiceDependency = Annotated[Service, Depends(_service)]

ModelName = Annotated[str, Path(description="Name of a model.", examples=["freaky-torus"])]
MeshQuery = Annotated[
    MeshChoice | None, Query(alias="mesh", description="As in the body, over which it wins: `fine` or `coarse`.")
]
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


async def known_query(request: Request) -> None:
    """Refuse parameters that the description of a call doesn't list; raises ProblemError, invalid-request."""
    known: dict[tuple[str, str], list[str]] = request.app.state.query_parameters
    listed = known.get((request.scope["route"].path, request.method))
    unknown = [] if listed is None else [name for name in request.query_params if name not in listed]
    if unknown:
        choice = f"choose among {', '.join(listed)}" if listed else "this call has none"
        raise ProblemError("invalid-request", f"There is no query parameter {unknown[0]!r} here: {choice}.")


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
