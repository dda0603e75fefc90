"""The time-discrete geodesic between two shapes, and the logarithm (paper, appendix B)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import unwrap
from shapespace.mesh.rigid_motion import align
from shapespace.shell.space import (
    TOLERANCE,
    ChordSolver,
    DiscretePath,
    Factorise,
    ShellPoint,
    ShellSpace,
    edge_length,
    fault_between,
    keeps_faces,
)
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.line_search import backtrack
from shapespace.solve.outcome import Status
from shapespace.solve.truncated_newton import descend

#: Most iterations with one set of factors, and how often factors are renewed before the attempt is given up.
ITERATIONS = 40
RENEWALS = 20
#: Most Newton steps of the minimisation of the path energy.
DESCENTS = 30
#: A time step whose energy is more than this many times the mean is a jump: a geodesic has constant speed.
JUMP = 4.0
#: Iterations and tolerance for the shapes of an initial path, which need not be exact.
MIDDLE_ITERATIONS, MIDDLE_TOLERANCE = 30, 1e-2
#: Factors are renewed after three iterations that leave more than this share of the residual.
SLOW = 0.1
#: Most Gauss–Newton steps to each shape of the initial path, which need not be exact, and the smallest step length.
NEAREST_ITERATIONS, SMALLEST_STEP = 4, 1 / 32
#: These steps end once one reduces the squared misfit by less than this share.
WORTHWHILE = 0.1


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
) -> DiscretePath:
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
        nowhere, reason = space.reference.vertices[None], "start has an entry that is not finite"
        return DiscretePath(vertices=nowhere, space=space, status=Status.NOT_FINITE, reason=reason)
    if not np.isfinite(end).all():
        reason = "end has an entry that is not finite"
        return DiscretePath(vertices=start[None], space=space, status=Status.NOT_FINITE, reason=reason)
    if steps == 1:
        both = np.stack([start, align(end, start)])
        return DiscretePath(vertices=both, space=space, status=Status.CONVERGED, residual=0)
    factorise = space.factorisations(steps - 1)
    ways: list[Callable[[], _Begun]] = [lambda: _straight(space, start, end, factorise)]
    if bisect:
        ways.append(lambda: _descended(space, _bisected(space, start, end, factorise), factorise, tolerance))
    if first is not None:
        given = np.concatenate([start[None], first[1:-1], align(end, first[-2])[None]])
        ways = [lambda: _descended(space, given, factorise, tolerance)]
    for begin in ways:
        try:
            found = _relax(space, begin(), factorise, tolerance)
        except NotPositiveDefiniteError as error:
            reason = f"a shape on the way is degenerate: {error}"
            found = DiscretePath(vertices=start[None], space=space, status=Status.STALLED, iterations=1, reason=reason)
        if found.converged:
            shapes = found.vertices
            for k in range(1, steps + 1):
                shapes[k] = align(shapes[k], shapes[k - 1])
            return found
    return replace(found, vertices=start[None], status=Status.STALLED)


#: A first path (K + 1, V, 3), and a factor near each of its inner shapes.
_Begun = tuple[FloatArray, list[ChordSolver]]


def _descended(space: ShellSpace, shapes: FloatArray, factorise: list[Factorise], tolerance: float) -> _Begun:
    """The path of least energy downhill from another."""
    energy = _PathEnergy(space, shapes[0], shapes[-1], factorise)
    shapes = energy.path(descend(energy, shapes[1:-1], tolerance / 2, DESCENTS).x)
    return shapes, _factorised(space, shapes, factorise)


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
    path: DiscretePath


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


def towards(space: ShellSpace, path: DiscretePath, end: FloatArray) -> FloatArray:
    """A first path (K + 1, V, 3) for ``geodesic``, from a geodesic to a shape near its end.

    Of the difference between the two ends, a part that grows along the path is added to the lengths and angles of its
    shapes.
    """
    steps = len(path.vertices) - 1
    change = unwrap(space.nric(end), path.nric[-1]) - path.nric[-1]
    shapes = [path.vertices[0]]
    for k in range(1, steps):
        chord = space.factorise(space.point(path.vertices[k]))
        shapes.append(_nearest(chord, path.nric[k] + k / steps * change))
    return np.stack([*shapes, align(end, shapes[-1])])


def halved(space: ShellSpace, path: DiscretePath) -> DiscretePath:
    """The same path in twice as many steps: between two shapes, one at half the change of lengths and angles."""
    shapes = [path.vertices[0]]
    for k in range(1, len(path.vertices)):
        chord = space.factorise(space.point(shapes[-1]))
        middle = _nearest(chord, (path.nric[k - 1] + path.nric[k]) / 2)
        shapes += [middle, align(path.vertices[k], middle)]
    return DiscretePath(vertices=np.stack(shapes), space=space, status=path.status)


def _straight(space: ShellSpace, start: FloatArray, end: FloatArray, factorise: list[Factorise]) -> _Begun:
    """Shapes near a straight line of lengths and angles.

    One after the other, because each is a good start for the next: Gauss–Newton with a factor kept fixed.
    """
    first = space.point(start)
    line = unwrap(space.nric(end), first.z) - first.z
    steps = len(factorise) + 1
    shapes, chords = [start], []
    for k in range(1, steps):
        guess = space.point(start if k == 1 else 2 * shapes[-1] - shapes[-2])
        chords.append(factorise[k - 1](guess))
        shapes.append(_nearest(chords[-1], first.z + k / steps * line))
    return np.stack([*shapes, align(end, shapes[-1])]), chords


def _nearest(chord: ChordSolver, target: FloatArray) -> FloatArray:
    """A few steps from a factor's shape to that whose lengths and angles come closest to a target, in its metric."""
    point, misfit, square = _compared(chord.at, chord.at, target)
    for _ in range(NEAREST_ITERATIONS):
        step = chord.solve(point.pull_back(chord.at.lower(misfit)))
        found = _line_search(chord.at, target, point, step, square)
        if found is None:
            break
        before = square
        point, misfit, square = found
        if 1 - square / before < WORTHWHILE:
            break
    return point.vertices


