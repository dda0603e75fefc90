"""The call that answers a model as linear blend shapes."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from shapespace.model.decoder import MeshChoice
from shapespace.service.http.caching import CachedAnswer, entity_tag
from shapespace.service.http.dependencies import CallerDependency, Model, ServiceDependency
from shapespace.service.http.description import binary, problems
from shapespace.service.http.responses import cached_response
from shapespace.service.use_cases.batch import Timings
from shapespace.service.use_cases.blend_shapes import blend_shapes_file
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS

router = APIRouter(prefix="/v1/models/{name}", tags=["shapes"])
_GLB = {"glb": SHAPE_FORMATS["glb"].media_type}


@router.get(
    "/blendshapes",
    responses=binary(_GLB, "A GLB with morph targets.") | problems(404, 422, 503, 504),
    response_class=Response,
)
async def get_blend_shapes(
    service: ServiceDependency,
    request: Request,
    caller: CallerDependency,
    model: Model,
    mesh: Annotated[MeshChoice, Query(description="The mesh, if the model has a fine one.")] = MeshChoice.FINE,
) -> Response:
    """The shape of code 0 with a morph target for each bound of each coordinate: sliders without this server.

    `asset.extras.error` of the file is the distance of the linear blend from the model's shapes.
    """

    async def compute() -> tuple[CachedAnswer, Timings]:
        content, seconds = await blend_shapes_file(service.workers, caller, model, mesh)
        name = f"{model.manifest.name}-blendshapes.glb"
        return CachedAnswer(content, {"Content-Disposition": f'inline; filename="{name}"'}), seconds

    tag = entity_tag("blend shapes", model.digest, mesh)
    return await cached_response(service, request, tag, _GLB["glb"], compute)
