"""One code to one mesh file, coloured on request by how it differs from another shape."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from shapespace.files.colouring import Colouring, Quantity
from shapespace.model.decoder import Diagnostics, MeshChoice, Shape
from shapespace.model.latent_space import CheckedCode
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.use_cases.batch import Timings, solve, total_seconds
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS
from shapespace.solve.deadline import Deadline


@dataclass(frozen=True)
class ColourBy:
    """What to colour a mesh by.

    Attributes:
        quantity: stretch or bending.
        against: code of the shape to compare with; None is the reference.
    """

    quantity: Quantity
    against: CheckedCode | None


@dataclass(frozen=True)
class WantedShape:
    """A shape as somebody wants it.

    Attributes:
        code: of the shape; None is the reference.
        mesh: fine or coarse.
        format: one of SHAPE_FORMATS.
        colour_by: what to colour it by, if anything.
    """

    code: CheckedCode | None
    mesh: MeshChoice
    format: str
    colour_by: ColourBy | None = None


@dataclass(frozen=True)
class ShapeFile:
    """A shape as a file.

    Attributes:
        content: of the file.
        diagnostics: how well the shape was found.
        legend: of the colours, where there are some.
        seconds: time by stage.
    """

    content: bytes
    diagnostics: Diagnostics
    legend: Mapping[str, Any] | None
    seconds: Timings


async def shape_file(workers: Workers, caller: Caller, model: ShapeModel, wanted: WantedShape) -> ShapeFile:
    """One shape as a file.

    Raises:
        BusyError: no place for the request.
        DeadlineError, DisconnectedError, EndingError: the call ended before the file was ready.
        NotFiniteError, ModelFailedError: the model has no shape for the code.
    """
    mesh, colour_by = wanted.mesh, wanted.colour_by

    def find(code: CheckedCode | None, deadline: Deadline) -> Shape:
        return model.reference_shape(mesh) if code is None else solve(workers, model, mesh, code, deadline)

    def make(deadline: Deadline) -> ShapeFile:
        found, colouring = [find(wanted.code, deadline)], None
        if colour_by:
            found.append(find(colour_by.against, deadline))
        began = time.perf_counter()
        if colour_by:
            vertices, against = (shape.vertices for shape in found)
            colouring = Colouring.between(colour_by.quantity, vertices, against, model.mesh(mesh).connectivity)
        content = SHAPE_FORMATS[wanted.format].encode(found[0].vertices, model.mesh(mesh).faces, colouring)
        seconds = {**total_seconds(shape.seconds for shape in found), "encode": time.perf_counter() - began}
        return ShapeFile(content, found[0].diagnostics, colouring.legend if colouring else None, seconds)

    async with workers.admit(caller) as call:
        return await workers.run(make, call)
