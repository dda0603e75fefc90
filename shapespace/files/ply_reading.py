"""Reader of PLY, ASCII and binary: the vertices in the order of the file, and its polygons as triangles."""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, as_utf8, clipped
from shapespace.files.polygon_reading import Lines, TriangleFans, first_values, reals, strip_triangles, whole
from shapespace.mesh.triangle_mesh import MeshError

#: Bytes at the start of a file in which its header has to end.
_LONGEST_HEADER = 2**16
_DTYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8",
    "uint64": "u8", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip
#: The start of a header whose lines end in a carriage return alone.
_CARRIAGE_RETURNS = re.compile(rb"[^\r\n]*\r(?!\n)")
_HEAD_WANTED = "it should name a format, an element with its number of rows, or a property of a known type"
_BYTE_ORDERS = {b"binary_little_endian": "<", b"binary_big_endian": ">", b"ascii": ""}


@dataclass(frozen=True)
class PlyProperty:
    """A property of the rows of an element."""

    name: str  # name of the property
    type: np.dtype  # type of the value, or of the entries of a list
    length: np.dtype | None  # type of the number of entries of a list; None if the property is no list


@dataclass(frozen=True)
class PlyElement:
    """An element of a PLY file, which is a table."""

    name: str  # name of the element
    rows: int  # number of rows
    properties: list[PlyProperty]  # columns, in order

    @cached_property
    def lists(self) -> list[int]:
        """Indices of the properties that are lists."""
        return [k for k, p in enumerate(self.properties) if p.length is not None]

    @cached_property
    def steps(self) -> list[tuple[int, np.dtype, int]]:
        """For each list: bytes between it and the previous list, type of its length, and bytes of an entry."""
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
        """Bytes after the last list of a row."""
        return sum(p.type.itemsize for p in self.properties[max(self.lists, default=-1) + 1 :])

    @property
    def coordinates(self) -> list[int]:
        """Indices of the properties x, y and z; raises ValueError if one is missing."""
        names = [p.name for p in self.properties]
        if not {"x", "y", "z"} <= set(names):
            raise ValueError("its vertices lack x, y and z")
        return [names.index(axis) for axis in "xyz"]

    @property
    def corners(self) -> int:
        """Index of the property that lists the vertices of a face; raises ValueError if there is none."""
        for k, p in enumerate(self.properties):
            if p.name in ("vertex_indices", "vertex_index") and p.length is not None and p.type.kind != "f":
                return k
        raise ValueError("its faces have no list of vertex_indices")


