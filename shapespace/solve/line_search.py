"""Backtracking: how far to go along a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

Trial = TypeVar("Trial")

#: Share of the descent promised by the slope that a step has to bring (Armijo 1966).
ARMIJO = 1e-4


def backtrack(
    trial: Callable[[float], Trial], accepts: Callable[[float, Trial], bool], smallest: float
) -> tuple[float, Trial] | None:
    """The first of t = 1, 1/2, 1/4, … whose trial is accepted (Nocedal and Wright 2006, algorithm 3.1).

    Args:
        trial: computes the candidate at step length t.
        accepts: the acceptance rule, of t and its trial.
        smallest: t that is still tried; 0 only with a rule that accepts every step that is short enough.

    Returns:
        t and its trial, or None where none is accepted.
    """
    t = 1.0
    while t >= smallest:
        found = trial(t)
        if accepts(t, found):
            return t, found
        t /= 2
    return None


def sufficient_decrease(before: float, after: float, t: float, slope: float, rounding: float = 0.0) -> bool:
    """Armijo's rule for a value that falls by ``t · slope`` to first order; never holds for NaN.

    Args:
        before: the value at t = 0.
        after: the value at t.
        t: share of the step.
        slope: −(derivative along the step), positive for a direction of descent.
        rounding: numerical error of the two values, which the rule tolerates.
    """
    return after <= before - ARMIJO * t * slope + rounding
