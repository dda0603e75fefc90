"""Uploads that would cost far more than they weigh: refused before a parser of meshes sees them.

What a mesh in correspondence can need is known beforehand, from the model's own meshes, so that nothing has to be
unpacked, allocated or read to its end in order to find out that it is too much.
"""

from __future__ import annotations

import io
import re
import struct
import zipfile
from collections import Counter
from typing import Any

import orjson

from geometry.mesh import MeshError

#: Bytes of text, or of arrays, that a vertex or a face may take; and what a file may have beside them.
_OF_EACH, _BESIDE = 1000, 2**22
#: Most entries of a glTF file's lists: a rig has hundreds of nodes, and a mesh a primitive for each of its materials.
_NODES, _OTHERS = 10_000, 1000
_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
#: Pictures and buffers inside a glTF file take no parsing.
_EMBEDDED = re.compile(rb'"data:[^"]*"')


def refuse_bombs(data: bytes, format: str, vertices: int, faces: int) -> None:
    """Refuse a file that would unpack to, or need, more than a mesh of that size can.

    Args:
        data: the file.
        format: its format.
        vertices: of the largest mesh that it may hold.
        faces: of that.

    Raises:
        MeshError: with the reason.
    """
    most = _BESIDE + _OF_EACH * (vertices + faces)
    if format == "npz":
        _refuse_archive(data, most)
    elif format in ("glb", "gltf"):
        _refuse_gltf(data, format, most)
    elif len(data) > most:
        raise MeshError(f"it has {len(data)} bytes, where {most} are enough for {vertices} vertices and {faces} faces")


def _refuse_archive(data: bytes, most: int) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except Exception:  # damaged archives fail in many ways
        return  # whoever reads it will say so
    if size > most:
        raise MeshError(f"it unpacks to {size} bytes, where {most} are enough")


def _refuse_gltf(data: bytes, format: str, most: int) -> None:
    try:
        text = data[20 : 20 + struct.unpack_from("<I", data, 12)[0]] if format == "glb" else data
        described = len(_EMBEDDED.sub(b"", text))
        if described > most:
            raise MeshError(f"its description has {described} bytes, where {most} are enough")
        tree: dict[str, Any] = orjson.loads(text)
        for name, limit in (("nodes", _NODES), ("accessors", _OTHERS), ("meshes", _OTHERS), ("scenes", _OTHERS)):
            if len(tree.get(name, ())) > limit:
                raise MeshError(f"it holds {len(tree[name])} {name}; {limit} are the most")
        sizes = [_size(accessor) for accessor in tree["accessors"]]
        # Buffers may be shared by some accessors, and left out where there are zeros only.
        if sum(sizes) > 4 * len(data) + _BESIDE:
            raise MeshError(f"its accessors count {sum(sizes)} bytes, but the file has {len(data)}")
        places = Counter(node["mesh"] for node in tree.get("nodes", ()) if "mesh" in node)
        needed = parts = 0
        for k, mesh in enumerate(tree["meshes"]):
            for primitive in mesh["primitives"]:
                used = [*primitive["attributes"].values(), *([primitive["indices"]] if "indices" in primitive else [])]
                needed += max(1, places[k]) * sum(sizes[int(accessor)] for accessor in used)
                parts += max(1, places[k])
    except (ValueError, LookupError, TypeError, AttributeError, struct.error) as error:
        if isinstance(error, MeshError):
            raise
        raise MeshError(f"not a readable {format} file: damaged, or another kind of file") from None
    if needed > most or parts > _OTHERS:
        raise MeshError(f"its scene comes to {parts} parts and {needed} bytes, where {_OTHERS} and {most} are enough")


def _size(accessor: dict[str, Any]) -> int:
    """Bytes of an accessor's elements; a negative or broken count raises ValueError."""
    count = accessor["count"]
    if not isinstance(count, int) or count < 0:
        raise ValueError
    return count * _COMPONENTS[accessor["type"]] * _BYTES[accessor["componentType"]]
