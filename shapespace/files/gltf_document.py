"""Document of a glTF 2.0 file, from GLB or JSON: the tree of its JSON, and the data that accessors refer to.

Sections in comments are sections of the Khronos Group's glTF 2.0 specification.
"""

from __future__ import annotations

import binascii
import json
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, cast
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.files.archives import Place
from shapespace.files.limits import clipped
from shapespace.mesh.triangle_mesh import MeshError

#: Most levels of nodes. Programs that model write far fewer.
_MOST_LEVELS = 100
#: Extensions that change no triangle, so that a file may require them.
_APPEARANCE = re.compile(
    "VRM|MSFT_texture|(KHR|EXT)_(materials|texture|lights|xmp|audio|animation_pointer|mesh_(features|manifold)|struct)"
)
#: Extension that allows positions as integers. It is implemented here.
_QUANTIZATION = "KHR_mesh_quantization"
#: NumPy types of component types, and components of element types (3.6.2.2).
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
#: Largest ``byteStride`` (3.6.2.4).
_LARGEST_STRIDE = 252
_DATA_URI = re.compile(rb'"(data:[^"\\]*+)"')


def read_document(data: memoryview, *, binary: bool, beside: Place | None) -> tuple[GltfDocument, Buffers]:
    """Return the JSON of a file and its buffers, see `gltf_reading.open_scene`."""
    text, chunk = _chunks(data) if binary else (data, None)
    tree, uris = _parse(text)
    document = GltfDocument(tree)
    return document, Buffers(document.buffers, chunk, uris, beside)


def can_be_posed(path: Path) -> bool:
    """Whether a file has morph targets or skins, so that it describes more shapes than one; False if it is damaged."""
    try:
        document, _ = read_document(memoryview(path.read_bytes()), binary=path.suffix.lower() == ".glb", beside=None)
        primitives = (primitive for mesh in document.meshes for primitive in objects(mesh, "primitives"))
        return any("skin" in node for node in document.nodes) or any(each.get("targets") for each in primitives)
    except Exception:  # the readers of the mesh say what is wrong
        return False


