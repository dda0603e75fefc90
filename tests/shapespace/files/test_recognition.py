"""Which format a file has: its content says it first, then its name, then its media type."""

from __future__ import annotations

import bz2
import gzip
import io
import lzma
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.files.formats import MESH_FORMATS, USD_FORMATS
from shapespace.files.reading import READ_FORMATS, SCAN_FORMATS, read_arrays
from shapespace.files.recognition import FormatError, decide
from shapespace.mesh.triangle_mesh import MeshError

MESH = trimesh.creation.icosphere(1)
OFF = f"OFF {len(MESH.vertices)} {len(MESH.faces)} 0\n".encode() + b"\n".join(
    [
        *(b"%r %r %r" % tuple(row) for row in MESH.vertices.tolist()),
        *(b"3 %d %d %d" % tuple(row) for row in MESH.faces.tolist()),
    ]
)
FILES = {name: format.encode(MESH.vertices, MESH.faces) for name, format in MESH_FORMATS.items()} | {"off": OFF}
FILES["ascii.stl"] = b"solid mesh\n  facet normal 0 0 1\n  outer loop\n"
FILES["a.pcd"] = b"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n"


def archive(*names: str) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as file:
        for name in names:
            file.writestr(name, b"v 0 0 0\n")
    return content.getvalue()


@pytest.mark.parametrize("file", FILES)
def test_the_content_decides_before_name_and_media_type(file: str) -> None:
    format = file.rpartition(".")[2]
    found = decide(
        memoryview(FILES[file]),
        SCAN_FORMATS,
        "shape.xyz" if format != "obj" else "",
        "model/stl" if format != "obj" else "",
    )
    assert found.name == format


TEXT = b"1 2 3\n4 5 6\n"
DECIDED = {
    "its name before its media type": (TEXT, "a.b.CSV", "model/obj", "csv", "its name"),
    "a specific media type": (TEXT, "", "model/OBJ", "obj", "its media type"),
    "points with another extension": (TEXT, "cloud.asc", "application/pgp-keys", "xyz", "its content"),
    "a mesh with another extension": (b"v 1 2 3\n", "p.dat", "application/octet-stream", "obj", "its content"),
    "a media type and another extension": (b"?", "p.bin", "model/obj", "obj", "its media type"),
    "points as text/plain": (TEXT, "", "text/plain", "xyz", "its content"),
    "a mesh as text/plain": (b"# made by hand\no head\n v 1 2 3\n", "", "text/plain", "obj", "its content"),
    "JSON as any data": (b' {"vertices": []}', "", "application/octet-stream", "json", "its content"),
    "glTF whose asset comes late": (b'{"a": "' + b"x" * 2**17 + b'", "asset": {}}', "", "", "gltf", "its content"),
    "an archive named NPZ": (archive("a.txt", "b.npy"), "shape.npz", "", "npz", "its content"),
    "UTF-16": ("v 1 2 3\n".encode("utf-16"), "", "text/plain", "obj", "its content"),
}


@pytest.mark.parametrize("case", DECIDED)
def test_what_a_file_is_by(case: str) -> None:
    data, name, media_type, format, because = DECIDED[case]
    types = {media_type: name for name, media_type in READ_FORMATS.items()}
    found = decide(memoryview(data), (*SCAN_FORMATS, "json"), name, media_type, types)
    assert (found.name, found.because) == (format, because)


PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\1\0"
FOREIGN = {
    "a PNG picture": PNG,
    "a JPEG picture": b"\xff\xd8\xff\xe0\0\x10JFIF",
    "packed by gzip: unpack it first": gzip.compress(b"v 1 2 3\n", mtime=0),
    "a web page": b"\n<!DOCTYPE html><html>",
    "a USDZ file": archive("shape.usdc"),
    "a 3MF": archive("[Content_Types].xml", "3D/3dmodel.model"),
    "a 3MF or an office": archive("3D/3dmodel.model", "[Content_Types].xml"),
    "packed by bzip2": bz2.compress(b"v 1 2 3\n"),
    "packed by xz": lzma.compress(b"v 1 2 3\n"),
    "packed by Zstandard": b"\x28\xb5\x2f\xfd\x24\x08",
    "a RAR archive": b"Rar!\x1a\7\0",
    "one NumPy array": b"\x93NUMPY\1\0",
    "a FreeSurfer surface: save": b"#!ascii version of lh.white\n3 1\n0 0 0 0\n1 0 0 0\n0 1 0 0\n0 1 2 0\n",
    "a VRML file": b"#VRML V2.0 utf8\nShape {\n1 2 3,\n",
    "an X3D file": b'<?xml version="1.0"?>\n<X3D profile="Interchange">',
    "a Gmsh mesh": b"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n",
    "a Medit mesh": b"MeshVersionFormatted 2\nDimension 3\nVertices\n1\n0 0 0 1\n",
    "a DXF drawing": b"999\nmade by hand\n  0\r\nSECTION\r\n",
    "a STEP file": b"ISO-10303-21;\nHEADER;\n",
    "a BVH motion": b"HIERARCHY\nROOT Hips\nMOTION\n0 0 0 1 2 3\n",
    "a ZIP archive: unpack it first": archive("shape.obj"),
    "a FreeSurfer surface": b"\xff\xff\xfecreated by me",
    "a GIFTI surface": b'<?xml version="1.0"?>\n<!DOCTYPE GIFTI SYSTEM "gifti.dtd">\n<GIFTI Version="1.0">',
    "an FBX file": b"Kaydara FBX Binary  \0",
    "has points and no faces": b"",
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_files_that_are_no_meshes_are_named_and_never_repeated(kind: str, tmp_path: Path) -> None:
    path = tmp_path / ("shape.obj" if FOREIGN[kind] else "shape")
    path.write_bytes(FOREIGN[kind] or TEXT)
    with pytest.raises(FormatError) as refusal:
        read_arrays(path)
    assert kind in str(refusal.value)
    assert str(refusal.value).endswith(f"these can be read: {', '.join(READ_FORMATS)}")
    assert str(refusal.value).isprintable()


def test_usd_that_is_written_here_is_named(tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    for name, format in USD_FORMATS.items():
        with pytest.raises(FormatError, match=r"a USDZ? file, which can be written but not read"):
            decide(memoryview(format.encode(MESH.vertices, MESH.faces)), READ_FORMATS, f"shape.{name}")


@pytest.mark.parametrize("format", SCAN_FORMATS)
@pytest.mark.parametrize(
    "data", [PNG, gzip.compress(b"v 1 2 3\n", mtime=0), bytes(range(256)) * 8, b"\xff\xfe" + PNG[1:]]
)
def test_no_reader_repeats_bytes_of_a_file(format: str, data: bytes) -> None:
    with pytest.raises(MeshError) as refusal:
        read_arrays(data, format.upper(), points=True)
    said = str(refusal.value)
    assert said.isprintable()
    assert not any(trace in said for trace in ("PNG", "\\x", "\ufffd", "IHDR"))


#: A number that no message may repeat.
N = "4711.0815"
PLY = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
LINES = [
    ("obj", f"v 1 2 {N}x\n"), ("off", f"OFF\n1 0 0\n{N} x 0\n"), ("off", f"{N}\n"), ("stl", f"vertex {N}x 2 3\n"),
    ("ply", f"{PLY}{N} 2\n"), ("ply", PLY.replace("float z", f"{N} z")), ("ply", PLY.replace("ascii", N)),
    ("csv", f'"{N}","8,811","5,808"\n'), ("csv", f"1,2,{N[:4]},4,5,6\n"), ("csv", f"{N},a\n"),
    ("xyz", f"1 2 3\n{N} two 3\n"), ("xyz", f"7 {N} 2.5 3.5\n7 1.5 2.5 3.5\n"), ("txt", f"a{N} b c d\n1.5 2 3 4\n"),
    ("txt", f"{N}\n"), ("pts", f"1.5 2 3\n{N},5 1,5 2,5\n"), ("pts", f"v {N} 2 3\nvn {N} 0 1\n"),
    ("gltf", f'{{"asset": {{"version": "2.0"}}, "scene": "{N}", "scenes": [{{}}]}}'), ("gltf", f'{{"asset": {N}x}}'),
    ("gltf", f'{{"asset": {{"version": "{N}"}}}}'), ("vtk", f"# vtk DataFile Version 3.0\n{N}\n"),
    ("pcd", f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nDATA ascii\n1 2 {N}x\n"),
]  # fmt: skip


@pytest.mark.parametrize(("format", "text"), LINES)
def test_no_message_repeats_a_line(format: str, text: str) -> None:
    with pytest.raises(MeshError) as refusal:
        read_arrays(text.encode(), format, points=True)
    assert N[:4] not in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig"])
@pytest.mark.parametrize("format", ["obj", "off", "ply", "stl", "gltf"])
def test_texts_are_read_in_every_encoding(format: str, encoding: str) -> None:
    texts = {
        "obj": FILES["obj"].replace(b"v ", b"v \\\n", 1),
        "ply": b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
        "stl": b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
        b"endsolid a\n",
    }
    text = texts.get(format, FILES.get(format, b""))
    expected = read_arrays(text, format)
    for given in (format, None):
        vertices, faces = read_arrays(text.decode().encode(encoding), given)
        np.testing.assert_array_equal(vertices, expected[0])
        np.testing.assert_array_equal(faces, expected[1])


def mni(colours: int = 0, quads: bool = False) -> bytes:
    """A tetrahedron or a pyramid as CIVET writes it."""
    points = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, -1.25]]
    faces = [[0, 3, 2, 1], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]] if quads else [[0, 1, 2], [0, 2, 3], [1, 0, 4]]
    rows = [" ".join(map(str, row)) for row in points]
    shades = ["1 1 1 1"] * {0: 1, 1: len(faces), 2: len(points)}[colours]
    ends = np.cumsum([len(face) for face in faces])
    corners = [str(corner) for face in faces for corner in face]
    lines = [f"P 0.3 0.3 0.4 10 1 {len(points)}", *rows, "", *rows, "", f" {len(faces)}", f" {colours} {shades[0]}"]
    lines += [*shades[1:], "", " ".join(map(str, ends)), "", " ".join(corners)]
    return "\n".join(lines).encode() + b"\n"


@pytest.mark.parametrize("colours", [0, 1, 2])
def test_the_obj_of_mni_is_read(colours: int, tmp_path: Path) -> None:
    path = tmp_path / "white_left.obj"
    path.write_bytes(mni(colours))
    vertices, faces = read_arrays(path)
    assert vertices[4].tolist() == [0.5, 0.5, -1.25]
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [1, 0, 4]]
    faces = read_arrays(mni(colours, quads=True), "obj")[1]
    assert faces.tolist() == [[0, 3, 2], [0, 2, 1], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (mni()[:-40], "ends before"),
        (mni() + b"P 0.3 0.3 0.4 10 1 3\n0 0 0", "several objects"),
        (b"L 1 2\n0 0 0\n1 1 1\n1\n0 1 1 1 1\n2\n0 1\n", "with lines"),
        (b"p\0\0\x80?\0\0\x80?", "binary data"),
        (mni().replace(b"10 1 5", b"10 1 9999999"), "ends before"),
        (b"# nothing\n", "no vertices"),
    ],
)
def test_what_is_wrong_with_an_obj_is_said(data: bytes, says: str) -> None:
    with pytest.raises(MeshError, match=says):
        read_arrays(data, "obj")
