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


def binary_off(keyword: str, beside: int) -> bytes:
    """Return the file with some more numbers behind each vertex, and three colours behind every second face."""
    rows = np.hstack([VERTICES, np.ones((len(VERTICES), beside))]).astype(">f4").tobytes()
    colours = (struct.pack(">i", 0), struct.pack(">i3f", 3, 1, 0, 0))
    faces = b"".join(struct.pack(">4i", 3, *face) + colours[k % 2] for k, face in enumerate(FACES.tolist()))
    return f"{keyword} BINARY\n".encode() + struct.pack(">3i", len(VERTICES), len(FACES), 0) + rows + faces


def ply(property_name: str) -> bytes:
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(VERTICES)}\nproperty float x\nproperty float y\n"
        f"property float z\nproperty float {property_name}\nelement face {len(FACES)}\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    rows = np.column_stack([VERTICES, np.zeros(len(VERTICES))]).astype("<f4").tobytes()
    return head.encode() + rows + b"".join(struct.pack("<B3i", 3, *face) for face in FACES.tolist())


def listed(kind: str) -> bytes:
    """Return the file of `cells` with an element between its vertices and faces whose rows have lists."""
    head, end, body = cells(kind).partition(b"element face")
    element = b"element loop 2\nproperty list uchar short ids\n"
    place = len(body) - (sum(map(len, TRIANGLES)) + len(TRIANGLES) if kind == "ascii" else 13 * len(FACES))
    rows = b"0\n2 7 8\n" if kind == "ascii" else struct.pack(">BB2h", 0, 2, 7, 8)
    return head + element + end + body[:place] + rows + body[place:]


def strips(kind: str) -> bytes:
    """Return the file of `cells` with its faces as one row of triangle strips."""
    head, _, body = cells(kind).partition(b"element face 6\nproperty list uchar int")
    place = len(body) - (sum(map(len, TRIANGLES)) + len(TRIANGLES) if kind == "ascii" else 13 * len(FACES))
    row = [23, *[entry for face in FACES.tolist() for entry in (*face, -1)][:-1]]
    packed = struct.pack(">24i", *row) if kind != "ascii" else " ".join(map(str, row)).encode() + b"\n"
    return head + b"element tristrips 1\nproperty list int int" + body[:place] + packed