def _chunks(data: memoryview) -> tuple[memoryview, memoryview | None]:
    """Split a GLB file into its JSON and its data (4.4)."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, kind) != (b"glTF", b"JSON"):
        raise ValueError("damaged, or another kind of file")
    if version != 2:
        raise MeshError(f"it has GLB version {version}, but only version 2 can be read")
    if not 20 + size <= length <= len(data):
        raise ValueError(f"it should have {length} bytes, but has {len(data)}")
    text, rest = memoryview(bytes(data[20 : 20 + size]).rstrip(b"\0")), data[20 + size : length]  # zeros may follow
    if len(rest) < 8:
        return text, None
    size, kind = struct.unpack_from("<I4s", rest)
    if size > len(rest) - 8:
        raise ValueError("it is cut short")
    return text, rest[8 : 8 + size] if kind == b"BIN\0" else None


def _parse(text: memoryview) -> tuple[dict[str, Any], list[memoryview]]:
    """Parse JSON without its data URIs, which can be much longer than the rest.

    Returns:
        The JSON object, with ``data:K`` in place of data URI K, and the data URIs.
    """
    pieces: list[bytes | memoryview] = []
    uris: list[memoryview] = []
    place = 0
    for match in _DATA_URI.finditer(text):
        start, stop = match.span(1)
        pieces += [text[place:start], b"data:%d" % len(uris)]
        uris.append(text[start:stop])
        place = stop
    content = b"".join([*pieces, text[place:]])
    # Some programs write null for what is not there.
    tree = json.loads(content, object_hook=lambda o: {k: o[k] for k in o if o[k] is not None}, parse_float=_number)
    if not isinstance(tree, dict):
        raise ValueError("its JSON is not an object")
    return tree, uris


def _number(text: str) -> float:
    """Return a number; some programs write 3.0 for 3."""
    return int(value) if (value := float(text)).is_integer() else value


class GltfDocument:
    """The parts of the JSON that describe triangles.

    Attributes:
        tree: the whole JSON object.
        buffers, views, accessors, meshes, nodes, skins: entries of the members with these names.

    Raises:
        MeshError: the file is not glTF 2, or requires an extension that is not read.
        ValueError: one of these members is not a list of objects.
    """

    def __init__(self, tree: dict[str, Any]) -> None:
        self.tree = tree
        if str(tree.get("asset", {}).get("version", "2.0")).partition(".")[0] != "2":
            raise MeshError("it has another version of glTF, but only version 2 can be read")
        required = [name for name in tree.get("extensionsRequired", []) if name != _QUANTIZATION]
        unknown = [name for name in required if not _APPEARANCE.match(name)]
        if unknown:
            raise MeshError(
                f"it requires {clipped(', '.join(unknown))}, which can't be read: export it without this extension"
            )
        kinds = ("buffers", "bufferViews", "accessors", "meshes", "nodes", "skins", "scenes")
        self.buffers, self.views, self.accessors, self.meshes, self.nodes, self.skins, self._scenes = (
            objects(tree, kind) for kind in kinds
        )
        self._scene = tree.get("scene", 0)

    def roots(self) -> list[int]:
        """Return the root nodes of the default scene. Without scenes, these are all nodes that have no parent.

        Raises:
            MeshError: a node has two parents, or is a root and a child.
        """
        children = set[int]()
        for node in self.nodes:
            for child in node.get("children", []):
                if child in children:
                    raise MeshError("one of its nodes lies in two others")
                children.add(child)
        if not self._scenes:
            return [k for k in range(len(self.nodes)) if k not in children]
        roots: list[int] = entry_at(self._scenes, self._scene).get("nodes", [])
        if len(set(roots)) < len(roots) or children & set(roots):
            raise MeshError("a node of its scene lies in another one, or is there twice")
        return roots

    def placed_meshes(self) -> Iterator[PlacedMesh]:
        """Yield the meshes of the scene in the order of its nodes, each as its node poses it."""
        if not self.nodes:
            yield from (PlacedMesh(mesh, {}, None, {}) for mesh in self.meshes)
        places: dict[int, FloatArray | None] = {}
        waiting: list[tuple[int, FloatArray | None, int]] = [(root, None, 1) for root in reversed(self.roots())]
        while waiting:
            number, outer, depth = waiting.pop()
            if depth > _MOST_LEVELS:
                raise MeshError(f"its nodes are nested more than {_MOST_LEVELS} deep")
            node = entry_at(self.nodes, number)
            inner = _matrix(node)
            places[number] = outer if inner is None else inner if outer is None else outer @ inner
            waiting += [(child, places[number], depth + 1) for child in reversed(node.get("children", []))]
        for number, place in places.items():
            node = self.nodes[number]
            if "mesh" in node:
                yield PlacedMesh(entry_at(self.meshes, node["mesh"]), node, place, places)


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A mesh with the node that places it.

    Attributes:
        mesh: entry of the mesh.
        node: entry of the node; empty if the file has no nodes.
        place: matrix (4, 4) of the node in the scene; None for the identity.
        places: the same of every node of the scene, by its index.
    """

    mesh: dict[str, Any]
    node: dict[str, Any]
    place: FloatArray | None
    places: Mapping[int, FloatArray | None]

    def joint_place(self, number: int) -> FloatArray:
        """Return the matrix (4, 4) of a joint; raises ValueError if it is not in the scene."""
        if number not in self.places:
            raise ValueError("a joint of its skin is not a node of the scene")
        place = self.places[number]
        return np.eye(4) if place is None else place


def objects(tree: dict[str, Any], name: str) -> list[dict[str, Any]]:
    """Return a member that is a list of objects; raises ValueError if it is something else."""
    entries = tree.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"its {name} are not a list of objects")
    return entries


def entry_at(entries: list[dict[str, Any]], index: object) -> dict[str, Any]:
    """Return the entry at an index; raises ValueError if it is not an index of an entry."""
    number = _natural(index)
    if number >= len(entries):
        raise ValueError(f"it refers to entry {number} of a list that has {len(entries)}, counted from 0")
    return entries[number]


