"""Backtracking line search."""

from collections.abc import Callable
from typing import TypeVar

Trial = TypeVar("Trial")

#: Smallest share of the decrease predicted by the slope that a step must achieve (Armijo 1966).
ARMIJO = 1e-4


def backtrack(
    trial: Callable[[float], Trial], accepts: Callable[[float, Trial], bool], smallest: float
) -> tuple[float, Trial] | None:
    """Find the first of t = 1, 1/2, 1/4, … whose trial is accepted (Nocedal and Wright 2006, algorithm 3.1).

    Returns t and its trial, or None if no trial is accepted. The smallest t may be 0 only if the rule accepts every
    sufficiently short step.
    """
    t = 1.0
    while t >= smallest:
        found = trial(t)
        if accepts(t, found):
            return t, found
        t /= 2
    return None


def sufficient_decrease(before: float, after: float, t: float, slope: float, rounding: float = 0.0) -> bool:
    """Check Armijo's rule for a value that decreases by ``t · slope`` to first order; False for NaN.

    The slope is the negative derivative along the step, positive for a descent direction. The rule tolerates a
    numerical error ``rounding`` of the values.
    """
    return after <= before - ARMIJO * t * slope + rounding
