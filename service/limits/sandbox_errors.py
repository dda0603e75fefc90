"""Why a call of a sandbox comes to nothing; on both sides of its connection."""

from __future__ import annotations

import traceback
from pathlib import Path


class SandboxError(Exception):
    """A call without an answer."""


class LateError(SandboxError):
    """The deadline passed, and the child was ended."""


class OutOfMemoryError(SandboxError):
    """The task needs more memory than it may have."""


class NoProcessError(SandboxError):
    """The system gives no process."""


class DiedError(SandboxError):
    """The child died of what it was given."""


class ClosedError(SandboxError):
    """Nothing is done here any more."""


class FailedError(SandboxError):
    """What a task itself found wrong; raised by the task, and again where it was called.

    Attributes:
        kind: of fault, in a word; UNEXPECTED for an exception that the task was not prepared for.
        sentence: for people.
    """

    UNEXPECTED = "unexpected"

    def __init__(self, kind: str, sentence: str) -> None:
        super().__init__(sentence)
        self.kind, self.sentence = kind, sentence


def in_a_line(error: BaseException) -> str:
    """An exception that nobody expected, and where it was raised."""
    where = traceback.extract_tb(error.__traceback__)[-1:]
    places = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in where)
    return f"{type(error).__name__}: {' '.join(str(error).split())}{places}"