#: A shape, by how much its lengths and angles miss a target (2E,), and the square of that in a metric.
_Compared = tuple[ShellPoint, FloatArray, float]


def _compared(metric: ShellPoint, point: ShellPoint, target: FloatArray) -> _Compared:
    misfit = unwrap(target, point.z) - point.z
    return point, misfit, float(misfit @ metric.lower(misfit))


def _line_search(
    metric: ShellPoint, target: FloatArray, point: ShellPoint, step: FloatArray, square: float
) -> _Compared | None:
    """The shape along a step that comes closer to a target without a face that collapses."""
    found = backtrack(
        lambda t: _compared(metric, point.space.point(point.vertices + t * step), target),
        lambda _, there: there[2] < square and keeps_faces(point.space, point.vertices, there[0].vertices),
        SMALLEST_STEP,
    )
    return found and found[1]


def _bisected(space: ShellSpace, start: FloatArray, end: FloatArray, factorise: list[Factorise]) -> FloatArray:
    """A first path (K + 1, V, 3) between shapes far apart: their middle by least energy, then those of the halves.

    The search for each begins at one of the two shapes that it lies between, so that all shapes on the way are valid; a
    straight line of lengths and angles may lead through what is no shape.
    """
    shapes: dict[int, FloatArray] = {0: start, len(factorise) + 1: end}

    def fill(i: int, j: int) -> None:
        if j - i < 2:
            return
        k = (i + j) // 2
        between = _Middle(space, shapes[i], shapes[j], (k - i, j - k), factorise[0])
        nearer = shapes[i] if k - i <= j - k else shapes[j]
        shapes[k] = descend(between, nearer, MIDDLE_TOLERANCE, MIDDLE_ITERATIONS).x
        fill(i, k)
        fill(k, j)

    fill(0, len(factorise) + 1)
    return np.stack([shapes[k] for k in sorted(shapes)])


class _Middle:
    """``W[a, z(X)]/s + W[z(X), b]/t`` by X, for a shape s steps after a and t before b; see truncated_newton.Energy."""

    def __init__(
        self, space: ShellSpace, a: FloatArray, b: FloatArray, steps: tuple[int, int], factorise: Factorise
    ) -> None:
        self._space, self._factorise = space, factorise
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
        return self._factorise(self._space.point(x)).solve


def _inverse_in_time(steps: int) -> FloatArray:
    """T⁻¹ of T = tridiag(−1, 2, −1) for the inner shapes of a path."""
    k = np.arange(1, steps)
    return np.minimum.outer(k, k) * (steps - np.maximum.outer(k, k)) / steps


def _factorised(space: ShellSpace, shapes: FloatArray, factorise: list[Factorise]) -> list[ChordSolver]:
    """A factor at each inner shape of a path (K + 1, V, 3)."""
    return [f(space.point(x)) for f, x in zip(factorise, shapes[1:-1], strict=True)]


def _forces(space: ShellSpace, shapes: FloatArray) -> tuple[list[ShellPoint], FloatArray]:
    """The inner shapes with forces ``−F``."""
    z = space.nric(shapes)
    rest = space.energy.rest(z[:-1])
    covectors = rest.gradient_deformed(z[1:])[:-1] + rest.gradient_rest(z[1:])[1:]
    points = [ShellPoint(space, *xz) for xz in zip(shapes[1:-1], z[1:-1], strict=True)]
    forces = np.stack([-p.pull_back(c) for p, c in zip(points, covectors, strict=True)])
    return points, forces


