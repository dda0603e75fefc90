"""Messages between a sandbox and its children: JSON, bytes and arrays, never a pickle. Errors of calls."""

from __future__ import annotations

import json
import traceback
from collections.abc import Mapping
from io import BytesIO
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

JsonObject = dict[str, Any]
Arrays = dict[str, NDArray[Any]]

#: Most bytes of JSON in one message, and most characters of a sentence in it.
LONGEST_MESSAGE, LONGEST_SENTENCE = 2**20, 1000
#: Most bytes that are sent at once.
PIECE = 2**20
#: Bytes of an array in a file of NumPy beside its numbers.
_HEADER = 2**10


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
    """Bad input, for which the task has raised RefusedError.

    Attributes:
        kind: kind of that error; UNEXPECTED for an exception that the task doesn't handle.
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


def send(connection: Connection, message: Mapping[str, Any], arrays: Arrays | None = None) -> None:
    """Send a message, and arrays by name; raises OSError, or ValueError for arrays that would need a pickle."""
    connection.send_bytes(json.dumps(dict(message) | {"arrays": list(arrays or ())}).encode())
    for array in (arrays or {}).values():
        file = BytesIO()
        np.lib.format.write_array(file, array, allow_pickle=False)
        connection.send_bytes(file.getbuffer())


def receive(connection: Connection, most: int = 0) -> tuple[JsonObject, Arrays]:
    """Return the next message, and its arrays, which have at most ``most`` bytes together.

    Raises EOFError at the end, and ValueError, TypeError, LookupError or OSError if it is no message.
    """
    message, arrays = dict(json.loads(connection.recv_bytes(LONGEST_MESSAGE))), {}
    for name in message.pop("arrays"):
        file = BytesIO(connection.recv_bytes(most + _HEADER))
        array = np.lib.format.read_array(file, allow_pickle=False)
        most -= array.nbytes
        if most < 0 or array.dtype.kind not in "biuf":
            raise ValueError
        arrays[str(name)] = array
    return message, arrays
