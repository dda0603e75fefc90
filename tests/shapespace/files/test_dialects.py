"""Mesh files as other programs write them, beside what trimesh reads of the same bytes."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
import trimesh

from shapespace.files.reading import read_arrays
from shapespace.mesh.triangle_mesh import MeshError

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1.25]])
FACES = np.array([[0, 2, 1], [0, 3, 2], [0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
POINTS = [" ".join(f"{value:g}" for value in row) for row in VERTICES]
TRIANGLES = ["3 " + " ".join(map(str, face)) for face in FACES]
OBJ = "".join(f"v {row}\n" for row in POINTS) + "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in FACES)
COUNTS = f"{len(VERTICES)} {len(FACES)} 0"


def off(head: str, after_point: str = "", after_face: str = "", separator: str = "\n") -> str:
    rows = [row + after_point for row in POINTS] + [row + after_face for row in TRIANGLES]
    return f"{head}{separator}{separator.join(rows)}{separator}"


def solid(name: str, faces: np.ndarray) -> str:
    facets = "".join(
        "facet normal 0 0 0\nouter loop\n" + "".join(f"vertex {POINTS[k]}\n" for k in face) + "endloop\nendfacet\n"
        for face in faces
    )
    return f"solid {name}\n{facets}endsolid {name}\n"


def binary_stl(after: bytes = b"") -> bytes:
    rows = b"".join(bytes(12) + VERTICES[face].astype("<f4").tobytes() + bytes(2) for face in FACES)
    return b"made by a scanner".ljust(80) + struct.pack("<I", len(FACES)) + rows + after


def ply(property_name: str) -> bytes:
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(VERTICES)}\nproperty float x\nproperty float y\n"
        f"property float z\nproperty float {property_name}\nelement face {len(FACES)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.column_stack([VERTICES, np.zeros(len(VERTICES))]).astype("<f4").tobytes()
    return head.encode() + rows + b"".join(struct.pack("<B3i", 3, *face) for face in FACES.tolist())


def cells(kind: str) -> bytes:
    """Return a PLY file whose vertices have lists, of different lengths, before and after the coordinates."""
    lists = [list(range(k)) for k in range(len(VERTICES))]
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(VERTICES)}\nproperty list uchar short beside\nproperty float x\n"
        f"property float y\nproperty list uchar short after\nproperty float z\nelement face {len(FACES)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    if kind == "ascii":
        texts = [" ".join(map(str, [len(entries), *entries])) for entries in lists]
        rows = [f"{text} {x} {y} {text} {z}" for text, (x, y, z) in zip(texts, VERTICES.tolist(), strict=True)]
        return "\n".join([head.rstrip(), *rows, *TRIANGLES, ""]).encode()
    packed = [struct.pack(f">B{len(entries)}h", len(entries), *entries) for entries in lists]
    body = (
        text + struct.pack(">2f", x, y) + text + struct.pack(">f", z)
        for text, (x, y, z) in zip(packed, VERTICES.tolist(), strict=True)
    )
    return head.encode() + b"".join(body) + b"".join(struct.pack(">B3i", 3, *face) for face in FACES.tolist())


MESHES: dict[str, tuple[str, str | bytes]] = {
    "OBJ": ("obj", OBJ),
    "OBJ with capital keywords": ("obj", OBJ.replace("v ", "V ").replace("f ", "F ")),
    "OBJ with lines that go on": ("obj", OBJ.replace("v 1 ", "v 1 \\\n").replace("f 1 ", "f \\\r\n1 ")),
    "OBJ with a backslash that ends a remark": ("obj", "# saved as C:\\scans\\\n" + OBJ.replace("v 1 ", "v \\\n1 ")),
    "OBJ with lines and points as faces": ("obj", OBJ + "f 1 2\nf 3\n"),
    "OBJ with a byte-order mark": ("obj", "\ufeff" + OBJ),
    "OBJ in UTF-16": ("obj", OBJ.encode("utf-16")),
    "OFF": ("off", off(f"OFF\n{COUNTS}")),
    "OFF with its counts in the first line": ("off", off(f"OFF {COUNTS}")),
    "OFF with its counts glued to the keyword": ("off", off(f"OFF{COUNTS}")),
    "OFF with counts over two lines": ("off", off(f"OFF\n{len(VERTICES)}\n{len(FACES)} 0")),
    "OFF in small letters": ("off", off(f"off\n{COUNTS}")),
    "OFF with remarks": ("off", off(f"# made by hand\nOFF\n# counts\n{COUNTS} # edges are unknown", " # here")),
    "COFF": ("off", off(f"COFF\n{COUNTS}", " 255 0 0 255")),
    "NOFF": ("off", off(f"NOFF\n{COUNTS}", " 0 0 1")),
    "CNOFF": ("off", off(f"CNOFF\n{COUNTS}", " 0 0 1 255 0 0 255")),
    "NCOFF": ("off", off(f"NCOFF\n{COUNTS}", " 0 0 1 255 0 0 255")),
    "STOFF": ("off", off(f"STOFF\n{COUNTS}", " 0.5 0.5")),
    "OFF with colours of faces": ("off", off(f"OFF\n{COUNTS}", "", " 0.5 0.5 0.5")),
    "OFF with rows over several lines": ("off", off(f"OFF\n{COUNTS}").replace(" ", "\n")),
    "OFF with a remark behind the keyword": ("off", off(f"OFF # by hand\n{COUNTS}")),
    "OFF with several rows on a line": ("off", off(f"OFF\n{COUNTS}").replace("\n3 0", " 3 0").replace("\n1 ", " 1 ")),
    "OFF on one line": ("off", off(f"OFF {COUNTS}", separator=" ")),
    "NOFF with normals on their own lines": ("off", off(f"NOFF\n{COUNTS}", "\n0 0 1")),
    "COFF with colours on their own lines": ("off", off(f"COFF\n{COUNTS}", "\n255 0 0 255")),
    "COFF without colours": ("off", off(f"COFF\n{COUNTS}")),
    "PLY with a space in the name of a property": ("ply", ply("quality of scan")),
    "PLY in capitals": ("ply", ply("quality").replace(b"ply", b"PLY", 1)),
    "PLY with carriage returns": ("ply", cells("ascii").replace(b"\n", b"\r")),
    "binary PLY with carriage returns": ("ply", ply("quality").replace(b"\n", b"\r", 11)),
    "PLY with a list before x": ("ply", cells("ascii")),
    "binary PLY with a list before x": ("ply", cells("binary_big_endian")),
}
SOUPS: dict[str, tuple[str, str | bytes]] = {
    "STL": ("stl", solid("a", FACES)),
    "STL of several solids": ("stl", solid("a", FACES[:2]) + solid("b", FACES[2:])),
    "binary STL": ("stl", binary_stl()),
    "binary STL with bytes behind it": ("stl", binary_stl(b"\0" * 7)),
}
#: Of these trimesh reads something else: it knows fewer keywords, or stops at the byte-order mark.
ALONE = {
    "OBJ with capital keywords", "OBJ with a byte-order mark", "OBJ in UTF-16", "OFF with counts over two lines",
    "OFF with its counts glued to the keyword", "OFF in small letters", "OFF with remarks", "NOFF", "CNOFF", "NCOFF",
    "STOFF", "OFF with rows over several lines", "PLY with a space in the name of a property", "COFF",
    "binary STL with bytes behind it", "OFF with several rows on a line", "OFF on one line", "COFF without colours",
    "OFF with a remark behind the keyword", "NOFF with normals on their own lines", "PLY in capitals",
    "COFF with colours on their own lines", "PLY with carriage returns", "binary PLY with carriage returns",
    "PLY with a list before x", "binary PLY with a list before x", "OBJ with lines and points as faces",
    "OBJ with a backslash that ends a remark",
}  # fmt: skip


@pytest.mark.parametrize("name", [*MESHES, *SOUPS])
def test_dialects_are_read_as_the_plain_file_is(name: str) -> None:
    format, content = (MESHES | SOUPS)[name]
    data = content.encode() if isinstance(content, str) else content
    vertices, faces = read_arrays(data, format)
    np.testing.assert_allclose(vertices[faces], VERTICES[FACES], atol=1e-7)
    if name in MESHES:
        np.testing.assert_array_equal(faces, FACES)
    if name not in ALONE:
        theirs = trimesh.load(io.BytesIO(data), file_type=format, process=False, maintain_order=True)
        meshes = theirs.geometry.values() if isinstance(theirs, trimesh.Scene) else [theirs]
        triangles = np.concatenate([mesh.triangles for mesh in meshes])
        np.testing.assert_allclose(triangles, VERTICES[FACES], atol=1e-7)


def test_polygons_of_several_sizes_are_cut_into_fans() -> None:
    polygons = [[0, 1, 2, 3], [0, 1, 4], [0, 3, 2, 1, 4], [1, 2, 4]]
    head = (
        f"ply\nformat binary_big_endian 1.0\nelement vertex {len(VERTICES)}\nproperty float x\nproperty float y\n"
        f"property float z\nelement face {len(polygons)}\nproperty uchar flag\nproperty list ushort int vertex_index\n"
        "property list uchar float texcoord\nend_header\n"
    )
    rows = (struct.pack(f">BH{len(p)}iB{2 * len(p)}f", 7, len(p), *p, 2 * len(p), *range(2 * len(p))) for p in polygons)
    faces = read_arrays(head.encode() + VERTICES.astype(">f4").tobytes() + b"".join(rows), "ply")[1]
    fans = [[p[0], p[k], p[k + 1]] for p in polygons for k in range(1, len(p) - 1)]
    np.testing.assert_array_equal(faces, fans)


@pytest.mark.parametrize(
    ("content", "format", "says"),
    [
        (b"OFF BINARY\n\0\0\0\5", "off", "binary OFF"),
        (b"4OFF\n1 1 0\n", "off", "line 1 is '4OFF'"),
        (binary_stl()[:-1], "stl", "damaged"),
        (
            cells("ascii").replace(b"element face", b"element tristrips"),
            "ply",
            "triangle strips",
        ),
    ],
)
def test_other_dialects_are_refused(content: bytes, format: str, says: str) -> None:
    with pytest.raises(MeshError, match=says):
        read_arrays(content, format)
