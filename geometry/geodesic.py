"""The time-discrete geodesic between two shapes, and the logarithm (paper, appendix B)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from geometry.anderson import Anderson
from geometry.calculus import TOLERANCE, ChordSolver, Path, Point, ShellSpace, fault_between
from geometry.cholesky import NotPositiveDefiniteError
from geometry.energy import RestShape
from geometry.mesh import FloatArray, align
from geometry.nric import unwrap
from geometry.reconstruction import Reconstructor
from geometry.status import Status

#: Iterations from one set of factors, and how often the factors are renewed before it is given up.
ITERATIONS = 40
RENEWALS = 20
#: Damped steps before undamped ones are tried again, and the smallest of them.
DESCENTS = 40
SMALLEST_DESCENT = 1 / 1024
#: Three iterations that leave more than this of the residual ask for new factors.
SLOW = 0.1
#: Gauss–Newton steps towards each shape of the first path; it need not be exact.
NEAREST_ITERATIONS = 4


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def geodesic(
    space: ShellSpace,
    start: FloatArray,
    end: FloatArray,
    steps: int = 8,
    *,
    tolerance: float = TOLERANCE,
) -> Path:
    """Connect two shapes by K + 1 shapes of least path energy ``K Σ W[z_{k−1}, z_k]``.

    Stationary where ``F_k = J_kᵀ (∂₂W[z_{k−1}, z_k] + ∂₁W[z_k, z_{k+1}]) = 0`` for every inner shape, all of
    them together. The start is the straight line in lengths and angles, brought to the manifold shape by shape.

    Newton's matrix for it is block tridiagonal, and factorising that would cost what K² shapes cost. But
    moved to lengths and angles it is nearly ``T ⊗ H`` with T = tridiag(−1, 2, −1), because H and the tangent
    spaces change little along the path. So a step takes the forces F_k to tangent vectors ``J_k A_k⁻¹ F_k``,
    solves T along time for them, and projects the result back to each tangent space: K − 1 factors, two
    solves with each an iteration, and a contraction of 0.1 to 0.2 that Anderson acceleration helps.

    Args:
        space: where.
        start: X_0 (V, 3).
        end: (V, 3), in any position; X_K is it, moved rigidly towards its neighbour.
        steps: K.
        tolerance: of ``sqrt(F_kᵀ A_k⁻¹ F_k)`` at every inner shape.
    """
    start, end = space.shape(start), space.shape(end)
    if steps < 1:
        raise ValueError(f"a path needs at least one step, not {steps}")
    if not np.isfinite(start).all():
        return Path(space.reference.vertices[None], Status.NOT_FINITE, space, "start has an entry that is not finite")
    if not np.isfinite(end).all():
        return Path(start[None], Status.NOT_FINITE, space, "end has an entry that is not finite")
    if steps == 1:
        return Path(np.stack([start, align(end, start)]), Status.CONVERGED, space)
    chords = space.chords(steps - 1)
    attempt = _Relaxed(start[None], 0, (), "")
    for first_path in (_straight, _reconstructed):
        try:
            shapes = first_path(space, start, end, chords)
            if attempt.iterations:
                shapes = _descended(space, shapes, chords)
            attempt = _relax(space, shapes, chords, tolerance)
        except NotPositiveDefiniteError as error:
            attempt = _Relaxed(start[None], 1, (), f"a shape on the way is degenerate: {error}")
        if not attempt.fault:
            for k in range(1, steps + 1):
                attempt.shapes[k] = align(attempt.shapes[k], attempt.shapes[k - 1])
            iterations = (attempt.iterations,)
            return Path(attempt.shapes, Status.CONVERGED, space, "", iterations, attempt.residuals)
    return Path(start[None], Status.STALLED, space, attempt.fault or "", (attempt.iterations,), attempt.residuals)


@dataclass(frozen=True)
class Logarithm:
    """The velocity with which a geodesic leaves.

    Attributes:
        velocity: (V, 3) vertex field ``K (X_1 − X_0)``, without rigid motion: what ``exponential`` takes. Zero if
            there is no geodesic.
        nric: (2E,) ``K (z_1 − z_0)``, the same as change of lengths and angles, tangent up to O(1/K).
        path: the geodesic, with status and reason.
    """

    velocity: FloatArray
    nric: FloatArray
    path: Path


def logarithm(
    space: ShellSpace,
    start: FloatArray,
    end: FloatArray,
    steps: int = 8,
    *,
    tolerance: float = TOLERANCE,
) -> Logarithm:
    """The discrete logarithm of ``end`` at ``start``, inverse of ``exponential`` with as many steps.

    X_1 is aligned to X_0 before the difference is taken, so that the velocity has no rigid part.
    """
    path = geodesic(space, start, end, steps, tolerance=tolerance)
    if not path.converged:
        nothing = np.zeros_like(path.vertices[0])
        return Logarithm(nothing, np.zeros(2 * space.connectivity.edge_count), path)
    velocity = steps * (path.vertices[1] - path.vertices[0])
    return Logarithm(velocity, steps * (path.nric[1] - path.nric[0]), path)


def _straight(space: ShellSpace, start: FloatArray, end: FloatArray, chords: list[ChordSolver]) -> FloatArray:
    """Shapes (K + 1, V, 3) near a straight line of lengths and angles; leaves each chord factorised near its shape.

    One after the other, because each is a good start for the next: Gauss–Newton with a factor kept fixed.
    """
    first = space.point(start)
    line = unwrap(space.nric(end), first.z) - first.z
    steps = len(chords) + 1
    shapes = [start]
    for k, chord in enumerate(chords, start=1):
        guess = space.point(start if k == 1 else 2 * shapes[-1] - shapes[-2])
        chord.factorise(guess)
        shapes.append(_nearest(guess, first.z + k / steps * line, chord))
    return np.stack([*shapes, align(end, shapes[-1])])


def _nearest(guess: Point, target: FloatArray, chord: ChordSolver) -> FloatArray:
    """A few steps from a guess to the shape whose lengths and angles come closest to a target, in the metric."""
    point, misfit = guess, unwrap(target, guess.z) - guess.z
    square = misfit @ guess.lower(misfit)
    for _ in range(NEAREST_ITERATIONS):
        step = chord.solve(point.pull_back(guess.lower(misfit)))
        t = 1.0
        while t > 1 / 64:
            trial = guess.space.point(point.vertices + t * step)
            trial_misfit = unwrap(target, trial.z) - trial.z
            trial_square = trial_misfit @ guess.lower(trial_misfit)
            if trial_square < square:
                break
            t /= 2
        else:
            break
        gain = 1 - trial_square / square
        point, misfit, square = trial, trial_misfit, trial_square
        if gain < 0.1:
            break
    return point.vertices


def _reconstructed(space: ShellSpace, start: FloatArray, end: FloatArray, chords: list[ChordSolver]) -> FloatArray:
    """The same, slower, for shapes far apart: by full Gauss–Newton in a norm with fewer wrong minima."""
    reconstruct = Reconstructor(space.reference, backend=space.backend)
    first = space.nric(start)
    line = unwrap(space.nric(end), first) - first
    steps = len(chords) + 1
    shapes = [start]
    for k in range(1, steps):
        shapes.append(reconstruct(first + k / steps * line, shapes[-1], tolerance=1e-3).vertices)
    return np.stack([*shapes, align(end, shapes[-1])])


def _inverse_in_time(steps: int) -> FloatArray:
    """T⁻¹ of T = tridiag(−1, 2, −1) for the inner shapes of a path."""
    k = np.arange(1, steps)
    return np.minimum.outer(k, k) * (steps - np.maximum.outer(k, k)) / steps


def _renew(space: ShellSpace, shapes: FloatArray, chords: list[ChordSolver]) -> None:
    for chord, x in zip(chords, shapes[1:-1], strict=True):
        chord.factorise(space.point(x))


def _forces(space: ShellSpace, shapes: FloatArray) -> tuple[RestShape, FloatArray, list[Point], FloatArray]:
    """The shapes but the last as rest shapes, all lengths and angles, and the inner shapes with forces ``−F``."""
    z = space.nric(shapes)
    rest = space.energy.rest(z[:-1])
    covectors = rest.gradient_deformed(z[1:])[:-1] + rest.gradient_rest(z[1:])[1:]
    points = [Point(space, *xz) for xz in zip(shapes[1:-1], z[1:-1], strict=True)]
    forces = np.stack([-p.pull_back(c) for p, c in zip(points, covectors, strict=True)])
    return rest, z, points, forces


def _descended(space: ShellSpace, shapes: FloatArray, chords: list[ChordSolver]) -> FloatArray:
    """Lower the path energy by damped steps with new factors for each, until full steps do.

    One H, of the middle shape, for all: then the step is a symmetric positive definite matrix times the
    forces, so there is always a step that lowers the energy.
    """
    inverse = _inverse_in_time(len(shapes) - 1)
    easy = 0
    for _ in range(DESCENTS):
        _renew(space, shapes, chords)
        rest, z, _, forces = _forces(space, shapes)
        value = rest.value(z[1:]).sum()
        middle = chords[len(chords) // 2].at
        moves = [c.solve(f) for c, f in zip(chords, forces, strict=True)]
        tangents = inverse @ np.stack([c.at.push_forward(m) for c, m in zip(chords, moves, strict=True)])
        covectors = [middle.lower(t) for t in tangents]
        step = np.stack([c.solve(c.at.pull_back(p)) for c, p in zip(chords, covectors, strict=True)])
        slope = -np.vdot(forces, step)
        t = 1.0
        while t > SMALLEST_DESCENT:
            trial = shapes.copy()
            trial[1:-1] += t * step
            z = space.nric(trial)
            if space.energy.rest(z[:-1]).value(z[1:]).sum() <= value + 1e-4 * t * slope:
                break
            t /= 2
        else:
            break
        shapes = trial
        easy = easy + 1 if t >= 0.5 else 0
        if easy == 5:
            break
    return shapes


@dataclass(frozen=True)
class _Relaxed:
    """Where the iteration on a whole path ended, with its fault if it isn't solved."""

    shapes: FloatArray
    iterations: int
    residuals: tuple[float, ...]
    fault: str | None


