"""The outcome of an iteration: how it ended is a value, not an exception."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from shapespace.solve.deadline import Deadline


class Status(StrEnum):
    """How an iteration or a search ended. Vertices are finite with every status.

    ``poor``: the search ended, but its result does not describe what was given. Only `encode` answers it.
    """

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"
    DEADLINE = "deadline"
    NOT_FINITE = "not_finite"
    DEGENERATE = "degenerate"
    POOR = "poor"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How an iteration ended. Subclasses add the result, which is finite whatever the status.

    Attributes:
        status: CONVERGED, or why the iteration ended earlier.
        iterations: number of steps tried.
        residual: residual of the equations or of the target, in the norm of the subclass; ∞ if none was computed.
        reason: why it did not converge, in words; may be empty.
    """

    status: Status
    iterations: int = 0
    residual: float = np.inf
    reason: str = ""

    @property
    def converged(self) -> bool:
        """Whether the tolerance is met."""
        return self.status is Status.CONVERGED


def limit_reached(iterations: int, most: int, deadline: Deadline | None) -> Status | None:
    """Return the limit that an iteration has reached, if any."""
    if iterations >= most:
        return Status.ITERATION_LIMIT
    return Status.DEADLINE if deadline is not None and deadline.passed else None
