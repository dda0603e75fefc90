"""Mesh files up to the limit of uploads, generated to need far more time or memory than a mesh.

Bodies are generated on demand, each with the format that it is sent as.
"""

import base64
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Callable

from tests.gltf_documents import BINARY, FACES, MATRIX, VERTICES, chain, document, embedded, glb
from tests.surfaces import png_of

MIB = 2**20
#: Largest upload, in bytes.
MOST = 64 * MIB
FORM = "multipart/form-data; boundary=b"

#: Returns the format, or the content type, and a body of at most the given size.
Make = Callable[[int], tuple[str, bytes]]
HOSTILE: dict[str, Make] = {}


def hostile(make: Make) -> Make:
    HOSTILE[make.__name__] = make
    return make


def filled(size: int, start: bytes, repeated: bytes, end: bytes = b"") -> bytes:
    """``start``, as many repetitions as fit into the size, and ``end``."""
    return start + repeated * ((size - len(start) - len(end)) // len(repeated)) + end


def repeating(format: str, start: bytes, repeated: bytes, end: bytes = b"") -> Make:
    """A body in which one piece is repeated up to the size."""
    return lambda size: (format, filled(size, start, repeated, end))


def ply_head(kind: str, *lines: str) -> bytes:
    return "\n".join(["ply", f"format {kind} 1.0", *lines, "end_header", ""]).encode()


XYZ = ("property float x", "property float y", "property float z")
INDICES = "property list uchar int vertex_indices"
PROPERTIES = [f"property list uchar int l{k}" for k in range(1500)]
BOASTED = ("element vertex 1000000000000000", *XYZ, "element face 1000000000000000", INDICES)
A_FILE = b'--b\r\nContent-Disposition: form-data; name="f"; filename="a.obj"\r\n\r\n'

HOSTILE |= {
    "obj_of_vertices": repeating("obj", b"", b"v 1 2 3\n", b"f 1 2 3\n"),
    "obj_of_faces": repeating("obj", b"v 1 2 3\n", b"f 1 1 1\n"),
    "obj_of_one_polygon": repeating("obj", b"v 1 2 3\n" * 3 + b"f", b" 1"),
    "obj_of_long_polygons": repeating("obj", b"v 1 2 3\n" * 3, filled(MIB, b"f", b" 1", b"\n")),
    "obj_of_long_texture_lines": repeating("obj", b"v 1 2 3\n" * 3, filled(MIB, b"vt", b" 1", b"\n")),
    "obj_of_empty_lines": repeating("obj", b"", b"\n"),
    "obj_of_short_lines": repeating("obj", b"", b"g\r"),
    "obj_of_remarks": repeating("obj", b"", b"#\n"),
    "obj_of_spaces": repeating("obj", b"", b" "),
    "obj_of_nothing_but_digits": repeating("obj", b"v 1 2 ", b"9"),
    "obj_of_long_numbers": repeating("obj", b"", filled(MIB, b"v 1 2 0.", b"9", b"\n")),
    "obj_of_long_whole_numbers": repeating("obj", b"v 1 2 3\n", filled(MIB, b"f 1 1 ", b"1", b"\n")),
    "off_of_remarks": repeating("off", b"OFF\n", b"# \n"),
    "off_that_boasts": repeating("off", b"OFF 1000000000000 1000000000000 0\n", b"1 2 3\n"),
    "off_of_long_lines": repeating("off", b"OFF 1000 1 0\n", filled(MIB, b"1 2 3", b" 4", b"\n")),
    "off_of_polygons": repeating("off", b"OFF 1 60000 0\n1 2 3\n", b"30" + b" 0" * 30 + b"\n"),
    "ply_that_boasts": repeating("ply", ply_head("binary_little_endian", *BOASTED), b"\0"),
    "ply_that_boasts_in_text": repeating("ply", ply_head("ascii", *BOASTED), b"1 2 3\n"),
    "ply_of_other_rows": repeating(
        "ply", ply_head("ascii", f"element camera {10**15}", "property int x", "element vertex 1", *XYZ), b"1\n"
    ),
    "ply_of_many_properties": repeating(
        "ply",
        ply_head("ascii", "element vertex 1", *XYZ, "element face 65000", *PROPERTIES, INDICES) + b"0 0 0\n",
        b"0 " * len(PROPERTIES) + b"3 0 0 0\n",
    ),
    "ply_of_elements": repeating("ply", b"ply\nformat ascii 1.0\n", b"element vertex 0\nproperty list uint int x\n"),
    "ply_without_end": repeating("ply", b"ply\nformat ascii 1.0\n", b"comment x\n"),
    "glb_that_boasts": repeating("glb", struct.pack("<4sIII4s", b"glTF", 2, 2**32 - 1, 2**31, b"JSON"), b" "),
    "stl_of_text": repeating("stl", b"solid\n", b"vertex 0 0 0\n", b"endsolid\n"),
    "stl_of_solids": repeating("stl", b"", b"solid\nendsolid\n"),
    "stl_of_one_line": repeating("stl", b"solid", b" vertex 0 0 0"),
    "json_of_vertices": repeating("json", b'{"vertices": [', b"[1,2,3],", b"[1,2,3]]}"),
    "json_of_numbers": repeating("json", b'{"vertices": [', b"1.5,", b"1]}"),
    "json_of_objects": repeating("json", b'{"vertices": [', b'{"a":1},', b"1]}"),
    "json_of_names": repeating("json", b'{"vertices": [', b'"a",', b"1]}"),
    "json_of_spaces": repeating("json", b'{"vertices": [[1, 2, 3]]', b" ", b"}"),
    "json_of_nesting": repeating("json", b"", b"["),
    "gltf_of_many_buffers": repeating("gltf", b'{"buffers": [', b'{"uri":"data:,"},', b"{}]}"),
    "gltf_of_escapes": repeating("gltf", b'{"buffers": [{"uri": "data:;base64,\\/', b"A", b'"}]}'),
    "gltf_of_spaces": repeating("gltf", b"{", b" ", b"}"),
    "form_of_parts": repeating(FORM, b"", b'--b\r\nContent-Disposition: form-data; name="a"\r\n\r\n\r\n', b"--b--\r\n"),
    "form_of_boundaries": repeating(FORM, b"", b"--b\r\n"),
    "form_of_returns": repeating(FORM, A_FILE, b"\r"),
    "form_in_a_form": repeating(
        FORM, A_FILE[:-2] + b"Content-Type: multipart/mixed; boundary=c\r\n\r\n", b"--c\r\n\r\n"
    ),
    "form_with_a_long_name": repeating(FORM, b'--b\r\nContent-Disposition: form-data; name="', b"a"),
    "form_of_quotes": repeating(FORM, b"--b\r\nContent-Disposition: form-data; name=", b'"\\"'),
    "form_of_almost_boundaries": repeating(FORM, A_FILE, b"\r\n--bX"),
    "form_of_line_ends": repeating(FORM, A_FILE, b"\r\n-"),
    "form_of_headers": repeating(FORM, b"--b\r\n", b"a: b\r\n"),
    "form_with_a_long_header": repeating(FORM, b"--b\r\nContent-Disposition: ", b";a=b"),
    "form_of_nothing": repeating(FORM, b"", b"\r\n"),
    "form_with_an_obj": repeating(FORM, A_FILE, b"v 1 2 3\n", b"\r\n--b--\r\n"),
}


@hostile
def ply_of_lists(size: int) -> tuple[str, bytes]:
    """Faces of different sizes, which have to be read one by one, and lists of other properties."""
    lists = [f"property list uchar uchar l{k}" for k in range(3)]
    scalars = [f"property uchar s{k}" for k in range(250)]
    head = ply_head("binary_big_endian", "element vertex 1", *XYZ, "element face 65000", *lists, *scalars, INDICES)
    row = bytes(3 + 250)
    return "ply", filled(size, head + bytes(12) + row + b"\4" + bytes(16), row + b"\3" + bytes(12))


@hostile
def ply_of_one_list(size: int) -> tuple[str, bytes]:
    head = ply_head(
        "binary_little_endian", "element vertex 1", *XYZ, "element face 1", "property list uint uchar vertex_indices"
    )
    return "ply", filled(size, head + bytes(12) + struct.pack("<I", size - 500), b"\0")


@hostile
def stl_of_triangles(size: int) -> tuple[str, bytes]:
    count = (size - 84) // 50
    return "stl", bytes(80) + struct.pack("<I", count) + bytes(50 * count)


@hostile
def stl_that_boasts(size: int) -> tuple[str, bytes]:
    return "stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(size - 84)


def archive(
    members: dict[str, bytes],
    method: int = zipfile.ZIP_DEFLATED,
    patch: tuple[int, int, str] | None = None,
    before: bytes = b"",
) -> bytes:
    """An archive; ``patch`` (offset, value, struct type) changes a field in all entries of its directory.

    The members are added to the archive ``before``.
    """
    buffer = io.BytesIO(before)
    with zipfile.ZipFile(buffer, "a", method, compresslevel=1) as file:
        for name, content in members.items():
            file.writestr(name, content)
    data = bytearray(buffer.getvalue())
    place = data.find(b"PK\x01\x02") if patch else -1
    while patch and place >= 0:
        struct.pack_into(patch[2], data, place + patch[0], patch[1])
        place = data.find(b"PK\x01\x02", place + 4)
    return bytes(data)


def npy(shape: str, data: bytes = b"", kind: str = "<f8") -> bytes:
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x02\x00" + struct.pack("<I", len(text)) + text + data


ZEROS = npy("(2796202, 3)", bytes(64 * MIB))


def twice(member: bytes, method: int = zipfile.ZIP_DEFLATED, patch: tuple[int, int, str] | None = None) -> bytes:
    """An archive with the same member for vertices and faces."""
    return archive({"vertices.npy": member, "faces.npy": member}, method, patch)


HOSTILE |= {
    # 64 MiB of zeros, which deflate to 64 KiB; declared as a few bytes; and declared as encrypted.
    "npz_of_zeros": lambda _: ("npz", twice(ZEROS)),
    "npz_whose_directory_lies": lambda _: ("npz", twice(ZEROS, patch=(24, 1000, "<I"))),
    "npz_that_is_encrypted": lambda _: ("npz", twice(ZEROS, patch=(8, 1, "<H"))),
    "npz_whose_array_boasts": lambda _: ("npz", twice(npy(f"({10**17}, 3)", bytes(24)))),
    # A few entries of half a MiB each, which deflate well.
    "npz_of_long_text": lambda _: ("npz", twice(npy("(64, 3)", bytes(96 * MIB), f"<U{MIB // 8}"))),
    # A header of 96 MiB, which deflates to half a MiB.
    "npz_with_a_long_head": lambda _: (
        "npz",
        twice(b"\x93NUMPY\x02\x00" + struct.pack("<I", 96 * MIB) + bytes(96 * MIB)),
    ),
    "npz_of_many_dimensions": lambda _: ("npz", twice(npy("(" + "1," * 100_000 + ")"))),
    "npz_of_nested_dimensions": lambda _: ("npz", twice(npy("(" * 5000 + ")" * 5000))),
    "npz_of_no_values": lambda _: ("npz", twice(npy(f"({10**8}, 0, 3)"))),
    "npz_of_objects": lambda _: ("npz", twice(npy("(1000, 3)", bytes(24_000), "|O"))),
    "npz_with_a_long_name": lambda _: ("npz", archive({"a" * 60_000: b"", "vertices.npy": npy("(8, 3)", bytes(192))})),
    # LZMA allocates as much memory as its header declares.
    "npz_by_another_method": lambda _: ("npz", twice(npy("(10922, 3)", bytes(MIB // 4)), zipfile.ZIP_LZMA)),
}


@hostile
def npz_of_many_members(size: int) -> tuple[str, bytes]:
    """As many members as fit into the directory."""
    entry = struct.pack("<4s4B4HL2L5H2L", b"PK\1\2", 20, 3, 20, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0) + b"a"
    directory = entry * ((size - 100) // len(entry))
    return "npz", directory + struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 65535, 65535, len(directory), 0, 0)


@hostile
def npz_of_a_thousand_members(size: int) -> tuple[str, bytes]:
    """Each member unpacks to a header and a quarter of a MiB."""
    more = {f"{k}.npy": npy("(32768,)", bytes(MIB // 4)) for k in range(990)}
    small = {"vertices.npy": npy("(4, 3)", bytes(96)), "faces.npy": npy("(4, 3)", bytes(96), "<i8")}
    return "npz", archive(more | small)


@hostile
def json_of_one_wide_string(size: int) -> tuple[str, bytes]:
    """With one character outside the basic plane, every character of a Python string takes four bytes."""
    return "json", filled(min(size, 13 * MIB), b'{"name": "\xf0\x9f\x98\x80', b"a", b'"}')


@hostile
def json_with_an_escape(size: int) -> tuple[str, bytes]:
    """The same with ASCII escapes, and invalid at its end, so that the error contains the whole text."""
    return "json", filled(min(size, 13 * MIB), b'{"name": "\\ud83d\\ude00', b"a", b'"}}')


@hostile
def json_as_large_as_it_may_be(size: int) -> tuple[str, bytes]:
    rows, faces = b",".join([b"[1.23456789,2.3456789,3.456789]"] * 32_768), b",".join([b"[3234,3235,3236]"] * 65_536)
    return "json", b'{"name": "\xf0\x9f\x98\x80", "vertices": [' + rows + b'], "faces": [' + faces + b"]}"


@hostile
def glb_of_nodes(size: int) -> tuple[str, bytes]:
    return "glb", glb(document(nodes=[{"mesh": 0}] * 10**6, scenes=[{"nodes": list(range(10**6))}]), BINARY)


@hostile
def glb_of_many_places(size: int) -> tuple[str, bytes]:
    """As many nodes as JSON values are allowed, each with a transformation."""
    nodes: list[dict[str, object]] = [{"scale": [1, 2, 1], "translation": [k, 1, 2]} for k in range(24_000)]
    return "glb", glb(document(nodes=nodes, scenes=[{"nodes": list(range(len(nodes)))}]), BINARY)


@hostile
def glb_of_long_chain(size: int) -> tuple[str, bytes]:
    return "glb", chain(9_990)


@hostile
def glb_of_meshes_along_a_chain(size: int) -> tuple[str, bytes]:
    nodes = [{"matrix": MATRIX, "mesh": 0, "children": [k + 1]} for k in range(9_990)]
    return "glb", glb(document(nodes=[*nodes, {"mesh": 0}]), BINARY)


@hostile
def glb_of_one_name(size: int) -> tuple[str, bytes]:
    nodes = [{"name": "x", "mesh": 0} for _ in range(9_990)]
    return "glb", glb(document(nodes=nodes, scenes=[{"nodes": list(range(len(nodes)))}]), BINARY)


#: Members of a glTF document that a reader of surfaces may skip, by what they list.
SKIPPED: dict[str, object] = {
    "skins": {"joints": [0]}, "animations": {"channels": [{}]}, "materials": {}, "textures": {}, "cameras": {},
    "images": {"uri": "data:image/png;base64,AAAA"}, "extensionsUsed": "x",
}  # fmt: skip


def lengthy(member: str) -> Make:
    return lambda size: ("glb", glb(document(**{member: [SKIPPED[member]] * 30_000}), BINARY))


HOSTILE |= {f"glb_of_{member}": lengthy(member) for member in SKIPPED}


@hostile
def gltf_with_a_picture(size: int) -> tuple[str, bytes]:
    """A picture of half a gigapixel that is compressed to kilobytes."""
    picture = png_of(20_000, 1, 0, bytes(20_000 * 2_501))
    return "gltf", embedded(
        BINARY,
        images=[{"uri": "data:image/png;base64," + base64.b64encode(picture).decode()}] * 20,
        textures=[{"source": 0}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "material": 0}]}],
    )


@hostile
def glb_of_deep_json(size: int) -> tuple[str, bytes]:
    return "glb", glb(b"[" * (size - 100))


@hostile
def glb_of_small_values(size: int) -> tuple[str, bytes]:
    return "glb", glb(filled(min(size, 4 * MIB), b'{"extras": [', b'{"a":1},', b"1]}"))


@hostile
def glb_of_as_many_values_as_it_may_have(size: int) -> tuple[str, bytes]:
    text = json.dumps(document(extras=[{f"{k}": k / 7} for k in range(124_000)]), separators=(",", ":"))
    return "glb", glb(text.encode(), BINARY)


@hostile
def glb_of_a_wide_name(size: int) -> tuple[str, bytes]:
    return "glb", glb(filled(4 * MIB, b'{"extras": "\xf0\x9f\x98\x80', b"a", b'"}'), bytes(max(0, size - 5 * MIB)))


@hostile
def glb_of_vertices(size: int) -> tuple[str, bytes]:
    """An accessor to the whole buffer, used by a thousand primitives."""
    data = bytes(size - 3000)
    count = len(data) // 12
    tree = document(
        buffers=[{"byteLength": len(data)}],
        bufferViews=[{"buffer": 0, "byteLength": len(data)}],
        accessors=[{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": count // 3 * 3}],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}],
    )
    return "glb", glb(tree, data)


@hostile
def glb_of_nothing(size: int) -> tuple[str, bytes]:
    """Accessors of matrices without data."""
    tree = document(accessors=[{"componentType": 5126, "type": "MAT4", "count": 10**9}] * 2)
    return "glb", glb(tree, bytes(size - 3000))


@hostile
def gltf_of_one_buffer(size: int) -> tuple[str, bytes]:
    """A mesh whose data are at both ends of the largest possible buffer."""
    data = VERTICES.tobytes() + bytes((size - 3000) // 4 * 3 - len(BINARY)) + FACES.tobytes()
    places = (0, VERTICES.nbytes), (len(data) - FACES.nbytes, FACES.nbytes)
    return "gltf", embedded(data, bufferViews=[{"buffer": 0, "byteOffset": a, "byteLength": b} for a, b in places])


@hostile
def gltf_of_strides(size: int) -> tuple[str, bytes]:
    """Vertices with the largest stride allowed."""
    count = 32_000
    data = bytes(252 * count)
    return "gltf", embedded(
        data,
        bufferViews=[{"buffer": 0, "byteLength": len(data), "byteStride": 252}],
        accessors=[{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": count // 3 * 3}],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}],
    )


@hostile
def vtk_cells_larger_than_the_file(size: int) -> tuple[str, bytes]:
    """A legacy file of one polygon with two thousand million corners: VTK alone reads memory that isn't its own."""
    start = (
        b"# vtk DataFile Version 4.2\n\nBINARY\nDATASET POLYDATA\nPOINTS 4 float\n" + VERTICES.astype(">f4").tobytes()
    )
    corners = (size - len(start) - 64) // 4
    return "vtk", start + b"\nPOLYGONS 1 %d\n\x7f\xff\xff\xff" % corners + bytes(4 * corners - 4)


def _xml(points: int, block: bytes, blocks: int) -> bytes:
    """An XML file whose points are compressed: the same block again and again, of a mebibyte of zeros each."""
    head = struct.pack(f"<{3 + blocks}I", blocks, MIB, 0, *[len(block)] * blocks)
    text = base64.b64encode(head) + base64.b64encode(block * blocks)
    return (
        b'<VTKFile type="PolyData" byte_order="LittleEndian" header_type="UInt32" compressor="vtkZLibDataCompressor">'
        b'<PolyData><Piece NumberOfPoints="%d" NumberOfPolys="1"><Points><DataArray type="Float32" format="binary" '
        b'NumberOfComponents="3">%b</DataArray></Points></Piece></PolyData></VTKFile>' % (points, text)
    )


@hostile
def vtp_of_zeros(size: int) -> tuple[str, bytes]:
    """A thousand times its size, of which it says so."""
    block = zlib.compress(bytes(MIB), 9)
    blocks = size // (len(block) + 4) * 3 // 4 - 8
    return "vtp", _xml(blocks * MIB // 12, block, blocks)


@hostile
def vtp_of_zeros_that_says_it_has_few(size: int) -> tuple[str, bytes]:
    block = zlib.compress(bytes(MIB), 9)
    return "vtp", _xml(2**15, block, size // (len(block) + 4) * 3 // 4 - 8)


@hostile
def vtp_of_blocks_that_are_not_there(size: int) -> tuple[str, bytes]:
    block = zlib.compress(bytes(MIB), 9)
    text = _xml(2**15, block, 1)
    head = base64.b64encode(struct.pack("<4I", 1, MIB, 0, len(block)))
    return "vtp", text.replace(head, base64.b64encode(struct.pack("<4I", 2**32 - 1, 2**32 - 1, 2**32 - 1, size)))
