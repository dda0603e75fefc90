"""Reader of VTK's legacy files of polygons, also in unstructured grids; vertices and lines are ignored.

It reads the sections of a file that have the mesh, and checks every count that the file states.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, clipped
from shapespace.files.polygon_reading import ENDS_EARLY
from shapespace.files.vtk_cells import VtkCells, other_kind, surface
from shapespace.mesh.triangle_mesh import MeshError

DAMAGED = "it is damaged, or cut short"
#: The first line of a file, its title, the encoding of its numbers, and the kind of its data.
_HEAD = re.compile(
    rb"# vtk DataFile Version (\d+)\.\d+[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s+DATASET\s+(\w+)", re.IGNORECASE
)
#: Keywords that begin a section, with a number. Attributes of points and cells come last.
_SECTION = re.compile(
    rb"(?<=[\s])(POINTS|VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|CELLS|CELL_TYPES|POINT_DATA|CELL_DATA)[ \t]+(\d+)\b"
    rb"[ \t]*([^\s]*)[^\n]*\n",
    re.IGNORECASE,
)
_ANY_SECTION = re.compile(rb"(?<=\n)([A-Za-z_]{4,})[ \t]+\d+(?=[ \t\r\n])")
#: Keywords that may begin a line with a number in a file of polygons.
_KNOWN = {"POINTS", "VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "CELLS", "CELL_TYPES"}
_KNOWN |= {"FIELD", "METADATA", "INFORMATION", "DATA"}
_OFFSETS = re.compile(rb"\s*+OFFSETS[ \t]+(\w+)[^\n]*\n")
_CONNECTIVITY = re.compile(rb"CONNECTIVITY[ \t]+(\w+)[^\n]*\n")
#: Types of numbers. VTK writes its own indices, vtkIdType, with four bytes.
_TYPES = {
    "unsigned_char": "u1", "char": "i1", "unsigned_short": "u2", "short": "i2", "unsigned_int": "u4", "int": "i4",
    "unsigned_long": "u8", "long": "i8", "float": "f4", "double": "f8", "vtkidtype": "i4", "vtktypeint64": "i8",
    "vtktypeuint64": "u8", "vtktypeint32": "i4", "vtktypeuint32": "u4", "vtktypeint16": "i2", "vtktypeuint16": "u2",
    "vtktypeint8": "i1", "vtktypeuint8": "u1",
}  # fmt: skip
#: Bytes of a text that are turned into numbers at once.
_PIECE = 2**20


def read_vtk(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a legacy file.

    Files of the versions 1 to 5 are read. Polygons become fans of triangles, and come before the triangle strips.
    """
    head = _HEAD.match(data)
    if not head:
        raise ValueError("damaged, or another kind of file")
    version, ascii, kind = int(head[1]), head[2].upper() == b"ASCII", head[3].decode()
    if not 1 <= version <= 5:
        raise MeshError(f"it is version {version} of VTK's legacy files, and 1 to 5 are read")
    if kind.upper() not in ("POLYDATA", "UNSTRUCTURED_GRID"):
        raise MeshError(other_kind(kind))
    vertices, types = np.zeros((0, 3)), np.zeros(0, np.int64)
    cells: dict[str, VtkCells] = {}
    found = list(_SECTION.finditer(data, head.end()))
    ends = [match.start() for match in found[1:]] + [len(data)]
    for match, end in zip(found, ends, strict=True):
        name, count, section = match[1].decode().upper(), int(match[2]), data[match.end() : end]
        if name == "POINTS":
            limits.check(count, 0)
            vertices = numbers(section, 3 * count, _type(match[3]), ascii=ascii).astype(np.float64).reshape(-1, 3)
        elif name in ("POLYGONS", "TRIANGLE_STRIPS", "CELLS"):
            cells[name] = _cells(section, count, int(match[3]), ascii=ascii)._replace(strips=name == "TRIANGLE_STRIPS")
        elif name == "CELL_TYPES":
            types = numbers(section, count, _type(b"int"), ascii=ascii).astype(np.int64)
        elif name.endswith("_DATA"):
            break
    if not cells:
        _require_known_sections(data[head.end() :])
    grid = cells.pop("CELLS", None)
    return surface(vertices, [*cells.values(), *(grid.of_grid(types) if grid else ())], limits)


def _require_known_sections(data: memoryview) -> None:
    """Raise MeshError if there is an unknown section before the attributes; it may have the faces."""
    for match in _ANY_SECTION.finditer(data):
        name = match[1].decode().upper()
        if name.endswith("_DATA"):
            break
        if name not in _KNOWN:
            raise MeshError(f"its section {clipped(name)} is not read: save the faces as POLYGONS")


def _type(name: bytes) -> np.dtype:
    try:
        return np.dtype(">" + _TYPES[name.decode("latin-1").lower()])
    except KeyError:
        raise ValueError(f"its numbers have an unknown type; known ones are {', '.join(_TYPES)}") from None


def _cells(section: memoryview, count: int, size: int, *, ascii: bool) -> VtkCells:
    """Return cells: before version 5, each is its number of corners, and then the corners."""
    if offsets := _OFFSETS.match(section):
        kind, begin = _type(offsets[1]), offsets.end()
        connectivity = _CONNECTIVITY.search(section, begin if ascii else begin + count * kind.itemsize)
        if not connectivity:
            raise ValueError(DAMAGED)
        starts = numbers(section[begin : connectivity.start()], count, kind, ascii=ascii)
        corners = numbers(section[connectivity.end() :], size, _type(connectivity[1]), ascii=ascii)
        return VtkCells(starts.astype(np.int64), corners.astype(np.int64))
    values = numbers(section, size, _type(b"int"), ascii=ascii).astype(np.int64)
    starts = np.arange(0, size, 1 + int(values[0])) if size and values[0] > 0 else np.zeros(0, np.int64)
    if len(starts) != count or (values[starts] != values[0]).any():
        places, place = [], 0
        for _ in range(count):
            if place >= size:
                raise ValueError(ENDS_EARLY)
            places.append(place)
            place += 1 + max(int(values[place]), 0)
        starts = np.array(places, np.int64)
        if place != size:
            raise ValueError(ENDS_EARLY)
    is_corner = np.ones(size, bool)
    is_corner[starts] = False
    return VtkCells(np.append(0, np.cumsum(values[starts])), values[is_corner])


def numbers(data: memoryview, count: int, kind: np.dtype, *, ascii: bool) -> NDArray:
    """Return the first ``count`` numbers of a text, or of binary data of a type; raises ValueError if there are fewer.

    Numbers of a text are float64 or int64.
    """
    if not ascii:
        if count * kind.itemsize > len(data):
            raise ValueError(DAMAGED)
        return np.frombuffer(data, kind, count)
    if count > len(data):
        raise ValueError(DAMAGED)
    found = np.empty(count, np.float64 if kind.kind == "f" else np.int64)
    place = begin = 0
    while place < count:
        piece = bytes(data[begin : begin + _PIECE])
        if begin + _PIECE < len(data):  # a number that goes on is read with the next piece
            piece = piece[: max(piece.rfind(b" "), piece.rfind(b"\n"), piece.rfind(b"\t")) + 1]
        if not piece:
            raise ValueError(DAMAGED)
        begin += len(piece)
        words = piece.split(None, count - place)[: count - place]
        try:
            found[place : place + len(words)] = np.array(words, found.dtype)
        except (ValueError, OverflowError):
            raise ValueError(DAMAGED) from None
        place += len(words)
    return found
