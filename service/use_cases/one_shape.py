"""One shape as a mesh file, on request coloured by its difference from another shape."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.files.colouring import Colouring, Quantity
from shapespace.mesh.attributes import Topology
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import CheckedCode, NotFiniteError
from shapespace.model.memory import Examples
from shapespace.model.shape import Diagnostics, Quality, Shape
from shapespace.model.shape_model import ShapeModel
from shapespace.model.vertex_uncertainty import vertex_uncertainty
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.tracing import record_stages
from shapespace.service.use_cases.batch import Timings, solve, total_seconds
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS, catch_write_errors, with_topology
from shapespace.solve.deadline import Deadline


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


@dataclass(frozen=True)
class ShapeFile:
    """A shape as a file, with the legend of its colours, if there are any, and its time by stage."""

    content: bytes
    diagnostics: Diagnostics
    legend: Mapping[str, Any] | None
    seconds: Timings


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


async def shape_file(workers: Workers, caller: Caller, model: ShapeModel, wanted: ShapeRequest) -> ShapeFile:
    """Return one shape as a file; raises NotFiniteError or ModelFailedError if the model has none for the code."""
    mesh, colour_by = wanted.mesh, wanted.colour_by

    def find(code: CheckedCode | None, deadline: Deadline, examples: Examples) -> Shape:
        if code is None:
            return model.decoder.reference_shape(mesh)
        return solve(workers, model, mesh, wanted.quality, code, deadline, examples)

    def make(deadline: Deadline) -> ShapeFile:
        found, colouring = [find(wanted.code, deadline, wanted.examples)], None
        if colour_by and wanted.code and colour_by.covariance is not None:
            spread = vertex_uncertainty(model.decoder, wanted.code[0], colour_by.covariance, mesh, deadline)
            colouring = Colouring.of_spread(spread)
        elif colour_by:
            found.append(find(colour_by.against, deadline, bool(wanted.examples)))
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
        return ShapeFile(content, found[0].diagnostics, colouring.legend if colouring else None, seconds)

    async with workers.admit(caller) as call:
        return await workers.run(make, call)
