"""Reader of VTK's legacy and XML files of polygons, by the package ``vtk``.

The package trusts the counts in a file: wrong sizes of cells make it read memory that isn't its own. So a legacy file
is cut into its sections, of which the package reads the numbers, and cells are checked here.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, clipped
from shapespace.files.polygon_reading import ENDS_EARLY
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError

if TYPE_CHECKING:
    from vtkmodules.vtkCommonDataModel import vtkPolyData

#: Names of the formats: legacy files and XML files.
VTK_FORMATS = ("vtk", "vtp")
#: The first line of a legacy file, its title, the encoding of its numbers, and the kind of its data.
_HEAD = re.compile(
    rb"# vtk DataFile Version (\d+)\.\d+[^\n]*\n[^\n]*\n\s*(ASCII|BINARY)\s+DATASET\s+(\w+)", re.IGNORECASE
)
#: Keywords that begin a section of a legacy file. Attributes of points and cells come last.
_SECTION = re.compile(
    rb"(?<=[\s])(POINTS|VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|POINT_DATA|CELL_DATA)[ \t]+(\d+)\b", re.IGNORECASE
)
_ANY_SECTION = re.compile(rb"(?<=\n)([A-Za-z_]{4,})[ \t]+\d+(?=[ \t\r\n])")
#: Keywords that may begin a line with a number in a file of polygons.
_KNOWN = ("POINTS", "VERTICES", "LINES", "POLYGONS", "TRIANGLE_STRIPS", "FIELD", "METADATA", "INFORMATION", "DATA")
_LEGACY_CELLS = re.compile(rb"\w+\s+(\d+)\s+(\d+)(?=\s)")
_XML_KIND = re.compile(rb"<VTKFile\b[^>]*?\btype\s*=\s*[\"'](\w+)[\"']")
_XML_COUNT = re.compile(rb"\bNumberOf(Points|Verts|Lines|Strips|Polys)\s*=\s*[\"']\s*(\d+)")
#: Largest ratio of a compressed file's data to the file: the limit of zlib.
_LARGEST_RATIO = 1032


@cache
def vtk_installed() -> bool:
    """Return whether the package ``vtk`` is installed. Looked for once, because a look takes 0.1 ms."""
    return find_spec("vtkmodules") is not None


def vtk_loaded() -> bool:
    """Return whether this process has loaded the package."""
    return "vtkmodules.vtkCommonDataModel" in sys.modules


def read_vtk(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of a legacy file of polygons; vertices and lines are ignored.

    Files of the versions 1 to 5 are read. Polygons become fans of triangles, and come before the triangle strips.
    """
    _require_package()
    head = _HEAD.match(data)
    if not head:
        raise ValueError("damaged, or another kind of file")
    version, encoding, kind = int(head[1]), head[2], head[3].decode()
    if not 1 <= version <= 5:
        raise MeshError(f"it is version {version} of VTK's legacy files, and 1 to 5 are read")
    if kind.upper() != "POLYDATA":
        raise MeshError(_other_kind(kind))
    found = list(_SECTION.finditer(data, head.end()))
    ends = [match.start() for match in found[1:]] + [len(data)]
    vertices = np.zeros((0, 3))
    faces = dict.fromkeys(("POLYGONS", "TRIANGLE_STRIPS"), np.zeros((0, 3), np.int64))
    if not {match[1].decode().upper() for match in found} & faces.keys():
        _require_known_sections(data[head.end() :])
    for match, end in zip(found, ends, strict=True):
        name, count = match[1].decode().upper(), int(match[2])
        section = data[match.start() : end]
        begin = b"# vtk DataFile Version %d.%d\n\n%s\nDATASET POLYDATA\n" % (version, version == 5, encoding)
        # A number that the end of the text cuts short would not be noticed.
        close = b"\n" if encoding.upper() == b"ASCII" else b""
        if name == "POINTS":
            limits.check(count, 0)
            vertices = _vertices(_legacy_output(b"".join([begin, section, close])), count)
        elif name in faces:
            offsets, corners = _legacy_cells(begin, section, close, version)
            faces[name] = _triangles(offsets, corners, limits, strips=name == "TRIANGLE_STRIPS")
        elif name.endswith("_DATA"):
            break
    return vertices, _checked(np.concatenate([*faces.values()]), len(vertices), limits)


