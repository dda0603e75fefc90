"""Nonlinear least squares in a box, for few unknowns whose every residual is dear."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from shapespace.arrays import FloatArray
from shapespace.solve.deadline import Deadline
from shapespace.solve.status import Status

#: A Jacobian is renewed once the point has moved this far, as a fraction of the scale, before it is believed.
TRUSTED = 0.05
#: What a step must gain of what the Jacobian promised, or a new one is made if it has been updated.
POOR = 0.25
#: Damping relative to the largest diagonal entry of JᵀJ: always, and the first and the last where a step fails.
SMALLEST_DAMPING, FIRST_DAMPING, LARGEST_DAMPING = 1e-10, 1e-3, 1e3


@dataclass(frozen=True)
class Fit:
    """What the iteration found.

    Attributes:
        x: (m,) inside the box.
        residual: (n,) there.
        status: how the iteration ended.
        evaluations: of the residual, those of Jacobians not counted.
    """

    x: FloatArray
    residual: FloatArray
    status: Status
    evaluations: int

    @property
    def cost(self) -> float:
        """``‖r‖²``."""
        return float(self.residual @ self.residual)


@np.errstate(over="ignore", invalid="ignore")
def least_squares(
    residual: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray, FloatArray], FloatArray],
    start: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    scale: FloatArray,
    *,
    tolerance: float = 1e-4,
    gain_tolerance: float = 1e-6,
    large: float = np.inf,
    secant: bool = True,
    max_evaluations: int = 40,
    deadline: Deadline | None = None,
) -> Fit:
    """Minimise ``‖r(x)‖²`` over a box by Gauss–Newton with damping (Levenberg and Marquardt).

    A Jacobian here costs as much as m residuals. It is made once and then follows by Broyden's secant updates
    (Nocedal and Wright 2006, section 11.1). A new one is made where a step disappoints, after as many steps as it
    costs, and at the end if the point has moved far since: the minimum of a residual that doesn't vanish is only as
    right as the Jacobian. ``scipy.optimize.least_squares`` would make one at each step.

    Args:
        residual: (m,) to (n,).
        jacobian: x and its residual to (n, m).
        start: (m,); what lies outside the box is moved to its side.
        lower: (m,) sides of the box, infinite where there is none.
        upper: (m,) the opposite ones.
        scale: (m,) lengths that count as equally long in each coordinate.
        tolerance: stop once no coordinate would move further than this fraction of its scale,
        gain_tolerance: or ``‖r‖²`` would not shrink by more than this fraction of itself,
        large: where ``‖r‖`` is less; above, of ``‖r‖`` times this: most of such a residual can't vanish.
        secant: whether Jacobians are worth saving; otherwise one is made at each step.
        max_evaluations: of the residual.
        deadline: after which no evaluation begins.
    """
    low, high = lower / scale, upper / scale
    u = np.clip(start / scale, low, high)
    r = residual(u * scale)
    evaluations, damping, made_at = 1, 0.0, u
    J = jacobian(u * scale, r) * scale
    updates = 0

    def fit(status: Status) -> Fit:
        return Fit(u * scale, r, status, evaluations)

    if not np.isfinite(r).all():
        return fit(Status.NOT_FINITE)
    while evaluations < max_evaluations:
        if deadline is not None and deadline.passed:
            return fit(Status.DEADLINE)
        if not np.isfinite(J).all():
            return fit(Status.STALLED)
        step = _step(J, r, low - u, high - u, damping)
        predicted = r @ r - np.sum((r + J @ step) ** 2)
        if np.abs(step).max() <= tolerance or predicted <= gain_tolerance * shrinkable(float(r @ r), large):
            if updates and np.abs(u - made_at).max() > TRUSTED:
                J, made_at, updates = jacobian(u * scale, r) * scale, u, 0
                continue
            return fit(Status.CONVERGED)
        trial = np.clip(u + step, low, high)
        trial_r = residual(trial * scale)
        evaluations += 1
        gain = (r @ r - trial_r @ trial_r) / predicted
        taken = bool(gain > 1e-3)  # not where it isn't a number
        if taken:
            if secant:  # a step that failed may have met a cliff, whose slope is nobody else's
                J += np.outer(trial_r - r - J @ step, step / (step @ step))
            u, r = trial, trial_r
            damping = damping if gain < 0.5 else damping / 10 if damping > FIRST_DAMPING else 0.0
        elif not updates:
            damping = max(10 * damping, FIRST_DAMPING)
            if damping > LARGEST_DAMPING:
                return fit(Status.STALLED)
        if (taken and not secant) or (updates and not gain > POOR) or updates == len(u):
            J, made_at, updates = jacobian(u * scale, r) * scale, u, 0
        else:
            updates += taken
    return fit(Status.ITERATION_LIMIT)


def shrinkable(cost: float, large: float) -> float:
    """What gains of a cost ``‖r‖²`` are compared with: itself, or ``large · ‖r‖`` where ``‖r‖`` is larger."""
    return float(min(cost, large * np.sqrt(cost)))


def _step(J: FloatArray, r: FloatArray, low: FloatArray, high: FloatArray, damping: float) -> FloatArray:
    """The minimiser of ``‖J d + r‖² + μ‖d‖²`` with low ≤ d ≤ high."""
    H, g = J.T @ J, J.T @ r
    shift = max(damping, SMALLEST_DAMPING) * max(H.diagonal().max(), np.finfo(float).tiny)
    R = cholesky(H + shift * np.eye(len(g)))
    b = -solve_triangular(R, g, trans="T")
    d: FloatArray = solve_triangular(R, b)
    if ((d < low) | (d > high)).any():
        from scipy.optimize import lsq_linear  # 9 MB and a tenth of a second that most servers never need

        # A side of no length is one that the solver doesn't take.
        d = lsq_linear(R, b, (low, np.maximum(high, low + np.finfo(float).eps)), method="bvls").x
    return d
