"""The error for requests that can't be answered."""

from __future__ import annotations

from typing import Any


class RefusedError(Exception):
    """A request that can't be answered. The message says what to do.

    Attributes:
        kind: kind of problem, mostly a key of `shapespace.service.http.problems.KINDS`.
        extensions: further members of the answer.
        headers: further headers of the answer.
    """

    def __init__(self, kind: str, detail: str, **extensions: Any) -> None:
        super().__init__(detail)
        self.kind, self.extensions, self.headers = kind, extensions, dict[str, str]()
