"""Reader of VTK's XML files of polygons, also in unstructured grids; vertices and lines are ignored.

Arrays are text, binary, or appended behind the tags; uncompressed, or in blocks that zlib, LZ4 or LZMA compressed. Each
array is unpacked to the size that the tags state, and no further
(https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html).
"""

from __future__ import annotations

import binascii
import lzma
import re
import zlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.files.pcd_reading import repeat
from shapespace.files.polygon_reading import ENDS_EARLY
from shapespace.files.vtk_cells import VtkCells, other_kind, surface
from shapespace.files.vtk_reading import DAMAGED, numbers
from shapespace.mesh.triangle_mesh import MeshError, require_vertices

_QUOTED = rb"\"[^\"]{0,1000}\"|'[^']{0,1000}'"
_TAG = re.compile(rb"<!--.*?(?:-->|\Z)|<(/?)([A-Za-z]\w{0,30})((?:[^<>\"']++|" + _QUOTED + rb"){0,100}+)>", re.DOTALL)
_ATTRIBUTE = re.compile(rb"(?<![\w:])([\w:]++)\s*+=\s*+(?:\"([^\"]*)\"|'([^']*)')")
_APPENDED = re.compile(rb"<AppendedData\b([^<>]{0,200})>\s*+_")
_TYPES = {f"{name}{8 * size}": f"{kind}{size}" for name, kind in (("Int", "i"), ("UInt", "u")) for size in (1, 2, 4, 8)}
_TYPES |= {"Float32": "f4", "Float64": "f8"}
#: Elements with the arrays of a piece that count, and its number of cells in each.
_SECTIONS = {"Points": "NumberOfPoints", "Polys": "NumberOfPolys", "Strips": "NumberOfStrips", "Cells": "NumberOfCells"}
#: Bytes that LZMA may need.
_LZMA_MEMORY = 2**27


@dataclass(frozen=True)
class _Piece:
    """A part of the mesh with its own points."""

    counts: dict[str, int]  # number of points or cells by section
    arrays: dict[tuple[str, str], tuple[dict[str, str], memoryview]] = field(default_factory=dict)  # attributes, text


