"""Which format a file has, by its first bytes, its name, its media type or, last, by the lines of a text."""

from __future__ import annotations

import re
import struct
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import PurePath
from types import MappingProxyType

from shapespace.files.limits import as_utf8, clipped, label
from shapespace.files.mni_reading import is_mni
from shapespace.mesh.triangle_mesh import MeshError

#: Bytes at the start of a file in which its format is looked for.
START = 2**16
#: Media types that senders use for any file. They say nothing about the format.
_ANY_TYPE = ("", "text/plain", "application/octet-stream", "binary/octet-stream", "application/x-www-form-urlencoded")
_NUMBER = rb"[-+]?[\d.][\d.eE+-]*"
#: The start of files by format.
_MAGIC = {
    "glb": rb"glTF",
    "gltf": rb'\s*\{(?s:.*?)"asset"\s*:\s*\{',
    "ply": rb"(?i:ply)\s",
    "stl": rb"\s*(?i:solid\b(?s:.*?)\bfacet\s+normal\s)",
    "off": rb"\s*(?:#[^\n]*\n\s*)*(?i:(?:ST)?[CN]{0,2}OFF)[\s\d]",
    "pcd": rb"#\s*\.PCD\b|VERSION\s+[\d.]+\s+FIELDS\s",
    "vtk": rb"#\s*vtk DataFile",
    "vtu": rb"\s*(?:<\?xml[^>]*>\s*)?<VTKFile\b[^>]*[\"']UnstructuredGrid[\"']",
    "vtp": rb"\s*(?:<\?xml[^>]*>\s*)?<VTKFile\b",
}
#: The start of files that are no meshes, or that are not read.
_FOREIGN = {
    "a PNG picture": rb"\x89PNG",
    "a JPEG picture": rb"\xff\xd8\xff",
    "a PDF document": rb"%PDF",
    "a web page: download the file itself": rb"\s*(?i:<!doctype html|<html)",
    "packed by gzip: unpack it first": rb"\x1f\x8b",
    "packed by bzip2: unpack it first": rb"BZh\d1AY",
    "packed by xz: unpack it first": rb"\xfd7zXZ",
    "packed by Zstandard: unpack it first": rb"\x28\xb5\x2f\xfd",
    "a 7z archive: unpack it first": rb"7z\xbc\xaf",
    "a RAR archive: unpack it first": rb"Rar!\x1a",
    "one NumPy array: save vertices and faces together by numpy.savez": rb"\x93NUMPY",
    "a USD file, which can be written but not read: save it as GLB or OBJ": rb"PXR-USDC|#usda",
    "an FBX file: save it as GLB or OBJ": rb"Kaydara FBX|; FBX",
    "a Blender file: export it as GLB or OBJ": rb"BLENDER",
    "a COLLADA file: save it as GLB or OBJ": rb"\s*(?:<\?xml[^>]*>\s*)?<COLLADA\b",
    "a GIFTI surface: save it as PLY or OBJ": rb"\s*(?:<\?xml[^>]*>\s*)?(?:<!DOCTYPE GIFTI[^>]*>\s*)?<GIFTI\b",
    "a FreeSurfer surface: save it as PLY or STL": rb"\xff\xff\xfe|#!ascii version of ",
    "a VRML file: save it as PLY or OBJ": rb"#VRML ",
    "an X3D file: save it as PLY or OBJ": rb"\s*(?:<\?xml[^>]*>\s*)?(?:<!DOCTYPE X3D[^>]*>\s*)?<X3D\b",
    "a Gmsh mesh: save it as STL or VTK": rb"\$MeshFormat\s",
    "a Medit mesh: save it as OBJ or PLY": rb"\s*MeshVersionFormatted\s",
    "a DXF drawing: save it as STL or OBJ": rb"(?:\s*999\r?\n[^\n]*\n)*\s*0\r?\n\s*SECTION\s",
    "a STEP file: save it as STL": rb"ISO-10303-21;",
    "a BVH motion without a mesh": rb"\s*HIERARCHY\s",
}
#: Members that come first in ZIP archives of other kinds.
_FOREIGN_MEMBERS = {
    "a USDZ file, which can be written but not read: save it as GLB or OBJ": rb".*\.usd[ac]?$",
    "a 3MF or an office file: save it as STL or OBJ": rb"\[Content_Types\]\.xml$|_rels/|3D/",
}
_VERTEX = re.compile(rb"^[ \t]*[vV](?:[ \t]+" + _NUMBER + rb"){3}", re.MULTILINE)
_POINT = re.compile(rb'^[ \t"]*' + _NUMBER + rb'(?:[\s",;]+' + _NUMBER + rb"){2}", re.MULTILINE)
#: A member's header in a ZIP archive: 26 bytes, then the length of its name, and the name 4 bytes later.
_ZIP, _NAME_LENGTH, _MEMBER_NAME = (b"PK\x03\x04", b"PK\x05\x06"), 26, 30
#: Binary STL: the place of the number of triangles, the bytes before the first triangle, and those of a triangle.
_STL_COUNT, _STL_HEADER, _STL_TRIANGLE = 80, 84, 50


