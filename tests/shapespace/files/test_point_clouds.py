"""Point clouds as text and as PCD: the dialects that scanners, spreadsheets and other libraries write."""

from __future__ import annotations

import struct

import numpy as np
import pytest

from shapespace.files.limits import Limits
from shapespace.files.reading import SCAN_FORMATS, read_arrays
from shapespace.mesh.triangle_mesh import MeshError

POINTS = np.array([[12.5, 7.25, 3.1], [-1.0, 0.5, 2.0], [4.0, -5.75, 6.0]])


def read(content: str | bytes, format: str = "xyz") -> np.ndarray:
    return read_arrays(content.encode() if isinstance(content, str) else content, format, points=True)[0]


def rows(separator: str = " ", decimal: str = ".", before: str = "", after: str = "") -> str:
    lines = (separator.join(f"{value:.2f}".replace(".", decimal) for value in point) for point in POINTS)
    return "".join(f"{before.format(k=k)}{line}{after}\n" for k, line in enumerate(lines))


READ = {
    "blanks": rows(),
    "tabs": rows("\t"),
    "commas": rows(","),
    "commas and blanks": rows(", "),
    "semicolons": rows(";"),
    "a separator at the end": rows(";", after=";"),
    "decimal commas": rows(decimal=","),
    "decimal commas and tabs": rows("\t", ","),
    "decimal commas and semicolons": rows(";", ","),
    "decimal commas, separated by commas and blanks": rows(", ", ","),
    "normals": rows(after=" 0.1 0.2 0.3"),
    "colours": rows(",", after=",255,128,0"),
    "a running number from 0": rows(before="{k} "),
    "a running number with decimal commas": rows(";", ",", before="{k};"),
    "a number of points": "3\n" + rows(),
    "a number of points, with intensity and colour": "3\n" + rows(after=" -1024 10 20 30"),
    "a header": "x y z\n" + rows(),
    "a header of other columns": "id;x;y;z\n" + rows(";", before="7;"),
    "a header with units": "X [mm];Y [mm];Z [mm]\n" + rows(";", ","),
    "a header of ParaView": '"Points:0","Points:1","Points:2"\n' + rows(","),
    "a header of CloudCompare": "//X Y Z R G B\n" + rows(after=" 1 2 3"),
    "remarks": "# scanned on Monday\n\n" + rows(after=" # seen") + "// end\n",
    "a byte-order mark": "\ufeff" + rows(),
    "UTF-16": rows().encode("utf-16"),
    "ends of lines of Windows": rows().replace("\n", "\r\n"),
    "ends of lines of old Macs": rows().replace("\n", "\r"),
    "no end of the last line": rows().rstrip("\n"),
    "exponents": "1.25e1 725E-2 +3.1\n-1 .5 2.\n4e0 -5.75 6\n",
}


@pytest.mark.parametrize("dialect", READ)
@pytest.mark.parametrize("format", ["xyz", "pts", "csv", "txt"])
def test_points_are_read_in_every_dialect(dialect: str, format: str) -> None:
    np.testing.assert_array_equal(read(READ[dialect], format), POINTS)


REFUSED = {
    "two readings": ("1,2,3,4,5,6\n7,8,9,10,11,12\n", r"\(1, 2, 3\) and as \(1.2, 3.4, 5.6\)"),
    "thousands": ("1,234.5 2,345.6 3,456.7\n", "line 1 is '1,234.5"),
    "a label in front": ("C 1 2 3\n", "line 1 is 'C 1 2 3'"),
    "a line of words": ("1 2 3\n4 five 6\n", "line 2 is '4 five 6'"),
    "another dialect later": ("1.5 2 3\n" * 500 + "1,5 2,5 3,5\n", "line 501 is '1,5 2,5 3,5'"),
    "two numbers": ("1 2\n", "line 1 is '1 2'"),
    "fewer points than said": ("4\n" + rows(), "should have 4 points, but has 3"),
    "a running number that stops": (
        "".join(f"{k} 1 2 3\n" for k in [*range(500), 7]),
        "counts the points, but not in line 501",
    ),
    "nothing": ("", "line 1 is ''"),
    "a picture": (b"\x89PNG\r\n\x1a\n\x00\x00", "it is not text"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_what_is_no_list_of_points_is_refused(fault: str) -> None:
    content, says = REFUSED[fault]
    with pytest.raises(MeshError, match=says):
        read(content)


def test_a_header_with_a_name_for_each_number_settles_how_commas_are_meant() -> None:
    assert read("x,y,z,r,g,b\n1,2,3,4,5,6\n").tolist() == [[1, 2, 3]]


def test_more_points_than_the_limit_are_refused() -> None:
    with pytest.raises(MeshError, match="more than 2 vertices"):
        read_arrays(rows().encode(), "xyz", Limits(2, 2), points=True)


def pcd(kind: str, body: bytes, points: int = 3, fields: str = "rgb x y z", sizes: str = "4 4 4 4") -> bytes:
    types, counts = " ".join("F" for _ in fields.split()), " ".join("1" for _ in fields.split())
    head = (
        f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {types}\n"
        f"COUNT {counts}\nWIDTH {points}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {points}\nDATA {kind}\n"
    )
    return head.encode() + body


ROWS = np.column_stack([[9.0, 9.0, 9.0], POINTS]).astype("<f4")


def packed(content: bytes) -> bytes:
    """LZF of bytes: literals, with a reference where the first four repeat themselves."""
    assert content[:4] == content[4:8] == content[8:12]
    reference = bytes([(6 << 5) | 0, 3])  # 8 bytes, from 4 bytes before
    literals = b"".join(
        bytes([len(content[k : k + 32]) - 1]) + content[k : k + 32] for k in range(12, len(content), 32)
    )
    return struct.pack("<II", 6 + 1 + len(literals), len(content)) + b"\x03" + content[:4] + reference + literals


PCD = {
    "ascii": pcd("ascii", "".join(f"9 {x} {y} {z}\n" for x, y, z in POINTS).encode()),
    "binary": pcd("binary", ROWS.tobytes()),
    "binary_compressed": pcd("binary_compressed", packed(ROWS.T.tobytes())),
    "missing points": pcd("binary", np.vstack([ROWS, np.full((1, 4), np.nan, "<f4")]).tobytes(), 4),
}


@pytest.mark.parametrize("kind", PCD)
def test_pcd_is_read(kind: str) -> None:
    np.testing.assert_array_equal(read(PCD[kind], "pcd"), POINTS.astype(np.float32) if kind != "ascii" else POINTS)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (pcd("binary", ROWS.tobytes()[:-4]), "not a readable pcd file"),
        (pcd("zipped", ROWS.tobytes()), "are zipped, which can't be read"),
        (pcd("binary", ROWS.tobytes(), fields="rgb a b c"), "not x, y and z"),
        (pcd("ascii", b"9 1 2 3\n"), "have 3 points, but has 1"),
        (pcd("binary_compressed", struct.pack("<II", 4, 48) + b"\xff\xff\xff\xff"), "damaged"),
        (b"1 2 3\n", "no line DATA"),
    ],
)
def test_damaged_pcd_is_refused(content: bytes, says: str) -> None:
    with pytest.raises(MeshError, match=says):
        read(content, "pcd")


def test_points_are_no_meshes() -> None:
    assert {"xyz", "pts", "csv", "txt", "pcd"} <= SCAN_FORMATS.keys()
    with pytest.raises(MeshError):
        read_arrays(rows().encode(), "xyz")
