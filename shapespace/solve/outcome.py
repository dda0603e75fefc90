"""What every iteration returns besides its result: how it ended is a value, not an exception."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np


class Status(StrEnum):
    """How an iteration ended; anything but CONVERGED still comes with finite vertices."""

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"
    DEADLINE = "deadline"
    NOT_FINITE = "not_finite"
    DEGENERATE = "degenerate"


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """How an iteration ended. Drivers extend it by what they have found, which is finite whatever the status.

    Attributes:
        status: CONVERGED, or why the iteration ended before that.
        iterations: steps tried.
        residual: what is left, in the norm that the driver names; infinite where nothing has been computed.
        reason: in words, why it did not converge; may be empty where the status says all.
    """

    status: Status
    iterations: int = 0
    residual: float = np.inf
    reason: str = ""

    @property
    def converged(self) -> bool:
        """Whether the tolerance is met."""
        return self.status is Status.CONVERGED