def _natural(value: object) -> int:
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError("something else stands where a whole number from 0 should")
    return value


def _matrix(node: dict[str, Any]) -> FloatArray | None:
    """Return the matrix (4, 4) of a node, or None for the identity (3.5.3)."""
    if not node.keys() & {"matrix", "translation", "rotation", "scale"}:
        return None
    matrix = np.eye(4)
    if "rotation" in node:
        matrix[:3, :3] = _rotation(*_numbers(node["rotation"], 4))
    if "scale" in node:
        matrix[:3, :3] *= _numbers(node["scale"], 3)
    if "translation" in node:
        matrix[:3, 3] = _numbers(node["translation"], 3)
    if "matrix" in node:
        given = _numbers(node["matrix"], 16).reshape(4, 4).T
        if not np.allclose(given[3], [0, 0, 0, 1], atol=1e-5):
            raise ValueError("the last row of a matrix is not 0, 0, 0, 1")
        matrix = given @ matrix
    return None if np.array_equal(matrix, np.eye(4)) else matrix


def _rotation(x: float, y: float, z: float, w: float) -> FloatArray:
    """Return the rotation matrix (3, 3) of a quaternion of any length."""
    rotation = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z],
    ]
    return np.array(rotation) / (x * x + y * y + z * z + w * w)


def _numbers(value: object, length: int) -> FloatArray:
    numbers = np.array(value, np.float64)
    if numbers.shape != (length,):
        raise ValueError(f"{length} numbers are needed in a node, not something else")
    return numbers


@dataclass(frozen=True)
class Accessor:
    """Location and type of an array of elements (3.6.2)."""

    buffer: int | None  # index of the buffer; None for elements that are zero
    start: int  # offset of the first byte in the buffer
    stride: int  # bytes from one element to the next
    count: int  # number of elements
    dtype: np.dtype  # type of the components
    width: int  # number of components in an element
    normalized: bool  # whether integers stand for numbers between 0 or −1 and 1
    sparse: tuple[Accessor, Accessor] | None = None  # indices of elements that are replaced, and their values

    @classmethod
    def of(cls, document: GltfDocument, index: object, kind: str, components: tuple[int, ...]) -> Accessor:
        """Return an accessor of a document that has this element type, and one of these component types.

        Raises:
            MeshError: the accessor has no data.
            ValueError: it has another type, or more elements than there are data.
        """
        accessor = entry_at(document.accessors, index)
        if "bufferView" not in accessor and "sparse" not in accessor:
            raise MeshError(f"its accessor {index} has no data")
        if accessor["type"] != kind or accessor["componentType"] not in components:
            raise ValueError(f"its accessor {index} has a wrong type")
        normalized = accessor.get("normalized", False) is True
        count, sparse = _natural(accessor["count"]), accessor.get("sparse")
        if "bufferView" in accessor:
            found = cls._in_view(document, accessor, accessor["componentType"], kind, count, f"accessor {index}")
        else:
            found = cls(None, 0, 0, count, np.dtype(_DTYPES[accessor["componentType"]]), _WIDTHS[kind], False)
        pair = None
        if sparse is not None:
            number, where = _natural(sparse["count"]), f"sparse accessor {index}"
            indices, values = sparse["indices"], sparse["values"]
            pair = (
                cls._in_view(document, indices, indices["componentType"], "SCALAR", number, where),
                cls._in_view(document, values, accessor["componentType"], kind, number, where),
            )
        return replace(found, normalized=normalized, sparse=pair)

    @classmethod
    def _in_view(
        cls, document: GltfDocument, entry: dict[str, Any], component: int, kind: str, count: int, name: str
    ) -> Accessor:
        """Return the elements of an entry that has a buffer view."""
        dtype, width = np.dtype(_DTYPES[component]), _WIDTHS[kind]
        size = width * dtype.itemsize
        view = entry_at(document.views, entry["bufferView"])
        stride, inside = _natural(view.get("byteStride") or size), _natural(entry.get("byteOffset", 0))
        if not count or not size <= stride <= _LARGEST_STRIDE:
            raise ValueError(f"its {name} has {count} elements, {stride} bytes apart")
        start, length = _natural(view.get("byteOffset", 0)), _natural(view["byteLength"])
        buffer = _natural(view["buffer"])
        if (
            inside + (count - 1) * stride + size > length
            or start + length > _natural(entry_at(document.buffers, buffer)["byteLength"])
        ):  # fmt: skip
            raise ValueError(f"its {name} has {count} elements, but not enough data")
        return cls(buffer, start + inside, stride, count, dtype, width, normalized=False)

    def real(self, buffers: Buffers) -> FloatArray:
        """Return the elements (count, width) as float64; normalised integers become fractions."""
        given = self.read(buffers)
        values = given.astype(np.float64)
        if self.normalized and given.dtype.kind != "f":
            values /= np.iinfo(given.dtype).max
            np.maximum(values, -1, out=values)
        return values

    def read(self, buffers: Buffers) -> NDArray:
        """Return the elements (count, width) in the type of the file."""
        if self.buffer is None:
            elements: NDArray = np.zeros((self.count, self.width), self.dtype)
        else:
            size = self.width * self.dtype.itemsize
            content = buffers.read(self.buffer, self.start, self.start + (self.count - 1) * self.stride + size)
            strides = (self.stride, self.dtype.itemsize)
            elements = np.ndarray((self.count, self.width), self.dtype, content, 0, strides)
        if self.sparse is None:
            return elements
        indices, values = self.sparse
        elements = elements.copy()
        elements[indices.read(buffers).ravel()] = values.read(buffers)
        return elements


