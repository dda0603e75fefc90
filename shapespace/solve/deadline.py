"""How long an iteration may go on."""

from __future__ import annotations

import time


class Deadline:
    """The moment by which work has to end, or any earlier one at which it is called off; safe between threads.

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
        """Whether the work should stop."""
        return self._called_off or time.monotonic() > self.time

    def call_off(self) -> None:
        """Stop the work now, because nobody waits for the result any more."""
        self._called_off = True