def cells(kind: str, separator: str = " ") -> bytes:
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
        return head.encode() + "\n".join([*rows, *TRIANGLES, ""]).replace(" ", separator).encode()
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
    "OBJ with the former keyword of faces": ("obj", OBJ.replace("f ", "fo ")),
    "OBJ with exponents of Fortran": ("obj", OBJ.replace("1.25", "1.25D+00").replace("v 1 0 0", "v 1d0 0 0# a")),
    "OBJ with decimal points in its faces": ("obj", OBJ.replace("f 1 3 2", "f 1.0 3.0/ 2.00//1")),
    "OBJ with zeros behind it": ("obj", OBJ + "\0" * 9),
    "OBJ whose last line goes on": ("obj", OBJ[:-1] + " \\"),
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
    "binary OFF": ("off", binary_off("OFF", 0)),
    "binary STCNOFF": ("off", binary_off("STCNOFF", 9)),
    "OFF without its keyword": ("off", off(COUNTS)),
    "OFF with edges and points": ("off", off("OFF\n5 8 0") + "2 0 1\n1 3\n"),
    "PLY with one number a line": ("ply", cells("ascii", "\n")),
    "PLY with all rows on one line": ("ply", cells("ascii").replace(b"\n3 ", b" 3 ")),
    "PLY without a version": ("ply", cells("ascii").replace(b"ascii 1.0", b"ascii")),
    "PLY with decimal points in its faces": ("ply", cells("ascii").replace(b"3 0 2 1", b"3.0 0.0 2.0 1.0")),
    "PLY with edges and points": ("ply", cells("ascii").replace(b"face 6", b"face 8") + b"2 0 1\n1 4\n"),
    "binary PLY with edges": (
        "ply",
        cells("binary_big_endian").replace(b"face 6", b"face 7") + struct.pack(">B2i", 2, 0, 1),
    ),
    "PLY with lists before its faces": ("ply", listed("ascii")),
    "binary PLY with lists before its faces": ("ply", listed("binary_big_endian")),
    "PLY with triangle strips": ("ply", strips("ascii")),
    "binary PLY with triangle strips": ("ply", strips("binary_big_endian")),
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
    "STL without its last line": ("stl", solid("a", FACES)[:-11]),
    "STL without its last end of a line": ("stl", solid("a", FACES)[:-12]),
    "STL on one line": ("stl", solid("a vertex 1 2 3", FACES).replace("\n", " ")),
    "STL with a facet on each line": ("stl", solid("a", FACES).replace("\n", " ").replace(" facet", "\n facet")),
    "STL with blanks in its keywords": ("stl", solid("a", FACES).replace("endsolid", "end solid")),
    "binary STL": ("stl", binary_stl()),
    "binary STL whose number of faces is not filled in": ("stl", binary_stl().replace(b"\6\0\0\0", bytes(4), 1)),
    "binary STL with the largest number of faces": ("stl", binary_stl().replace(b"\6\0\0\0", b"\xff" * 4, 1)),
    "binary STL with bytes behind it": ("stl", binary_stl(b"\0" * 7)),
}
#: Of these trimesh reads something else: it knows fewer keywords, or stops at the byte-order mark.
ALONE = {
    "binary OFF", "binary STCNOFF",
    "OBJ with capital keywords", "OBJ with a byte-order mark", "OBJ in UTF-16", "OFF with counts over two lines",
    "OFF with its counts glued to the keyword", "OFF in small letters", "OFF with remarks", "NOFF", "CNOFF", "NCOFF",
    "STOFF", "OFF with rows over several lines", "PLY with a space in the name of a property", "COFF",
    "binary STL with bytes behind it", "OFF with several rows on a line", "OFF on one line", "COFF without colours",
    "OFF with a remark behind the keyword", "NOFF with normals on their own lines", "PLY in capitals",
    "COFF with colours on their own lines", "PLY with carriage returns", "binary PLY with carriage returns",
    "PLY with a list before x", "binary PLY with a list before x", "OBJ with lines and points as faces",
    "OBJ with a backslash that ends a remark",
    "OBJ with the former keyword of faces",
    "OBJ with exponents of Fortran",
    "OBJ with decimal points in its faces",
    "OBJ with zeros behind it",
    "OBJ whose last line goes on",
    "OFF without its keyword",
    "OFF with edges and points",
    "PLY with one number a line",
    "PLY with all rows on one line",
    "PLY without a version",
    "PLY with decimal points in its faces",
    "PLY with edges and points",
    "binary PLY with edges",
    "PLY with lists before its faces",
    "binary PLY with lists before its faces",
    "PLY with triangle strips",
    "binary PLY with triangle strips",
    "STL without its last line",
    "STL without its last end of a line",
    "STL on one line",
    "STL with a facet on each line",
    "STL with blanks in its keywords",
    "binary STL whose number of faces is not filled in",
    "binary STL with the largest number of faces",
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
        (b"OFF BINARY\n\0\0\0\5", "off", "ends before"),
        (binary_off("OFF", 0)[:-4], "off", "ends before"),
        (binary_off("OFF", 0).replace(b"\0\0\0\6", b"\0\0\0\7", 1), "off", "ends before"),
        (b"4OFF\n1 1 0\n", "off", "line 1 can't be read"),
        (binary_stl()[:-1], "stl", "damaged"),
        (
            solid("a", np.array([[0, 3, 2, 1], [0, 1, 2, 4]])).encode(),
            "stl",
            "line 8 can't be read: .* a facet has three",
        ),
        (solid("a", FACES)[:-35].encode(), "stl", "in the middle of a facet"),
        (solid("a", FACES)[:-11].encode() + b"facet norm", "stl", "in the middle of a facet"),
        (OBJ.replace("f 1", "f 0").encode(), "obj", "line 6 can't be read: .* whole numbers from 1"),
        (OBJ.replace("1.25", "-1.#IND00").encode(), "obj", "line 5 can't be read"),
        (cells("ascii")[:-9], "ply", "ends before"),
        (
            cells("ascii").replace(b"0.5 0.5", b"x 0.5"),
            "ply",
            "line 16 can't be read: a row of vertex has the values of beside x",
        ),
    ],
)
def test_other_dialects_are_refused(content: bytes, format: str, says: str) -> None:
    with pytest.raises(MeshError, match=says):
        read_arrays(content, format)