def read_ply(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a PLY file; elements with neither are ignored.

    In a text, each row should have a line. If rows go on in the next line, or share one, only numbers count.
    """
    try:
        return _read(*open_table(data, limits), limits)
    except (ValueError, LookupError, EOFError) as error:
        elements, table = open_table(data, limits)
        if isinstance(error, MeshError) or not isinstance(table, TextTable):
            raise
        with suppress(ValueError, LookupError, EOFError):
            return _read(elements, NumbersTable(table), limits)
        raise


def _read(elements: list[PlyElement], table: TextTable | BinaryTable, limits: Limits) -> tuple[FloatArray, IntArray]:
    vertices, faces, strips = np.zeros((0, 3)), np.zeros((0, 3), np.int64), np.zeros((0, 3), np.int64)
    # Elements after these are not read, unless all numbers of a text have to be.
    wanted = {element.name for element in elements if element.rows} & {"vertex", "face", "tristrips"}
    for element in elements:
        if not (wanted or isinstance(table, NumbersTable)):
            break
        if element.name == "vertex":
            limits.check(element.rows, 0)
            vertices = table.columns(element, element.coordinates)
        elif element.name == "face" and element.rows:
            limits.check(0, element.rows)
            faces = table.polygons(element)
        elif element.name == "tristrips" and element.rows:
            corners = chain.from_iterable(
                (-1, *map(int, strip)) for (strip,) in table.lists(element, [element.corners])
            )
            strips = _separated(np.fromiter(corners, np.int64))
            limits.check(0, len(strips))
        else:
            table.skip(element)
        wanted.discard(element.name)
    table.close()
    return vertices, faces if len(faces) else strips


def _separated(corners: IntArray) -> IntArray:
    """Return the triangles (F, 3) of strips (n,), which −1 separates."""
    sizes = np.diff(np.flatnonzero(np.append(corners, -1) == -1), prepend=-1) - 1
    return strip_triangles(corners[corners != -1], np.append(0, np.cumsum(sizes)))


def open_table(data: memoryview, limits: Limits) -> tuple[list[PlyElement], TextTable | BinaryTable]:
    """Return the elements of a file, and the table with their rows."""
    data = as_utf8(data)
    head = bytes(data[:_LONGEST_HEADER])
    end = re.search(rb"(?<=[\r\n])end_header[ \t]*" + (rb"\r" if _CARRIAGE_RETURNS.match(head) else rb"\r?\n"), head)
    if not head[:3].lower() == b"ply" or not end:
        raise ValueError("damaged, or another kind of file")
    order, elements = None, list[PlyElement]()
    for number, line in enumerate(head[: end.start()].splitlines(), 1):
        try:
            match line.split():
                case [b"format", kind, *_]:
                    order = _BYTE_ORDERS[kind]
                case [b"element", name, rows]:
                    elements.append(PlyElement(name.decode("latin-1"), int(rows), []))
                case [b"property", b"list", length, kind, name, *more]:
                    elements[-1].properties.append(_property(b" ".join([name, *more]), kind, length, order))
                case [b"property", kind, name, *more]:
                    elements[-1].properties.append(_property(b" ".join([name, *more]), kind, None, order))
        except (ValueError, LookupError):
            raise ValueError(f"line {number} of its head can't be read: {_HEAD_WANTED}") from None
    if order is None or len({e.name for e in elements}) < len(elements) or any(e.rows < 0 for e in elements):
        raise ValueError("its head is damaged")
    return elements, BinaryTable(data[end.end() :], limits) if order else TextTable(data, limits, end.end())


def _property(name: bytes, kind: bytes, length: bytes | None, order: str | None) -> PlyProperty:
    types = [np.dtype((order or "") + _DTYPES[k.decode("latin-1")]) for k in (kind, length) if k is not None]
    if length is not None and types[1].kind == "f":
        raise ValueError("the length of a list is not a whole number")
    return PlyProperty(name.decode("latin-1"), types[0], types[1] if length is not None else None)


class TextTable:
    """Rows of an ASCII file, one on each line, after its header, which ends at ``start``.

    Elements have to be read or skipped in their order in the file.
    """

    def __init__(self, data: memoryview, limits: Limits, start: int) -> None:
        self.limits, self.lines = limits, Lines(data, "", start=start)

    def _rows(self, element: PlyElement) -> Iterator[list[bytes]]:
        """Yield the values of each row."""
        names = clipped(" ".join(p.name for p in element.properties))
        self.lines.wanted = f"a row of {clipped(element.name)} has the values of {names}"
        for _ in range(element.rows):
            yield self._row(element)

    def _row(self, element: PlyElement) -> list[bytes]:
        return self.lines.next().split()

    def close(self) -> None:
        """Tell that nothing more is needed."""

    def skip(self, element: PlyElement) -> None:
        """Skip the rows of an element."""
        self.lines.skip(element.rows)

    def columns(self, element: PlyElement, which: Sequence[int]) -> FloatArray:
        """Return the properties ``which`` of an element, which are no lists, (rows, k)."""
        values = array("d")
        with self.lines:
            for row in self._rows(element):
                for k in element.lists:  # shortens each list to its length, so that properties keep their indices
                    row[k + 1 : k + 1 + int(row[k])] = []
                values.extend(reals([row[k] for k in which], len(which)))
        return np.array(values, np.float64).reshape(-1, len(which))

    def polygons(self, element: PlyElement) -> IntArray:
        """Return the polygons in the rows of an element as triangles (F, 3)."""
        triangles, corners = TriangleFans(self.limits), element.corners
        with self.lines:
            for (polygon,) in self.lists(element, [corners]):
                triangles.add(whole(polygon))
        return triangles.faces

    def lists(self, element: PlyElement, which: Sequence[int]) -> Iterator[list[Sequence[bytes]]]:
        """Yield the lists ``which`` of each row."""
        with self.lines:
            for row in self._rows(element):
                start, found = 0, dict[int, Sequence[bytes]]()
                for k, p in enumerate(element.properties[: max(which) + 1]):
                    if p.length is None:
                        start += 1
                        continue
                    (length,) = whole(row[start : start + 1])
                    if k in which:
                        found[k] = first_values(length, row[start + 1 :])
                    start += 1 + length
                yield [found[k] for k in which]


class NumbersTable(TextTable):
    """Rows of an ASCII file whose lines don't matter; with the methods of `TextTable`."""

    def __init__(self, table: TextTable) -> None:
        self.limits, self.lines = table.limits, table.lines
        self._values = chain.from_iterable(line.split() for line in self.lines)

    def _row(self, element: PlyElement) -> list[bytes]:
        row: list[bytes] = []
        for p in element.properties:
            (value,) = values = [*islice(self._values, 1)]
            row += values
            if p.length is not None:
                row += first_values(int(value), [*islice(self._values, max(int(value), 0))])
        return row

    def skip(self, element: PlyElement) -> None:
        """Skip the rows of an element."""
        for _ in self._rows(element):
            pass

    def close(self) -> None:
        """Raise ValueError if there are more numbers than the header says."""
        if next(self._values, None) is not None:
            raise ValueError("more numbers than it says")


class BinaryTable:
    """Rows of a binary file; with the methods of `TextTable`."""

    def __init__(self, data: memoryview, limits: Limits) -> None:
        self._data, self._limits, self._place = data, limits, 0

    def _equal_rows(self, element: PlyElement, lengths: Sequence[int] = ()) -> NDArray:
        """View the rows of an element as a structured array, if all lists have these lengths.

        Fields have the index of their property as name.
        """
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

    def close(self) -> None:
        """Tell that nothing more is needed."""

    def skip(self, element: PlyElement) -> None:
        """Skip the rows of an element."""
        if not element.lists:
            self._place += self._equal_rows(element).nbytes
            return
        self._spans(element, 0)

    def columns(self, element: PlyElement, which: Sequence[int]) -> FloatArray:
        """Return the properties ``which`` of an element, which are no lists, (rows, k)."""
        if element.lists:
            return self._columns_beside_lists(element, which)
        rows = self._equal_rows(element)
        self._place += rows.nbytes
        return np.hstack([rows[f"{k}"] for k in which]).astype(np.float64)

    def _columns_beside_lists(self, element: PlyElement, which: Sequence[int]) -> FloatArray:
        """Return the same where rows can have different lengths. The fields before a list end at its length."""
        values = array("d")
        sizes = [p.type.itemsize for p in element.properties]
        for _ in range(element.rows):
            place, (spans, self._place) = self._place, self._row(element)
            starts, ends = list[int](), dict(zip(element.lists, spans, strict=True))
            for k, size in enumerate(sizes):
                starts.append(place)
                place = ends[k][0] + max(ends[k][1], 0) * size if k in ends else place + size
            values.extend(float(np.ndarray((), element.properties[k].type, self._data, starts[k])) for k in which)
        return np.array(values, np.float64).reshape(-1, len(which))

    def polygons(self, element: PlyElement) -> IntArray:
        """Return the polygons in the rows of an element as triangles (F, 3)."""
        corners = element.corners
        which = element.lists.index(corners)
        spans, _ = self._row(element)
        try:
            rows = self._equal_rows(element, [length for _, length in spans])
            lengths = zip(element.lists, spans, strict=True)
            equal = all((rows[f"length {k}"] == length).all() for k, (_, length) in lengths)
        except ValueError:  # the file is too short for rows like the first one
            equal = False
        if equal and spans[which][1] == 3:
            self._place += rows.nbytes
            return rows[f"{corners}"].astype(np.int64)
        starts, sizes = self._spans(element, which)
        if sizes.min() < 1:
            raise ValueError(f"a face has {sizes.min()} corners")
        # Points and lines, which have fewer corners, are left out.
        ends = np.cumsum(np.maximum(sizes - 2, 0))
        self._limits.check(0, int(ends[-1]))
        faces = np.empty((ends[-1], 3), np.int64)
        kind = element.properties[corners].type
        content = np.frombuffer(self._data, np.uint8)
        for size in np.unique(sizes).tolist():
            of_size = np.flatnonzero(sizes == size)
            values = content[starts[of_size, None] + np.arange(size * kind.itemsize)].view(kind).astype(np.int64)
            for k in range(size - 2):
                faces[ends[of_size] - (size - 2) + k] = values[:, [0, k + 1, k + 2]]
        return faces

    def _spans(self, element: PlyElement, which: int) -> tuple[IntArray, IntArray]:
        """Return first byte and number of entries of list ``which`` in each row of an element, (rows,) each."""
        starts, lengths = array("q"), array("q")
        for _ in range(element.rows):
            spans, self._place = self._row(element)
            starts.append(spans[which][0])
            lengths.append(spans[which][1])
        return np.array(starts), np.array(lengths)

    def lists(self, element: PlyElement, which: Sequence[int]) -> Iterator[list[NDArray]]:
        """Yield the lists ``which`` of each row."""
        places = [(element.lists.index(k), element.properties[k].type) for k in which]
        for _ in range(element.rows):
            spans, self._place = self._row(element)
            yield [np.ndarray((spans[place][1],), kind, self._data, spans[place][0]) for place, kind in places]

    def _row(self, element: PlyElement) -> tuple[list[tuple[int, int]], int]:
        """Return start and number of entries of each list of the next row, and the end of the row."""
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