def read_vtp(data: memoryview, limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of an XML file of polygons, as `read_vtk` does for legacy files."""
    _require_package()
    start = bytes(data[: 2**16])
    kind = _XML_KIND.search(start)
    if not kind:
        raise ValueError("damaged, or another kind of file")
    if kind[1] != b"PolyData":
        raise MeshError(_other_kind(kind[1].decode()))
    if not bytes(data[-1000:]).rstrip(b" \t\r\n\0").endswith((b"</VTKFile>", b"/>")):
        raise ValueError("it is cut short")
    for match in _XML_COUNT.finditer(data):
        count = int(match[2])
        limits.check(count if match[1] == b"Points" else 0, count if match[1] == b"Polys" else 0)
        if count > _LARGEST_RATIO * len(data):
            raise EOFError(ENDS_EARLY)
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    reader = vtkXMLPolyDataReader()
    reader.ReadFromInputStringOn()
    reader.SetInputString(bytes(data))  # type: ignore[call-overload]
    with _errors():
        reader.UpdateInformation()
        for attributes in (reader.GetPointDataArraySelection(), reader.GetCellDataArraySelection()):
            attributes.DisableAllArrays()
        reader.Update()
    found = reader.GetOutput()
    vertices = _vertices(found, found.GetNumberOfPoints())
    faces = [
        _triangles(_numbers(cells.GetOffsetsArray()), _numbers(cells.GetConnectivityArray()), limits, strips=strips)
        for cells, strips in ((found.GetPolys(), False), (found.GetStrips(), True))
    ]
    return vertices, _checked(np.concatenate(faces), len(vertices), limits)


def _require_known_sections(data: memoryview) -> None:
    """Raise MeshError if there is an unknown section before the attributes; it may have the faces."""
    for match in _ANY_SECTION.finditer(data):
        name = match[1].decode().upper()
        if name.endswith("_DATA"):
            break
        if name not in _KNOWN:
            raise MeshError(f"its section {clipped(name)} is not read: save the faces as POLYGONS")


def _require_package() -> None:
    if not vtk_installed():
        raise MeshError('VTK files are read by the package vtk, which is not installed: pip install "shapespace[vtk]"')


def _other_kind(kind: str) -> str:
    return f"it holds {clipped(kind)}, and only PolyData is read: extract the surface, in ParaView by Extract Surface"


def _legacy_output(content: bytes) -> vtkPolyData:
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader

    reader = vtkPolyDataReader()
    reader.ReadFromInputStringOn()
    reader.SetBinaryInputString(content, len(content))  # type: ignore[arg-type]
    with _errors():
        reader.Update()
    return reader.GetOutput()


def _legacy_cells(begin: bytes, section: memoryview, close: bytes, version: int) -> tuple[IntArray, IntArray]:
    """Return the offsets (n + 1,) of n cells in the list of their corners, and this list."""
    if version >= 5:
        found = _legacy_output(b"".join([begin, section, close]))
        cells = found.GetPolys() if found.GetNumberOfPolys() else found.GetStrips()
        return _numbers(cells.GetOffsetsArray()), _numbers(cells.GetConnectivityArray())
    head = _LEGACY_CELLS.match(section)
    if not head:
        raise ValueError("its cells have no size")
    count, size = int(head[1]), int(head[2])
    # As an array of numbers, so that the package doesn't follow the sizes of the cells.
    field = b"FIELD cells 1\ncells 1 %d int" % size
    array = _legacy_output(b"".join([begin, field, section[head.end() :], close])).GetFieldData().GetArray("cells")
    values = _numbers(array)
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
    return np.append(0, np.cumsum(values[starts])), values[is_corner]


def _numbers(array: object) -> IntArray:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    numbers: IntArray = vtk_to_numpy(array).astype(np.int64).ravel()  # type: ignore[no-untyped-call]
    return numbers


def _vertices(found: vtkPolyData, count: int) -> FloatArray:
    from vtkmodules.util.numpy_support import vtk_to_numpy

    points = found.GetPoints()
    if points is None:
        raise ValueError("it has no points")
    found_points = vtk_to_numpy(points.GetData())  # type: ignore[no-untyped-call]
    vertices: FloatArray = found_points.astype(np.float64)
    if vertices.shape != (count, 3):
        raise EOFError(ENDS_EARLY)
    return vertices


def _triangles(offsets: IntArray, corners: IntArray, limits: Limits, *, strips: bool) -> IntArray:
    """Return the triangles (F, 3) of polygons or triangle strips that begin at ``offsets`` in the list of corners."""
    cells = MeshAttributes(starts=offsets, corners=corners)
    if len(cells.sizes) == 0:
        return np.zeros((0, 3), np.int64)
    if offsets[0] != 0 or cells.sizes.min() < 0 or offsets[-1] > len(corners):
        raise ValueError(ENDS_EARLY)
    if cells.sizes.min() < 3:
        raise ValueError(f"a face has {cells.sizes.min()} corners")
    limits.check(0, int((cells.sizes - 2).sum()))
    if not strips:
        return cells.triangles
    first, second, third = cells.triangle_corners.T
    odd = (second - first) % 2 == 0
    faces: IntArray = corners[
        np.stack([second - 1, np.where(odd, third, second), np.where(odd, second, third)], axis=1)
    ]
    # Triangles without area join strips.
    return faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def _checked(faces: IntArray, vertex_count: int, limits: Limits) -> IntArray:
    limits.check(vertex_count, len(faces))
    if faces.size and not 0 <= faces.min() <= faces.max() < vertex_count:
        raise MeshError(f"faces name vertices {faces.min()} to {faces.max()}, but there are {vertex_count} vertices")
    return faces


@contextmanager
def _errors() -> Iterator[None]:
    """Raise ValueError where the package reports an error, which it would print otherwise."""
    from vtkmodules.vtkCommonCore import vtkLogger, vtkOutputWindow, vtkStringOutputWindow

    window, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    verbosity = vtkLogger.GetCurrentVerbosityCutoff()
    vtkOutputWindow.SetInstance(window)
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        yield
    finally:
        vtkOutputWindow.SetInstance(before)
        vtkLogger.SetStderrVerbosity(verbosity)
    if re.search("error", window.GetOutput(), re.IGNORECASE):
        raise ValueError("damaged, or cut short")
