"""The ways in which an iteration ends, see outcome.Outcome: values, not exceptions."""

from enum import StrEnum


class Status(StrEnum):
    """How an iteration ended; anything but CONVERGED still comes with finite vertices."""

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"
    DEADLINE = "deadline"
    NOT_FINITE = "not_finite"
    DEGENERATE = "degenerate"
