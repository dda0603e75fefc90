"""VTK's files of polygons, legacy and XML, beside what VTK itself reads and writes."""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import vtkPolyData, vtkUnstructuredGrid
from vtkmodules.vtkFiltersCore import vtkStripper, vtkTriangleFilter
from vtkmodules.vtkIOLegacy import vtkPolyDataReader, vtkPolyDataWriter, vtkUnstructuredGridWriter
from vtkmodules.vtkIOXML import vtkXMLPolyDataReader, vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

from shapespace.files.colouring import Colouring, Quantity
from shapespace.files.formats import VTK_FORMATS
from shapespace.files.limits import Limits
from shapespace.files.reading import read_arrays
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.training.collection.generators import freaky_torus

TORUS = freaky_torus.reference()
POINTS = "POINTS 5 float\n0 0 0 1 0 0 1 1 0 0 1 0\n0.5 0.5 1.25\n"
POLYGONS = "POLYGONS 5 21\n4 3 2 1 0\n3 0 1 4 3 1 2 4\n3 2 3 4\n3 3 0 4\n"
HEAD = "# vtk DataFile Version 3.0\na pyramid\nASCII\nDATASET POLYDATA\n"
PYRAMID = HEAD + POINTS + POLYGONS
FACES = [[3, 2, 1], [3, 1, 0], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
CELLS_51 = (
    "POLYGONS 6 16\nOFFSETS vtktypeint64\n0 4 7 10 13 16\nCONNECTIVITY vtktypeint64\n3 2 1 0 0 1 4 1 2 4\n2 3 4 3 0 4\n"
)
ATTRIBUTES = (
    "POINT_DATA 5\nSCALARS thickness double 1\nLOOKUP_TABLE default\n1 2 3 4 5\n"
    "CELL_DATA 5\nFIELD f 1\nlabel 1 5 int\n0 0 0 0 0\n"
)


def binary(version: str, cells: bytes) -> bytes:
    points = np.array([0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0, 0.5, 0.5, 1.25], ">f8").tobytes()
    head = f"# vtk DataFile Version {version}\na pyramid\nBINARY\nDATASET POLYDATA\nPOINTS 5 double\n"
    return head.encode() + points + b"\n" + cells + b"\n"


BINARY_CELLS = b"POLYGONS 5 21\n" + struct.pack(">21i", 4, 3, 2, 1, 0, 3, 0, 1, 4, 3, 1, 2, 4, 3, 2, 3, 4, 3, 3, 0, 4)
BINARY_CELLS_51 = (
    b"POLYGONS 6 16\nOFFSETS vtktypeint64\n" + struct.pack(">6q", 0, 4, 7, 10, 13, 16)
    + b"\nCONNECTIVITY vtktypeint64\n" + struct.pack(">16q", 3, 2, 1, 0, 0, 1, 4, 1, 2, 4, 2, 3, 4, 3, 0, 4)
)  # fmt: skip

FILES: dict[str, bytes] = {
    "ASCII, version 3": PYRAMID.encode(),
    "ASCII, version 1": PYRAMID.replace("3.0", "1.0").encode(),
    "ASCII, version 5": (HEAD.replace("3.0", "5.1") + POINTS + CELLS_51).encode(),
    "lines that end as in Windows": PYRAMID.replace("\n", "\r\n").encode(),
    "attributes": (PYRAMID + ATTRIBUTES).encode(),
    "a time in front": (HEAD + "FIELD FieldData 1\nTimeValue 1 1 double\n0.5\n" + POINTS + POLYGONS).encode(),
    "vertices and lines between": (
        HEAD + POINTS + "VERTICES 1 2\n1 0\nLINES 2 7\n2 0 1\n3 1 2 3\n" + POLYGONS
    ).encode(),
    "a name of an array": (HEAD.replace("3.0", "4.2") + POINTS + "METADATA\nINFORMATION 0\n\n" + POLYGONS).encode(),
    "binary, version 4.2": binary("4.2", BINARY_CELLS),
    "binary, version 5.1": binary("5.1", BINARY_CELLS_51),
}


def own(data: bytes) -> vtkPolyData:
    """What VTK reads."""
    if data.startswith(b"<"):
        reader = vtkXMLPolyDataReader()
        reader.SetInputString(data)
    else:
        reader = vtkPolyDataReader()
        reader.SetBinaryInputString(data, len(data))
    reader.ReadFromInputStringOn()
    reader.Update()
    return reader.GetOutput()


def arrays(found: vtkPolyData) -> tuple[np.ndarray, list[list[int]]]:
    polygons = found.GetPolys()
    starts, corners = vtk_to_numpy(polygons.GetOffsetsArray()), vtk_to_numpy(polygons.GetConnectivityArray())
    return vtk_to_numpy(found.GetPoints().GetData()), [part.tolist() for part in np.split(corners, starts[1:-1])]


@pytest.mark.parametrize("name", FILES)
def test_legacy_files_are_read_as_vtk_reads_them(name: str) -> None:
    vertices, faces = read_arrays(FILES[name], "vtk")
    assert faces.tolist() == FACES
    points, polygons = arrays(own(FILES[name]))
    np.testing.assert_array_equal(vertices, points)
    assert polygons == [[3, 2, 1, 0], *FACES[2:]]


def xml(found: vtkPolyData, mode: int, *, compressor: str = "zlib", encoded: bool = True) -> bytes:
    writer = vtkXMLPolyDataWriter()
    writer.SetInputData(found)
    writer.SetDataMode(mode)
    choices = {"zlib": writer.SetCompressorTypeToZLib, "lz4": writer.SetCompressorTypeToLZ4}
    choices |= {"lzma": writer.SetCompressorTypeToLZMA, "none": writer.SetCompressorTypeToNone}
    choices[compressor]()
    writer.SetEncodeAppendedData(encoded)
    writer.WriteToOutputStringOn()
    writer.Write()
    text = writer.GetOutputString()
    return text if isinstance(text, bytes) else text.encode()


ASCII, BINARY, APPENDED = 0, 1, 2


@pytest.mark.parametrize("mode", [ASCII, BINARY, APPENDED])
@pytest.mark.parametrize("compressor", ["none", "zlib", "lz4", "lzma"])
def test_xml_files_of_every_encoding_are_read(mode: int, compressor: str, tmp_path: Path) -> None:
    path = tmp_path / "pyramid.VTP"
    path.write_bytes(xml(own((PYRAMID + ATTRIBUTES).encode()), mode, compressor=compressor))
    vertices, faces = read_arrays(path)
    assert faces.tolist() == FACES
    assert vertices.tolist()[4] == [0.5, 0.5, 1.25]


def test_appended_data_may_be_raw() -> None:
    data = xml(own(VTK_FORMATS["vtk"].encode(TORUS.vertices, TORUS.faces)), APPENDED, encoded=False)
    assert np.array_equal(read_arrays(data, "vtp")[1], TORUS.faces)


@pytest.mark.parametrize("format", ["vtk", "vtp"])
@pytest.mark.parametrize("version", [42, 51])
def test_triangle_strips_are_turned_into_triangles(format: str, version: int) -> None:
    stripper = vtkStripper()
    stripper.SetInputData(own(VTK_FORMATS["vtk"].encode(TORUS.vertices, TORUS.faces)))
    stripper.Update()
    strips = stripper.GetOutput()
    assert strips.GetNumberOfStrips() > 0
    if format == "vtp":
        data = xml(strips, APPENDED)
    else:
        writer = vtkPolyDataWriter()
        writer.SetInputData(strips)
        writer.SetFileVersion(version)
        writer.SetFileTypeToBinary()
        writer.WriteToOutputStringOn()
        writer.Write()
        data = writer.GetOutputStdString()
    triangles = vtkTriangleFilter()
    triangles.SetInputData(strips)
    triangles.Update()

    def turned(faces: np.ndarray) -> set[tuple[int, ...]]:
        """Each face from its smallest vertex, without losing its winding."""
        return {tuple(np.roll(face, -int(face.argmin())).tolist()) for face in faces}

    faces = read_arrays(data, format)[1]
    assert len(faces) == len(TORUS.faces)
    assert turned(faces) == turned(TORUS.faces)
    assert turned(faces) == turned(np.array(arrays(triangles.GetOutput())[1]))


@pytest.mark.parametrize("format", VTK_FORMATS)
def test_others_read_what_we_write(format: str) -> None:
    data = VTK_FORMATS[format].encode(TORUS.vertices, TORUS.faces)
    points, polygons = arrays(own(data))
    assert np.array_equal(points, TORUS.vertices.astype(np.float32))
    assert polygons == TORUS.faces.tolist()
    vertices, faces = read_arrays(data, format)
    assert np.array_equal(vertices, TORUS.vertices.astype(np.float32))
    assert np.array_equal(faces, TORUS.faces)
    assert data == VTK_FORMATS[format].encode(TORUS.vertices, TORUS.faces), "equal bytes for equal shapes"


@pytest.mark.parametrize("format", VTK_FORMATS)
def test_polygons_and_colours_are_written(format: str) -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.25]])
    surface = MeshAttributes(starts=np.array([0, 4, 7]), corners=np.array([3, 2, 1, 0, 0, 1, 4]))
    colouring = Colouring(Quantity.STRETCH, np.array([-1, -0.5, 0, 0.5, 1.0]), 1.0)
    found = own(VTK_FORMATS[format].encode(vertices, surface.triangles, colouring, surface))
    assert arrays(found)[1] == [[3, 2, 1, 0], [0, 1, 4]]
    assert vtk_to_numpy(found.GetPointData().GetScalars()).tolist() == [-1, -0.5, 0, 0.5, 1.0]
    assert found.GetPointData().GetScalars().GetName() == "stretch"
    rgb = vtk_to_numpy(found.GetPointData().GetArray("RGB"))
    assert np.array_equal(rgb, np.rint(255 * colouring.srgb))


