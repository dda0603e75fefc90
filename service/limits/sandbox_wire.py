"""Messages between a sandbox and its children: length of a JSON text, the text, then plain bytes. Never a pickle."""

from __future__ import annotations

import json
import math
import re
import select
import socket
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

JsonObject = dict[str, Any]
Arrays = dict[str, "NDArray[Any]"]
#: A function that waits until a connection is ready for an event of ``select.poll``.
Wait = Callable[[int], None]

#: Most bytes of JSON in one message, and most characters of a sentence in it.
LONGEST_MESSAGE, LONGEST_SENTENCE = 2**20, 1000
_LENGTH = struct.Struct("!I")
_PIECE = 2**20
_DTYPE = re.compile(r"[<|>][fiub][1248]")


def _no_wait(_: int) -> None:
    """Return at once: the connection of a child blocks by itself."""


def send(connection: socket.socket, message: Mapping[str, Any], wait: Wait = _no_wait) -> None:
    """Send a message; raises OSError."""
    data = json.dumps(message).encode()
    send_all(connection, _LENGTH.pack(len(data)) + data, wait)


def send_all(connection: socket.socket, data: bytes | bytearray | memoryview, wait: Wait) -> None:
    """Send bytes; raises OSError."""
    rest = memoryview(data)
    while rest:
        wait(select.POLLOUT)
        with suppress(BlockingIOError):
            rest = rest[connection.send(rest[:_PIECE]) :]


def receive(connection: socket.socket, wait: Wait = _no_wait) -> dict[str, Any]:
    """Return the next message; raises EOFError at the end, and ValueError if it is no message."""
    (length,) = _LENGTH.unpack(receive_exactly(connection, _LENGTH.size, wait))
    if length > LONGEST_MESSAGE:
        raise ValueError
    message = json.loads(receive_exactly(connection, length, wait))
    if not isinstance(message, dict):
        raise ValueError
    return message


def receive_exactly(connection: socket.socket, length: int, wait: Wait = _no_wait) -> bytearray:
    """Return ``length`` bytes; raises EOFError if the connection ends before."""
    # Piece by piece, so that data that never come take no memory.
    data = bytearray()
    while len(data) < length:
        wait(select.POLLIN)
        piece = connection.recv(min(length - len(data), _PIECE))
        if not piece:
            raise EOFError
        data += piece
    return data


def receive_arrays(connection: socket.socket, described: Any, most: int, wait: Wait) -> Arrays:
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
        arrays[str(name)] = np.frombuffer(receive_exactly(connection, length, wait), dtype).reshape(shape)
    return arrays
