"""One shape as a mesh file, on request coloured by its difference from another shape."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.files.colouring import Colouring, Quantity
from shapespace.mesh.attributes import Topology
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import CheckedCode, NotFiniteError
from shapespace.model.memory import Examples
from shapespace.model.shape import Quality, Shape
from shapespace.model.shape_model import ShapeModel
from shapespace.model.vertex_uncertainty import vertex_uncertainty
from shapespace.service.limits.workers import Call, Caller
from shapespace.service.tracing import record_stages
from shapespace.service.use_cases.batch import EncodedFile, solve, total_seconds
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, catch_write_errors, with_topology


@dataclass(frozen=True)
class ColourOptions:
    """What colours a mesh: the difference from a code, None for the reference, or a spread by a covariance (m, m)."""

    quantity: Quantity
    against: CheckedCode | None
    covariance: FloatArray | None = None


@dataclass(frozen=True)
class ShapeRequest:
    """A request for one shape, in a format of SHAPE_FORMATS.

    The code None is the reference. ``quality`` is that of the shape that colours compare with too, and ``place`` is
    relative to the reference.
    """

    code: CheckedCode | None
    mesh: MeshChoice
    format: str
    quality: Quality = Quality.AUTO
    colour_by: ColourOptions | None = None
    place: Placement | None = None
    topology: Topology = Topology.ORIGINAL
    examples: Examples = True


def place_vertices(vertices: NDArray[np.floating], place: Placement | None) -> FloatArray:
    """Return positions (…, V, 3) after a placement; raises NotFiniteError if they overflow."""
    there = vertices.astype(np.float64, copy=False)
    if place is None:
        return there
    with np.errstate(over="ignore", invalid="ignore"):
        moved = place(there)
        if not np.isfinite(moved.astype(np.float32)).all():
            raise NotFiniteError("place moves the shape so far away that the numbers overflow. Send smaller numbers.")
    return moved


async def shape_file(caller: Caller, model: ShapeModel, wanted: ShapeRequest) -> EncodedFile:
    """Return one shape as a file.

    Raises NotFiniteError or ModelFailedError if the model has no shape for the code.
    """
    mesh, colour_by = wanted.mesh, wanted.colour_by

    def find(call: Call, code: CheckedCode | None, examples: Examples) -> Shape:
        if code is None:
            return model.decoder.reference_shape(mesh)
        return solve(call, model, mesh, wanted.quality, code, examples)

    def make(call: Call) -> EncodedFile:
        found, colouring = [find(call, wanted.code, wanted.examples)], None
        if colour_by and wanted.code and colour_by.covariance is not None:
            spread = vertex_uncertainty(model.decoder, wanted.code[0], colour_by.covariance, mesh, call)
            colouring = Colouring.of_spread(spread)
        elif colour_by:
            found.append(find(call, colour_by.against, bool(wanted.examples)))
        began = time.perf_counter()
        if colour_by and colouring is None:
            vertices, against = (shape.vertices for shape in found)
            colouring = Colouring.between(colour_by.quantity, vertices, against, model.mesh(mesh).connectivity)
        vertices = place_vertices(found[0].vertices, wanted.place)
        surface = with_topology(model.decoder.surface(mesh), wanted.topology)
        with catch_write_errors():
            content = SHAPE_FORMATS[wanted.format].encode(vertices, model.mesh(mesh).faces, colouring, surface)
        encoding = {"encode": time.perf_counter() - began}
        record_stages(encoding)
        seconds = total_seconds(shape.seconds for shape in found) | encoding
        legend = colouring.legend if colouring else {}
        return EncodedFile(content, seconds, asdict(found[0].diagnostics), legend=legend)

    async with caller.admit() as call:
        return await call.run(make)
