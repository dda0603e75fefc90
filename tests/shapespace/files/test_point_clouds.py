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
    "exponents of Fortran": "1.25D+01 7.25D0 3.1d0\n-1D0 .5 2.\n4 -5.75 6\n",
    "decimal commas in quotation marks": rows('","', ",", before='"', after='"'),
    "decimal commas in single quotation marks": rows("','", ",", before="'", after="'"),
    "quotation marks where a comma needs them": '"12,5","7,25","3,1"\n-1,"0,5",2\n4,"-5,75",6\n',
    "labels": rows(before="P{k} "),
    "labels with blanks": rows(";", ",", before="left eye {k};"),
    "labels and row numbers": rows(before="Point {k} "),
    "a mark behind the row number": rows(before="{k}: "),
    "a bracket behind the row number": rows(before="{k}) "),
    "a point behind the row number": rows(before="{k}. "),
    "row numbers with gaps": rows(before="{k}7 "),
    "row numbers that go down": rows(";", ",", before="-{k};"),
    "row numbers with decimals": rows(before="{k}.0 "),
    "two row numbers": rows(before="{k} 1{k} "),
    "row numbers that start again": rows(before="{k} ").replace("2 4", "0 4"),
    "brackets": rows(", ", before="(", after="),"),
    "pipes": "| x | y | z |\n|---|---|---|\n" + rows(" | ", before="| ", after=" |"),
    "typographic minus signs": rows().replace("-", "\u2212"),
    "a NUL at the end": rows() + "\0",
    "the end-of-file character of DOS": rows() + "\x1a",
    "rows without values": "x,y,z\n" + rows(",") + ",,\n, , ,\n",
    "rows without values, with decimal commas": "x;y;z;\n" + rows(";", ",", after=";") + ";;;\n",
    "points that are NaN": "nan nan nan\n" + rows() + "1 nan 2\n",
    "a header in the encoding of Windows": ("Länge;x;y;z\n" + rows(";", ",", before="0,5;")).encode("cp1252"),
    "a header of 3D Slicer": "# columns = id,x,y,z,ow,label\n" + rows(",", before="node_{k},", after=",0,F-{k}"),
    "a header with words before x": "nr,name,x,y,z\n" + rows(",", before='1,"eye, left",'),
    "a header that R writes": '"x" "y" "z"\n' + rows(before='"{k}" '),
    "a header with units below": "q;x;y;z\n1;mm;mm;m\n" + rows(";", before="0.5;"),
}
#: Headers with a column q in front, which has fractions.
HEADERS = [
    "q,X_mm,Y_mm,Z_mm",
    "q,X Coordinate,Y Coordinate,Z Coordinate",
    "q,Position X,Position Y,Position Z",
    "q,easting,northing,elevation",
    "q,Easting (m),Northing (m),Elevation (m)",
    "q,Rechtswert,Hochwert,Hoehe",
    "q,E,N,Höhe",
    "q,xPos,yPos,zPos",
    "q,PositionX,PositionY,PositionZ",
    "q,px,py,pz",
    "q,X1,Y1,Z1",
    "q,X_East,Y_North,Z_Up",
    "q,Position(X),Position(Y),Position(Z)",
    "q,cartesian_points:0,cartesian_points:1,cartesian_points:2",
    "q,pos[0],pos[1],pos[2]",
    "q,location.x,location.y,location.z",
    "q,X in mm,Y in mm,Z in mm",
    "q,scanner x,scanner y,scanner z",
    '"q","Coordinates:0","Coordinates:1","Coordinates:2"',
]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("header", HEADERS)
def test_a_header_tells_the_columns_in_any_spelling(header: str, separator: str) -> None:
    content = header.replace(",", separator) + "\n" + rows(separator, before=f"0.5{separator}")
    np.testing.assert_array_equal(read(content, "csv"), POINTS)


def test_positions_are_told_from_normals_and_heights_by_their_names() -> None:
    normals = "Normal_X,Normal_Y,Normal_Z,X,Y,Z\n" + rows(",", before="0.5,0.5,0.5,")
    np.testing.assert_array_equal(read(normals), POINTS)
    np.testing.assert_array_equal(read("n,X_mm,Y_mm,Z_mm\n" + rows(",", before="0.5,")), POINTS)
    np.testing.assert_array_equal(read("height,x,y,z\n" + rows(",", before="0.5,")), POINTS)
    np.testing.assert_array_equal(read("depth,Y,Z,X\n" + rows(",", before="0.5,")), POINTS[:, [2, 0, 1]])


@pytest.mark.parametrize("dialect", READ)
@pytest.mark.parametrize("format", ["xyz", "pts", "csv", "txt"])
def test_points_are_read_in_every_dialect(dialect: str, format: str) -> None:
    np.testing.assert_array_equal(read(READ[dialect], format), POINTS)


