"""Least energy where a barrier is near: Newton's steps by conjugate gradients, each in a line search."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from shapespace.arrays import FloatArray

#: Most conjugate gradients in a step, and the part of the forces at which they end: at most, and at least.
GRADIENTS = 60
LOOSEST, TIGHTEST = 0.3, 1e-3
#: Displacement by which the Hessian is felt, as a share of the length that the problem gives.
PROBE = 1e-6
#: Armijo's share of the expected descent, what rounding adds to an energy, and the smallest step tried.
ARMIJO, ROUNDING, SMALLEST_STEP = 1e-4, 1e-15, 1e-6


class Energy(Protocol):
    """What is minimised, by unknowns of any shape."""

    @property
    def length(self) -> float:
        """Size of an edge, in the unit of the unknowns."""

    def value(self, x: FloatArray) -> float:
        """The energy; infinite beyond the barrier."""

    def forces(self, x: FloatArray) -> FloatArray:
        """Its negative gradient."""

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        """Whether a step stays on this side of the barrier, which a straight line may jump over."""

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        """Forces to a step: symmetric positive definite, near the inverse of the Hessian at x."""


@dataclass(frozen=True)
class Descent:
    """Where a descent ended.

    Attributes:
        x: the unknowns.
        residual: length of the preconditioned forces there, ``sqrt(Fᵀ P F)``.
        iterations: steps taken.
        converged: whether the residual is below the tolerance.
    """

    x: FloatArray
    residual: float
    iterations: int
    converged: bool


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
    value, residual = energy.value(x), np.inf
    for iteration in range(max_iterations + 1):
        solve, forces = energy.precondition(x), energy.forces(x)
        first = solve(forces)
        residual = float(np.sqrt(abs(np.vdot(forces, first))))
        if not np.isfinite(residual) or residual <= tolerance or iteration == max_iterations:
            break
        step = _newton_step(energy, x, forces, first, solve, residual)
        slope, t = float(np.vdot(forces, step)), 1.0
        while t > SMALLEST_STEP:
            if energy.admits(x, t * step):
                trial = energy.value(x + t * step)
                if trial <= value - ARMIJO * t * slope + ROUNDING * abs(value):
                    break
            t /= 2
        else:
            break
        x, value = x + t * step, trial
    return Descent(x, residual, iteration, residual <= tolerance)


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
