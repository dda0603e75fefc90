"""A model as a GLB with a morph target for each bound of each coordinate."""

from __future__ import annotations

import time
from functools import partial

from shapespace.model.blend_shapes import blend_shapes, require_ends
from shapespace.model.decoder import MeshChoice, Quality, Shape
from shapespace.model.latent_space import Codes
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.use_cases.batch import Timings, solve
from shapespace.service.use_cases.many_shapes import shapes_size
from shapespace.solve.deadline import Deadline


async def blend_shapes_file(
    workers: Workers, caller: Caller, model: ShapeModel, mesh: MeshChoice
) -> tuple[bytes, Timings]:
    """Return the GLB, and its time by stage.

    Raises:
        PeriodicError: a coordinate is periodic, so that it has no bounds.
        TooManyCodesError: all targets together have more vertices than one answer may hold.
        NotFiniteError, ModelFailedError: the model has no shape at a bound.
        BusyError, DeadlineError, DisconnectedError, EndingError: the queue is full, or the call ended early.
    """
    require_ends(model.decoder)
    size = shapes_size(model, 2 * model.latents.dimension + 1, mesh)

    def shape(deadline: Deadline, code: Codes) -> Shape:
        return solve(workers, model, mesh, Quality.FULL, (code, True), deadline)

    def make(deadline: Deadline) -> tuple[bytes, Timings]:
        began = time.perf_counter()
        found = blend_shapes(model.decoder, mesh, partial(shape, deadline))
        solved = time.perf_counter()
        content = found.glb()
        return content, {"reconstruct": solved - began, "encode": time.perf_counter() - solved}

    with workers.holding(caller, size):
        async with workers.admit(caller) as call:
            return await workers.run(make, call)
