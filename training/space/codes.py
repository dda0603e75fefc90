"""Codes of the shapes of a collection: their exponentials come closest to the shapes, in vertices."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.coordinates.reconstruction import DEFAULT_ETA
from shapespace.mesh.rigid_motion import align, aligned_change
from shapespace.shell.exponential import exponential
from shapespace.shell.exponential_derivative import ExponentialDerivative
from shapespace.shell.space import ShellSpace
from shapespace.solve.least_squares import Box, Stopping, least_squares
from shapespace.solve.outcome import Status
from shapespace.training.runs.progress import progress
from shapespace.training.runs.workers import run

#: The search ends when no coefficient would move by more than 1e-3, when the sum of squares would fall by less than
#: 1e-3 of itself, or after 40 exponentials.
STOPPING = Stopping(1e-3, 1e-3, max_evaluations=40)
#: The search starts from the first multiple of the given start that has an exponential.
START_SHARES = (1.0, 0.75, 0.5, 0.25, 0.0)
#: Margin of the bounds on each side of the shapes' codes, as a share of their range.
MARGIN = 0.05
#: Least width of the negative or positive side of the bounds, as a share of the width of the other side.
SMALLEST_SIDE = 0.1
#: Steps of an exponential that stands for the limit of K. With a centred first step, 1 − R² is about 3e-7 there.
LIMIT_STEPS = 64
#: Candidates for K, and the largest 1 − R² against the limit: a tenth of the error of good networks.
STEPS, STEPS_ERROR = (8, 12, 16, 24, 32), 1e-5
#: Random codes on which K is chosen.
STEPS_CODES = 12


@dataclass(frozen=True)
class Codes:
    """Codes of shapes, and their exponentials."""

    codes: FloatArray  # (n, m)
    vertices: FloatArray  # (n, V, 3) exponentials of the codes, aligned to the shapes
    exponentials: tuple[int, ...]  # (n,) number of exponentials of each search
    status: tuple[Status, ...]  # (n,) status of each search


def nearest_codes(
    space: ShellSpace,
    mean: FloatArray,
    modes: FloatArray,
    shapes: FloatArray,
    start: FloatArray,
    steps: int,
    workers: int = -1,
    centre: FloatArray | None = None,
) -> Codes:
    """Find the codes ``w`` that minimise ``‖exp_z̄(Σ_j w_j u_j) − x‖²`` over vertices, after rigid alignment.

    The method is Gauss–Newton, with the derivative of the discrete exponential. Projections of logarithms, from which
    the search starts, are minimisers only to first order, because the exponential is nonlinear.

    Modes (m, V, 3) are vertex fields at the mean (V, 3), scaled so that codes are about 1. Shapes (n, V, 3) may be in
    any position; ``start`` (n, m) has codes nearby. The vertex field ``centre`` (V, 3) is added to all velocities. The
    result does not depend on the number of workers.
    """
    items = [(shape, code) for shape, code in zip(shapes, start, strict=True)]
    shape_of = exponential_map(space, mean, modes, steps, centre)
    return gathered(run(partial(_nearest, shape_of), items, workers=workers), len(items))


def gathered(results: Iterable[tuple[int, NearestCode]], count: int) -> Codes:
    """Return the codes of ``count`` searches that end in any order."""
    found = dict(progress(results, "finding the codes of your shapes", "shape", count))
    codes, vertices, counts, status = zip(*(found[k] for k in range(count)), strict=True)
    return Codes(np.stack(codes), np.stack(vertices), counts, status)


def box_of(codes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return lower and upper bounds (m,) around codes (n, m) and the code of the mean, which is 0, with a margin."""
    lower, upper = codes.min(axis=0), codes.max(axis=0)
    room = MARGIN * (upper - lower)
    lower, upper = lower - room, upper + room
    return np.minimum(lower, -SMALLEST_SIDE * upper), np.maximum(upper, -SMALLEST_SIDE * lower)


