"""How an iteration ended: a value, not an exception."""

from enum import StrEnum


class Status(StrEnum):
    """How an iteration ended; anything but CONVERGED still comes with finite vertices."""

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"
    DEADLINE = "deadline"
    NOT_FINITE = "not_finite"
    DEGENERATE = "degenerate"
