"""The error for requests that can't be answered."""

from __future__ import annotations


class RefusedError(Exception):
    """A request that can't be answered, for a reason that the client learns.

    Attributes:
        kind: kind of problem, a key of `shapespace.service.http.problems.KINDS`. The message says what to do.
    """

    def __init__(self, kind: str, detail: str) -> None:
        super().__init__(detail)
        self.kind = kind