def enough_steps(space: ShellSpace, mean: FloatArray, modes: FloatArray, codes: FloatArray, workers: int = -1) -> int:
    """Return the smallest K whose exponentials are close enough to the limit, see `STEPS`.

    They are compared at random codes in the bounds of ``codes`` (n, m). Where fewer than two of these have a shape, K
    is the largest candidate.
    """
    drawn = np.random.default_rng(0).uniform(*box_of(codes), (STEPS_CODES, codes.shape[1]))
    results = run(partial(_by_steps, space, mean, modes), list(drawn), workers=workers)
    shot = [found for _, found in sorted(progress(results, "time steps", "code", len(drawn))) if found is not None]
    if len(shot) < 2:
        return STEPS[-1]
    ends, norm = np.stack(shot, axis=1), WeightedNorm.of(space.reference.with_vertices(mean), DEFAULT_ETA)
    limit = ends[-1]
    spread = norm.square(limit - limit.mean(axis=0)).sum()
    near = [norm.square(end - limit).sum() <= STEPS_ERROR * spread for end in ends]
    return next((steps for steps, enough in zip(STEPS, near, strict=False) if enough), STEPS[-1])


def _by_steps(space: ShellSpace, mean: FloatArray, modes: FloatArray, code: FloatArray) -> FloatArray | None:
    """Return lengths and angles (k, 2E) of a code's shapes by number of steps, the limit last; None if one fails."""
    velocity = np.tensordot(code, modes, axes=1)
    paths = [exponential(space, mean, velocity, steps) for steps in (*STEPS, LIMIT_STEPS)]
    return np.stack([path.nric[-1] for path in paths]) if all(path.converged for path in paths) else None


class NearestCode(NamedTuple):
    """The code whose shape comes closest to a shape."""

    code: FloatArray  # (m,)
    vertices: FloatArray  # (V, 3) its shape, aligned to the given one
    shapes: int  # number of shapes of the search
    status: Status


#: Map from a code (m,) to its shape (V, 3) and the function that computes its derivative (m, V, 3); None where the code
#: has no shape.
ShapeMap = Callable[[FloatArray], tuple[FloatArray, Callable[[], FloatArray]] | None]


def nearest_code(shape_of: ShapeMap, target: FloatArray, start: FloatArray) -> NearestCode:
    """Find the code that minimises ``‖shape_of(w) − x‖²`` over vertices, after rigid alignment, by Gauss–Newton.

    The target x is (V, 3), the start (m,). The code 0 must have a shape.
    """
    everywhere = np.full(len(start), np.inf)
    box = Box(-everywhere, everywhere, np.ones(len(start)))

    @lru_cache(2)  # for the best code and for the code that is tried
    def shoot(code: tuple[float, ...]) -> tuple[FloatArray, Callable[[], FloatArray]] | None:
        return shape_of(np.array(code))

    def residuals(x: FloatArray) -> FloatArray:
        found = shoot(tuple(x))
        return np.full(target.size, np.nan) if found is None else (align(found[0], target) - target).ravel()

    def shape_at(x: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]]:
        found = shoot(tuple(x))
        if found is None:
            raise RuntimeError("the search went to a code without a shape")
        return found

    def jacobian(x: FloatArray, _: FloatArray) -> FloatArray:
        vertices, derivative = shape_at(x)
        changes = aligned_change(vertices, derivative(), target)
        return changes.reshape(len(changes), -1).T

    first = next(share * start for share in START_SHARES if shoot(tuple(share * start)))
    fit = least_squares(residuals, jacobian, first, box, STOPPING)
    return NearestCode(fit.x, align(shape_at(fit.x)[0], target), fit.iterations, fit.status)


def exponential_map(
    space: ShellSpace, mean: FloatArray, modes: FloatArray, steps: int, centre: FloatArray | None = None
) -> ShapeMap:
    """Return the map from codes (m,) to exponentials along modes (m, V, 3) at the mean (V, 3), which can be pickled.

    The vertex field ``centre`` (V, 3) is added to all velocities.
    """
    return partial(_exponential, space, mean, modes, steps, np.zeros_like(mean) if centre is None else centre)


def _exponential(
    space: ShellSpace, mean: FloatArray, modes: FloatArray, steps: int, centre: FloatArray, code: FloatArray
) -> tuple[FloatArray, Callable[[], FloatArray]] | None:
    path = exponential(space, mean, centre + np.tensordot(code, modes, axes=1), steps)
    if not path.converged:
        return None
    return path.vertices[-1], lambda: ExponentialDerivative(path).push_forward(modes)


def _nearest(shape_of: ShapeMap, item: tuple[FloatArray, FloatArray]) -> NearestCode:
    return nearest_code(shape_of, *item)
