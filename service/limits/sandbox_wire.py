"""Messages between a sandbox and its children: a JSON text, then plain bytes in pieces. Never a pickle."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

JsonObject = dict[str, Any]
Arrays = dict[str, "NDArray[Any]"]

#: Most bytes of JSON in one message, and most characters of a sentence in it.
LONGEST_MESSAGE, LONGEST_SENTENCE = 2**20, 1000
_PIECE = 2**20
_DTYPE = re.compile(r"[<|>][fiub][1248]")


def send(connection: Connection, message: Mapping[str, Any], parts: Iterable[memoryview] = ()) -> None:
    """Send a message and the bytes that follow it; raises OSError."""
    connection.send_bytes(json.dumps(message).encode())
    for part in parts:
        for start in range(0, len(part), _PIECE):
            connection.send_bytes(part[start : start + _PIECE])


def receive(connection: Connection) -> JsonObject:
    """Return the next message; raises EOFError at the end, ValueError or OSError if it is no message."""
    message = json.loads(connection.recv_bytes(LONGEST_MESSAGE))
    if not isinstance(message, dict):
        raise ValueError
    return message


def receive_exactly(connection: Connection, length: int) -> bytearray:
    """Return the ``length`` bytes that follow a message; raises as `receive`."""
    data = bytearray()
    while len(data) < length:
        data += connection.recv_bytes(min(length - len(data), _PIECE))
    return data


def describe_arrays(arrays: Arrays) -> list[tuple[str, str, tuple[int, ...]]]:
    """Return what `receive_arrays` has to know about arrays."""
    return [(name, array.dtype.str, array.shape) for name, array in arrays.items()]


def receive_arrays(connection: Connection, described: Any, most: int) -> Arrays:
    """Return the arrays that follow a message, which describes them; raises ValueError for more than ``most`` bytes."""
    import numpy as np

    arrays = {}
    for name, dtype, shape in described:
        if not _DTYPE.fullmatch(dtype) or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError
        length = math.prod(shape) * np.dtype(dtype).itemsize
        most -= length
        if most < 0:
            raise ValueError
        arrays[str(name)] = np.frombuffer(receive_exactly(connection, length), dtype).reshape(shape)
    return arrays
