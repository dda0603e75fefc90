"""Reading OBJ, OFF, PLY, STL and NPZ: known answers, files of other programs, limits and refusals."""

import io
import struct
import zipfile
from typing import Any

import numpy as np
import pytest
import trimesh

from shapespace.files.formats import MESH_FORMATS
from shapespace.files.limits import Limits
from shapespace.files.npz import read_mesh_npz
from shapespace.files.reading import read_arrays
from shapespace.mesh.triangle_mesh import MeshError
from tests.hostile import INDICES, XYZ, archive, npy, ply_head

BALL = trimesh.creation.icosphere(2)
BALL.vertices += 0.1 * np.random.default_rng(0).normal(size=BALL.vertices.shape)
#: Corners of a pyramid, whose faces are a square and four triangles.
CORNERS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]]
SIDES = [[0, 3, 2, 1], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
TRIANGLES = [[0, 3, 2], [0, 2, 1], *SIDES[1:]]
POINT_LINES = "".join(f"{x} {y} {z}\n" for x, y, z in CORNERS)
SIDE_LINES = "".join(" ".join(map(str, [len(side), *side])) + "\n" for side in SIDES)


def of_binary_ply(order: str, kinds: str, count: str, index: str) -> bytes:
    """The pyramid with colours before coordinates, faces of two sizes, and a list that is not read."""
    types = {"f": "float", "d": "double", "B": "uchar", "H": "ushort", "i": "int", "I": "uint", "b": "char"}
    head = ply_head(
        {"<": "binary_little_endian", ">": "binary_big_endian"}[order],
        "comment made by hand",
        "element material 2", "property uchar red", "property int number",
        "element vertex 5", "property uchar red",
        *(f"property {types[k]} {axis}" for k, axis in zip(kinds, "xyz", strict=True)),
        "element face 5", "property list uchar float texcoord",
        f"property list {types[count]} {types[index]} vertex_index", "property uchar flag",
        "element edge 1000", "property list uchar int whatever",
    )  # fmt: skip
    rows = [struct.pack(f"{order}B{kinds}", 255, *corner) for corner in CORNERS]
    for k, side in enumerate(SIDES):
        texture = struct.pack(f"{order}B{k}f", k, *[0.5] * k)
        rows.append(texture + struct.pack(f"{order}{count}{len(side)}{index}B", len(side), *side, 7))
    return head + bytes(2 * 5) + b"".join(rows)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("kinds", "count", "index"), [("fff", "B", "i"), ("dfd", "I", "H"), ("fdf", "b", "B")])
def test_binary_ply_of_all_kinds(order: str, kinds: str, count: str, index: str) -> None:
    vertices, faces = read_arrays(of_binary_ply(order, kinds, count, index), "ply")
    np.testing.assert_array_equal(vertices, CORNERS)
    assert faces.tolist() == TRIANGLES


@pytest.mark.parametrize("ends", ["\n", "\r\n"])
def test_polygons_in_text(ends: str) -> None:
    files = {
        "off": f"# remark\nOFF\n# another\n5 5 0\n\n{POINT_LINES}{SIDE_LINES}",
        "ply": ply_head("ascii", "comment", "element vertex 5", *XYZ, "element face 5", INDICES).decode()
        + POINT_LINES
        + SIDE_LINES,
        "obj": "o pyramid\n"
        + "".join(f" \tv  {line}\n" for line in POINT_LINES.splitlines())
        + "vt 0 0\nvn 0 0 1\nusemtl v 1 2 3\n\n  # v 1 2 3\n"
        + "".join("f " + " ".join(f"{c - 5}/1/1" for c in side) + " # a side\n" for side in SIDES),
    }
    for format, text in files.items():
        vertices, faces = read_arrays(text.replace("\n", ends).encode(), format)
        np.testing.assert_array_equal(vertices, CORNERS)
        assert faces.tolist() == TRIANGLES, format


def test_ply_rows_with_more_than_is_needed() -> None:
    head = ply_head(
        "ascii", "element camera 2", "property int id", "element vertex 3", "property uchar red", *XYZ,
        "element face 1", "property uchar flag", "property list uchar float texcoord", INDICES,
    )  # fmt: skip
    vertices, faces = read_arrays(head + b"1\n2\n9 0 0 0\n9 1 0 0\n9 0 1 0\n7 2 0.5 0.5 3 2 1 0\n", "ply")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert faces.tolist() == [[2, 1, 0]]


