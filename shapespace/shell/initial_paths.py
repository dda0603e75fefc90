"""The energy of a path, and initial paths for the geodesic equation: straight, bisected, or of least energy."""

from collections.abc import Callable

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import unwrap
from shapespace.mesh.rigid_motion import align
from shapespace.shell.space import ChordSolver, Factorise, ShellPoint, ShellSpace, edge_length, keeps_faces
from shapespace.solve.line_search import backtrack
from shapespace.solve.truncated_newton import descend

#: Largest number of Newton steps when the path energy is minimised.
MOST_DESCENTS = 30
#: Most steps to a middle shape, and tolerance of its residual: it need not be exact.
MIDDLE_STEPS, MIDDLE_TOLERANCE = 30, 1e-2
#: Most Gauss–Newton steps to a shape of a straight path, which need not be exact, and the smallest step length. The
#: steps end once one of them reduces the squared misfit by less than the share `SMALLEST_GAIN`.
NEAREST_STEPS, SMALLEST_STEP, SMALLEST_GAIN = 4, 1 / 32, 0.1


def inverse_in_time(steps: int) -> FloatArray:
    """Compute T⁻¹ for T = tridiag(−1, 2, −1) on the inner shapes of a path."""
    k = np.arange(1, steps)
    return np.minimum.outer(k, k) * (steps - np.maximum.outer(k, k)) / steps


def factorised(space: ShellSpace, shapes: FloatArray, factorise: list[Factorise]) -> list[ChordSolver]:
    """Factorise A at each inner shape of a path (K + 1, V, 3)."""
    return [f(space.point(x)) for f, x in zip(factorise, shapes[1:-1], strict=True)]


def path_forces(space: ShellSpace, shapes: FloatArray) -> tuple[list[ShellPoint], FloatArray]:
    """Compute the forces ``−F`` at the inner shapes of a path, which are returned too."""
    z = space.nric(shapes)
    rest = space.energy.rest(z[:-1])
    covectors = rest.gradient_deformed(z[1:])[:-1] + rest.gradient_rest(z[1:])[1:]
    points = [ShellPoint(space, *xz) for xz in zip(shapes[1:-1], z[1:-1], strict=True)]
    forces = np.stack([-p.pull_back(c) for p, c in zip(points, covectors, strict=True)])
    return points, forces


