"""Finding latent codes: of meshes, of vertices pulled elsewhere, at random."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Annotated, Any

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response

from shapespace.model.correspondence import limits, match
from shapespace.model.edit import Editor, Target
from shapespace.model.latent_space import Bounds
from shapespace.service.http.dependencies import MeshQuery, Model, ServiceDependency, limit_codes, one_of
from shapespace.service.http.messages.bodies import JSONBody
from shapespace.service.http.messages.schemas import (
    EditAnswer,
    EditRequest,
    EncodeAnswer,
    MeshAnswer,
    SampleAnswer,
    SampleRequest,
)
from shapespace.service.http.messages.upload_reading import gather
from shapespace.service.http.messages.upload_reading import read as read_upload
from shapespace.service.http.messages.uploads import FORMATS, MEDIA_TYPES
from shapespace.service.http.problems import ProblemError
from shapespace.service.http.responses import problems, server_timing
from shapespace.service.use_cases.shape_formats import dump_json, float32
from shapespace.solve.deadline import Deadline
from shapespace.solve.status import Status

router = APIRouter(prefix="/v1/models/{name}", tags=["codes"])

_FILE = {"type": "string", "format": "binary", "description": "A mesh file."}
_FORM = {"type": "object", "properties": {"file": _FILE}, "required": ["file"]}
_UPLOAD = {
    "requestBody": {
        "required": True,
        "content": {
            **{media_type: {"schema": _FILE} for media_type in (*MEDIA_TYPES, "application/octet-stream")},
            "application/json": {"schema": {"$ref": f"#/components/schemas/{MeshAnswer.__name__}"}},
            "multipart/form-data": {"schema": _FORM},
        },
    }
}


@router.post(
    "/encode",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=EncodeAnswer,
    openapi_extra=_UPLOAD,
)
async def encode(
    service: ServiceDependency,
    request: Request,
    model: Model,
    format: Annotated[
        str | None,
        one_of(FORMATS),
        Query(description="Format of the file, which wins over `Content-Type`."),
    ] = None,
    bounds: Annotated[
        Bounds, Query(description="Whether the code may lie outside the bounds, is looked for inside, or is refused.")
    ] = Bounds.ALLOW,
) -> Response:
    """The code whose shape comes closest to a mesh in correspondence, in any rigid pose.

    The file holds the fine or the coarse mesh of the model in its vertex order (STL: in its order of faces), in the
    units of the training meshes.
    """
    body, content_type = await gather(request), request.headers.get("content-type", "")

    def make(deadline: Deadline) -> tuple[bytes, dict[str, float]]:
        began = time.perf_counter()
        mesh = read_upload(service.sandbox, body, content_type, format, limits(model), deadline)
        given = match(model, *mesh)
        read = time.perf_counter()
        found = model.encode(given, bounds, deadline)
        if found.status is Status.DEADLINE:
            raise service.workers.late()
        answer = {
            "latent": found.code,
            "residual": found.residual,
            "vertex_error": {"mean": found.distances.mean(), "max": found.distances.max()},
            "vertex_errors": float32(found.distances),
            "inside_bounds": found.inside_bounds,
            "status": found.status,
            "iterations": found.iterations,
            "mesh": found.mesh,
            "diagnostics": asdict(found.shape.diagnostics),
        }
        return dump_json(answer), {"read": read - began, "encode": time.perf_counter() - read}

    async with service.workers.admit(request) as deadline:
        content, seconds = await service.workers.run(make, deadline)
    return Response(content, headers={"Server-Timing": server_timing(seconds)}, media_type="application/json")


@router.post(
    "/edit",
    responses=problems(400, 404, 413, 415, 422, 503, 504),
    response_model=EditAnswer,
)
async def edit(
    service: ServiceDependency,
    request: Request,
    model: Model,
    body: Annotated[EditRequest, Depends(JSONBody(EditRequest))],
    mesh: MeshQuery = None,
) -> Response:
    """The code inside the bounds whose shape comes closest to having some vertices at some places."""
    which = mesh or body.mesh
    count = len(model.mesh(which).vertices)
    if len(body.targets) > count:
        raise ProblemError("invalid-request", f"targets has {len(body.targets)} entries. Send {count} at most.")
    for i, target in enumerate(body.targets):
        if not 0 <= target.vertex < count:
            raise ProblemError(
                "invalid-request",
                f"targets[{i}].vertex is {target.vertex}, but the {which} mesh has vertices 0 to {count - 1}.",
            )
    start, _ = model.latents.code(body.latent, Bounds.CLAMP)
    targets = [Target(target.vertex, target.position) for target in body.targets]

    def make(deadline: Deadline) -> tuple[bytes, dict[str, float]]:
        began = time.perf_counter()
        found = Editor(model)(start, targets, body.prior, which, deadline)
        if found.status is Status.DEADLINE:
            raise service.workers.late()
        answer = {
            "latent": found.code,
            "residual": np.sqrt((found.distances**2).mean()),
            "distances": found.distances,
            "status": found.status,
            "iterations": found.iterations,
            "diagnostics": asdict(found.shape.diagnostics),
        }
        return dump_json(answer), {"edit": time.perf_counter() - began}

    async with service.workers.admit(request) as deadline:
        content, seconds = await service.workers.run(make, deadline)
    return Response(content, headers={"Server-Timing": server_timing(seconds)}, media_type="application/json")


@router.post(
    "/sample",
    responses=problems(400, 404, 413, 415, 422),
    response_model=SampleAnswer,
)
async def sample(
    service: ServiceDependency, model: Model, body: Annotated[SampleRequest, Depends(JSONBody(SampleRequest))]
) -> Response:
    """Random codes inside the bounds; one seed gives the same from every replica."""
    limit_codes(service, body.count, "count")
    codes: Any = model.latents.sample(body.count, body.seed, body.distribution)
    return Response(dump_json({"latents": codes}), media_type="application/json")
