"""The energy of a discrete path, its gradient and its preconditioner."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.shell.space import ChordSolver, Factorise, ShellPoint, ShellSpace, edge_length, keeps_faces


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
