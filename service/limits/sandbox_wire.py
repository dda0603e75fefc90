"""What goes between a sandbox and its children: JSON behind its length, then plain bytes; never a pickle."""

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

Facts = dict[str, Any]
Arrays = dict[str, "NDArray[Any]"]
#: Waits until a connection is ready for an event of ``select.poll``.
Wait = Callable[[int], None]

#: Bytes of JSON in one message, and characters of a sentence in it.
LONGEST_MESSAGE, LONGEST_SENTENCE = 2**20, 1000
_LENGTH = struct.Struct("!I")
_PIECE = 2**20
_DTYPE = re.compile(r"[<|>][fiub][1248]")


def _blocks(_: int) -> None:
    """What children wait for is the connection itself."""


def send(connection: socket.socket, message: Mapping[str, Any], wait: Wait = _blocks) -> None:
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


def receive(connection: socket.socket, wait: Wait = _blocks) -> dict[str, Any]:
    """The next message; raises EOFError, and ValueError for what is none."""
    (length,) = _LENGTH.unpack(receive_exactly(connection, _LENGTH.size, wait))
    if length > LONGEST_MESSAGE:
        raise ValueError
    message = json.loads(receive_exactly(connection, length, wait))
    if not isinstance(message, dict):
        raise ValueError
    return message


def receive_exactly(connection: socket.socket, length: int, wait: Wait = _blocks) -> bytearray:
    """So many bytes; raises EOFError where the connection ends before."""
    # By pieces: what hasn't come yet takes no memory.
    data = bytearray()
    while len(data) < length:
        wait(select.POLLIN)
        piece = connection.recv(min(length - len(data), _PIECE))
        if not piece:
            raise EOFError
        data += piece
    return data


def receive_arrays(connection: socket.socket, described: Any, most: int, wait: Wait) -> Arrays:
    """Arrays whose names, types and shapes a message has told; raises ValueError for more than ``most`` bytes."""
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