def test_points_without_faces_are_a_scan() -> None:
    points, faces = read_arrays((HEAD + POINTS).encode(), "vtk", points=True)
    assert (len(points), len(faces)) == (5, 0)


BAD: dict[str, tuple[str, str | bytes, str]] = {
    "nothing": ("vtk", "", "damaged, or another kind of file"),
    "another kind of file": ("vtp", PYRAMID, "damaged, or another kind of file"),
    "a volume": ("vtk", HEAD.replace("POLYDATA", "STRUCTURED_POINTS"), "it holds STRUCTURED_POINTS, and only"),
    "a grid": ("vtp", '<VTKFile type="ImageData" version="1.0"></VTKFile>', "it holds ImageData, and only polygons"),
    "an unknown version": ("vtk", "# vtk DataFile Version 9.9" + PYRAMID[PYRAMID.index("\n"):], "version 9 of VTK"),
    "an unknown section": ("vtk", PYRAMID.replace("POLYGONS", "POLYGONZ"), "section POLYGONZ is not read"),
    "XML of nothing": ("vtp", '<VTKFile type="PolyData"/>', "it has no points|cut short"),
    "half of XML": ("vtp", xml(own(PYRAMID.encode()), APPENDED)[:400], "cut short"),
    "pieces in other files": ("vtp", '<?xml version="1.0"?><VTKFile type="PPolyData"/>', "it holds PPolyData, and"),
    "points cut short": ("vtk", PYRAMID[: PYRAMID.index("0.5 1.25")], "cut short"),
    "points cut in a number": ("vtk", PYRAMID[: PYRAMID.index(" 0 1 0")], "cut short"),
    "faces cut short": ("vtk", PYRAMID[:-8], "cut short"),
    "binary points cut short": ("vtk", FILES["binary, version 4.2"][:180], "cut short"),
    "binary faces cut short": ("vtk", FILES["binary, version 4.2"][:-8], "cut short"),
    "binary faces of version 5 cut short": ("vtk", FILES["binary, version 5.1"][:-8], "cut short"),
    "XML cut short": ("vtp", xml(own(PYRAMID.encode()), APPENDED)[:-200], "cut short"),
    "more points than there are": ("vtk", PYRAMID.replace("POINTS 5", "POINTS 9999999999999"), "cut short|ends before"),
    "more polygons than there are": ("vtk", PYRAMID.replace("POLYGONS 5", "POLYGONS 6"), "not a readable"),
    "fewer polygons than there are": ("vtk", PYRAMID.replace("POLYGONS 5", "POLYGONS 4"), "ends before"),
    "a polygon larger than the file": ("vtk", PYRAMID.replace("\n4 3", "\n999999999 3"), "not a readable"),
    "a vertex that is missing": ("vtk", PYRAMID.replace("3 2 1 0", "3 2 1 9"), "faces name vertices 0 to 9"),
    "a vertex below zero": ("vtk", PYRAMID.replace("3 2 1 0", "3 2 1 -9"), "faces name vertices -9 to 4"),
    "offsets beyond the end": ("vtk", FILES["ASCII, version 5"].replace(b"13 16", b"13 99"), "ends before"),
    "offsets that go back": ("vtk", FILES["ASCII, version 5"].replace(b"7 10", b"7 4"), "ends before|corners"),
    "decimal commas": ("vtk", PYRAMID.replace("0.5 0.5 1.25", "0,5 0,5 1,25"), "cut short"),
    "XML of more points than there can be": (
        "vtp", xml(own(PYRAMID.encode()), APPENDED).replace(b'Points="5"', b'Points="500000000000"'), "cut short",
    ),
    "XML of more points than there are": (
        "vtp", xml(own(PYRAMID.encode()), BINARY).replace(b'Points="5"', b'Points="6"'), "cut short",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_damaged_files_and_other_data_are_refused(name: str) -> None:
    format, data, says = BAD[name]
    with pytest.raises(MeshError, match=says):
        read_arrays(data.encode() if isinstance(data, str) else data, format)


@pytest.mark.parametrize("format", VTK_FORMATS)
@pytest.mark.parametrize("limits", [Limits(vertices=10), Limits(faces=10)])
def test_large_meshes_are_refused(format: str, limits: Limits) -> None:
    with pytest.raises(MeshError, match="it has more than 10"):
        read_arrays(VTK_FORMATS[format].encode(TORUS.vertices, TORUS.faces), format, limits)


def grid(*cells: tuple[int, list[int]]) -> vtkUnstructuredGrid:
    """An unstructured grid on the points of the torus: the type and the corners of each cell."""
    found, points = vtkUnstructuredGrid(), vtkPoints()
    points.SetData(numpy_to_vtk(TORUS.vertices, deep=True))
    found.SetPoints(points)
    for kind, corners in cells:
        found.InsertNextCell(kind, len(corners), corners)
    return found


CELLS = grid(
    (1, [0]), (9, [0, 1, 2, 3]), (3, [4, 5]), (5, [4, 5, 6]), (7, [7, 8, 9, 10, 11]), (6, [0, 1, 2, 3]),
    (8, [0, 1, 2, 3]),
)  # fmt: skip
CELL_FACES = [
    *([0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9], [7, 9, 10], [7, 10, 11]),
    *([0, 1, 3], [0, 3, 2]),  # the pixel
    *([0, 1, 2], [1, 3, 2]),  # the strip
]


def written(mesh: vtkUnstructuredGrid, kind: str) -> bytes:
    if kind in ("ascii", "binary", "appended"):
        writer = vtkXMLUnstructuredGridWriter()
        writer.SetDataMode({"ascii": ASCII, "binary": BINARY, "appended": APPENDED}[kind])
        writer.SetByteOrderToBigEndian()
        writer.SetHeaderTypeToUInt64()
    else:
        writer = vtkUnstructuredGridWriter()
        writer.SetFileVersion(int(kind))
        writer.SetFileType(1 if kind == "42" else 2)
    writer.SetInputData(mesh)
    writer.WriteToOutputStringOn()
    writer.Write()
    content = writer.GetOutputStdString() if kind.isdecimal() else writer.GetOutputString()
    return content if isinstance(content, bytes) else content.encode()


@pytest.mark.parametrize("kind", ["42", "51", "ascii", "binary", "appended"])
def test_the_polygons_of_a_grid_are_read(kind: str) -> None:
    vertices, faces = read_arrays(written(CELLS, kind), "vtk" if kind.isdecimal() else "vtu")
    np.testing.assert_allclose(vertices, TORUS.vertices, rtol=1e-5)
    assert faces.tolist() == CELL_FACES
    with pytest.raises(MeshError, match="it holds cells that are no polygons"):
        read_arrays(written(grid((5, [0, 1, 2]), (10, [0, 1, 2, 3])), kind))


def test_pieces_follow_one_another() -> None:
    piece = (
        '<Piece NumberOfPoints="3" NumberOfPolys="1"><PointData><DataArray type="Float32" Name="a > b">1</DataArray>'
        '</PointData><Points><DataArray type="Float64" NumberOfComponents="3">0 0 0 1 0 0 0 1 0</DataArray></Points>'
        '<!-- <Polys> --><Polys><DataArray type="Int32" Name="connectivity" format="ascii">0 1 2</DataArray>'
        "<DataArray type='UInt8' Name='offsets' format='ascii'>3</DataArray></Polys></Piece>"
    )
    text = f'<VTKFile type="PolyData"><PolyData>{piece * 2}<Piece NumberOfPoints="0"/></PolyData></VTKFile>'
    vertices, faces = read_arrays(text.encode(), "vtp")
    assert (len(vertices), faces.tolist()) == (6, [[0, 1, 2], [3, 4, 5]])
    with pytest.raises(MeshError, match="faces name vertices 0 to 3, but there are 3"):
        read_arrays(text.replace("0 1 2</D", "0 1 3</D").encode(), "vtp")


def test_cells_with_two_corners_are_left_out() -> None:
    text = PYRAMID.replace("POLYGONS 5 21", "POLYGONS 7 26") + "2 0 1\n1 3\n"
    assert read_arrays(text.encode(), "vtk")[1].tolist() == FACES


@pytest.mark.parametrize("kind", ["vtk 42", "vtk 51", "vtu", "vtp lz4", "vtp zlib", "vtp lzma", "vtp none"])
def test_no_damage_ends_the_process_or_makes_another_mesh(kind: str) -> None:
    """The package vtk ends the process at some of these files."""
    format, _, way = kind.partition(" ")
    content = xml(own(PYRAMID.encode()), APPENDED, compressor=way, encoded=False) if format == "vtp" else b""
    content = content or written(CELLS, way or "binary")
    rng = np.random.default_rng(0)
    for k in range(1, 20):
        with pytest.raises(MeshError):
            read_arrays(content[: len(content) * k // 20].rpartition(b"<")[0], format)
    for place in rng.integers(len(content), size=150).tolist():
        damaged = content[:place] + bytes([content[place] ^ 1 << int(rng.integers(8))]) + content[place + 1 :]
        with suppress(MeshError):
            read_arrays(damaged, format)
