"""A limit on the time of an iteration."""

from __future__ import annotations

import time


class Deadline:
    """The time by which work has to end, in seconds from now. It can be called off earlier, from any thread.

    Attributes:
        time: end time on the clock of ``time.monotonic``.
    """

    def __init__(self, seconds: float) -> None:
        self.time = time.monotonic() + seconds
        self._called_off = False

    @property
    def passed(self) -> bool:
        """Whether the work should stop."""
        return self._called_off or time.monotonic() > self.time

    def call_off(self) -> None:
        """Stop the work now, because its result is no longer needed."""
        self._called_off = True