def read_vtp(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3); polygons become fans of triangles, and come before triangle strips."""
    file = _XmlFile(data)
    pieces = [(piece, *file.cells(piece, limits)) for piece in file.pieces]
    if not pieces:
        raise ValueError("it has no points")
    vertices = np.concatenate([points for _, points, _ in pieces])
    begins = np.cumsum([0, *(len(points) for _, points, _ in pieces)]).tolist()
    cells: list[VtkCells] = []
    for begin, (_, points, own) in zip(begins, pieces, strict=False):
        for one in own:
            require_vertices(one.corners, len(points))
            cells.append(one._replace(corners=one.corners + begin))
    return surface(vertices, cells, limits)


class _XmlFile:
    """The pieces of a file, with their arrays."""

    def __init__(self, data: memoryview) -> None:
        appended = _APPENDED.search(data)
        self._appended = data[appended.end() :] if appended else None
        self._raw = appended is not None and _attributes(appended[1]).get("encoding") == "raw"
        self.pieces: list[_Piece] = []
        self._head: dict[str, str] = {}
        section = ""
        for tag in _TAG.finditer(data, 0, appended.start() if appended else len(data)):
            name, attributes = (tag[2] or b"").decode(), _attributes(tag[3] or b"")
            if name == "VTKFile" and not tag[1]:
                self._head = attributes
            elif name == "Piece" and not tag[1]:
                counts = {own: int(attributes.get(count, 0)) for own, count in _SECTIONS.items()}
                self.pieces.append(_Piece(counts))
            elif name in (*_SECTIONS, "Verts", "Lines", "PointData", "CellData", "FieldData"):
                section = "" if tag[1] else name
            elif name == "DataArray" and not tag[1] and section in _SECTIONS and self.pieces:
                end = re.compile(b"<").search(data, tag.end())
                text = data[tag.end() : end.start() if end else len(data)]
                key = "points" if section == "Points" else attributes.get("Name", "")
                self.pieces[-1].arrays[section, key] = attributes, text
        kind = self._head.get("type")
        if kind is None:
            raise ValueError("damaged, or another kind of file")
        if kind not in ("PolyData", "UnstructuredGrid"):
            raise MeshError(other_kind(kind))
        if not bytes(data[-1000:]).rstrip(b" \t\r\n\0").endswith((b"</VTKFile>", b"/>")):
            raise ValueError("it is cut short")
        self._order = ">" if self._head.get("byte_order") == "BigEndian" else "<"
        self._number = np.dtype(self._order + ("u8" if self._head.get("header_type") == "UInt64" else "u4"))

    def cells(self, piece: _Piece, limits: Limits) -> tuple[FloatArray, list[VtkCells]]:
        """Return the points (n, 3) of a piece, and its cells."""
        limits.check(piece.counts["Points"], piece.counts["Polys"])
        points = self._array(piece, "Points", "points", 3 * piece.counts["Points"])
        cells: list[VtkCells] = []
        for section in ("Polys", "Strips", "Cells"):
            if not (count := piece.counts[section]):
                continue
            ends = self._array(piece, section, "offsets", count).astype(np.int64)
            size = int(ends[-1])
            if size < 0 or (np.diff(ends) < 0).any():
                raise ValueError(ENDS_EARLY)
            # A triangle has three corners, and larger polygons have fewer for each triangle.
            limits.check(0, {"Polys": size // 3, "Strips": size - 2 * count}.get(section, 0))
            corners = self._array(piece, section, "connectivity", size).astype(np.int64)
            found = VtkCells(np.append(0, ends), corners, strips=section == "Strips")
            types = self._array(piece, section, "types", count) if section == "Cells" else None
            cells += [found] if types is None else found.of_grid(types.astype(np.int64))
        return points.astype(np.float64).reshape(-1, 3), cells

    def _array(self, piece: _Piece, section: str, name: str, count: int) -> NDArray:
        """Return ``count`` numbers of an array; raises ValueError if it has fewer."""
        if not count:
            return np.zeros(0)
        if (section, name) not in piece.arrays:
            raise ValueError(f"its {section} have no {name}")
        attributes, text = piece.arrays[section, name]
        kind, format = _TYPES.get(attributes.get("type", "")), attributes.get("format", "ascii")
        if kind is None or (section == "Points" and attributes.get("NumberOfComponents", "3") != "3"):
            raise ValueError(f"its {name} have an unknown type")
        dtype = np.dtype(self._order + kind)
        if format == "ascii":
            return numbers(text, count, dtype, ascii=True)
        if format == "appended":
            if self._appended is None:
                raise ValueError(DAMAGED)
            source, raw = self._appended[int(attributes["offset"]) :], self._raw
        else:
            source, raw = memoryview(bytes(text).translate(None, b" \t\r\n")), False
        unpacked = self._unpacked(source, count * dtype.itemsize, raw=raw)
        return np.frombuffer(unpacked, dtype, count)

    def _unpacked(self, source: memoryview, size: int, *, raw: bool) -> bytes | memoryview:
        """Return the first ``size`` bytes of an array."""
        width, compressor = self._number.itemsize, self._head.get("compressor")
        (first,) = np.frombuffer(_decoded(source, width, raw=raw), self._number, 1).tolist()
        if not compressor:
            if first < size:
                raise ValueError(DAMAGED)
            return _decoded(source, width + size, raw=raw)[width:]
        head = width * (3 + first)
        _, block, last, *packed = np.frombuffer(_decoded(source, head, raw=raw), self._number, 3 + first).tolist()
        begin = head if raw else -(-head // 3) * 4
        content, place, out = _decoded(source[begin:], sum(packed), raw=raw), 0, bytearray()
        for k, length in enumerate(packed):
            whole = last if last and k == len(packed) - 1 else block
            # No more is unpacked than is needed.
            if len(out) + whole > size:
                raise ValueError(DAMAGED)
            out += _decompressed(memoryview(content)[place : place + length], whole, compressor)
            place += length
        if len(out) != size:
            raise ValueError(DAMAGED)
        return bytes(out)


def _attributes(text: bytes) -> dict[str, str]:
    return {found[1].decode(): (found[2] or found[3] or b"").decode("latin-1") for found in _ATTRIBUTE.finditer(text)}


def _decoded(source: memoryview, count: int, *, raw: bool) -> memoryview:
    """Return the first ``count`` bytes of data, which are base64 if not ``raw``."""
    found = source[:count] if raw else memoryview(binascii.a2b_base64(source[: -(-count // 3) * 4]))[:count]
    if len(found) < count:
        raise ValueError(DAMAGED)
    return found


def _decompressed(data: memoryview, size: int, compressor: str) -> bytes | bytearray:
    """Return a block of ``size`` bytes; raises ValueError if it has another size."""
    out: bytes | bytearray
    if compressor == "vtkZLibDataCompressor":
        out = zlib.decompressobj().decompress(data, size + 1)
    elif compressor == "vtkLZMADataCompressor":
        out = lzma.LZMADecompressor(memlimit=_LZMA_MEMORY).decompress(data, size + 1)
    elif compressor == "vtkLZ4DataCompressor":
        out = _lz4(data, size)
    else:
        raise MeshError("its data are compressed in an unknown way: save it as text, or compressed by zlib")
    if len(out) != size:
        raise ValueError(DAMAGED)
    return out


def _lz4(data: memoryview, size: int) -> bytearray:
    """Return the at most ``size`` bytes that a block of LZ4 packed."""
    out, place = bytearray(), 0
    while place < len(data):
        literals, copied = data[place] >> 4, data[place] & 15
        literals, place = _lz4_length(data, place + 1, literals)
        out += data[place : place + literals]
        place += literals
        if place < len(data):  # the last sequence has only literals
            offset = data[place] | data[place + 1] << 8
            copied, place = _lz4_length(data, place + 2, copied)
            if len(out) + copied + 4 > size or not offset:
                raise ValueError(DAMAGED)
            repeat(out, len(out) - offset, copied + 4)
    return out


def _lz4_length(data: memoryview, place: int, start: int) -> tuple[int, int]:
    """Return a length, which goes on in further bytes if it starts with 15, and the place behind it."""
    if start == 15:
        while data[place] == 255:
            start += 255
            place += 1
        return start + data[place], place + 1
    return start, place
