"""Parallel transport along a path of shapes, by Schild's ladder (Rumpf and Wirth 2015)."""

from dataclasses import dataclass, replace
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
    """A vector transported along a path; converged if it reached the end.

    Iterations and residual sum up the geodesics and exponentials that were solved: their total, and their maximum.

    Attributes:
        velocities: (n, V, 3) vertex fields without rigid motion at the shapes that were reached, the given field first.
    """

    velocities: FloatArray


def parallel_transport(
    space: ShellSpace, path: DiscretePath, velocity: FloatArray, *, tolerance: float = TOLERANCE
) -> Transport:
    """Transport a tangent vector along a path, by a geodesic parallelogram for each of the K steps.

    The vector v_{k−1} is scaled to the length of a step, so that its tip is p = X_{k−1} + v_{k−1}/s. Let c be the
    middle of the two-step geodesic from p to X_k. The two-step geodesic from X_{k−1} through c ends at the tip of the
    transported vector at X_k. This needs two small solves per step and no derivative of the metric. It is first-order
    in the lengths of path and vector, and exact in flat space.

    Args:
        space: Riemannian space of the shapes.
        path: a complete path with at least two shapes.
        velocity: (V, 3) vertex field at the first shape.
        tolerance: tolerance of each solve.
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
            reason = f"step {len(carried)}: {rung.reason}"
            found = Transport(velocities=np.stack(carried), status=rung.status, reason=reason)
            return replace(found, iterations=iterations, residual=residual)
        tip = align(rung.vertices[-1], y)
        carried.append((tip - y) / shrink)
    return Transport(velocities=np.stack(carried), status=Status.CONVERGED, iterations=iterations, residual=residual)
