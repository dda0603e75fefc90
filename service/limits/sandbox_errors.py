"""Errors of calls to a sandbox, for both sides of its connection."""

from __future__ import annotations

import traceback
from pathlib import Path


class SandboxError(Exception):
    """A call that has no result."""


class LateError(SandboxError):
    """The deadline passed, and the child was killed."""


class OutOfMemoryError(SandboxError):
    """The task needs more memory than it may have."""


class NoProcessError(SandboxError):
    """No process can be started."""


class DiedError(SandboxError):
    """The child crashed or exited during the call."""


class ClosedError(SandboxError):
    """The sandbox is closed."""


class FailedError(SandboxError):
    """Bad input that a task reports. The task raises it, and the sandbox raises it again for the caller.

    Attributes:
        kind: kind of fault, in one word; UNEXPECTED for an exception that the task doesn't handle.
        sentence: description for people.
    """

    UNEXPECTED = "unexpected"

    def __init__(self, kind: str, sentence: str) -> None:
        super().__init__(sentence)
        self.kind, self.sentence = kind, sentence


def in_a_line(error: BaseException) -> str:
    """Describe an unexpected exception, and where it was raised, in one line."""
    where = traceback.extract_tb(error.__traceback__)[-1:]
    places = "".join(f" ({Path(frame.filename).name}, line {frame.lineno})" for frame in where)
    return f"{type(error).__name__}: {' '.join(str(error).split())}{places}"
