"""Nonlinear least squares in a box, for few unknowns and expensive residuals."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from shapespace.arrays import FloatArray
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Outcome, Status, limit_reached

#: An updated Jacobian is replaced at a minimum farther than `SECANT_DISTANCE` from where it was computed, in units of
#: the scale, and after a step with a smaller ratio of actual to predicted gain than `SECANT_GAIN`.
SECANT_DISTANCE, SECANT_GAIN = 0.05, 0.25


@dataclass(frozen=True)
class StepControl:
    """Acceptance of steps, and damping as a share of the largest diagonal entry of JᵀJ."""

    taken: float = 1e-3  # smallest ratio of actual to predicted gain at which a step is taken
    good: float = 0.5  # smallest ratio at which the damping decreases
    smallest: float = 1e-10  # smallest damping
    first: float = 1e-3  # first damping after a failed step
    largest: float = 1e3  # the iteration stalls beyond this damping
    factor: float = 10  # increase and decrease of the damping


CONTROL = StepControl()


@dataclass(frozen=True)
class Box:
    """Bounds and scales of the unknowns, each (m,)."""

    lower: FloatArray  # lower bounds, −∞ where there is none
    upper: FloatArray  # upper bounds, ∞ where there is none
    scale: FloatArray  # typical size of each unknown; steps are measured in it


@dataclass(frozen=True)
class Stopping:
    """When the iteration ends."""

    # the iteration has converged once no unknown would move further than this fraction of its scale
    tolerance: float = 1e-4
    # it has also converged once ``‖r‖²`` would decrease by at most this fraction of itself
    gain_tolerance: float = 1e-6
    # if ``‖r‖`` is larger than this, the fraction refers to ``large · ‖r‖``: most of such a residual can't vanish
    large: float = np.inf
    max_evaluations: int = 40  # largest number of evaluations of the residuals
    deadline: Deadline | None = None  # no evaluation begins after it

    def nothing_to_gain(self, step: FloatArray, predicted: float, cost: float) -> bool:
        """Whether a step, in units of the scale, is too small or gains too little for another evaluation."""
        return bool(
            np.abs(step).max() <= self.tolerance or predicted <= self.gain_tolerance * shrinkable(cost, self.large)
        )


@dataclass(frozen=True, kw_only=True)
class Fit(Outcome):
    """The result of the iteration. Its iterations count evaluations of the residuals, without Jacobians."""

    x: FloatArray  # (m,) unknowns in the box
    residuals: FloatArray  # (n,) r(x), whose norm is the residual

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

    A Jacobian takes as long as m residuals. It is computed once and then updated by Broyden's secant formula (Nocedal
    and Wright 2006, section 11.1). A new one is computed after a step that gains less than predicted, and after m
    steps. If the point has moved far since, a new one is also computed at the end: where residuals don't vanish, the
    minimum is only as accurate as the Jacobian. ``scipy.optimize.least_squares`` would compute a Jacobian in each step.

    The residuals map (m,) to (n,), and ``jacobian`` maps x and r(x) to (n, m). Unknowns of the start outside the box
    are clipped to it. Without ``secant``, a Jacobian is computed in each step.
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
    while (reached := limit_reached(evaluations, stopping.max_evaluations, stopping.deadline)) is None:
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
        taken = bool(gain > CONTROL.taken)  # False for NaN
        if taken:
            J.follow(step, trial_r - r)
            u, r = trial, trial_r
            if gain >= CONTROL.good:
                damping = damping / CONTROL.factor if damping > CONTROL.first else 0.0
        elif not J.updates:
            damping = max(CONTROL.factor * damping, CONTROL.first)
            if damping > CONTROL.largest:
                return fit(Status.STALLED, "no damped step lowers the residual")
        J.renew_or_keep(u, r, taken, gain)
    return fit(reached)


class _Jacobian:
    """A Jacobian that is computed at some points, and updated by Broyden's formula in between."""

    matrix: FloatArray  # (n, m), in units of the scale
    updates: int  # number of updates since it was computed

    def __init__(
        self, make: Callable[[FloatArray, FloatArray], FloatArray], secant: bool, u: FloatArray, r: FloatArray
    ) -> None:
        self._make, self._secant = make, secant
        self.renew(u, r)

    def renew(self, u: FloatArray, r: FloatArray) -> None:
        """Compute the Jacobian at a point."""
        self.matrix, self._made_at, self.updates = self._make(u, r), u, 0

    def is_outdated(self, u: FloatArray) -> bool:
        """Whether the Jacobian has been updated and was computed too far from this point to identify a minimum."""
        return self.updates > 0 and bool(np.abs(u - self._made_at).max() > SECANT_DISTANCE)

    def follow(self, step: FloatArray, change: FloatArray) -> None:
        """Update the Jacobian so that it predicts the change of the residuals along a step that was taken.

        Steps that were not taken are ignored: residuals may jump along them, which has no meaning for the slope.
        """
        if self._secant:
            self.matrix += np.outer(change - self.matrix @ step, step / (step @ step))

    def renew_or_keep(self, u: FloatArray, r: FloatArray, taken: bool, gain: float) -> None:
        """Compute a new Jacobian if necessary, after a step with this ratio of actual to predicted gain."""
        disappointing = self.updates > 0 and not gain > SECANT_GAIN
        if (taken and not self._secant) or disappointing or self.updates == len(u):
            self.renew(u, r)
        else:
            self.updates += taken


def shrinkable(cost: float, large: float) -> float:
    """Return the scale for gains of a cost ``‖r‖²``: the cost itself, or ``large · ‖r‖`` if ``‖r‖ > large``."""
    return float(min(cost, large * np.sqrt(cost)))


def _step(J: FloatArray, r: FloatArray, low: FloatArray, high: FloatArray, damping: float) -> FloatArray:
    """Minimise ``‖J d + r‖² + μ‖d‖²`` over low ≤ d ≤ high."""
    H, g = J.T @ J, J.T @ r
    # A Jacobian of zeros determines no step.
    shift = max(damping, CONTROL.smallest) * max(H.diagonal().max(), np.sqrt(np.finfo(float).tiny))
    R = cholesky(H + shift * np.eye(len(g)))
    b = -solve_triangular(R, g, trans="T")
    d: FloatArray = solve_triangular(R, b)
    if ((d < low) | (d > high)).any():
        # Imported on demand: it takes 9 MB and a tenth of a second, and most servers never need it.
        from scipy.optimize import lsq_linear

        # The solver rejects equal bounds.
        d = lsq_linear(R, b, (low, np.maximum(high, low + np.finfo(float).eps)), method="bvls").x
    return d
