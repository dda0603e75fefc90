"""The time-discrete geodesic between two shapes, and the logarithm (paper, appendix B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import unwrap
from shapespace.mesh.rigid_motion import align
from shapespace.shell.space import (
    TOLERANCE,
    ChordSolver,
    Path,
    Point,
    ShellSpace,
    edge_length,
    fault_between,
    keeps_faces,
)
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.status import Status
from shapespace.solve.truncated_newton import descend

#: Iterations from one set of factors, and how often the factors are renewed before it is given up.
ITERATIONS = 40
RENEWALS = 20
#: Newton steps for the energy of a path.
DESCENTS = 30
#: A step of a path with more than this times the mean energy of all is a jump: a geodesic has constant speed.
JUMP = 4.0
#: Of the shapes of a first path, which need not be exact.
MIDDLE_ITERATIONS, MIDDLE_TOLERANCE = 30, 1e-2
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
    first: FloatArray | None = None,
    bisect: bool = True,
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
        first: (K + 1, V, 3) a path from start to end to begin with instead, such as one through a shape near the end.
        bisect: whether to try the slower first path for shapes far apart, too.
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
    ways: list[Callable[[], FloatArray]] = [lambda: _straight(space, start, end, chords)]
    if bisect:
        ways.append(lambda: _descended(space, _bisected(space, start, end, chords), chords, tolerance))
    if first is not None:
        given = np.concatenate([start[None], first[1:-1], align(end, first[-2])[None]])
        ways = [lambda: _descended(space, given, chords, tolerance)]
    attempt = _Relaxed(start[None], 0, (), "")
    for first_path in ways:
        try:
            attempt = _relax(space, first_path(), chords, tolerance)
        except NotPositiveDefiniteError as error:
            attempt = _Relaxed(start[None], 1, (), f"a shape on the way is degenerate: {error}")
        if not attempt.fault:
            for k in range(1, steps + 1):
                attempt.shapes[k] = align(attempt.shapes[k], attempt.shapes[k - 1])
            iterations = (attempt.iterations,)
            return Path(attempt.shapes, Status.CONVERGED, space, "", iterations, attempt.residuals)
    return Path(start[None], Status.STALLED, space, attempt.fault or "", (attempt.iterations,), attempt.residuals)


def _descended(space: ShellSpace, shapes: FloatArray, chords: list[ChordSolver], tolerance: float) -> FloatArray:
    """The path (K + 1, V, 3) of least energy downhill from another; leaves each chord factorised near its shape."""
    energy = _PathEnergy(space, shapes[0], shapes[-1], chords)
    shapes = energy.path(descend(energy, shapes[1:-1], tolerance / 2, DESCENTS).x)
    _renew(space, shapes, chords)
    return shapes


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


def towards(space: ShellSpace, path: Path, end: FloatArray) -> FloatArray:
    """A first path (K + 1, V, 3) for ``geodesic``, from a geodesic to a shape near its end.

    To lengths and angles of its shapes a growing part is added of what the two ends differ by.
    """
    steps, chord = len(path.vertices) - 1, space.chord
    change = unwrap(space.nric(end), path.nric[-1]) - path.nric[-1]
    shapes = [path.vertices[0]]
    for k in range(1, steps):
        guess = space.point(path.vertices[k])
        chord.factorise(guess)
        shapes.append(_nearest(guess, path.nric[k] + k / steps * change, chord))
    return np.stack([*shapes, align(end, shapes[-1])])


def halved(space: ShellSpace, path: Path) -> Path:
    """The same path in twice as many steps, with shapes between by half the change of lengths and angles."""
    chord, shapes = space.chord, [path.vertices[0]]
    for k in range(1, len(path.vertices)):
        guess = space.point(shapes[-1])
        chord.factorise(guess)
        middle = _nearest(guess, (path.nric[k - 1] + path.nric[k]) / 2, chord)
        shapes += [middle, align(path.vertices[k], middle)]
    return Path(np.stack(shapes), path.status, space)


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
            if trial_square < square and keeps_faces(guess.space, point.vertices, trial.vertices):
                break
            t /= 2
        else:
            break
        gain = 1 - trial_square / square
        point, misfit, square = trial, trial_misfit, trial_square
        if gain < 0.1:
            break
    return point.vertices


def _bisected(space: ShellSpace, start: FloatArray, end: FloatArray, chords: list[ChordSolver]) -> FloatArray:
    """The same, slower, for shapes far apart: the middle of both by least energy, then the middles of the halves.

    Each is sought from one of the two that it lies between, and so are all shapes valid on the way. The line of lengths
    and angles may lead through what is no shape.
    """
    shapes: dict[int, FloatArray] = {0: start, len(chords) + 1: end}

    def fill(i: int, j: int) -> None:
        if j - i < 2:
            return
        k = (i + j) // 2
        between = _Middle(space, shapes[i], shapes[j], (k - i, j - k), chords[0])
        nearer = shapes[i] if k - i <= j - k else shapes[j]
        shapes[k] = descend(between, nearer, MIDDLE_TOLERANCE, MIDDLE_ITERATIONS).x
        fill(i, k)
        fill(k, j)

    fill(0, len(chords) + 1)
    return np.stack([shapes[k] for k in sorted(shapes)])


class _Middle:
    """``W[a, z(X)]/s + W[z(X), b]/t`` by X, for a shape s steps after a and t before b; see newton.Energy."""

    def __init__(
        self, space: ShellSpace, a: FloatArray, b: FloatArray, steps: tuple[int, int], chord: ChordSolver
    ) -> None:
        self._space, self._chord = space, chord
        self._first, self._second = 1 / steps[0], 1 / steps[1]
        self._a, self._b = space.point(a).rest, space.nric(b)
        self.length = edge_length(space)

    def value(self, x: FloatArray) -> float:
        z = self._space.nric(x)
        return float(self._first * self._a.value(z) + self._second * self._space.energy.rest(z).value(self._b))

    def forces(self, x: FloatArray) -> FloatArray:
        point = self._space.point(x)
        covector = self._first * self._a.gradient_deformed(point.z) + self._second * point.rest.gradient_rest(self._b)
        return -point.pull_back(covector)

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        return keeps_faces(self._space, x, x + step)

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        self._chord.factorise(self._space.point(x))
        return self._chord.solve


def _inverse_in_time(steps: int) -> FloatArray:
    """T⁻¹ of T = tridiag(−1, 2, −1) for the inner shapes of a path."""
    k = np.arange(1, steps)
    return np.minimum.outer(k, k) * (steps - np.maximum.outer(k, k)) / steps


def _renew(space: ShellSpace, shapes: FloatArray, chords: list[ChordSolver]) -> None:
    for chord, x in zip(chords, shapes[1:-1], strict=True):
        chord.factorise(space.point(x))


def _forces(space: ShellSpace, shapes: FloatArray) -> tuple[list[Point], FloatArray]:
    """The inner shapes with forces ``−F``."""
    z = space.nric(shapes)
    rest = space.energy.rest(z[:-1])
    covectors = rest.gradient_deformed(z[1:])[:-1] + rest.gradient_rest(z[1:])[1:]
    points = [Point(space, *xz) for xz in zip(shapes[1:-1], z[1:-1], strict=True)]
    forces = np.stack([-p.pull_back(c) for p, c in zip(points, covectors, strict=True)])
    return points, forces


class _PathEnergy:
    """``Σ W[z_{k−1}, z_k]`` by the inner shapes (K − 1, V, 3) of a path; see newton.Energy."""

    def __init__(self, space: ShellSpace, start: FloatArray, end: FloatArray, chords: list[ChordSolver]) -> None:
        self._space, self._start, self._end, self._chords = space, start[None], end[None], chords
        self._inverse = _inverse_in_time(len(chords) + 1)
        self.length = edge_length(space)

    def path(self, x: FloatArray) -> FloatArray:
        """All shapes (K + 1, V, 3)."""
        return np.concatenate([self._start, x, self._end])

    def value(self, x: FloatArray) -> float:
        z = self._space.nric(self.path(x))
        return float(self._space.energy.rest(z[:-1]).value(z[1:]).sum())

    def forces(self, x: FloatArray) -> FloatArray:
        return _forces(self._space, self.path(x))[1]

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        return keeps_faces(self._space, x, x + step)

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """One H, of the middle shape, for all: only then is the product symmetric and positive definite."""
        _renew(self._space, self.path(x), self._chords)
        middle = self._chords[len(self._chords) // 2].at

        def solve(forces: FloatArray) -> FloatArray:
            moves = [c.solve(f) for c, f in zip(self._chords, forces, strict=True)]
            tangents = [c.at.push_forward(m) for c, m in zip(self._chords, moves, strict=True)]
            covectors = [middle.lower(t) for t in self._inverse @ np.stack(tangents)]
            return np.stack([c.solve(c.at.pull_back(p)) for c, p in zip(self._chords, covectors, strict=True)])

        return solve


@dataclass(frozen=True)
class _Relaxed:
    """Where the iteration on a whole path ended, with its fault if it isn't solved."""

    shapes: FloatArray
    iterations: int
    residuals: tuple[float, ...]
    fault: str | None


def _jump(space: ShellSpace, shapes: FloatArray) -> str | None:
    """What makes a stationary path no geodesic: a step that passes over a collapse, where W has a value again."""
    z = space.nric(shapes)
    energies = space.energy.rest(z[:-1]).value(z[1:])
    worst = int(energies.argmax())
    if energies[worst] > JUMP * energies.mean():
        return f"step {worst + 1} takes {energies[worst] / energies.mean():.1f} times the mean energy of all: a jump"
    return None


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
            points, forces = _forces(space, shapes)
            moves = np.stack([c.solve(f) for c, f in zip(chords, forces, strict=True)])
            squares = np.abs(np.einsum("kvc,kvc->k", forces, moves))
            residuals.append(float(np.sqrt(squares.max())))
            if residuals[-1] <= tolerance:
                faults = (fault_between(a, b) for a, b in pairwise(points))
                fault = next((f for f in faults if f), None) or _jump(space, shapes)
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
