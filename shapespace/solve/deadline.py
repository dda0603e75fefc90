"""A limit on the time of an iteration."""

from __future__ import annotations

import time

#: Time that a search leaves for completing its result: this share of all time, but at most these seconds.
COMPLETING_SHARE, COMPLETING_SECONDS = 0.25, 2.0


class Deadline:
    """The time by which work has to end, in seconds from now. It can be called off earlier, from any thread."""

    def __init__(self, seconds: float) -> None:
        self.time = time.monotonic() + seconds  # on the clock of ``time.monotonic``
        self._called_off = False

    @classmethod
    def of(cls, limit: Deadline | float | None) -> Deadline | None:
        """Return a limit as a deadline; a number is in seconds from now."""
        return limit if limit is None or isinstance(limit, Deadline) else Deadline(limit)

    @property
    def passed(self) -> bool:
        """Whether the work should stop."""
        return self._called_off or time.monotonic() > self.time

    def call_off(self) -> None:
        """Stop the work now, because its result is no longer needed."""
        self._called_off = True

    def for_searching(self) -> Deadline:
        """Return an earlier deadline, for a search whose best result has to be completed by this deadline."""
        return _Searching(self)


class _Searching(Deadline):
    """The earlier deadline of a search; calling off either deadline calls off the other."""

    def __init__(self, whole: Deadline) -> None:
        left = max(whole.time - time.monotonic(), 0.0)
        super().__init__(left - min(COMPLETING_SHARE * left, COMPLETING_SECONDS))
        self._whole = whole

    @property
    def passed(self) -> bool:
        return super().passed or self._whole.passed

    def call_off(self) -> None:
        self._whole.call_off()