def test_off_with_colours_and_counts_beside_its_name() -> None:
    text = b"COFF 3 1 0\n0 0 0 255 0 0 255\n1 0 0 255 0 0 255\n0 1 0 255 0 0 255\n3 0 1 2 0.5 0.5 0.5\n"
    vertices, faces = read_arrays(text, "off")
    np.testing.assert_array_equal(vertices, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    assert faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("format", "data"),
    [
        ("ply", BALL.export(file_type="ply")),
        ("ply", BALL.export(file_type="ply", encoding="ascii")),
        ("off", BALL.export(file_type="off").encode()),
        ("obj", BALL.export(file_type="obj").encode()),
    ],
)
def test_what_trimesh_writes(format: str, data: bytes) -> None:
    vertices, faces = read_arrays(data, format)
    np.testing.assert_allclose(vertices, BALL.vertices, atol=1e-6)
    assert np.array_equal(faces, BALL.faces)


@pytest.mark.parametrize("format", ["stl", "stl_ascii"])
def test_stl_binary_and_ascii(format: str) -> None:
    data = BALL.export(file_type=format)
    data = data if isinstance(data, bytes) else data.encode()
    for given in (data, data.replace(b"vertex", b"   VERTEX"), b"solid" + data[5:]):
        vertices, faces = read_arrays(given, "stl")
        np.testing.assert_allclose(vertices[faces], BALL.triangles, rtol=1e-6)
        assert np.array_equal(faces, np.arange(3 * len(BALL.faces)).reshape(-1, 3))


@pytest.mark.parametrize("format", MESH_FORMATS)
def test_a_buffer_may_be_of_any_kind_and_stays_as_it_is(format: str) -> None:
    data = MESH_FORMATS[format].encode(BALL.vertices, BALL.faces)
    expected = read_arrays(data, format)
    for given in (bytearray(data), memoryview(data)):
        for a, b in zip(read_arrays(given, format), expected, strict=True):
            assert np.array_equal(a, b)
        assert given == data


@pytest.mark.parametrize("format", [*MESH_FORMATS, "off"])
def test_limits_end_reading(format: str) -> None:
    data = BALL.export(file_type="off").encode() if format == "off" else ""
    data = data or MESH_FORMATS[format].encode(BALL.vertices, BALL.faces)
    count = 3 * len(BALL.faces) if format == "stl" else len(BALL.vertices)
    assert len(read_arrays(data, format, Limits(count, len(BALL.faces)))[0]) == count
    with pytest.raises(MeshError, match=f"more than {count - 1} vertices"):
        read_arrays(data, format, Limits(count - 1, len(BALL.faces)))
    with pytest.raises(MeshError, match=f"more than {len(BALL.faces) - 1} faces"):
        read_arrays(data, format, Limits(count, len(BALL.faces) - 1))


def test_only_the_arrays_that_are_asked_for_are_unpacked() -> None:
    columns = io.BytesIO()
    np.savez_compressed(
        columns, vertices=np.asfortranarray(BALL.vertices), faces=BALL.faces.astype(">u2"), names=np.array(["a", "b"])
    )
    data = memoryview(columns.getvalue())
    assert read_mesh_npz(data).keys() == {"vertices", "faces"}
    arrays = read_mesh_npz(data, ("vertices", "names"))
    assert np.array_equal(arrays["vertices"], BALL.vertices)
    assert arrays["names"].tolist() == ["a", "b"]
    assert np.array_equal(read_mesh_npz(data)["faces"], BALL.faces)


POINT = npy("(1, 3)", bytes(24))


def npz(vertices: bytes = POINT, method: int = zipfile.ZIP_STORED, **more: Any) -> bytes:
    return archive({"vertices.npy": vertices, "faces.npy": npy("(0, 3)")}, method, **more)


