"""Backtracking: the share of a step that is taken."""

import numpy as np
import pytest

from shapespace.solve.line_search import ARMIJO, backtrack, sufficient_decrease


@pytest.mark.parametrize(("longest", "expected"), [(2, 1.0), (1, 1.0), (0.9, 0.5), (0.25, 0.25), (0.2, 0.125)])
def test_the_longest_halving_that_is_accepted_is_taken(longest: float, expected: float) -> None:
    tried: list[float] = []

    def trial(t: float) -> str:
        tried.append(t)
        return f"at {t}"

    assert backtrack(trial, lambda t, found: t <= longest and found == f"at {t}", 0) == (expected, f"at {expected}")
    assert tried == [2.0**-k for k in range(len(tried))], "no share is tried after the accepted one"


def test_the_smallest_step_is_still_tried_and_no_smaller_one() -> None:
    tried: list[float] = []
    assert backtrack(tried.append, lambda t, _: False, 1 / 16) is None
    assert tried == [1, 1 / 2, 1 / 4, 1 / 8, 1 / 16]


def test_a_decrease_is_sufficient_if_it_is_a_share_of_what_the_slope_promises() -> None:
    promised = 0.5 * 8
    for share, enough in ((1, True), (1.01 * ARMIJO, True), (0.99 * ARMIJO, False), (-1, False)):
        assert sufficient_decrease(10, 10 - share * promised, 0.5, 8) is enough
    assert sufficient_decrease(10, 10 + 1e-9, 0.5, 0, rounding=2e-9)
    assert not sufficient_decrease(10, np.nan, 0.5, 8)
    assert not sufficient_decrease(10, np.inf, 0.5, 8)
