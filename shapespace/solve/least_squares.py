"""Nonlinear least squares in a box, with few unknowns and residuals that are expensive to compute."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from shapespace.arrays import FloatArray
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Outcome, Status

#: At a minimum, an updated Jacobian is trusted only within this distance, as a fraction of the scale, of the point
#: where it was computed; further away a new one is computed.
TRUSTED = 0.05
#: Thresholds for the ratio of a step's actual gain to the gain that the Jacobian predicts: above the first the step is
#: taken, above the second an updated Jacobian is kept, above the third the damping decreases.
TAKEN, POOR, GOOD = 1e-3, 0.25, 0.5
#: Damping as a share of the largest diagonal entry of JᵀJ: the smallest value, the first after a failed step, and the
#: largest; then the factor by which it increases or decreases.
SMALLEST_DAMPING, FIRST_DAMPING, LARGEST_DAMPING, DAMPING_FACTOR = 1e-10, 1e-3, 1e3, 10


@dataclass(frozen=True)
class Box:
    """Where the unknowns may be, each (m,).

    Attributes:
        lower: lower bounds, −∞ where there is none.
        upper: upper bounds, ∞ where there is none.
        scale: for each coordinate the length that counts as one unit.
    """

    lower: FloatArray
    upper: FloatArray
    scale: FloatArray


@dataclass(frozen=True)
class Stopping:
    """When the iteration ends.

    Attributes:
        tolerance: it has converged once no coordinate would move further than this fraction of its scale,
        gain_tolerance: or once ``‖r‖²`` would shrink by no more than this fraction of itself.
        large: where ``‖r‖`` is larger, that fraction is of ``large · ‖r‖``: most of such a residual can't vanish.
        max_evaluations: most evaluations of the residuals.
        deadline: no evaluation begins after it.
    """

    tolerance: float = 1e-4
    gain_tolerance: float = 1e-6
    large: float = np.inf
    max_evaluations: int = 40
    deadline: Deadline | None = None

    def nothing_to_gain(self, step: FloatArray, predicted: float, cost: float) -> bool:
        """Whether a step, in units of the scale, would gain too little to be worth an evaluation."""
        return bool(
            np.abs(step).max() <= self.tolerance or predicted <= self.gain_tolerance * shrinkable(cost, self.large)
        )

    def reached(self, evaluations: int) -> Status | None:
        """The limit that is reached after so many evaluations, if one is."""
        if evaluations >= self.max_evaluations:
            return Status.ITERATION_LIMIT
        return Status.DEADLINE if self.deadline is not None and self.deadline.passed else None


@dataclass(frozen=True, kw_only=True)
class Fit(Outcome):
    """What the iteration found. Iterations are evaluations of the residuals, those of Jacobians not counted.

    Attributes:
        x: (m,) inside the box.
        residuals: (n,) r(x), whose norm is the residual.
    """

    x: FloatArray
    residuals: FloatArray

    @property
    def cost(self) -> float:
        """``‖r‖²``."""
        return float(self.residuals @ self.residuals)


@np.errstate(over="ignore", invalid="ignore")
def least_squares(
    residuals: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray, FloatArray], FloatArray],
    start: FloatArray,
    box: Box,
    stopping: Stopping | None = None,
    *,
    secant: bool = True,
) -> Fit:
    """Minimise ``‖r(x)‖²`` over a box by Gauss–Newton with damping (Levenberg and Marquardt).

    A Jacobian here costs as much as m residuals. It is computed once and then updated by Broyden's secant formula
    (Nocedal and Wright 2006, section 11.1). A new one is computed where a step gains less than predicted, after m
    steps, and at the end if the point has moved far since: where residuals don't vanish, the minimum found is only as
    accurate as the Jacobian. ``scipy.optimize.least_squares`` would compute one at each step.

    Args:
        residuals: r, (m,) to (n,).
        jacobian: x and r(x) to (n, m).
        start: (m,); coordinates outside the box are moved to its nearest side.
        box: bounds and scales of the unknowns.
        stopping: when to end.
        secant: whether to save Jacobians by secant updates; otherwise one is computed at each step.
    """
    stopping = stopping or Stopping()
    scale, low, high = box.scale, box.lower / box.scale, box.upper / box.scale
    u = np.clip(start / scale, low, high)
    r = residuals(u * scale)
    evaluations, damping = 1, 0.0

    def fit(status: Status, reason: str = "") -> Fit:
        norm = float(np.linalg.norm(r))
        return Fit(x=u * scale, residuals=r, status=status, iterations=evaluations, residual=norm, reason=reason)

    if not np.isfinite(r).all():
        return fit(Status.NOT_FINITE, "the residuals at the start are not finite")
    J = _Jacobian(lambda u, r: jacobian(u * scale, r) * scale, secant, u, r)
    while (reached := stopping.reached(evaluations)) is None:
        if not np.isfinite(J.matrix).all():
            return fit(Status.STALLED, "the Jacobian is not finite")
        step = _step(J.matrix, r, low - u, high - u, damping)
        predicted = float(r @ r - np.sum((r + J.matrix @ step) ** 2))
        if stopping.nothing_to_gain(step, predicted, float(r @ r)):
            if not J.is_outdated(u):
                return fit(Status.CONVERGED)
            J.renew(u, r)
            continue
        trial = np.clip(u + step, low, high)
        trial_r = residuals(trial * scale)
        evaluations += 1
        gain = float((r @ r - trial_r @ trial_r) / predicted)
        taken = bool(gain > TAKEN)  # not where it isn't a number
        if taken:
            J.follow(step, trial_r - r)
            u, r = trial, trial_r
            if gain >= GOOD:
                damping = damping / DAMPING_FACTOR if damping > FIRST_DAMPING else 0.0
        elif not J.updates:
            damping = max(DAMPING_FACTOR * damping, FIRST_DAMPING)
            if damping > LARGEST_DAMPING:
                return fit(Status.STALLED, "no damped step lowers the residual")
        J.renew_or_keep(u, r, taken, gain)
    return fit(reached)


class _Jacobian:
    """A Jacobian that is computed at some points and updated by Broyden's formula between them.

    Attributes:
        matrix: (n, m), in units of the scale.
        updates: how many steps it has been updated for since it was computed.
    """

    matrix: FloatArray
    updates: int

    def __init__(
        self, make: Callable[[FloatArray, FloatArray], FloatArray], secant: bool, u: FloatArray, r: FloatArray
    ) -> None:
        self._make, self._secant = make, secant
        self.renew(u, r)

    def renew(self, u: FloatArray, r: FloatArray) -> None:
        """Compute it at a point."""
        self.matrix, self._made_at, self.updates = self._make(u, r), u, 0

    def is_outdated(self, u: FloatArray) -> bool:
        """Whether it has been updated since it was made, too far from this point to tell a minimum."""
        return self.updates > 0 and bool(np.abs(u - self._made_at).max() > TRUSTED)

    def follow(self, step: FloatArray, change: FloatArray) -> None:
        """Update it so that it predicts how the residuals have changed along a step that was taken.

        Steps that were not taken are ignored: residuals may jump along them, which says nothing of the slope elsewhere.
        """
        if self._secant:
            self.matrix += np.outer(change - self.matrix @ step, step / (step @ step))

    def renew_or_keep(self, u: FloatArray, r: FloatArray, taken: bool, gain: float) -> None:
        """Compute it anew if that is due, after a step that has gained this share of the predicted gain."""
        disappointing = self.updates > 0 and not gain > POOR
        if (taken and not self._secant) or disappointing or self.updates == len(u):
            self.renew(u, r)
        else:
            self.updates += taken


def shrinkable(cost: float, large: float) -> float:
    """What gains of a cost ``‖r‖²`` are compared with: itself, or ``large · ‖r‖`` where ``‖r‖`` is larger."""
    return float(min(cost, large * np.sqrt(cost)))


def _step(J: FloatArray, r: FloatArray, low: FloatArray, high: FloatArray, damping: float) -> FloatArray:
    """The minimiser of ``‖J d + r‖² + μ‖d‖²`` with low ≤ d ≤ high."""
    H, g = J.T @ J, J.T @ r
    # Where the Jacobian is all zero, no step is determined.
    shift = max(damping, SMALLEST_DAMPING) * max(H.diagonal().max(), np.sqrt(np.finfo(float).tiny))
    R = cholesky(H + shift * np.eye(len(g)))
    b = -solve_triangular(R, g, trans="T")
    d: FloatArray = solve_triangular(R, b)
    if ((d < low) | (d > high)).any():
        # Imported here: it takes 9 MB and a tenth of a second, and most servers never need it.
        from scipy.optimize import lsq_linear

        # The solver refuses bounds that are equal.
        d = lsq_linear(R, b, (low, np.maximum(high, low + np.finfo(float).eps)), method="bvls").x
    return d
