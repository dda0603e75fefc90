"""The two spaces in which the laws are tested, with the same operations on points and vectors (V, 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.shell.exponential import exponential
from shapespace.shell.geodesic import geodesic, logarithm
from shapespace.shell.mean import Mean, centre_of_mass, elastic_mean
from shapespace.shell.space import DiscretePath, ShellSpace
from shapespace.shell.transport import parallel_transport
from shapespace.solve.outcome import Outcome, Status
from tests.shapespace.shell.measures import distance

Ended = TypeVar("Ended", bound=Outcome)


def found(outcome: Ended) -> Ended:
    """The outcome, which must have converged."""
    assert outcome.converged, outcome.reason
    return outcome


@dataclass(frozen=True)
class FlatSpace:
    """R^{V×3} with the Euclidean product: geodesics are straight lines, and laws to first order hold exactly."""

    tolerance = 1e-12
    flat = True
    centred = False

    def exponential(self, start: FloatArray, velocity: FloatArray, steps: int) -> FloatArray:
        return start + np.linspace(0, 1, steps + 1)[:, None, None] * velocity

    def geodesic(self, start: FloatArray, end: FloatArray, steps: int) -> FloatArray:
        return self.exponential(start, end - start, steps)

    def logarithm(self, start: FloatArray, end: FloatArray, steps: int) -> FloatArray:
        return end - start

    def transport(self, path: FloatArray, velocity: FloatArray) -> FloatArray:
        return np.broadcast_to(velocity, path.shape)

    def means(self, shapes: FloatArray, weights: FloatArray, start: FloatArray, steps: int) -> list[FloatArray]:
        return [np.average(shapes, axis=0, weights=weights)]

    def energy(self, path: FloatArray) -> float:
        return (len(path) - 1) * float((np.diff(path, axis=0) ** 2).sum())

    def inner(self, at: FloatArray, first: FloatArray, second: FloatArray) -> float:
        return float(np.vdot(first, second))

    def distance(self, first: FloatArray, second: FloatArray) -> float:
        return float(np.abs(first - second).max())

    def difference(self, end: FloatArray, start: FloatArray) -> FloatArray:
        return end - start

    def scaled(self, factor: float) -> FlatSpace:
        return self


@dataclass(frozen=True)
class Shells:
    """The space of shells, up to rigid motions; every operation must converge. Distances have this tolerance."""

    space: ShellSpace
    tolerance = 1e-6
    flat = False

    @property
    def centred(self) -> bool:
        return self.space.first_step == "centred"

    def _path(self, vertices: FloatArray) -> DiscretePath:
        return DiscretePath(vertices=vertices, space=self.space, status=Status.CONVERGED)

    def exponential(self, start: FloatArray, velocity: FloatArray, steps: int) -> FloatArray:
        return found(exponential(self.space, start, velocity, steps)).vertices

    def geodesic(self, start: FloatArray, end: FloatArray, steps: int) -> FloatArray:
        return found(geodesic(self.space, start, end, steps)).vertices

    def logarithm(self, start: FloatArray, end: FloatArray, steps: int) -> FloatArray:
        log = logarithm(self.space, start, end, steps)
        found(log.path)
        return log.velocity

    def transport(self, path: FloatArray, velocity: FloatArray) -> FloatArray:
        return found(parallel_transport(self.space, self._path(path), velocity)).velocities

    def means(self, shapes: FloatArray, weights: FloatArray, start: FloatArray, steps: int) -> list[FloatArray]:
        means: list[Mean] = [
            elastic_mean(self.space, shapes, weights, start=start),
            centre_of_mass(self.space, shapes, weights, start=start, steps=steps),
        ]
        return [found(mean).vertices for mean in means]

    def energy(self, path: FloatArray) -> float:
        return self._path(path).energy

    def inner(self, at: FloatArray, first: FloatArray, second: FloatArray) -> float:
        return self.space.inner(at, first, second)

    def distance(self, first: FloatArray, second: FloatArray) -> float:
        return distance(self.space, first, second)

    def difference(self, end: FloatArray, start: FloatArray) -> FloatArray:
        return without_rigid_motion(align(end, start) - start, start)

    def scaled(self, factor: float) -> Shells:
        space, reference = self.space, self.space.reference
        larger = reference.with_vertices(factor * reference.vertices)
        return Shells(ShellSpace(larger, space.material, first_step=space.first_step))


Space = FlatSpace | Shells