class PathEnergy:
    """``Σ W[z_{k−1}, z_k]`` as a function of the inner shapes (K − 1, V, 3); see truncated_newton.Energy."""

    def __init__(self, space: ShellSpace, start: FloatArray, end: FloatArray, factorise: list[Factorise]) -> None:
        self._space, self._start, self._end, self._factorise = space, start[None], end[None], factorise
        self._inverse = inverse_in_time(len(factorise) + 1)
        self.length = edge_length(space)

    def path(self, x: FloatArray) -> FloatArray:
        """Return all shapes (K + 1, V, 3)."""
        return np.concatenate([self._start, x, self._end])

    def value(self, x: FloatArray) -> float:
        """See `Energy`."""
        z = self._space.nric(self.path(x))
        return float(self._space.energy.rest(z[:-1]).value(z[1:]).sum())

    def forces(self, x: FloatArray) -> FloatArray:
        """See truncated_newton.Energy."""
        return path_forces(self._space, self.path(x))[1]

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        """See truncated_newton.Energy."""
        return keeps_faces(self._space, x, x + step)

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Use the H of the middle shape for all shapes: only then is the product symmetric and positive definite."""
        chords = factorised(self._space, self.path(x), self._factorise)
        middle = chords[len(chords) // 2].at

        def solve(forces: FloatArray) -> FloatArray:
            moves = [c.solve(f) for c, f in zip(chords, forces, strict=True)]
            tangents = [c.at.push_forward(m) for c, m in zip(chords, moves, strict=True)]
            covectors = [middle.lower(t) for t in self._inverse @ np.stack(tangents)]
            return np.stack([c.solve(c.at.pull_back(p)) for c, p in zip(chords, covectors, strict=True)])

        return solve


#: A path (K + 1, V, 3), with a factor of A near each inner shape.
InitialPath = tuple[FloatArray, list[ChordSolver]]


def straight(space: ShellSpace, start: FloatArray, end: FloatArray, factorise: list[Factorise]) -> InitialPath:
    """Find shapes close to a straight line in lengths and angles, by Gauss–Newton with fixed factors.

    The shapes are computed in order, because each is a good start for the next.
    """
    first = space.point(start)
    line = unwrap(space.nric(end), first.z) - first.z
    steps = len(factorise) + 1
    shapes, chords = [start], []
    for k in range(1, steps):
        guess = space.point(start if k == 1 else 2 * shapes[-1] - shapes[-2])
        chords.append(factorise[k - 1](guess))
        shapes.append(nearest(chords[-1], first.z + k / steps * line))
    return np.stack([*shapes, align(end, shapes[-1])]), chords


def nearest(chord: ChordSolver, target: FloatArray) -> FloatArray:
    """Make a few steps from the shape of a factor towards the shape closest to target lengths and angles (2E,).

    Distances are measured in the metric at the shape of the factor.
    """
    point, misfit, square = _compared(chord.at, chord.at, target)
    for _ in range(NEAREST_STEPS):
        step = chord.solve(point.pull_back(chord.at.lower(misfit)))
        found = _line_search(chord.at, target, point, step, square)
        if found is None:
            break
        before = square
        point, misfit, square = found
        if 1 - square / before < SMALLEST_GAIN:
            break
    return point.vertices


#: A shape, the misfit (2E,) between its lengths and angles and a target, and the squared misfit in a metric.
_Compared = tuple[ShellPoint, FloatArray, float]


def _compared(metric: ShellPoint, point: ShellPoint, target: FloatArray) -> _Compared:
    misfit = unwrap(target, point.z) - point.z
    return point, misfit, float(misfit @ metric.lower(misfit))


def _line_search(
    metric: ShellPoint, target: FloatArray, point: ShellPoint, step: FloatArray, square: float
) -> _Compared | None:
    found = backtrack(
        lambda t: _compared(metric, point.space.point(point.vertices + t * step), target),
        lambda _, there: there[2] < square and keeps_faces(point.space, point.vertices, there[0].vertices),
        SMALLEST_STEP,
    )
    return found and found[1]


def bisected(space: ShellSpace, start: FloatArray, end: FloatArray, factorise: list[Factorise]) -> FloatArray:
    """Find a path (K + 1, V, 3) between distant shapes: the middle of least energy, then the middles of both halves.

    The search for a middle starts at one of its two ends, so that all shapes on the way are valid. On a straight line
    of lengths and angles there may be no valid shape.
    """
    shapes: dict[int, FloatArray] = {0: start, len(factorise) + 1: end}

    def fill(i: int, j: int) -> None:
        if j - i < 2:
            return
        k = (i + j) // 2
        between = _Middle(space, shapes[i], shapes[j], (k - i, j - k), factorise[0])
        nearer = shapes[i] if k - i <= j - k else shapes[j]
        shapes[k] = descend(between, nearer, MIDDLE_TOLERANCE, MIDDLE_STEPS).x
        fill(i, k)
        fill(k, j)

    fill(0, len(factorise) + 1)
    return np.stack([shapes[k] for k in sorted(shapes)])


class _Middle:
    """``W[a, z(X)]/s + W[z(X), b]/t`` for a shape X, s steps after a and t before b; see truncated_newton.Energy."""

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


def descended(space: ShellSpace, shapes: FloatArray, factorise: list[Factorise], tolerance: float) -> InitialPath:
    """Minimise the path energy from a given path."""
    energy = PathEnergy(space, shapes[0], shapes[-1], factorise)
    shapes = energy.path(descend(energy, shapes[1:-1], tolerance / 2, MOST_DESCENTS).x)
    return shapes, factorised(space, shapes, factorise)
