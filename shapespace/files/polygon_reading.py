"""Readers of OBJ, OFF, PLY, STL and XYZ: the vertices in the order of the file, and its polygons as triangles.

Written here because other readers split and reorder vertices along seams of texture, and because files come from
strangers: every reader goes through its file once, and checks sizes against its limits before it allocates anything.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice, pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, clipped
from shapespace.mesh.triangle_mesh import MeshError

#: Bytes at the start of a PLY file in which its header has to end.
_PLY_HEADER = 2**16
#: Bytes that are copied at once to count the lines before an error.
_PIECE = 2**20
_ENDS = "it ends before all that it says is there"


def _lines_with(start: bytes) -> re.Pattern[bytes]:
    """Lines that begin so after blanks: others cost no Python, as strangers may send tens of millions of them."""
    return re.compile(rb"(?<![^\r\n])[^\S\r\n]*+(" + start + rb"[^\r\n]*+)")


_LINE, _OBJ_LINE, _STL_LINE = map(_lines_with, (rb"[^\s#]", rb"[vf]\b", rb"(?i:vertex|endsolid)"))


class Lines:
    """The lines of a text that are neither empty nor a remark; where one can't be understood, the error names it.

    Args:
        line: a pattern of the lines that count, each its first group.

    """

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
        """The next line; raises EOFError behind the last one."""
        for line in self._lines:
            return line
        raise EOFError(_ENDS)

    def skip(self, count: int) -> None:
        """Go behind so many lines without a look at them; raises EOFError where there are fewer."""
        if sum(1 for _ in islice(self._matches, count)) < count:
            raise EOFError(_ENDS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError | LookupError | OverflowError) and not isinstance(error, MeshError):
            line = _LINE.match(self._data[self._place : self._place + 1000])
            text = line[1].decode(errors="replace") if line else ""
            raise ValueError(f"line {self._number} is {clipped(text)!r}") from None


class _Triangles:
    """Polygons, each cut into triangles that have its first corner in common."""

    def __init__(self, limits: Limits) -> None:
        self._limits, self._corners = limits, array("q")

    def add(self, polygon: Sequence[int]) -> None:
        """Append a polygon of three corners or more; raises ValueError for less."""
        if len(polygon) < 3:
            raise ValueError(f"a face has {len(polygon)} corners")
        self._limits.check(0, len(self._corners) // 3 + len(polygon) - 2)
        first = polygon[0]
        for a, b in pairwise(polygon[1:]):
            self._corners.extend((first, a, b))

    def all(self) -> IntArray:
        """(F, 3)."""
        return np.array(self._corners, np.int64).reshape(-1, 3)


def read_obj(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) and faces (F, 3) of an OBJ file; everything else in it is left out."""
    coordinates, triangles = array("d"), _Triangles(limits)
    with Lines(data, _OBJ_LINE) as lines:
        for line in lines:
            keyword, *values = line.split(None, 1)
            if keyword == b"v":
                coordinates.extend(_point(values[0]))
                limits.check(len(coordinates) // 3, 0)
            elif keyword == b"f":
                here = len(coordinates) // 3
                numbers = [int(value.partition(b"/")[0]) for value in values[0].partition(b"#")[0].split()]
                # Negative ones count back from the vertex before the line.
                triangles.add([number - 1 if number > 0 else here + number for number in numbers])
    return np.array(coordinates, np.float64).reshape(-1, 3), triangles.all()


def _point(values: bytes) -> tuple[float, float, float]:
    x, y, z = values.split(None, 3)[:3]
    return float(x), float(y), float(z)


def read_off(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) and faces (F, 3) of an OFF file, colours and normals left out."""
    coordinates, triangles = array("d"), _Triangles(limits)
    with Lines(data) as lines:
        keyword, *counts = lines.next().split()
        if not re.fullmatch(rb"(ST)?C?N?OFF", keyword):
            raise ValueError("another kind of file")
        # Both on one line, or on two.
        vertex_count, face_count, *_ = (int(value) for value in counts or lines.next().split())
        limits.check(vertex_count, face_count)
        if min(vertex_count, face_count) < 0:
            raise ValueError("less than none")
        for _ in range(vertex_count):
            coordinates.extend(_point(lines.next()))
        for _ in range(face_count):
            corners, *values = lines.next().split()
            triangles.add([int(value) for value in _exactly(int(corners), values)])
    return np.array(coordinates, np.float64).reshape(-1, 3), triangles.all()


def read_xyz(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Points (N, 3) of a text with a point on each line, and no faces; normals or colours behind them are left out."""
    coordinates = array("d")
    with Lines(data) as lines:
        for line in lines:
            coordinates.extend(_point(line.replace(b",", b" ")))
            limits.check(len(coordinates) // 3, 0)
    return np.array(coordinates, np.float64).reshape(-1, 3), np.zeros((0, 3), np.int64)


def _exactly(count: int, values: Sequence[bytes]) -> Sequence[bytes]:
    """So many of the values; raises ValueError where there are fewer."""
    if not 0 <= count <= len(values):
        raise ValueError("values are missing")
    return values[:count]


#: A triangle of a binary STL file, the bytes before the first, and those of them that count the triangles.
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEAD, _STL_COUNT = 84, 80


def read_stl(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Vertices (3F, 3) and faces (F, 3) of an STL file, binary or ASCII: three vertices for each face."""
    triangles = struct.unpack_from("<I", data, _STL_COUNT)[0] if len(data) >= _STL_HEAD else 0
    # Binary files may begin like text, but their length says what they are.
    if len(data) == _STL_HEAD + triangles * _STL.itemsize:
        limits.check(3 * triangles, triangles)
        corners = np.frombuffer(data, _STL, offset=_STL_HEAD)["corners"]
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


_PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8",
    "uint64": "u8", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {b"binary_little_endian": "<", b"binary_big_endian": ">", b"ascii": ""}


@dataclass(frozen=True)
class _Property:
    """A property of a PLY element: its NumPy type, and that of its number of entries where it is a list."""

    name: str
    type: np.dtype
    length: np.dtype | None


@dataclass(frozen=True)
class Element:
    """A kind of rows in a PLY file, and how many there are."""

    name: str
    rows: int
    properties: list[_Property]

    @cached_property
    def lists(self) -> list[int]:
        """Which properties are lists."""
        return [k for k, p in enumerate(self.properties) if p.length is not None]

    @cached_property
    def steps(self) -> list[tuple[int, np.dtype, int]]:
        """For each list the bytes in front of it, its kind of length, and the bytes of an entry."""
        steps, gap = [], 0
        for p in self.properties:
            if p.length is None:
                gap += p.type.itemsize
            else:
                steps.append((gap, p.length, p.type.itemsize))
                gap = 0
        return steps

    @cached_property
    def rest(self) -> int:
        """Bytes behind the last list."""
        return sum(p.type.itemsize for p in self.properties[max(self.lists, default=-1) + 1 :])

    @property
    def coordinates(self) -> list[int]:
        """Which properties are x, y and z; raises ValueError where one is missing."""
        names = [p.name for p in self.properties]
        if self.lists or not {"x", "y", "z"} <= set(names):
            raise ValueError("its vertices have lists, or no x, y and z")
        return [names.index(axis) for axis in "xyz"]

    @property
    def corners(self) -> int:
        """Which property lists a face's vertices; raises ValueError where none does."""
        for k, p in enumerate(self.properties):
            if p.name in ("vertex_indices", "vertex_index") and p.length is not None and p.type.kind != "f":
                return k
        raise ValueError("its faces have no list of vertex_indices")


def read_ply(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) and faces (F, 3) of a PLY file, ASCII or binary; its other elements are left out."""
    text, elements, body = ply_head(data)
    table = TextTable(body, limits) if text else BinaryTable(body, limits)
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    # Nothing behind these two has to be understood.
    wanted = {element.name for element in elements if element.rows} & {"vertex", "face"}
    for element in elements:
        if not wanted:
            break
        if element.name == "vertex":
            limits.check(element.rows, 0)
            vertices = table.columns(element, element.coordinates)
        elif element.name == "face" and element.rows:
            limits.check(0, element.rows)
            faces = table.polygons(element)
        else:
            table.skip(element)
        wanted.discard(element.name)
    return vertices, faces


def ply_head(data: memoryview) -> tuple[bool, list[Element], memoryview]:
    """Whether a PLY file is text, its elements, and what comes behind its head."""
    head = bytes(data[:_PLY_HEADER])
    end = re.search(rb"^end_header[ \t]*\r?\n", head, re.MULTILINE)
    if not head.startswith(b"ply") or not end:
        raise ValueError("damaged, or another kind of file")
    order, elements = None, list[Element]()
    for line in head[: end.start()].splitlines():
        match line.split():
            case [b"format", kind, _]:
                order = _PLY_ORDERS[kind]
            case [b"element", name, rows]:
                elements.append(Element(name.decode("latin-1"), int(rows), []))
            case [b"property", b"list", length, kind, name]:
                elements[-1].properties.append(_property(name, kind, length, order))
            case [b"property", kind, name]:
                elements[-1].properties.append(_property(name, kind, None, order))
    if order is None or len({e.name for e in elements}) < len(elements) or any(e.rows < 0 for e in elements):
        raise ValueError("its head is damaged")
    return order == "", elements, data[end.end() :]


def _property(name: bytes, kind: bytes, length: bytes | None, order: str | None) -> _Property:
    types = [np.dtype((order or "") + _PLY_TYPES[k.decode("latin-1")]) for k in (kind, length) if k is not None]
    if length is not None and types[1].kind == "f":
        raise ValueError("the length of a list is no whole number")
    return _Property(name.decode("latin-1"), types[0], types[1] if length is not None else None)


class TextTable:
    """The rows of an ASCII PLY file, one on a line."""

    def __init__(self, data: memoryview, limits: Limits) -> None:
        self._limits, self._lines = limits, Lines(data)

    def skip(self, element: Element) -> None:
        """Go behind the rows of an element."""
        with self._lines:
            self._lines.skip(element.rows)

    def columns(self, element: Element, which: Sequence[int]) -> FloatArray:
        """(rows, k) some properties of an element without lists."""
        values = array("d")
        with self._lines:
            for _ in range(element.rows):
                row = self._lines.next().split()
                values.extend(float(row[k]) for k in which)
        return np.array(values, np.float64).reshape(-1, len(which))

    def polygons(self, element: Element) -> IntArray:
        """(F, 3) the polygons that the rows of an element list, as triangles."""
        triangles = _Triangles(self._limits)
        with self._lines:
            for (corners,) in self.lists(element, [element.corners]):
                triangles.add([int(value) for value in corners])
        return triangles.all()

    def lists(self, element: Element, which: Sequence[int]) -> Iterator[list[Sequence[bytes]]]:
        """Some lists of each row."""
        for _ in range(element.rows):
            row, start, found = self._lines.next().split(), 0, dict[int, Sequence[bytes]]()
            for k, p in enumerate(element.properties[: max(which) + 1]):
                if p.length is None:
                    start += 1
                    continue
                if k in which:
                    found[k] = _exactly(int(row[start]), row[start + 1 :])
                start += 1 + int(row[start])
            yield [found[k] for k in which]


class BinaryTable:
    """The rows of a binary PLY file, one behind the other."""

    def __init__(self, data: memoryview, limits: Limits) -> None:
        self._data, self._limits, self._place = data, limits, 0

    def _alike(self, element: Element, lengths: Sequence[int] = ()) -> NDArray:
        """The rows of an element where they lie, if all have lists of these lengths; fields by number of property."""
        fields: list[tuple] = []
        left = iter(lengths)
        for k, p in enumerate(element.properties):
            if p.length is None:
                fields.append((f"{k}", p.type, (1,)))
            else:
                fields += [(f"length {k}", p.length), (f"{k}", p.type, (next(left),))]
        row = np.dtype(fields)
        if element.rows * row.itemsize > len(self._data) - self._place:
            raise ValueError(f"it says {element.rows} rows of {clipped(element.name)}, and ends before")
        return np.ndarray((element.rows,), row, self._data, self._place)

    def skip(self, element: Element) -> None:
        """Go behind the rows of an element."""
        if element.lists:
            raise ValueError(f"its {clipped(element.name)} rows, before the faces, have lists")
        self._place += self._alike(element).nbytes

    def columns(self, element: Element, which: Sequence[int]) -> FloatArray:
        """(rows, k) some properties of an element without lists."""
        rows = self._alike(element)
        self._place += rows.nbytes
        return np.hstack([rows[f"{k}"] for k in which]).astype(np.float64)

    def polygons(self, element: Element) -> IntArray:
        """(F, 3) the polygons that the rows of an element list, as triangles."""
        corners = element.corners
        which = element.lists.index(corners)
        spans, _ = self._row(element)
        try:
            rows = self._alike(element, [length for _, length in spans])
            lengths = zip(element.lists, spans, strict=True)
            alike = all((rows[f"length {k}"] == length).all() for k, (_, length) in lengths)
        except ValueError:  # the file would end before, were all rows like the first
            alike = False
        if alike and spans[which][1] == 3:
            self._place += rows.nbytes
            return rows[f"{corners}"].astype(np.int64)
        triangles = _Triangles(self._limits)
        for (polygon,) in self.lists(element, [corners]):
            self._limits.check(0, len(polygon) - 2)
            triangles.add(polygon.tolist())
        return triangles.all()

    def lists(self, element: Element, which: Sequence[int]) -> Iterator[list[NDArray]]:
        """Some lists of each row."""
        places = [(element.lists.index(k), element.properties[k].type) for k in which]
        for _ in range(element.rows):
            spans, self._place = self._row(element)
            yield [np.ndarray((spans[place][1],), kind, self._data, spans[place][0]) for place, kind in places]

    def _row(self, element: Element) -> tuple[list[tuple[int, int]], int]:
        """Where the lists of the next row begin and how many entries each has, and where the row ends."""
        spans, place = [], self._place
        for gap, kind, size in element.steps:
            start = place + gap + kind.itemsize
            order: Any = "big" if kind.str[0] == ">" else "little"
            length = int.from_bytes(self._data[place + gap : start], order, signed=kind.kind == "i")
            spans.append((start, length))
            place = start + max(length, 0) * size
        place += element.rest
        if place > len(self._data):
            raise ValueError(f"it says {element.rows} rows of {clipped(element.name)}, and ends before")
        return spans, place
