"""Readers of OBJ, OFF and STL: the vertices in the order of the file, and its polygons as triangles.

Other readers split and reorder vertices along seams of texture, so this project has its own. Each goes through its file
once.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator, Sequence
from itertools import islice, pairwise
from typing import Self

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, clipped
from shapespace.mesh.triangle_mesh import MeshError

#: Bytes that are copied at once to count the lines before an error.
_PIECE = 2**20
ENDS_EARLY = "it ends before all that it says is there"


def _lines_with(start: bytes) -> re.Pattern[bytes]:
    """Return a pattern for lines that start like this after blanks. It passes over other lines without Python code."""
    return re.compile(rb"(?<![^\r\n])[^\S\r\n]*+(" + start + rb"[^\r\n]*+)")


_LINE, _OBJ_LINE, _STL_LINE = map(_lines_with, (rb"[^\s#]", rb"[vf]\b", rb"(?i:vertex|endsolid)"))


class Lines:
    """The lines of a text that are neither empty nor a remark; where one can't be understood, the error names it."""

    def __init__(self, data: memoryview, line: re.Pattern[bytes] = _LINE) -> None:
        self._data, self._place = data, 0
        self._matches = line.finditer(data)
        self._lines = self._all()

    def _all(self) -> Iterator[bytes]:
        for match in self._matches:
            self._place = match.start(1)
            yield match.group(1).rstrip()

    @property
    def _number(self) -> int:
        before = self._data[: self._place]
        return 1 + sum(bytes(before[k : k + _PIECE]).count(b"\n") for k in range(0, len(before), _PIECE))

    def __iter__(self) -> Iterator[bytes]:
        return self._lines

    def next(self) -> bytes:
        """Return the next line; raises EOFError after the last one."""
        for line in self._lines:
            return line
        raise EOFError(ENDS_EARLY)

    def skip(self, count: int) -> None:
        """Skip ``count`` lines; raises EOFError if there are fewer."""
        if sum(1 for _ in islice(self._matches, count)) < count:
            raise EOFError(ENDS_EARLY)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError | LookupError | OverflowError) and not isinstance(error, MeshError):
            line = _LINE.match(self._data[self._place : self._place + 1000])
            text = line[1].decode(errors="replace") if line else ""
            raise ValueError(f"line {self._number} is {clipped(text)!r}") from None


class TriangleFans:
    """Triangles from polygons: the triangles of a polygon have its first corner in common."""

    def __init__(self, limits: Limits) -> None:
        self._limits, self._corners = limits, array("q")

    def add(self, polygon: Sequence[int]) -> None:
        """Append a polygon; raises ValueError if it has fewer than three corners."""
        if len(polygon) < 3:
            raise ValueError(f"a face has {len(polygon)} corners")
        self._limits.check(0, len(self._corners) // 3 + len(polygon) - 2)
        first = polygon[0]
        for a, b in pairwise(polygon[1:]):
            self._corners.extend((first, a, b))

    @property
    def faces(self) -> IntArray:
        """All triangles (F, 3)."""
        return np.array(self._corners, np.int64).reshape(-1, 3)


def read_obj(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of an OBJ file; everything else is ignored."""
    coordinates, triangles = array("d"), TriangleFans(limits)
    with Lines(data, _OBJ_LINE) as lines:
        for line in lines:
            keyword, *values = line.split(None, 1)
            if keyword == b"v":
                coordinates.extend(_point(values[0]))
                limits.check(len(coordinates) // 3, 0)
            elif keyword == b"f":
                here = len(coordinates) // 3
                numbers = [int(value.partition(b"/")[0]) for value in values[0].partition(b"#")[0].split()]
                # Negative numbers count back from the last vertex before this line.
                triangles.add([number - 1 if number > 0 else here + number for number in numbers])
    return np.array(coordinates, np.float64).reshape(-1, 3), triangles.faces


def _point(values: bytes) -> tuple[float, float, float]:
    x, y, z = values.split(None, 3)[:3]
    return float(x), float(y), float(z)


def read_off(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of an OFF file; colours and normals are ignored."""
    coordinates, triangles = array("d"), TriangleFans(limits)
    with Lines(data) as lines:
        keyword, *counts = lines.next().split()
        if not re.fullmatch(rb"(ST)?C?N?OFF", keyword):
            raise ValueError("another kind of file")
        # The counts are on the line of the keyword or on the next one.
        vertex_count, face_count, *_ = (int(value) for value in counts or lines.next().split())
        limits.check(vertex_count, face_count)
        if min(vertex_count, face_count) < 0:
            raise ValueError("less than none")
        for _ in range(vertex_count):
            coordinates.extend(_point(lines.next()))
        for _ in range(face_count):
            corners, *values = lines.next().split()
            triangles.add([int(value) for value in first_values(int(corners), values)])
    return np.array(coordinates, np.float64).reshape(-1, 3), triangles.faces


def first_values(count: int, values: Sequence[bytes]) -> Sequence[bytes]:
    """Return the first ``count`` values; raises ValueError if there are fewer."""
    if not 0 <= count <= len(values):
        raise ValueError("values are missing")
    return values[:count]


#: A triangle of a binary STL file, the bytes before the first triangle, and the place of the number of triangles there.
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER, _STL_COUNT = 84, 80


def read_stl(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (3F, 3) and faces (F, 3) of a binary or ASCII STL file, with three vertices for each face."""
    triangles = struct.unpack_from("<I", data, _STL_COUNT)[0] if len(data) >= _STL_HEADER else 0
    # A binary file may start like a text, but its length shows what it is.
    if len(data) == _STL_HEADER + triangles * _STL.itemsize:
        limits.check(3 * triangles, triangles)
        corners = np.frombuffer(data, _STL, offset=_STL_HEADER)["corners"]
        vertices = corners.astype(np.float64).reshape(-1, 3)
    else:
        vertices = _ascii_stl(data, limits)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _ascii_stl(data: memoryview, limits: Limits) -> FloatArray:
    coordinates, solids = array("d"), 0
    with Lines(data, _STL_LINE) as lines:
        for line in lines:
            keyword = line[:8].lower()
            if keyword.startswith(b"vertex"):
                coordinates.extend(_point(line[6:]))
                limits.check(len(coordinates) // 3, len(coordinates) // 9)
            elif keyword == b"endsolid":
                solids += 1
    if not solids or len(coordinates) % 9:
        raise ValueError("damaged, or another kind of file")
    if solids > 1:
        raise MeshError(f"holds {solids} meshes; a file needs exactly one")
    return np.array(coordinates, np.float64).reshape(-1, 3)
