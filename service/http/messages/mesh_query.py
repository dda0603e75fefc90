"""Query parameters of the calls that answer one mesh file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

from fastapi import Depends, Request

from shapespace.mesh.attributes import Topology
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import MeshChoice, Quality
from shapespace.model.latent_space import Bounds, CheckedCode
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.dependencies import Format, one_of
from shapespace.service.http.messages.color_query import NO_COLOR, ColorQuery, ColourParameters, choose_mesh
from shapespace.service.http.messages.place_query import PlaceQuery
from shapespace.service.http.messages.topology_query import TopologyQuery, choose_topology
from shapespace.service.use_cases.one_shape import ShapeRequest
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS


@dataclass(frozen=True)
class MeshOptions:
    """How a call answers a mesh.

    Attributes:
        format: name of the format, by ``?format=`` or ``Accept``.
        color: what colours the mesh.
        topology: polygons or triangles; None leaves the choice to the format.
        place: rigid motion and scale of the answered mesh.
    """

    format: str
    color: ColourParameters
    topology: Topology | None
    place: Placement | None = None

    def shape(
        self,
        model: ShapeModel,
        code: CheckedCode | None,
        mesh: MeshChoice,
        quality: Quality,
        bounds: Bounds = Bounds.ALLOW,
        covariance: Sequence[Sequence[float]] | None = None,
    ) -> ShapeRequest:
        """Return the request for the shape of a code; raises ProblemError or LatentError.

        Args:
            model: decodes the code.
            code: checked latent code; None is the reference.
            mesh: fine or coarse.
            quality: draft or full.
            bounds: what to do with a code outside the bounds that the colours compare with.
            covariance: (m, m), of codes around this one, for ``color=spread``.
        """
        colour_by = self.color.on(model, bounds, covariance)
        polygons = SHAPE_FORMATS[self.format].polygons
        topology = choose_topology(self.topology, self.format, model, mesh, polygons=polygons)
        return ShapeRequest(code, mesh, self.format, quality, colour_by, self.place, topology)


async def _frame(
    request: Request,
    color: ColorQuery = NO_COLOR,
    topology: TopologyQuery = None,
    format: Annotated[Format, one_of(SHAPE_FORMATS)] = None,
) -> MeshOptions:
    return MeshOptions(choose_mesh(format, request, color), color, topology)


#: Options of a frame, which has its place by the animation.
FrameQuery = Annotated[MeshOptions, Depends(_frame)]


async def _mesh(options: FrameQuery, place: PlaceQuery = None) -> MeshOptions:
    return replace(options, place=place)


#: Options of a single shape.
SingleMeshQuery = Annotated[MeshOptions, Depends(_mesh)]
