"""Until when an iteration may go on."""

from __future__ import annotations

import time


class Deadline:
    """An end that comes with the time, or as soon as somebody calls the work off; safe between threads.

    Args:
        seconds: from now.

    Attributes:
        time: on the clock of ``time.monotonic``.
    """

    def __init__(self, seconds: float) -> None:
        self.time = time.monotonic() + seconds
        self._called_off = False

    @property
    def passed(self) -> bool:
        """Whether whoever works should stop."""
        return self._called_off or time.monotonic() > self.time

    def call_off(self) -> None:
        """Nobody waits for the result any more."""
        self._called_off = True
