"""Minimisation of an energy with a barrier: Newton steps by conjugate gradients, each with a line search."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.solve.line_search import backtrack, sufficient_decrease
from shapespace.solve.outcome import Outcome, Status
from shapespace.solve.preconditioner import step_length


@dataclass(frozen=True)
class NewtonLimits:
    """Accuracy of truncated Newton."""

    gradients: int = 60  # most iterations of conjugate gradients in a step
    loosest: float = 0.3  # largest
    tightest: float = 1e-3  # and smallest relative residual that ends them
    probe: float = 1e-6  # displacement for Hessian products by differences, as a share of the energy's ``length``
    rounding: float = 1e-15  # relative rounding error of an energy
    smallest_step: float = 1e-6  # smallest step length of the line search


LIMITS = NewtonLimits()


class Energy(Protocol):
    """An energy of an array of unknowns of any shape."""

    @property
    def length(self) -> float:
        """Typical length of an edge, in the unit of the unknowns."""

    def value(self, x: FloatArray) -> float:
        """Compute the energy, infinite beyond the barrier."""

    def forces(self, x: FloatArray) -> FloatArray:
        """Compute the negative gradient."""

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        """Whether a step stays on this side of the barrier. A long step may end beyond it."""

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Return a map from forces to a step, symmetric positive definite and close to the inverse Hessian at x."""


@dataclass(frozen=True, kw_only=True)
class Descent(Outcome):
    """The result of a descent. Its residual is the length of the preconditioned forces, ``sqrt(Fᵀ P F)``."""

    x: FloatArray  # unknowns


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def descend(energy: Energy, x: FloatArray, tolerance: float, max_iterations: int) -> Descent:
    """Minimise by truncated Newton (Nocedal and Wright 2006, algorithm 7.1): short steps always lower the energy.

    Products with the Hessian are differences of forces. A step ends at the first direction of negative curvature.
    Exceptions of ``energy.precondition`` are passed on, such as NotPositiveDefiniteError. The energy of the start is
    finite.
    """
    value, residual, status = energy.value(x), np.inf, Status.ITERATION_LIMIT
    for iteration in range(max_iterations + 1):
        solve, forces = energy.precondition(x), energy.forces(x)
        first = solve(forces)
        residual = step_length(forces, first)
        if not np.isfinite(residual):
            status = Status.STALLED
            break
        if residual <= tolerance:
            status = Status.CONVERGED
            break
        if iteration == max_iterations:
            break
        step = _newton_step(energy, x, forces, first, solve, residual)
        found = _line_search(energy, x, value, step, float(np.vdot(forces, step)))
        if found is None:
            status = Status.STALLED
            break
        t, value = found
        x = x + t * step
    return Descent(x=x, status=status, iterations=iteration, residual=residual)


def _line_search(
    energy: Energy, x: FloatArray, value: float, step: FloatArray, slope: float
) -> tuple[float, float] | None:
    rounding = LIMITS.rounding * abs(value)
    return backtrack(
        lambda t: energy.value(x + t * step) if energy.admits(x, t * step) else np.nan,
        lambda t, trial: sufficient_decrease(value, trial, t, slope, rounding),
        LIMITS.smallest_step,
    )


def _newton_step(
    energy: Energy,
    x: FloatArray,
    forces: FloatArray,
    first: FloatArray,
    solve: Callable[[FloatArray], FloatArray],
    residual: float,
) -> FloatArray:
    """Minimise the quadratic model approximately, as far as its curvature is positive."""
    step, left, direction = np.zeros_like(x), forces, first
    square = residual**2
    enough = float(np.clip(np.sqrt(residual), LIMITS.tightest, LIMITS.loosest)) ** 2 * square
    for _ in range(LIMITS.gradients):
        probe = LIMITS.probe * energy.length / np.abs(direction).max()
        curved = (forces - energy.forces(x + probe * direction)) / probe
        curvature = float(np.vdot(direction, curved))
        if not curvature > 0:
            break
        step = step + square / curvature * direction
        left = left - square / curvature * curved
        solved = solve(left)
        before, square = square, float(np.vdot(left, solved))
        if not square > enough:
            break
        direction = solved + square / before * direction
    return step if step.any() else first
