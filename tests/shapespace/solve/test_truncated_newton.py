"""Truncated Newton descent on energies whose minimum is known."""

from collections.abc import Callable

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.solve.truncated_newton import descend


class Barrier:
    """``Σ c_i (x_i − log x_i)`` , weights over six orders of magnitude; least at 1, infinite for x_i ≤ 0."""

    length = 1.0
    weights = np.geomspace(1e-3, 1e3, 20)

    def __init__(self) -> None:
        self.seen: list[float] = []

    def value(self, x: FloatArray) -> float:
        self.seen.append(float(x.min()))
        return float(self.weights @ np.where(x > 0, x - np.log(np.abs(x)), np.inf))

    def forces(self, x: FloatArray) -> FloatArray:
        return -self.weights * (1 - 1 / x)

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        return bool((x + step > 0.1 * x).all())

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        return lambda forces: forces / self.weights


class Wells(Barrier):
    """``Σ (x_i² − 1)²``, whose curvature is negative around 0."""

    def value(self, x: FloatArray) -> float:
        return float(((x**2 - 1) ** 2).sum())

    def forces(self, x: FloatArray) -> FloatArray:
        return -4 * x * (x**2 - 1)

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        return True

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        return lambda forces: forces / 8


def test_the_minimum_is_found_from_beside_the_barrier(rng: np.random.Generator) -> None:
    energy = Barrier()
    found = descend(energy, np.exp(3 * rng.standard_normal(20)), 1e-9, 100)
    assert found.converged
    assert found.residual <= 1e-9
    np.testing.assert_allclose(found.x, 1, atol=1e-6)
    assert 3 < found.iterations < 40


def test_no_step_passes_the_barrier() -> None:
    energy = Barrier()
    descend(energy, np.full(20, 50.0), 1e-9, 100)
    assert min(energy.seen) > 0


def test_no_iteration_raises_the_energy(rng: np.random.Generator) -> None:
    start = np.exp(3 * rng.standard_normal(20))
    values = [Barrier().value(descend(Barrier(), start, 1e-9, n).x) for n in range(12)]
    assert (np.diff(values) < 0).all()
    few = descend(Barrier(), start, 1e-9, 3)
    assert not few.converged
    assert few.iterations == 3


def test_negative_curvature_leads_on_downhill(rng: np.random.Generator) -> None:
    start = 0.1 * rng.standard_normal(20)
    found = descend(Wells(), start, 1e-9, 100)
    assert found.converged
    np.testing.assert_allclose(found.x, np.sign(start), atol=1e-8)
