"""Reader of PCD, the point clouds of the Point Cloud Library: text, binary and compressed."""

from __future__ import annotations

import re
import struct

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.mesh.triangle_mesh import MeshError

_HEAD = re.compile(rb"^DATA[ \t]+(\w+)[ \t]*\r?\n", re.MULTILINE)
#: Bytes in which the head ends.
_LONGEST_HEAD = 2**16


def read_pcd(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Points (N, 3) of a PCD file, and no faces. Points that a sensor did not see, which are NaN there, are left out.

    Raises:
        MeshError: the file has more points than the limits allow, or its kind of data is unknown.
        ValueError: the file is damaged.
    """
    head = bytes(data[:_LONGEST_HEAD])
    end = _HEAD.search(head)
    if end is None:
        raise ValueError("its head has no line DATA")
    words = [line.split() for line in head[: end.start()].splitlines()]
    entries = {word[0].upper(): word[1:] for word in words if word}
    names = entries[b"FIELDS"]
    counts = [int(count) for count in entries.get(b"COUNT", [b"1"] * len(names))]
    types = zip(entries[b"TYPE"], entries[b"SIZE"], counts, strict=True)
    fields = [(kind + size).decode().lower() for kind, size, _ in types]
    points = int(entries[b"WIDTH"][0]) * int(entries[b"HEIGHT"][0])
    if points < 0 or len(names) != len(fields):
        raise ValueError("its head is damaged")
    limits.check(points, 0)
    row = np.dtype(
        [(f"{k}", f"<{field}", (count,)) for k, (field, count) in enumerate(zip(fields, counts, strict=True))]
    )
    if not {b"x", b"y", b"z"} <= set(names):
        raise ValueError("its fields are not x, y and z")
    axes = [names.index(axis) for axis in (b"x", b"y", b"z")]
    body, kind = data[end.end() :], end[1].lower()
    if kind == b"ascii":
        columns = [sum(counts[:k]) for k in axes]
        lines = str(body, "ascii").splitlines()
        found = np.loadtxt(lines, np.float64, usecols=columns, ndmin=2) if points else np.zeros((0, 3))
    elif kind == b"binary":
        rows = np.ndarray((points,), row, body)
        found = np.stack([rows[f"{k}"][:, 0] for k in axes], axis=1)
    elif kind == b"binary_compressed":
        packed, size = struct.unpack_from("<II", body)
        if size != points * row.itemsize:
            raise ValueError(f"its data have {size} bytes, and {points} points need {points * row.itemsize} bytes")
        content = _decompressed(body[8 : 8 + packed], size)
        # Here each field has its values together.
        offsets = [points * sum(row[k].itemsize for k in range(axis)) for axis in axes]
        columns_of = zip(axes, offsets, strict=True)
        found = np.stack([np.ndarray((points,), row[k], content, offset)[:, 0] for k, offset in columns_of], axis=1)
    else:
        raise MeshError("its data are neither ascii, binary nor binary_compressed: save it as ascii")
    if len(found) != points:
        raise ValueError(f"it should have {points} points, but has {len(found)}")
    return found[~np.isnan(found).any(axis=1)].astype(np.float64), np.zeros((0, 3), np.int64)


def _decompressed(data: memoryview, size: int) -> bytearray:
    """Return the bytes that LZF packed; raises ValueError if they are not ``size`` bytes."""
    out = bytearray()
    place, end = 0, len(data)
    while place < end and len(out) <= size:
        control = data[place]
        place += 1
        if control < 32:
            out += data[place : place + control + 1]
            place += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[place]
            place += 1
        start = len(out) - ((control & 31) << 8) - data[place] - 1
        place += 1
        repeat(out, start, length + 2)
    if len(out) != size:
        raise ValueError(f"its compressed data make {len(out)} of {size} bytes")
    return out


def repeat(out: bytearray, start: int, length: int) -> None:
    """Append bytes that begin at ``start``, over and over; raises ValueError if there are none."""
    pattern = bytes(out[start : start + length]) if start >= 0 else b""
    if not pattern:
        raise ValueError("its compressed data are damaged")
    out += (pattern * (length // len(pattern) + 1))[:length]
