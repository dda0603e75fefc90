"""Minimises an energy with a barrier: Newton steps by conjugate gradients, each followed by a line search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.solve.line_search import backtrack, sufficient_decrease
from shapespace.solve.outcome import Outcome, Status
from shapespace.solve.preconditioner import step_length

#: Most iterations of conjugate gradients in a step, and the largest and smallest relative residual that ends them.
GRADIENTS = 60
LOOSEST, TIGHTEST = 0.3, 1e-3
#: Displacement for the difference quotients of forces that stand for Hessian products, as a share of the energy's
#: ``length``.
PROBE = 1e-6
#: Relative rounding error of an energy, and the smallest step length tried.
ROUNDING, SMALLEST_STEP = 1e-15, 1e-6


class Energy(Protocol):
    """What is minimised, over an array of unknowns of any shape."""

    @property
    def length(self) -> float:
        """Size of an edge, in the unit of the unknowns."""

    def value(self, x: FloatArray) -> float:
        """The energy; infinite beyond the barrier."""

    def forces(self, x: FloatArray) -> FloatArray:
        """Its negative gradient."""

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        """Whether a step stays on this side of the barrier. A straight step can land beyond it."""

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Map forces to a step, by a symmetric positive definite approximation of the inverse Hessian at x."""


@dataclass(frozen=True, kw_only=True)
class Descent(Outcome):
    """Where a descent ended, with the length of the preconditioned forces there, ``sqrt(Fᵀ P F)``, as residual.

    Attributes:
        x: the unknowns.
    """

    x: FloatArray


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def descend(energy: Energy, x: FloatArray, tolerance: float, max_iterations: int) -> Descent:
    """Truncated Newton (Nocedal and Wright 2006, algorithm 7.1): steps always lower the energy if short enough.

    Products with the Hessian are differences of forces. Where its curvature is negative the step goes no further along
    that direction. Raises NotPositiveDefiniteError where the problem's ``precondition`` does.

    Args:
        energy: see Energy.
        x: start, of finite energy.
        tolerance: of the residual.
        max_iterations: most steps.
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
    """The share of a step that is admitted and lowers the energy enough, and the energy there."""
    rounding = ROUNDING * abs(value)
    return backtrack(
        lambda t: energy.value(x + t * step) if energy.admits(x, t * step) else np.nan,
        lambda t, trial: sufficient_decrease(value, trial, t, slope, rounding),
        SMALLEST_STEP,
    )


def _newton_step(
    energy: Energy,
    x: FloatArray,
    forces: FloatArray,
    first: FloatArray,
    solve: Callable[[FloatArray], FloatArray],
    residual: float,
) -> FloatArray:
    """About the minimiser of the quadratic model, or of its part along which it curves upwards."""
    step, left, direction = np.zeros_like(x), forces, first
    square = residual**2
    enough = float(np.clip(np.sqrt(residual), TIGHTEST, LOOSEST)) ** 2 * square
    for _ in range(GRADIENTS):
        probe = PROBE * energy.length / np.abs(direction).max()
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