def _relax(space: ShellSpace, shapes: FloatArray, chords: list[ChordSolver], tolerance: float) -> _Relaxed:
    inverse = _inverse_in_time(len(shapes) - 1)
    shapes, best, lowest = shapes.copy(), shapes.copy(), np.inf
    iterations = failures = 0
    for renewal in range(RENEWALS):
        if renewal:
            _renew(space, shapes, chords)
        else:
            for chord, x in zip(chords, shapes[1:-1], strict=True):
                chord.turn_to(space.point(x))
        before = lowest
        mixing, residuals = Anderson(), []
        for _ in range(ITERATIONS):
            _, _, points, forces = _forces(space, shapes)
            moves = np.stack([c.solve(f) for c, f in zip(chords, forces, strict=True)])
            squares = np.abs(np.einsum("kvc,kvc->k", forces, moves))
            residuals.append(float(np.sqrt(squares.max())))
            if residuals[-1] <= tolerance:
                faults = (fault_between(a, b) for a, b in pairwise(points))
                fault = next((f for f in faults if f), None)
                return _Relaxed(shapes, iterations, tuple(np.sqrt(squares).tolist()), fault)
            if residuals[-1] < lowest:
                lowest, best = residuals[-1], shapes.copy()
            if not np.isfinite(residuals[-1]) or (len(residuals) > 3 and residuals[-1] > SLOW * residuals[-4]):
                break
            tangents = np.stack([c.push_forward(m) for c, m in zip(chords, moves, strict=True)])
            moves = np.stack([c.project(t) for c, t in zip(chords, inverse @ tangents, strict=True)])
            shapes[1:-1] = mixing(shapes[1:-1].copy(), forces, moves)
            iterations += 1
        shapes = best.copy()
        failures += lowest > before / 2
        if failures == 2:
            break
    fault = f"residual {lowest:.1e} after {iterations} iterations"
    return _Relaxed(best, iterations, (lowest,), fault)
