"""Reader of glTF 2.0: the triangles of a scene at rest, from GLB or from JSON with its data inside or beside it.

The size of a scene is known before any of its data are unpacked, and each node is visited once. Skins, morph targets,
animations, cameras and lights are left out, and so is how it looks; what would change the triangles and isn't known
here is refused. Sections named in comments are those of the Khronos Group's glTF 2.0 specification.
"""

from __future__ import annotations

import binascii
import json
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits, clipped
from shapespace.mesh.triangle_mesh import MeshError

#: Most primitives, counted at each of their places, and most levels of nodes.
_MOST_PARTS, _DEEPEST = 1000, 100
#: Extensions that a file may require: the first one is implemented; those with the other prefixes change no triangle.
_QUANTIZATION = "KHR_mesh_quantization"
_APPEARANCE = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_")
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_POSITIONS, _INDICES = (5120, 5121, 5122, 5123, 5126), (5121, 5123, 5125)
#: Component types of attributes whose elements are integers: glTF allows no larger ones there (3.7.2.1).
_NUMBERS = (5121, 5123, 5126)
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_LONGEST_STRIDE = 252
_DATA = re.compile(rb'"(data:[^"\\]*+)"')


def read_gltf(
    data: memoryview, limits: Limits, *, binary: bool, beside: Path | None = None
) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) and faces (F, 3) of the default scene, its primitives one after the other.

    Vertices that the attribute _VERTEX numbers are in that order, those of one number once. Arguments and errors are
    those of `open_scene`.
    """
    scene = open_scene(data, limits, binary=binary, beside=beside)
    return scene.vertices, scene.faces


def open_scene(data: memoryview, limits: Limits, *, binary: bool, beside: Path | None = None) -> Scene:
    """The default scene of a file.

    Args:
        data: the file.
        limits: of the whole scene.
        binary: whether it is GLB.
        beside: path of the file, where buffers in files beside it may be read.

    Raises:
        MeshError: too large, too deep, no mesh or more than one, or something that isn't read; with the reason.
        Exception: of any kind, where the file is damaged.
    """
    text, chunk = _chunks(data) if binary else (data, None)
    tree, uris = _parse(text)
    document = GltfDocument(tree)
    buffers = Buffers(document.buffers, chunk, uris, beside)
    return Scene(document, buffers, limits)


def _chunks(data: memoryview) -> tuple[memoryview, memoryview | None]:
    """JSON and data of a GLB file (4.4)."""
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    if (magic, kind) != (b"glTF", b"JSON"):
        raise ValueError("damaged, or another kind of file")
    if version != 2:
        raise MeshError(f"it is GLB {version}, and 2 is read")
    if not 20 + size <= length <= len(data):
        raise ValueError(f"it says {length} bytes, and has {len(data)}")
    text, rest = data[20 : 20 + size], data[20 + size : length]
    if len(rest) < 8:
        return text, None
    size, kind = struct.unpack_from("<I4s", rest)
    if size > len(rest) - 8:
        raise ValueError("it is cut short")
    return text, rest[8 : 8 + size] if kind == b"BIN\0" else None


def _parse(text: memoryview) -> tuple[dict[str, Any], list[memoryview]]:
    """The JSON, and the data URIs that were inside: in their place stands ``data:`` with their number."""
    pieces: list[bytes | memoryview] = []
    uris: list[memoryview] = []
    place = 0
    for match in _DATA.finditer(text):
        start, stop = match.span(1)
        pieces += [text[place:start], b"data:%d" % len(uris)]
        uris.append(text[start:stop])
        place = stop
    tree = json.loads(b"".join([*pieces, text[place:]]))
    if not isinstance(tree, dict):
        raise ValueError("its JSON is no object")
    return tree, uris


class GltfDocument:
    """The parts of the JSON that describe triangles, once they are known to be what they should be."""

    def __init__(self, tree: dict[str, Any]) -> None:
        self.tree = tree
        version = clipped(tree.get("asset", {}).get("version", "2.0"))
        if version.partition(".")[0] != "2":
            raise MeshError(f"it is glTF {version}, and 2 is read")
        required = [name for name in tree.get("extensionsRequired", []) if name != _QUANTIZATION]
        unknown = [name for name in required if not name.startswith(_APPEARANCE)]
        if unknown:
            raise MeshError(f"it requires {clipped(', '.join(unknown))}, which is not read: export it without")
        kinds = ("buffers", "bufferViews", "accessors", "meshes", "nodes", "scenes")
        self.buffers, self.views, self.accessors, self.meshes, self.nodes, self.scenes = (
            _objects(tree, kind) for kind in kinds
        )
        self._scene = tree.get("scene", 0)

    def roots(self) -> list[int]:
        """The nodes that the default scene begins with; without scenes those that lie in no other."""
        inner = set[int]()
        for node in self.nodes:
            for child in node.get("children", []):
                if child in inner:
                    raise MeshError(f"its node {clipped(child)} lies in two others")
                inner.add(child)
        if not self.scenes:
            return [k for k in range(len(self.nodes)) if k not in inner]
        roots: list[int] = _entry(self.scenes, self._scene).get("nodes", [])
        if len(set(roots)) < len(roots) or inner & set(roots):
            raise MeshError("a node of its scene lies in another one, or is there twice")
        return roots

    def places(self) -> Iterator[tuple[int, FloatArray | None]]:
        """The meshes of the scene by their numbers, each with the matrix (4, 4) of its place, none for the identity."""
        if not self.nodes:
            yield from ((k, None) for k in range(len(self.meshes)))
        # The last root first: the order in which this project has always read files.
        waiting: list[tuple[int, FloatArray | None, int]] = [(root, None, 1) for root in self.roots()]
        while waiting:
            number, outer, depth = waiting.pop()
            if depth > _DEEPEST:
                raise MeshError(f"its nodes lie more than {_DEEPEST} deep in each other")
            node = _entry(self.nodes, number)
            inner = _matrix(node)
            place = outer if inner is None else inner if outer is None else outer @ inner
            waiting += [(child, place, depth + 1) for child in node.get("children", [])]
            if "mesh" in node:
                yield node["mesh"], place


def _objects(tree: dict[str, Any], name: str) -> list[dict[str, Any]]:
    entries = tree.get(name, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError(f"its {name} are no list of objects")
    return entries


def _entry(entries: list[dict[str, Any]], index: object) -> dict[str, Any]:
    return entries[_whole(index)]


def _whole(value: object) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"{clipped(value)} stands where a whole number should")
    return value


def _matrix(node: dict[str, Any]) -> FloatArray | None:
    """The transformation of a node (4, 4), none for the identity (3.5.3)."""
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
        if (given[3] != [0, 0, 0, 1]).any():
            raise ValueError("the last row of a matrix is not 0, 0, 0, 1")
        matrix = given @ matrix
    return None if np.array_equal(matrix, np.eye(4)) else matrix


def _rotation(x: float, y: float, z: float, w: float) -> FloatArray:
    """The rotation (3, 3) of a quaternion of any length."""
    turned = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), w * w - x * x + y * y - z * z, 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), w * w - x * x - y * y + z * z],
    ]
    return np.array(turned) / (x * x + y * y + z * z + w * w)


def _numbers(value: object, length: int) -> FloatArray:
    numbers = np.array(value, np.float64)
    if numbers.shape != (length,):
        raise ValueError(f"{length} numbers are needed in a node, not {clipped(value)}")
    return numbers


@dataclass(frozen=True)
class Accessor:
    """Elements of one type, and where they lie (3.6.2).

    Attributes:
        buffer: which one.
        start: first byte there.
        stride: bytes from one element to the next.
        count: of elements.
        dtype: of their components.
        width: how many components an element has.
        normalized: whether integers stand for numbers from 0 or −1 to 1.
    """

    buffer: int
    start: int
    stride: int
    count: int
    dtype: np.dtype
    width: int
    normalized: bool

    @classmethod
    def of(cls, document: GltfDocument, index: object, kind: str, components: tuple[int, ...]) -> Accessor:
        """One of the accessors, which must be of that kind and have such components."""
        accessor = _entry(document.accessors, index)
        if "sparse" in accessor:
            raise MeshError(f"its accessor {index} is sparse, which is not read: export every value")
        if "bufferView" not in accessor:
            raise MeshError(f"its accessor {index} has no data")
        if accessor["type"] != kind or accessor["componentType"] not in components:
            raise ValueError(f"its accessor {index} is of another type than it has to be")
        dtype, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[kind]
        number, size = _whole(accessor["count"]), width * dtype.itemsize
        view = _entry(document.views, accessor["bufferView"])
        stride, inside = _whole(view.get("byteStride", size)), _whole(accessor.get("byteOffset", 0))
        if not number or not size <= stride <= _LONGEST_STRIDE:
            raise ValueError(f"its accessor {index} has {number} elements, {stride} bytes apart")
        start, length = _whole(view.get("byteOffset", 0)), _whole(view["byteLength"])
        buffer = _whole(view["buffer"])
        if (
            inside + (number - 1) * stride + size > length
            or start + length > _whole(_entry(document.buffers, buffer)["byteLength"])
        ):  # fmt: skip
            raise ValueError(f"its accessor {index} has {number} elements, which is more than there are data")
        return cls(buffer, start + inside, stride, number, dtype, width, accessor.get("normalized", False) is True)

    def real(self, buffers: Buffers) -> FloatArray:
        """(count, width), as the numbers that they stand for."""
        given = self.read(buffers)
        values = given.astype(np.float64)
        if self.normalized and given.dtype.kind != "f":
            values /= np.iinfo(given.dtype).max
            np.maximum(values, -1, out=values)
        return values

    def read(self, buffers: Buffers) -> NDArray:
        """(count, width), as they are."""
        size = self.width * self.dtype.itemsize
        content = buffers.read(self.buffer, self.start, self.start + (self.count - 1) * self.stride + size)
        return np.ndarray((self.count, self.width), self.dtype, content, 0, (self.stride, self.dtype.itemsize))


class Buffers:
    """Where the bytes of a document are: in the file's own data, in its JSON, or in files beside it (3.6.1).

    Nothing is opened or decoded before it is read, and then only as much as is read.
    """

    def __init__(
        self, entries: list[dict[str, Any]], chunk: memoryview | None, uris: list[memoryview], beside: Path | None
    ) -> None:
        self._sources: list[memoryview | Path | None] = []
        self._encoded, self._uris = set[int](), uris
        for k, entry in enumerate(entries):
            uri = entry.get("uri")
            if uri is None:
                self._sources.append(chunk if k == 0 else None)
            elif uri.startswith("data:"):
                whole = self.text(uri)
                header, comma, _ = bytes(whole[:1000]).partition(b",")
                if not comma or not header.endswith(b";base64"):
                    raise ValueError("it has data that aren't base64")
                self._encoded.add(k)
                self._sources.append(whole[len(header) + 1 :])
            else:
                self._sources.append(_beside(unquote(uri), beside))

    def text(self, uri: str) -> memoryview:
        """The data URI that one in the JSON stands for."""
        return self._uris[int(uri[5:])] if uri[5:].isdecimal() else memoryview(uri.encode())

    def read(self, index: int, start: int, stop: int) -> bytes | memoryview:
        """Bytes of a buffer; raises ValueError where it ends before."""
        source = self._sources[index]
        content: bytes | memoryview
        if source is None:
            raise ValueError(f"its buffer {index} has no data")
        if isinstance(source, Path):
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


def _beside(name: str, path: Path | None) -> Path:
    """A file in the same folder as that one or below; raises ValueError where there is none."""
    inside = PurePosixPath(name)
    if path is None or inside.is_absolute() or ".." in inside.parts or not (path.parent / inside).is_file():
        raise ValueError(f"it needs {clipped(name)}, which is not beside it")
    return path.parent / inside


class Scene:
    """The triangles of a scene.

    Args:
        document: of the file.
        buffers: its data.
        limits: of the whole scene.

    Attributes:
        parts: its primitives, each at its place.
        read: those whose vertices are listed, one after the other; the others are on the vertices of one of them.
        vertices: (V, 3).
        faces: (F, 3), of the parts one after the other.
        corners: (F, 3) the vertices as they are listed.
        first: (V,) the first of these that each vertex is.
    """

    def __init__(self, document: GltfDocument, buffers: Buffers, limits: Limits) -> None:
        self.document, self.buffers, self.parts = document, buffers, _parts(document)
        numbered = all(part.numbers for part in self.parts)
        # Our own files have a part for each material, on the same vertices.
        sources = [(part.positions, part.numbers) if numbered and part.place is None else k
                   for k, part in enumerate(self.parts)]  # fmt: skip
        self.read = [self.parts[sources.index(source)] for source in dict.fromkeys(sources)]
        limits.check(sum(part.positions.count for part in self.read), sum(part.most_faces for part in self.parts))
        begins = np.cumsum([0, *(part.positions.count for part in self.read)])
        place = dict(zip(dict.fromkeys(sources), begins.tolist(), strict=False))
        listed = np.concatenate([part.vertices(buffers) for part in self.read])
        parts = zip(sources, self.parts, strict=True)
        self.corners = np.concatenate([place[source] + part.faces(buffers) for source, part in parts])
        numbers = self._numbers(len(listed)) if numbered else None
        self.first = np.arange(len(listed)) if numbers is None else np.unique(numbers, return_index=True)[1]
        self.vertices = listed[self.first]
        self.faces = self.corners if numbers is None else numbers[self.corners]
        if numbers is not None and not np.array_equal(listed, self.vertices[numbers], equal_nan=True):
            raise MeshError("its _VERTEX has one number for vertices at different places")

    def _numbers(self, count: int) -> IntArray:
        """(count,) the attribute _VERTEX."""
        values = np.concatenate([part.numbers.read(self.buffers).ravel() for part in self.read if part.numbers])
        if not ((values >= 0) & (values < count) & (values == np.floor(values))).all():
            raise MeshError("its _VERTEX has entries that number no vertex")
        numbers = values.astype(np.int64)
        there = np.zeros(numbers.max() + 1, bool)
        there[numbers] = True
        if not there.all():
            raise MeshError(f"its _VERTEX leaves out the number {int(there.argmin())}")
        return numbers


@dataclass(frozen=True)
class PlacedPrimitive:
    """A primitive at one of its places (3.7.2).

    Attributes:
        positions: of its vertices.
        indices: of its corners, one after the other where there are none.
        numbers: the attribute _VERTEX, if it has one.
        mode: what the corners make.
        place: matrix (4, 4), none for the identity.
        primitive: what the file says of it.
        mesh: what the file says of the mesh that it belongs to.
    """

    positions: Accessor
    indices: Accessor | None
    numbers: Accessor | None
    mode: int
    place: FloatArray | None
    primitive: dict[str, Any]
    mesh: dict[str, Any]

    @property
    def corners(self) -> int:
        """How many there are."""
        return (self.indices or self.positions).count

    @property
    def most_faces(self) -> int:
        """How many faces there are at most: some of a strip may have no area."""
        return self.corners // 3 if self.mode == _TRIANGLES else max(0, self.corners - 2)

    def vertices(self, buffers: Buffers) -> FloatArray:
        """(count, 3) where they stand."""
        vertices = self.positions.real(buffers)
        if self.place is not None:
            # Coordinates that aren't finite are for the caller to judge.
            with np.errstate(all="ignore"):
                vertices = vertices @ self.place[:3, :3].T + self.place[:3, 3]
        return vertices

    def faces(self, buffers: Buffers) -> IntArray:
        """(F, 3), numbered from the first of these vertices."""
        count = self.positions.count
        if self.indices is None:
            corners = np.arange(count)
        else:
            corners = self.indices.read(buffers).ravel().astype(np.int64)
            if corners.max() >= count:
                raise MeshError(
                    f"faces name vertices {corners.min()} to {corners.max()}, but there are {count} vertices"
                )
        if self.mode == _TRIANGLES:
            faces = corners.reshape(-1, 3)
        else:
            first = corners[:-2] if self.mode == _STRIP else np.full(len(corners) - 2, corners[0])
            faces = np.stack([first, corners[1:-1], corners[2:]], axis=1)
            if self.mode == _STRIP:
                faces[1::2] = faces[1::2, [0, 2, 1]]
            # Strips are joined by triangles without area.
            faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        mirrored = self.place is not None and np.linalg.det(self.place[:3, :3]) < 0
        return faces[:, ::-1] if mirrored else faces


def _parts(document: GltfDocument) -> list[PlacedPrimitive]:
    """Every primitive of the scene at each of its places."""
    parts: list[PlacedPrimitive] = []
    for number, place in document.places():
        primitives = _objects(_entry(document.meshes, number), "primitives")
        for primitive in primitives:
            if len(parts) == _MOST_PARTS:
                raise MeshError(f"its scene comes to more than {_MOST_PARTS} parts")
            parts.append(_part(document, primitive, place, document.meshes[number]))
    if not parts:
        raise MeshError("holds no mesh")
    return parts


def _part(
    document: GltfDocument, primitive: dict[str, Any], place: FloatArray | None, mesh: dict[str, Any]
) -> PlacedPrimitive:
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        raise MeshError("has points or lines: export triangles only")
    positions = Accessor.of(document, primitive["attributes"]["POSITION"], "VEC3", _POSITIONS)
    indices = None
    if "indices" in primitive:
        indices = Accessor.of(document, primitive["indices"], "SCALAR", _INDICES)
    numbers = None
    if "_VERTEX" in primitive["attributes"]:
        numbers = Accessor.of(document, primitive["attributes"]["_VERTEX"], "SCALAR", _NUMBERS)
        if numbers.count != positions.count:
            raise ValueError(f"_VERTEX numbers {numbers.count} of {positions.count} vertices")
    part = PlacedPrimitive(positions, indices, numbers, mode, place, primitive, mesh)
    if part.corners < 3 or (mode == _TRIANGLES and part.corners % 3):
        raise ValueError(f"{part.corners} corners make no triangles")
    return part