class FormatError(MeshError):
    """The format of a file is unknown or not read. The message has no subject: "is a PNG picture"."""


@dataclass(frozen=True)
class Assumed:
    """The format of a file, and what it follows from."""

    name: str  # name of the format
    because: str  # noun that can stand in "as … says"


def decide(
    data: memoryview,
    formats: Collection[str],
    name: str = "",
    media_type: str = "",
    media_types: Mapping[str, str] = MappingProxyType({}),
) -> Assumed:
    """Return the format of a file.

    The first bytes decide, then the extension of its name, then its media type. Last, a text is recognised by its
    lines. Extensions and media types that tell no format don't count.

    Args:
        data: content of the file.
        formats: formats that can be read.
        name: name of the file; empty if it has none.
        media_type: declared media type; empty if there is none.
        media_types: formats by media type.

    Raises:
        FormatError: the format is unknown, or none of ``formats``.
    """
    suffix, media_type = PurePath(name).suffix.lstrip(".").lower(), media_type.lower()
    if found := _by_first_bytes(data):
        return _accepted(suffix if (found, suffix) == ("zip", "npz") else found, formats)
    if suffix in formats:
        return Assumed(suffix, "its name")
    if media_type not in _ANY_TYPE and media_types.get(media_type) in formats:
        return Assumed(media_types[media_type], "its media type")
    if found := _by_lines(data):
        return _accepted(found, formats)
    if suffix or media_type not in _ANY_TYPE:
        what = f".{label(suffix)} is not the extension" if suffix else f"{clipped(media_type)} is not the media type"
        raise FormatError(f"has no known format: {what} of a format that can be read")
    raise FormatError("has no known format: neither its content nor a name or a media type tells a format")


def _accepted(format: str, formats: Collection[str]) -> Assumed:
    if format in formats:
        return Assumed(format, "its content")
    if format == "zip":
        raise FormatError("is a ZIP archive: unpack it first")
    raise FormatError("has points and no faces" if format == "xyz" else f"is a {format} file, which is not read here")


def _by_first_bytes(data: memoryview) -> str | None:
    """Return the format that the first bytes tell, if any; raises FormatError for files that are not read."""
    start = bytes(data[:START])
    if start.startswith(_ZIP):
        return _archive(start)
    for kind, magic in _FOREIGN.items():
        if re.match(magic, start):
            raise FormatError(f"is {kind}")
    if len(data) > _STL_HEADER:
        (triangles,) = struct.unpack_from("<I", data, _STL_COUNT)
        if triangles and len(data) == _STL_HEADER + _STL_TRIANGLE * triangles:
            return "stl"
    text = _text(start)
    if is_mni(text):
        return "obj"
    return next((name for name, magic in _MAGIC.items() if re.match(magic, text)), None)


def _archive(start: bytes) -> str:
    """Return "npz" or "zip", by the first member of an archive."""
    length = int.from_bytes(start[_NAME_LENGTH : _NAME_LENGTH + 2], "little")
    member = start[_MEMBER_NAME : _MEMBER_NAME + length]
    for kind, name in _FOREIGN_MEMBERS.items():
        if re.match(name, member):
            raise FormatError(f"is {kind}")
    return "npz" if member.endswith(b".npy") else "zip"


def _by_lines(data: memoryview) -> str | None:
    """Return the format that a text seems to have."""
    text = _text(bytes(data[:START]))
    if b"\0" in text:
        return None
    if text.lstrip().startswith(b"{"):
        return "gltf" if re.search(rb'"asset"\s*:\s*\{', data) else "json"
    if _VERTEX.search(text):
        return "obj"
    return "xyz" if _POINT.search(text) else None


def _text(start: bytes) -> bytes:
    try:
        return bytes(as_utf8(memoryview(start)))
    except ValueError:  # no text
        return start
