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

    Args:
        trial: computes the candidate at step length t.
        accepts: acceptance rule for t and its trial.
        smallest: smallest t that is tried; may be 0 only if the rule accepts every sufficiently short step.

    Returns:
        t and its trial, or None if no trial is accepted.
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

    Args:
        before: value at t = 0.
        after: value at t.
        t: step length.
        slope: negative derivative along the step, positive for a descent direction.
        rounding: numerical error of the values that the rule tolerates.
    """
    return after <= before - ARMIJO * t * slope + rounding
