"""Query parameters of the calls that answer meshes: codes, colours, polygons, placements, formats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from fastapi import Depends, Query, Request
from pydantic import Field, TypeAdapter, WithJsonSchema, model_validator

from shapespace.files.colouring import Quantity
from shapespace.mesh.attributes import Topology
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Bounds, CheckedCode
from shapespace.model.memory import Examples
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel
from shapespace.model.vertex_uncertainty import require_covariance
from shapespace.service.http.dependencies import Format, one_of
from shapespace.service.http.messages.bodies import read_query
from shapespace.service.http.negotiation import choose, listed
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.fields import Body, Number
from shapespace.service.use_cases.one_shape import ColourOptions, ShapeRequest
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, UNAVAILABLE, writable

#: Numbers in a query, separated by commas. Generated clients repeat the key instead, which is read alike.
Numbers = Annotated[list[str] | None, WithJsonSchema({"type": "array", "items": {"type": "number"}})]
#: Tolerance of the products of a rotation's rows, which should be 0 or 1.
_ROUNDING = 1e-3
_EXAMPLE = '{"rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]], "translation": [0, 0, 2], "scale": 1}'
_Three = Annotated[list[Number], Field(min_length=3, max_length=3, fail_fast=True)]
#: Reasons why formats can't hold a coloured mesh.
_UNCOLOURED = {
    name: f"{name.upper()} files can't carry colours" for name, format in SHAPE_FORMATS.items() if not format.coloured
}


def numbers(parts: Sequence[str], name: str) -> list[float]:
    """Read a code from a query; raises RefusedError, invalid-request."""
    text = ",".join(parts)
    try:
        if "_" in text or not text.isascii():  # Python accepts more spellings of numbers than other languages
            raise ValueError
        return [float(part) for part in text.split(",")] if text else []
    except ValueError:
        raise RefusedError(
            "invalid-request", f"{name} is not a list of numbers. Send them separated by commas: ?{name}=0.1,0.2"
        ) from None


@dataclass(frozen=True)
class ColourParameters:
    """Values of ``?color=`` and ``?against=``."""

    quantity: Quantity | None
    against: list[float] | None

    def on(
        self, model: ShapeModel, bounds: Bounds = Bounds.ALLOW, covariance: Sequence[Sequence[float]] | None = None
    ) -> ColourOptions | None:
        """Return the colouring, with the other code checked like the first; raises LatentError or RefusedError."""
        if self.quantity is Quantity.SPREAD:
            if covariance is None:
                raise RefusedError(
                    "invalid-request",
                    "color=spread needs the covariance of the code. POST the code and its covariance in the body.",
                )
            return ColourOptions(self.quantity, None, require_covariance(model.decoder, covariance))
        if covariance is not None:
            raise RefusedError(
                "invalid-request", "covariance is only for color=spread. Add ?color=spread, or leave covariance out."
            )
        if self.quantity is None:
            return None
        return ColourOptions(self.quantity, None if self.against is None else model.latents.code(self.against, bounds))


async def _color(
    color: Annotated[
        Quantity | None,
        Query(
            description="Colour the vertices by their difference from another shape: `stretch` is the logarithm of "
            "the ratio of edge lengths, `bending` the change of the dihedral angles in radians. `spread` is the "
            "standard deviation of each vertex, from the `covariance` in the body of a POST. Every format but STL "
            "can have colours; NPZ and JSON have the values."
        ),
    ] = None,
    against: Annotated[
        Numbers,
        Query(
            description="With `color`: code of the other shape, its coordinates separated by commas. By default the "
            "other shape is the reference.",
            openapi_examples={"a code": {"value": [0, 0, 0, 0]}},
        ),
    ] = None,
) -> ColourParameters:
    if against is not None and color in (None, Quantity.SPREAD):
        raise RefusedError(
            "invalid-request",
            "against is only for color=stretch and color=bending. Add one of them, or leave against out.",
        )
    return ColourParameters(color, None if against is None else numbers(against, "against"))


ColorQuery = Annotated[ColourParameters, Depends(_color)]
NO_COLOR = ColourParameters(None, None)

TopologyQuery = Annotated[
    Topology | None,
    Query(
        description="`original` (default of OBJ, zip, PLY, USD and VTK): faces are the polygons of the training "
        "files. `triangles`: polygons are split into triangles from their first corner."
    ),
]


def choose_topology(
    asked: Topology | None, format: str, model: ShapeModel, mesh: MeshChoice, *, polygons: bool
) -> Topology:
    """Return the topology of an answer; raises RefusedError for polygons that are not available."""
    if asked is Topology.ORIGINAL:
        if not polygons:
            raise RefusedError(
                "invalid-request",
                f"{format.upper()} answers have triangles only. "
                "For topology=original ask for obj, zip, ply, vtk or usd.",
            )
        if model.decoder.fine and not model.decoder.finer(mesh):
            raise RefusedError(
                "invalid-request", "The coarse mesh has triangles only. For topology=original ask for mesh=fine."
            )
    return asked or Topology.ORIGINAL


class _PlacementRequest(Body):
    """Placement in the form that ``edit`` and ``fit`` answer."""

    rotation: Annotated[list[_Three], Field(min_length=3, max_length=3, fail_fast=True)] = Field(
        [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    )
    translation: _Three = Field([0, 0, 0])
    scale: Number = Field(1, gt=0)

    @model_validator(mode="after")
    def _turns(self) -> _PlacementRequest:
        matrix = np.array(self.rotation)
        largest = np.abs(matrix).max()
        if not (largest < 2 and np.abs(matrix @ matrix.T - np.eye(3)).max() < _ROUNDING and np.linalg.det(matrix) > 0):
            raise ValueError(
                "rotation is not a rotation matrix: its rows must be orthogonal, of length 1, and without a reflection"
            )
        return self


_ADAPTER = TypeAdapter(_PlacementRequest)


async def _place(
    place: Annotated[
        str | None,
        Query(
            description="Move the mesh to this placement, which is JSON as `edit` and `fit` answer it. It takes x to "
            "`scale` · `rotation` · x + `translation`. Members left out change nothing.",
            openapi_examples={"a quarter turn": {"value": _EXAMPLE}},
        ),
    ] = None,
) -> Placement | None:
    if place is None:
        return None
    given = read_query(place, "place", _ADAPTER)
    return Placement(np.array(given.rotation, float), np.array(given.translation, float), given.scale)


PlaceQuery = Annotated[Placement | None, Depends(_place)]


@dataclass(frozen=True)
class MeshOptions:
    """How a call answers a mesh; ``topology`` None leaves the choice to the format."""

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
        examples: Examples = True,
    ) -> ShapeRequest:
        """Return the request for the shape of a code, None for the reference; raises RefusedError or LatentError.

        ``bounds`` are for the code that colours compare with, and ``covariance`` (m, m) is for ``color=spread``.
        """
        colour_by = self.color.on(model, bounds, covariance)
        polygons = SHAPE_FORMATS[self.format].polygons
        topology = choose_topology(self.topology, self.format, model, mesh, polygons=polygons)
        examples = examples if model.decoder.remembers else True
        return ShapeRequest(code, mesh, self.format, quality, colour_by, self.place, topology, examples)


async def _frame(
    request: Request,
    color: ColorQuery = NO_COLOR,
    topology: TopologyQuery = None,
    format: Annotated[Format, one_of(SHAPE_FORMATS)] = None,
) -> MeshOptions:
    formats = {name: f.media_type for name, f in SHAPE_FORMATS.items() if f.coloured or color.quantity is None}
    chosen = choose(writable(formats), format, listed(request.headers, "accept"), _UNCOLOURED | UNAVAILABLE)
    return MeshOptions(chosen, color, topology)


#: Options of a frame, which has its place by the animation.
FrameQuery = Annotated[MeshOptions, Depends(_frame)]


async def _mesh(options: FrameQuery, place: PlaceQuery = None) -> MeshOptions:
    return replace(options, place=place)


#: Options of a single shape.
SingleMeshQuery = Annotated[MeshOptions, Depends(_mesh)]