class Buffers:
    """Buffers of a document: in the data of a GLB file, in the JSON, or in files beside it (3.6.1).

    `read` opens files and decodes base64 only for the bytes that it returns.
    """

    def __init__(
        self, entries: list[dict[str, Any]], chunk: memoryview | None, uris: list[memoryview], beside: Place | None
    ) -> None:
        self._sources: list[memoryview | Place | None] = []
        self._encoded, self._uris = set[int](), uris
        for k, entry in enumerate(entries):
            uri = entry.get("uri")
            if uri is None:
                self._sources.append(chunk if k == 0 else None)
            elif uri.startswith("data:"):
                text = self.text(uri)
                header, comma, _ = bytes(text[:1000]).partition(b",")
                if not comma or not header.endswith(b";base64"):
                    raise ValueError("it has data that aren't base64")
                self._encoded.add(k)
                self._sources.append(text[len(header) + 1 :])
            else:
                self._sources.append(_beside(unquote(uri), beside))

    def text(self, uri: str) -> memoryview:
        """Return the data URI for a ``uri`` of the JSON, see `_parse`."""
        return self._uris[int(uri[5:])] if uri[5:].isdecimal() else memoryview(uri.encode())

    def read(self, index: int, start: int, stop: int) -> bytes | memoryview:
        """Return bytes of a buffer; raises ValueError if the buffer ends before ``stop``."""
        source = self._sources[index]
        content: bytes | memoryview
        if source is None:
            raise ValueError(f"its buffer {index} has no data")
        if isinstance(source, Place):
            with source.open("rb") as file:
                file.seek(start)
                content = file.read(stop - start)
        elif index in self._encoded:
            first, last = start // 3 * 4, -(-stop // 3) * 4
            decoded = binascii.a2b_base64(source[first:last], strict_mode=True)
            content = memoryview(decoded)[start % 3 :][: stop - start]
        else:
            content = source[start:stop]
        if len(content) < stop - start:
            raise ValueError(f"its buffer {index} ends before its data")
        return content


def _beside(name: str, path: Place | None) -> Place:
    """Return the path of a file in the folder of ``path`` or below; raises ValueError if there is none."""
    inside = PurePosixPath(name)
    if path is not None and not inside.is_absolute() and ".." not in inside.parts:
        found = cast("Place", path.parent).joinpath(str(inside))
        if found.is_file():
            return found
    raise ValueError(f"it needs {clipped(name)}, which is not beside it")