TWO_WAYS = "the commas of line 1 can stand before decimals or between columns: write"
REFUSED = {
    "two readings": ("1,2,3,4,5,6\n7,8,9,10,11,12\n", TWO_WAYS),
    "thousands": ("1,234.5 2,345.6 3,456.7\n", "line 1 does not begin with three numbers"),
    "thousands in quotation marks": ('"9,287","8,811","5,808"\n', "before decimals or between thousands"),
    "two decimals of three": ("1,5,2,5,3\n1,25,2,5,4\n", TWO_WAYS),
    "some decimals": ("1,5,2,3\n1,5,2,5,3\n", TWO_WAYS),
    "decimal commas and points": ("1.5 2 3\n1,5 2,5 3\n", "line 1 is written otherwise than line 2: write all"),
    "labels of other lines": ("v 1.5 2 3\nvn 0 0 1\n", "line 2 is a line of OBJ"),
    "a label in some lines": ("1A 1.5 2 3\n12 1.5 2 3\n", "line 1 is written otherwise than line 2"),
    "whole numbers in no order": (
        rows(before="{k} ") + "1 2.5 2.5 2.5\n2 1 1 1\n",
        "line 1 can begin with x, y and z, or with a row number",
    ),
    "a row number before decimal commas": ("1,9,28,8,11,5,80\n2,3,28,8,11,5,8\n", TWO_WAYS),
    "a remark of three words": (
        "# a scan today\n1,2,3,4,5,6\n",
        "the commas of line 2 can stand before decimals or between columns",
    ),
    "a date": ("Date 2024 1 5\nP1 1.5 2.5 3.5\n", "line 1 is written otherwise than line 2"),
    "a label that is missing": ("P1 1 2 3\n" * 500 + "1.5 2 3 4\n", "line 501 is written otherwise than line 1"),
    "a header of other names with numbers": ("t,a1,a2,a3\n" + rows(",", before="0.5,"), "does not tell the columns"),
    "one whole number": (rows(before="7 "), "line 1 can begin with x, y and z, or with a row number: delete"),
    "a grid of heights": ("0 0 1.5 0.1 0.2\n0 1 2.5 0.3 0.4\n1 0 3.5 0.6 0.1\n", "or with a row number"),
    "a header of other names": ("a,b,c,d\n" + rows(",", before="0.5,"), "its header does not tell the columns"),
    "two sets of coordinates": ("x_a,y_a,z_a,x_b,y_b,z_b\n0.1,2,3,4,5,6\n", "two sets of columns x, y and z"),
    "a header of another length": ("q x y z\n0.1 2 3 4 5\n", "names 4 columns, and a point has 5"),
    "a header alone": ("Points:0,Points:1,Points:2\n1.5,2\n", "line 2 does not begin"),
    "a line of words": ("1 2 3\n4 five 6\n", "line 2 does not begin with three numbers"),
    "another dialect later": ("1.5 2 3\n" * 500 + "1,5 2,5 3,5\n", "line 501 is written otherwise than line 1"),
    "two numbers": ("1 2\n", "line 1 does not begin"),
    "fewer points than said": ("4\n" + rows(), "should have 4 points, but has 3"),
    "a running number that stops": (
        "".join(f"{k} 1 2 3\n" for k in [*range(500), 7]),
        "counts the points, but not in line 501",
    ),
    "nothing": ("", "no line with three numbers"),
    "a picture": (b"\x89PNG\r\n\x1a\n\x00\x00", "it is not text"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_what_is_no_list_of_points_is_refused(fault: str) -> None:
    content, says = REFUSED[fault]
    with pytest.raises(MeshError, match=says):
        read(content)


def test_a_header_with_a_name_for_each_number_settles_how_commas_are_meant() -> None:
    assert read("x,y,z,r,g,b\n1,2,3,4,5,6\n").tolist() == [[1, 2, 3]]
    assert read("x,y,z\n1,2,3,4,5,6\n").tolist() == [[1.2, 3.4, 5.6]]
    assert read("x,y,z,r,g\n1,2,3,4,5\n").tolist() == [[1, 2, 3]]
    assert read("i,x,y,z\n2,1.5,2.5,3.5\n2,1,2,3\n").tolist() == [[1.5, 2.5, 3.5], [1, 2, 3]]


def test_whole_coordinates_are_not_taken_for_row_numbers() -> None:
    grid = "".join(f"{k % 4} {k // 4} 5 255\n" for k in range(12))
    assert read(grid)[5].tolist() == [1, 1, 5]
    assert read("3 4 5 0.5 0.25 0.125\n6 7 8 0.5 0.25 0.125\n")[1].tolist() == [6, 7, 8]


def test_lines_far_down_may_need_more_than_the_first() -> None:
    assert read("1.5 2 3\n" * 500 + "1.5D0 2 3\n")[-1].tolist() == [1.5, 2, 3]


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
        (pcd("zipped", ROWS.tobytes()), "neither ascii, binary nor"),
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
