"""Parallel transport along a path of shapes, by Schild's ladder (Rumpf and Wirth 2015)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.shell.exponential import extrapolate
from shapespace.shell.geodesic import geodesic
from shapespace.shell.space import TOLERANCE, DiscretePath, ShellSpace
from shapespace.solve.outcome import Outcome, Status


@dataclass(frozen=True, kw_only=True)
class Transport(Outcome):
    """A vector carried along a path; converged if it got to the end.

    Iterations and the largest residual are those of the geodesics and exponentials solved on the way.

    Attributes:
        velocities: (n, V, 3) vertex fields without rigid motion, one at each shape reached, the given one
            first.
    """

    velocities: FloatArray


def parallel_transport(
    space: ShellSpace, path: DiscretePath, velocity: FloatArray, *, tolerance: float = TOLERANCE
) -> Transport:
    """Carry a tangent vector along a path, a geodesic parallelogram for each of its K steps.

    With v_{k−1} scaled to the length of a step, p = X_{k−1} + v_{k−1}/s is the tip of the vector; c is the
    middle of a two-step geodesic from p to X_k; the two-step geodesic from X_{k−1} through c ends in the tip
    at X_k. Two small solves a rung, and no derivative of the metric. First-order in the length of path and
    vector, exact where the space is flat.

    Args:
        space: where.
        path: complete, with at least two shapes.
        velocity: (V, 3) vertex field at its first shape.
        tolerance: of each solve.
    """
    steps = len(path.vertices) - 1
    if steps < 1:
        raise ValueError("a path needs at least two shapes to carry a vector along")
    first = path.vertices[0]
    carried = [without_rigid_motion(space.shape(velocity), first)]
    if not np.isfinite(carried[0]).all():
        nothing = np.zeros((0, *first.shape))
        return Transport(velocities=nothing, status=Status.NOT_FINITE, reason="the vector is not finite")
    size = space.norm(first, carried[0])
    if size == 0:
        return Transport(velocities=np.zeros_like(path.vertices), status=Status.CONVERGED, residual=0)
    stride = np.sqrt(path.energy) / steps
    shrink = (stride if stride > 0 else size) / size
    iterations, residual = 0, 0.0
    for x, y in pairwise(path.vertices):
        half = rung = geodesic(space, x + shrink * carried[-1], y, 2, tolerance=tolerance)
        if half.converged:
            rung = extrapolate(space, x, align(half.vertices[1], x), 1, tolerance=tolerance)
            iterations += half.iterations
        iterations, residual = iterations + rung.iterations, max(residual, half.residual, rung.residual)
        if not rung.converged:
            return Transport(
                velocities=np.stack(carried),
                status=rung.status,
                iterations=iterations,
                residual=residual,
                reason=f"step {len(carried)}: {rung.reason}",
            )
        tip = align(rung.vertices[-1], y)
        carried.append((tip - y) / shrink)
    return Transport(velocities=np.stack(carried), status=Status.CONVERGED, iterations=iterations, residual=residual)
