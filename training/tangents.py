"""The shapes of a collection as tangent vectors at their mean: the discrete logarithms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from geometry.calculus import ShellSpace
from geometry.geodesic import logarithm
from geometry.mesh import FloatArray
from geometry.nric import unwrap
from geometry.rigid import without_rigid_motion
from geometry.status import Status
from training.modes import ModeError
from training.workers import run

#: Of the geodesics to the shapes, as a length; far below what modes leave unexplained.
LOGARITHM_TOLERANCE = 1e-6
#: A logarithm of fewer steps is further from one of many than the linearised one is (measured on three collections).
FEWEST_STEPS = 4
#: Logarithms that a process computes at a time.
CHUNK = 4


@dataclass(frozen=True)
class Tangents:
    """The shapes of a collection seen from their mean.

    Attributes:
        fields: (n, V, 3) vertex fields, without rigid motion.
        status: of the last geodesic tried; where it is not CONVERGED, the field is the linearised logarithm.
        steps: K of the geodesic found, 0 where there is none.
        reasons: for each shape why the geodesic with all steps was not found, or an empty string.
    """

    fields: FloatArray
    status: tuple[Status, ...]
    steps: tuple[int, ...]
    reasons: tuple[str, ...]

    @property
    def fallbacks(self) -> list[int]:
        """The shapes whose logarithm had to be linearised."""
        return [i for i, steps in enumerate(self.steps) if steps == 0]


def tangents(space: ShellSpace, mean: FloatArray, shapes: ArrayLike, steps: int, workers: int = -1) -> Tangents:
    """The discrete logarithms of shapes at their mean.

    Between far poses of real meshes a geodesic may not be found. One with half as many steps often is, as its shapes
    need not pass where the surface degenerates; failing that too, the difference of lengths and angles, with the
    angles unwrapped from the mean's, is projected to the tangent space: the logarithm to first order.

    A logarithm is the inverse of the exponential with as many steps, and converges only to first order in 1/K: on real
    collections those of 4 and of 8 steps differ by 10 to 35 % of their length.

    Args:
        space: where; each process gets a copy.
        mean: X̄ (V, 3).
        shapes: (n, V, 3), in any position.
        steps: K of the geodesics.
        workers: processes, by default one a core; 1 computes here. The result does not depend on it.

    Raises:
        ModeError: a shape with a coordinate that isn't finite.
        WorkersError: processes that are killed again and again.
    """
    x = np.stack([space.shape(shape) for shape in np.asarray(shapes, dtype=np.float64)])
    bad = np.flatnonzero(~np.isfinite(x).all(axis=(1, 2)))
    if len(bad):
        raise ModeError(f"shape {bad[0]} has a coordinate that is not finite")
    parts = [x[i : i + CHUNK] for i in range(0, len(x), CHUNK)]
    done = dict(run(partial(_logarithms, space, mean, steps), parts, workers=workers))
    fields, status, found, reasons = zip(*(one for k in range(len(parts)) for one in done[k]), strict=True)
    return Tangents(np.stack(fields), status, found, reasons)


def _logarithms(
    space: ShellSpace, mean: FloatArray, steps: int, shapes: FloatArray
) -> list[tuple[FloatArray, Status, int, str]]:
    return [_logarithm(space, mean, shape, steps) for shape in shapes]


def _logarithm(
    space: ShellSpace, mean: FloatArray, shape: FloatArray, steps: int
) -> tuple[FloatArray, Status, int, str]:
    reason = ""
    for k in (steps, steps // 2) if steps // 2 >= FEWEST_STEPS else (steps,):
        found = logarithm(space, mean, shape, k, tolerance=LOGARITHM_TOLERANCE)
        reason = reason or found.path.reason
        if found.path.converged:
            return without_rigid_motion(found.velocity, mean), found.path.status, k, reason
    z = space.nric(mean)
    return space.project(mean, unwrap(space.nric(shape), z) - z), found.path.status, 0, reason