LINE = b"v 0 0 0\n"
REFUSED: dict[str, tuple[str, bytes, str]] = {
    "OBJ: no number": ("obj", LINE + b"\nv 1 x 2\n", "line 3 can't be read: a vertex is v x y z"),
    "OBJ: two numbers": ("obj", LINE + b"v 1 2\n", "line 2 can't be read: a vertex"),
    "OBJ: a number of a million digits": ("obj", LINE + b"f 1 1 " + b"9" * 10**6, "line 2 can't be read: a face"),
    "OFF: of four dimensions": ("off", b"4OFF\n1 0 0\n0 0 0 0\n", "line 1 can't be read: the keyword OFF"),
    "OFF: rows are missing": ("off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n", "it ends before"),
    "OFF: corners are missing": ("off", b"OFF\n1 1 0\n0 0 0\n3 0 0\n", "it ends before the data that it announces"),
    "OFF: less than none": ("off", b"OFF\n-1 -1 0\n", "not a readable off file"),
    "STL: without an end": ("stl", b"solid a\nvertex 0 0 0\nvertex 0 0 0\nvertex 0 0 0\n", "damaged"),
    "PLY: rows are missing": ("ply", ply_head("ascii", "element vertex 2", *XYZ) + b"0 0 0\n", "it ends before"),
    "PLY: bytes are missing": (
        "ply",
        ply_head("binary_little_endian", "element vertex 2", *XYZ) + bytes(23),
        "says 2 rows of vertex",
    ),
    "PLY: no z": ("ply", ply_head("ascii", "element vertex 1", *XYZ[:2]) + b"0 0\n", "lack x, y and z"),
    "PLY: a type nobody knows": (
        "ply",
        ply_head("ascii", "element vertex 1", "property real x"),
        "not a readable ply file",
    ),
    "PLY: no corner": (
        "ply",
        ply_head("ascii", "element face 1", INDICES) + b"0\n",
        "line 6 can't be read: a row of face has the values of vertex_indices",
    ),
    "PLY: a list as long as it says": (
        "ply",
        ply_head("binary_little_endian", "element face 1", "property list uint int vertex_indices") + b"\xff" * 20,
        "says 1 rows of face",
    ),
    "PLY: a face too many": (
        "ply",
        ply_head("binary_big_endian", "element face 2", INDICES) + b"\3" + bytes(12) + b"\4" + bytes(12),
        "says 2 rows of face",
    ),
    "PLY: no end": ("ply", b"ply\nformat ascii 1.0\n" + b"comment\n" * 10**5, "damaged"),
    "NPZ: a checksum": ("npz", npz().replace(bytes(24), bytes(23) + b"\1", 1), "damaged"),
    "NPZ: cut short": ("npz", npz(npy("(9, 3)", bytes(24))), "damaged"),
    "NPZ: version 3": ("npz", npz(b"\x93NUMPY\3\0" + POINT[8:]), "damaged"),
    "NPZ: text": ("npz", npz(npy("(1, 3)", bytes(1200), "<U100")), "an array of numbers, not <U100"),
    "NPZ: encrypted": ("npz", npz(patch=(8, 1, "<H")), "damaged"),
    "NPZ: LZMA": ("npz", npz(method=zipfile.ZIP_LZMA), "damaged"),
    "unknown": ("fbx", b"", "not a readable fbx file"),
}  # fmt: skip


@pytest.mark.parametrize("fault", REFUSED)
def test_what_is_refused_and_why(fault: str) -> None:
    format, data, says = REFUSED[fault]
    with pytest.raises(MeshError) as refusal:
        read_arrays(data, format)
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 300


def test_points_come_without_faces_where_they_will_do() -> None:
    rows = "".join(f"  {x} {y}\t{z} 0 0 1\r\n" for x, y, z in CORNERS)
    files = {
        "xyz": f"# made by hand\n\n{rows}",
        "obj": "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS),
        "off": f"OFF 5 0 0\n{POINT_LINES}",
    }
    buffer = io.BytesIO()
    np.savez(buffer, vertices=np.array(CORNERS))
    contents = {name: text.encode() for name, text in files.items()} | {"npz": buffer.getvalue()}
    for format, content in contents.items():
        points, faces = read_arrays(content, format, points=True)
        np.testing.assert_array_equal(points, CORNERS)
        assert faces.shape == (0, 3)


def test_points_alone_are_no_mesh() -> None:
    buffer = io.BytesIO()
    np.savez(buffer, vertices=np.array(CORNERS))
    for content, format in ((buffer.getvalue(), "npz"), (POINT_LINES.encode(), "xyz")):
        with pytest.raises(MeshError):
            read_arrays(content, format)


def test_a_point_that_is_none_is_named_by_its_line_and_too_many_end_the_reading() -> None:
    with pytest.raises(MeshError, match=r"line 3 does not begin with three numbers"):
        read_arrays(b"0 0 0\n# next\n1 two 3\n", "xyz", points=True)
    with pytest.raises(MeshError, match=r"line 1"):
        read_arrays(b"0 0\n", "xyz", points=True)
    with pytest.raises(MeshError, match="more than 4 vertices"):
        read_arrays(POINT_LINES.encode(), "xyz", Limits(4, 4), points=True)