class _PathEnergy:
    """``Σ W[z_{k−1}, z_k]`` by the inner shapes (K − 1, V, 3) of a path; see truncated_newton.Energy."""

    def __init__(self, space: ShellSpace, start: FloatArray, end: FloatArray, factorise: list[Factorise]) -> None:
        self._space, self._start, self._end, self._factorise = space, start[None], end[None], factorise
        self._inverse = _inverse_in_time(len(factorise) + 1)
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
        chords = _factorised(self._space, self.path(x), self._factorise)
        middle = chords[len(chords) // 2].at

        def solve(forces: FloatArray) -> FloatArray:
            moves = [c.solve(f) for c, f in zip(chords, forces, strict=True)]
            tangents = [c.at.push_forward(m) for c, m in zip(chords, moves, strict=True)]
            covectors = [middle.lower(t) for t in self._inverse @ np.stack(tangents)]
            return np.stack([c.solve(c.at.pull_back(p)) for c, p in zip(chords, covectors, strict=True)])

        return solve


def _jump(space: ShellSpace, shapes: FloatArray) -> str | None:
    """What makes a stationary path no geodesic: a step that passes over a collapse, where W has a value again."""
    z = space.nric(shapes)
    energies = space.energy.rest(z[:-1]).value(z[1:])
    worst = int(energies.argmax())
    if energies[worst] > JUMP * energies.mean():
        return f"step {worst + 1} takes {energies[worst] / energies.mean():.1f} times the mean energy of all: a jump"
    return None


def _relax(space: ShellSpace, begun: _Begun, factorise: list[Factorise], tolerance: float) -> DiscretePath:
    """All equations of a path at once, from a first path: rounds of iterations, each with new factors.

    Given up after two rounds that don't halve the residual.
    """
    shapes, chords = begun
    chords = [c.rotated_to(space.point(x)) for c, x in zip(chords, shapes[1:-1], strict=True)]
    best, lowest = shapes, np.inf
    iterations = failures = 0
    for renewal in range(RENEWALS):
        if renewal:
            chords = _factorised(space, best, factorise)
        found = _round(space, best, chords, tolerance)
        iterations += found.iterations
        if found.status in (Status.CONVERGED, Status.DEGENERATE):
            return replace(found, iterations=iterations)
        failures += min(found.residual, lowest) > lowest / 2
        if found.residual < lowest:
            best, lowest = found.vertices, found.residual
        if failures == 2:
            break
    return _stalled(space, best, iterations, lowest)


def _stalled(space: ShellSpace, shapes: FloatArray, iterations: int, residual: float) -> DiscretePath:
    return DiscretePath(
        vertices=shapes,
        space=space,
        status=Status.STALLED,
        iterations=iterations,
        residual=residual,
        reason=f"residual {residual:.1e} after {iterations} iterations",
    )


def _round(space: ShellSpace, shapes: FloatArray, chords: list[ChordSolver], tolerance: float) -> DiscretePath:
    """Iterate with the same factors, accelerated, as long as it is worth it; the shapes of the smallest residual.

    Its status is DEGENERATE where the equations are solved by what is no geodesic.
    """
    inverse = _inverse_in_time(len(shapes) - 1)
    shapes, best, lowest = shapes.copy(), shapes, np.inf
    mixing, residuals = Anderson(), []
    for _ in range(ITERATIONS):
        points, forces = _forces(space, shapes)
        moves = np.stack([c.solve(f) for c, f in zip(chords, forces, strict=True)])
        residuals.append(float(np.sqrt(np.abs(np.einsum("kvc,kvc->k", forces, moves)).max())))
        if residuals[-1] <= tolerance:
            faults = (fault_between(a, b) for a, b in pairwise(points))
            fault = next((f for f in faults if f), None) or _jump(space, shapes)
            return DiscretePath(
                vertices=shapes,
                space=space,
                status=Status.DEGENERATE if fault else Status.CONVERGED,
                iterations=len(residuals) - 1,
                residual=residuals[-1],
                reason=fault or "",
            )
        if residuals[-1] < lowest:
            lowest, best = residuals[-1], shapes.copy()
        if not np.isfinite(residuals[-1]) or (len(residuals) > 3 and residuals[-1] > SLOW * residuals[-4]):
            return _stalled(space, best, len(residuals) - 1, lowest)
        tangents = np.stack([c.push_forward(m) for c, m in zip(chords, moves, strict=True)])
        moves = np.stack([c.project(t) for c, t in zip(chords, inverse @ tangents, strict=True)])
        shapes[1:-1] = mixing(shapes[1:-1].copy(), forces, moves)
    return _stalled(space, best, ITERATIONS, lowest)
