"""Readers of OBJ, OFF and STL: the vertices in the order of the file, and its polygons as triangles.

Other readers split and reorder vertices along seams of texture, so this project has its own. Each goes through its file
once.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from enum import Enum
from itertools import islice, pairwise
from typing import Self

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, as_utf8
from shapespace.files.mni_reading import is_mni, read_mni
from shapespace.mesh.triangle_mesh import MeshError

#: Bytes that are copied at once to count the lines before an error.
_PIECE = 2**20
ENDS_EARLY = "it ends before the data that it announces"
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
#: A comment of OBJ, which ends with its line, or the end of a line that goes on in the next one.
_CONTINUES = rb"\\[ \t]*(?:\r\n?|\n|\Z)"
_CONTINUED = re.compile(rb"((?<!\S)#[^\r\n]*+)|" + _CONTINUES)


#: The start of a remark, where it is not what Windows writes for a number that is not finite.
_REMARK = re.compile(rb"#(?!IND|INF|[QS]NAN)")
#: An exponent of Fortran, and decimals of a whole number.
_FORTRAN, _POINT_ZERO = re.compile(rb"(?<=[\d.])[dD](?=[+-]?\d)"), re.compile(rb"(?<=\d)\.0*\Z")
#: The lines that OBJ should have.
OBJ_VERTEX = "a vertex is v x y z, with decimal points"
OBJ_FACE = "a face is f a b c, with whole numbers from 1"


def _lines_with(start: bytes) -> re.Pattern[bytes]:
    """Return a pattern for lines that start like this after blanks. It passes over other lines without Python code."""
    return re.compile(rb"(?<![^\r\n])[^\S\r\n]*+(" + start + rb"[^\r\n]*+)")


_LINE, _OBJ_LINE = map(_lines_with, (rb"[^\s#]", rb"(?:[vV]|[fF]o?)\b"))
#: The parts of ASCII STL that count: a corner, the end of a facet, and the name of a solid, which may be any text.
_STL_PART = re.compile(
    rb"(?<!\S)((?i:vertex\s++\S++\s++\S++\s++\S++|end\s*(?:loop|facet)\b|"
    rb"(?:end\s*)?solid\b[^\r\n]*?(?=\sfacet\s+normal\b|[\r\n]|\Z)))"
)


class Lines:
    """The lines of a text that are neither empty nor a remark.

    As a context, it turns an error of a line into a ValueError with its number and with `wanted`.

    Args:
        data: the text in UTF-8, with or without a byte-order mark, or in UTF-16 with one.
        wanted: what the lines should be, as a sentence; can be changed while reading.
        line: a pattern of the lines that count, each its first group.
        start: place of the first line in the text.
    """

    def __init__(self, data: memoryview, wanted: str, line: re.Pattern[bytes] = _LINE, start: int = 0) -> None:
        self._data, self._place, self.wanted = as_utf8(data), start, wanted
        self._matches = line.finditer(self._data, start)
        self._lines = self._all()

    def _all(self) -> Iterator[bytes]:
        for match in self._matches:
            self._place = match.start(1)
            yield match.group(1).rstrip()

    @property
    def _number(self) -> int:
        before = self._data[: self._place]
        pieces = [bytes(before[k : k + _PIECE]) for k in range(0, len(before), _PIECE)]
        return 1 + max(sum(piece.count(end) for piece in pieces) for end in (b"\n", b"\r"))

    def __iter__(self) -> Iterator[bytes]:
        return self._lines

    def next(self) -> bytes:
        """Return the next line; raises EOFError after the last one."""
        for line in self._lines:
            return line
        raise EOFError(ENDS_EARLY)

    def behind(self, line: bytes) -> bytes:
        """Return the text behind the line that was read last."""
        return bytes(self._data[self._place + len(line) :])

    def skip(self, count: int) -> None:
        """Skip ``count`` lines; raises EOFError if there are fewer."""
        if sum(1 for _ in islice(self._matches, count)) < count:
            raise EOFError(ENDS_EARLY)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, ValueError | LookupError | OverflowError) and not isinstance(error, MeshError):
            raise ValueError(f"line {self._number} can't be read: {self.wanted}") from None


def joined_lines(data: memoryview) -> memoryview:
    """Return an OBJ or MTL text, in UTF-8, with lines joined that end in a backslash, except comments."""
    data = as_utf8(data)
    return memoryview(_CONTINUED.sub(rb"\1 ", bytes(data))) if re.search(_CONTINUES, data) else data


#: The keyword of OFF, which may be missing, and what follows on its line.
_OFF = re.compile(rb"(?:((?:ST)?[CN]{0,2})OFF)(\s+BINARY\b.*|[\s\d].*)?|()(\d+\s+\d+(?:\s+\d+)?)", re.IGNORECASE)


class TriangleFans:
    """Triangles from polygons: the triangles of a polygon have its first corner in common."""

    def __init__(self, limits: Limits) -> None:
        self._limits, self._most, self._corners = limits, 3 * limits.faces, array("q")

    def add(self, polygon: Sequence[int]) -> None:
        """Append a polygon; raises ValueError if it has no corner. Points and lines, with one or two, are left out."""
        if not polygon:
            raise ValueError("a face has no corners")
        if (corners := len(self._corners) + 3 * (len(polygon) - 2)) > self._most:
            self._limits.check(0, corners // 3)
        if len(polygon) >= 3:
            self._corners.extend(polygon[:3])
        for a, b in pairwise(polygon[2:]):
            self._corners.extend((polygon[0], a, b))

    @property
    def faces(self) -> IntArray:
        """All triangles (F, 3)."""
        return np.array(self._corners, np.int64).reshape(-1, 3)


def read_obj(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of an OBJ file, Wavefront's or MNI's; everything else is ignored."""
    coordinates, triangles, most = array("d"), TriangleFans(limits), 3 * limits.vertices
    text = as_utf8(data)
    if is_mni(start := bytes(text[:1000])):
        return read_mni(text, limits)
    if b"\0" in start.rstrip(b"\0"):
        raise ValueError("it is not text")
    with Lines(joined_lines(text), OBJ_VERTEX, _OBJ_LINE) as lines:
        for line in lines:
            keyword, *values = line.split(None, 1)
            lines.wanted = OBJ_VERTEX if keyword in b"vV" else OBJ_FACE
            if keyword in b"vV":
                coordinates.extend(_point(values[0]))
                if len(coordinates) > most:
                    limits.check(len(coordinates) // 3, 0)
            else:
                here = len(coordinates) // 3
                corners = values[0].partition(b"#")[0].split()
                numbers = whole(corners if b"/" not in values[0] else (c.partition(b"/")[0] for c in corners))
                if 0 in numbers:
                    raise ValueError
                # Negative numbers count back from the last vertex before this line.
                triangles.add([number - 1 if number > 0 else here + number for number in numbers])
    return np.array(coordinates, np.float64).reshape(-1, 3), triangles.faces


def _point(values: bytes) -> list[float]:
    return reals(_REMARK.split(values, 1)[0].split(None, 3)[:3], 3)


def reals(values: Sequence[bytes], count: int) -> list[float]:
    """Return ``count`` numbers from text, also with exponents of Fortran; raises ValueError otherwise."""
    if len(values) != count:
        raise ValueError
    try:
        return [float(value) for value in values]
    except ValueError:
        return [float(_FORTRAN.sub(b"e", value)) for value in values]


def whole(values: Iterable[bytes]) -> list[int]:
    """Return whole numbers from text, also with a decimal point; raises ValueError for fractions."""
    values = [*values]
    try:
        return [int(value) for value in values]
    except ValueError:
        return [int(_POINT_ZERO.sub(b"", value)) for value in values]


def read_off(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of an OFF file; colours, normals and texture coordinates are ignored.

    The keyword can be OFF with any of ST, C and N in front, and the file text or binary. In a text, counts and rows may
    go on in the next line, or share one. Some files lack the colours or normals that the keyword says. So the first of
    three layouts that explains the whole file counts.
    """
    try:
        return _read_off(data, limits, OffLayout.ROWS)
    except (ValueError, EOFError) as error:
        if isinstance(error, MeshError):
            raise
        for layout in (OffLayout.PLAIN_ROWS, OffLayout.NUMBERS):
            with suppress(ValueError, EOFError):
                return _read_off(data, limits, layout)
        raise


class OffLayout(Enum):
    """Layout of an OFF file: rows as the keyword says, rows that need no more than three numbers, or only numbers."""

    ROWS = 1
    PLAIN_ROWS = 2
    NUMBERS = 3


def _read_off(data: memoryview, limits: Limits, layout: OffLayout) -> tuple[FloatArray, IntArray]:
    coordinates, triangles = array("d"), TriangleFans(limits)
    with Lines(data, "the keyword OFF is needed, then the numbers of vertices, faces and edges") as lines:
        found = _OFF.fullmatch(lines.next().partition(b"#")[0].rstrip())
        if not found:
            raise ValueError("another kind of file")
        prefix, rest = (found[1] or b"").upper(), (found[2] or found[4] or b"").split()
        if rest and rest[0].upper() == b"BINARY":
            return _binary_off(data, prefix, limits)
        width = 3 if layout is OffLayout.PLAIN_ROWS else 3 + 2 * (b"ST" in prefix) + 3 * sum(map(prefix.count, b"CN"))
        rows = layout is not OffLayout.NUMBERS
        counts = _row(lines, 1, rest)
        counts = counts if len(counts) > 1 and rows else _row(lines, 3, counts)
        vertex_count, face_count, left = int(counts[0]), int(counts[1]), counts[3:]
        limits.check(vertex_count, face_count)
        if min(vertex_count, face_count) < 0:
            raise ValueError("less than none")
        lines.wanted = "a vertex has three coordinates, with decimal points"
        while len(coordinates) < 3 * vertex_count:
            row = _row(lines, width, None if rows else left)
            coordinates.extend(reals(row[:3], 3))
            left = row[width:]
        lines.wanted = "a face has the number of its corners, and then the indices of as many vertices"
        for _ in range(face_count):
            row = _row(lines, 1, None if rows else left)
            corners = int(row[0])
            if len(row) != 1 + corners:
                row = _row(lines, 1 + corners, row)
                row, left = [row[0], *first_values(corners, row[1:])], row[1 + corners :]
            else:
                left = []
            triangles.add(whole(row[1:]))
        if not rows and (left or next(iter(lines), None)):
            raise ValueError("more numbers than it says")
    return np.array(coordinates, np.float64).reshape(-1, 3), triangles.faces


def _binary_off(data: memoryview, prefix: bytes, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return the same of a binary file: after the first line, big-endian integers and floats of four bytes."""
    body = data[bytes(data[:1000]).index(b"\n") + 1 :]
    body = body[: len(body) // 4 * 4]
    if len(body) < 12:
        raise EOFError(ENDS_EARLY)
    vertex_count, face_count, _ = np.frombuffer(body, ">i4", 3).tolist()
    limits.check(vertex_count, face_count)
    width = 3 + 3 * (b"N" in prefix) + 4 * (b"C" in prefix) + 2 * (b"ST" in prefix)
    if min(vertex_count, face_count) < 0 or len(body) < 12 + 4 * (width * vertex_count + 2 * face_count):
        raise EOFError(ENDS_EARLY)
    vertices = np.frombuffer(body, ">f4", width * vertex_count, 12).reshape(-1, width)[:, :3]
    values, triangles = np.frombuffer(body, ">i4", -1, 12 + 4 * width * vertex_count), TriangleFans(limits)
    place = 0
    for _ in range(face_count):
        # The number of corners, the corners, the number of colours, and the colours.
        end = place + 1 + (int(values[place]) if place < len(values) else 0)
        if not place < end < len(values) or values[end] < 0:
            raise EOFError(ENDS_EARLY)
        triangles.add(values[place + 1 : end].tolist())
        place = end + 1 + int(values[end])
    if place > len(values):
        raise EOFError(ENDS_EARLY)
    return vertices.astype(np.float64), triangles.faces


def _row(lines: Lines, count: int, row: list[bytes] | None = None) -> list[bytes]:
    """Return a row of at least ``count`` values, from one line or several; ``row`` has its first values."""
    row = row or []
    while len(row) < count:
        row += lines.next().partition(b"#")[0].split()
    return row


def first_values(count: int, values: Sequence[bytes]) -> Sequence[bytes]:
    """Return the first ``count`` values; raises ValueError if there are fewer."""
    if not 0 <= count <= len(values):
        raise ValueError("values are missing")
    return values[:count]


#: A triangle of a binary STL file, the bytes before the first triangle, and the place of the number of triangles there.
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEADER, _STL_COUNT = 84, 80
#: Numbers of triangles in files whose program did not fill the number in, when it knew it.
_UNCOUNTED = (0, 2**32 - 1)
_STL_END = re.compile(rb"end\s*(?:loop|facet)", re.IGNORECASE)
_STL_CLOSED = re.compile(rb"end\s*(facet|solid)", re.IGNORECASE)


def read_stl(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (3F, 3) and faces (F, 3) of a binary or ASCII STL file, with three vertices for each face."""
    triangles = struct.unpack_from("<I", data, _STL_COUNT)[0] if len(data) >= _STL_HEADER else 0
    if triangles in _UNCOUNTED and len(data) > _STL_HEADER and not _is_ascii_stl(data):
        triangles, rest = divmod(len(data) - _STL_HEADER, _STL.itemsize)
        triangles = 0 if rest else triangles
    binary = _STL_HEADER + triangles * _STL.itemsize
    # A binary file may start like a text, but its length shows what it is. Some programs append bytes.
    if len(data) == binary or (triangles > 0 and binary < len(data) and not _is_ascii_stl(data)):
        limits.check(3 * triangles, triangles)
        corners = np.frombuffer(data, _STL, triangles, _STL_HEADER)["corners"]
        vertices = corners.astype(np.float64).reshape(-1, 3)
    else:
        vertices = _ascii_stl(data, limits)
    return vertices, np.arange(len(vertices)).reshape(-1, 3)


def _is_ascii_stl(data: memoryview) -> bool:
    start = bytes(data[:1000]).lower()
    return start.lstrip(_BYTE_ORDER_MARK + b" \t\r\n").startswith(b"solid") and b"\0" not in start


def _is_whole_stl(last: bytes, behind: bytes) -> bool:
    """Whether ASCII STL ends behind a solid, or behind a facet with no more than some of ``endsolid``."""
    end = _STL_CLOSED.match(last)
    return end is not None and (end[1].lower() == b"solid" or b"endsolid".startswith(behind.strip().lower()))


def _ascii_stl(data: memoryview, limits: Limits) -> FloatArray:
    """Return the corners (3F, 3) of all solids, one after the other. A missing end of the last solid is accepted."""
    coordinates, whole_facets, part = array("d"), 0, b""
    with Lines(data, "a corner is vertex x y z, with decimal points, and a facet has three", _STL_PART) as parts:
        for part in parts:
            if part[:6].lower() == b"vertex":
                coordinates.extend(_point(part[6:]))
                limits.check(len(coordinates) // 3, len(coordinates) // 9)
            elif _STL_END.match(part) and len(coordinates) != whole_facets:
                if len(coordinates) != whole_facets + 9:
                    raise ValueError
                whole_facets = len(coordinates)
    if not whole_facets:
        raise ValueError("damaged, or another kind of file")
    if len(coordinates) != whole_facets or not _is_whole_stl(part, parts.behind(part)):
        raise EOFError("it ends in the middle of a facet")
    return np.array(coordinates, np.float64).reshape(-1, 3)


def strip_triangles(corners: IntArray, offsets: IntArray) -> IntArray:
    """Return the triangles (F, 3) of strips, which begin at ``offsets`` (n + 1,) in the list of their corners.

    Triangles without area, which join strips, are left out.
    """
    sizes = np.diff(offsets)
    places = np.arange(len(corners)) - np.repeat(offsets[:-1], sizes)
    faces = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    # Every second triangle of a strip is turned over.
    odd = places[:-2] % 2 == 1
    faces[odd] = faces[odd][:, [0, 2, 1]]
    inside = (places + 2 < np.repeat(sizes, sizes))[:-2]
    found: IntArray = faces[inside & (faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    return found
