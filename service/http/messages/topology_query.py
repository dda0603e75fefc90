"""``?topology=``: whether a mesh is answered with the polygons of the training files, or with triangles."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query

from shapespace.mesh.attributes import Topology
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.problems import ProblemError

TopologyQuery = Annotated[
    Topology | None,
    Query(
        description="`original`, the default where a format can: faces are the polygons of the files that the model is "
        "of; OBJ (also in a zip), PLY and USD can. `triangles`: these cut at their first corner."
    ),
]


def choose_topology(
    asked: Topology | None, format: str, model: ShapeModel, mesh: MeshChoice, *, polygons: bool
) -> Topology:
    """Return the topology of an answer, given whether its format can hold polygons.

    Raises:
        ProblemError: invalid-request, if the query asks for polygons that are not available.
    """
    if asked is Topology.ORIGINAL:
        if not polygons:
            raise ProblemError(
                "invalid-request",
                f"{format.upper()} answers have triangles only. For topology=original ask for obj, zip, ply or usd.",
            )
        if model.decoder.fine and not model.decoder.finer(mesh):
            raise ProblemError(
                "invalid-request", "The coarse mesh has triangles only. For topology=original ask for mesh=fine."
            )
    return asked or Topology.ORIGINAL
