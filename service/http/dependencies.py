"""Dependencies that routes share: the parts of the running service, and common parameters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Path, Query, Request
from pydantic import Field, WithJsonSchema

from shapespace.model.decoder import MeshChoice
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.caching import AnswerCache
from shapespace.service.http.connections import Connections
from shapespace.service.http.messages.open_inference import ModelStatistics
from shapespace.service.http.version_key import version_key
from shapespace.service.limits.quota import client_name
from shapespace.service.limits.sandbox import Sandbox
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.operation.metrics import Metrics
from shapespace.service.operation.reloading import Reloader
from shapespace.service.refusals import RefusedError
from shapespace.service.repository.repository import ModelRepository
from shapespace.service.settings import Settings


@dataclass
class Service:
    """The parts of a running service."""

    settings: Settings
    repository: ModelRepository
    workers: Workers
    connections: Connections
    metrics: Metrics
    reloader: Reloader
    answers: AnswerCache
    sandbox: Sandbox
    #: Inferences by name and version of the model.
    inferences: dict[tuple[str, str], ModelStatistics] = field(default_factory=dict)
    #: Whether the server is shutting down, so that clients should use another one.
    draining: bool = False


# All dependencies are coroutines, because FastAPI runs plain functions in threads, which takes longer.
async def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


ServiceDependency = Annotated[Service, Depends(_service)]


@dataclass(frozen=True)
class Asked:
    """A request, its caller, and the service that it is for."""

    service: Service
    request: Request
    caller: Caller


async def _asked(request: Request) -> Asked:
    async def gone() -> Exception:
        try:
            while (await request.receive())["type"] != "http.disconnect":
                pass
        except RefusedError as error:  # the rest of the body is over the limit
            return error
        return RefusedError("client-closed", "The client closed the connection before its answer was ready.")

    service = await _service(request)
    client = client_name(request.client.host) if request.client else ""
    return Asked(service, request, Caller(service.workers, client, gone))


AskedDependency = Annotated[Asked, Depends(_asked)]

ModelName = Annotated[str, Path(description="Name of a model.", examples=["freaky-torus"])]
MeshQuery = Annotated[MeshChoice, Query(alias="mesh", description="Which mesh to answer, if the model has a fine one.")]
MeshOfBody = Annotated[
    MeshChoice | None, Query(alias="mesh", description="Overrides `mesh` in the body: `fine` or `coarse`.")
]
QualityQuery = Annotated[
    Quality,
    Query(
        alias="quality",
        description="`auto` is as close to the exact shape as `full`, within a tenth. `full` solves to convergence. "
        "`draft` omits Gauss–Newton if the first guess is accurate enough.",
    ),
]
_EXAMPLES = "`false` leaves out what the model remembers of training shapes."
ExamplesQuery = Annotated[bool, Query(alias="examples", description=_EXAMPLES)]
ExamplesOfBody = Annotated[
    bool | None, Query(alias="examples", description=f"Overrides `examples` in the body: {_EXAMPLES}")
]
QualityOfBody = Annotated[
    Quality | None, Query(alias="quality", description="Overrides `quality` in the body: `auto`, `full` or `draft`.")
]
#: In the path of routes that name it there, as in the Open Inference Protocol; otherwise in the query.
Version = Annotated[
    str | None,
    Field(description="Version of the model; by default the server's default version."),
    WithJsonSchema({"type": "string", "examples": ["1"]}),
]
Format = Annotated[str | None, Query(description="Format of the answer; overrides `Accept`. 406 lists the choices.")]


# Calls _service directly, because FastAPI would resolve a nested dependency again for every parameter.
async def _model(request: Request, name: ModelName, version: Version = None) -> ShapeModel:
    repository = (await _service(request)).repository
    key = await version_key(request) if version is None and repository.divides(name) else None
    model = repository.get(name, version, key)
    note_model(request, model, chosen=version is None)
    return model


def note_model(request: Request, model: ShapeModel, *, chosen: bool = False) -> None:
    """Note which model answers a request, and whether the server chose its version, for headers and metrics."""
    request.state.model, request.state.chosen = model.manifest, chosen


Model = Annotated[ShapeModel, Depends(_model)]


def one_of(names: Iterable[str]) -> WithJsonSchema:
    """Return the schema of a parameter with these values. Routes refuse other values with a list of choices."""
    return WithJsonSchema({"type": "string", "enum": [*names]})


def query_names(request: Request) -> list[str] | None:
    """Return the query parameters of a call; None if its description lists none, as for the page."""
    known: dict[tuple[str, str], list[str]] = request.app.state.query_parameters
    return known.get((request.scope["route"].path, request.method))


async def known_query(request: Request) -> None:
    """Raise RefusedError for query parameters that the call does not have, and for one that is given twice."""
    listed = query_names(request)
    unknown = [] if listed is None else [name for name in request.query_params if name not in listed]
    if unknown:
        choice = f"choose among {', '.join(listed)}" if listed else "this call has none"
        raise RefusedError("invalid-request", f"There is no query parameter {unknown[0]!r} here: {choice}.")
    given = Counter(name for name, _ in request.query_params.multi_items())
    # A list of numbers may come as several parameters, as some client libraries send lists.
    if twice := [name for name, count in given.items() if count > 1 and name != "latent"]:
        raise RefusedError("invalid-request", f"The query has {twice[0]!r} {given[twice[0]]} times. Send it once.")
