"""Writer of glTF 2.0: a shape, still or animated, as GLB or as JSON with its buffer inside.

Written here because trimesh writes no animations, and because every served mesh passes through it.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import components, cross, dot
from shapespace.files.colouring import Colouring
from shapespace.mesh.attributes import NONE, MeshAttributes, SurfaceMaterial, linear

FLOAT, UNSIGNED_INT = 5126, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
#: Without a material a viewer assumes bare metal, which is black where there is nothing to reflect.
MATERIAL = {
    "name": "clay",
    "doubleSided": True,
    "pbrMetallicRoughness": {
        "baseColorFactor": [0.72, 0.76, 0.82, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.75,
    },
}
#: For meshes with vertex colours, which are multiplied with the material's colour.
WHITE = MATERIAL | {
    "name": "coloured",
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.75},
}


def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Unit normals (V, 3) at the vertices of a shape (V, 3): means of the face normals, weighted by area."""
    return _normals(vertices, faces, faces, len(vertices))


def surface_normals(vertices: FloatArray, surface: MeshAttributes) -> FloatArray:
    """Unit normals (N, 3) of a shape (V, 3) by the numbers of `MeshAttributes.normal_corners`."""
    count = int(max(surface.normal_corners.max() + 1, len(vertices) if surface.shading is None else 0))
    return _normals(vertices, surface.triangles, surface.normal_faces, count)


def _normals(vertices: FloatArray, faces: IntArray, normal_faces: IntArray, count: int) -> FloatArray:
    """Means (count, 3) of the normals of faces (F, 3), of those whose corners have one number there, (F, 3)."""
    x, corners = components(vertices), np.ascontiguousarray(faces.T)
    a, b, c = (x.take(corner, axis=1) for corner in corners)
    by_face, into = cross(b - a, c - a), normal_faces.T.ravel()
    normals = np.empty((count, 3))
    for axis, normal in enumerate(by_face):
        normals[:, axis] = np.bincount(into, np.tile(normal, 3), minlength=count)
    length = np.sqrt(dot(normals.T, normals.T))
    # A vertex whose faces cancel out has no normal, but the format insists on a unit vector.
    normals[length == 0] = 0.0, 0.0, 1.0
    normals /= np.where(length > 0, length, 1)[:, None]
    return normals


def picture_type(data: bytes) -> str:
    """The media type of a picture, which is PNG or JPEG."""
    return "image/png" if data.startswith(b"\x89PNG") else "image/jpeg"


def _material(material: SurfaceMaterial, pictures: dict[str | None, int]) -> dict[str, Any]:
    look: dict[str, Any] = {
        "baseColorFactor": [*material.color],
        "metallicFactor": material.metallic,
        "roughnessFactor": material.roughness,
    }
    if material.texture is not None:
        look["baseColorTexture"] = {"index": pictures[material.texture]}
    found: dict[str, Any] = {"name": material.name, "doubleSided": True, "pbrMetallicRoughness": look}
    return found | ({"alphaMode": "BLEND"} if material.color[3] < 1 else {})


class _Piece(NamedTuple):
    """The triangles of one object and one material, NONE for none."""

    object: int
    material: int
    triangles: IntArray


def _pieces(surface: MeshAttributes, *, objects: bool, materials: bool) -> list[_Piece]:
    """Of a surface, told apart by these or not."""
    count = len(surface.triangle_polygons)
    of_objects = surface.objects.of if objects and surface.objects else None
    of_materials = surface.material_of if materials else None
    columns = [
        np.full(count, NONE) if of is None else of[surface.triangle_polygons] for of in (of_objects, of_materials)
    ]
    # One number for each pair: sorting these is much faster than sorting pairs.
    width = int(columns[1].max()) + 2
    pairs, of = np.unique(columns[0] * width + columns[1], return_inverse=True)
    found = []
    for k, pair in enumerate(pairs.tolist()):
        object, material = divmod(pair + 1, width)
        found.append(_Piece(object, material - 1, np.flatnonzero(of == k)))
    return found


class GltfBuilder:
    """A glTF document with a mesh on a node for each object of the surface, filled from arrays that all share.

    Args:
        vertices: (V, 3) positions at rest, in any unit.
        faces: (F, 3).
        name: of the mesh and its node, where the surface has none.
        colouring: of the vertices, instead of materials; its legend goes into the mesh's extras.
        surface: of the mesh. Vertices that have several texture coordinates or normals are there for each of them; the
            attribute _VERTEX numbers them then.
        joined: whether all objects are one mesh, with one set of sliders.

    Attributes:
        nodes: number of these.
        rows: (V',) the vertex that each vertex of the document is.
    """

    def __init__(
        self,
        vertices: FloatArray,
        faces: IntArray,
        name: str = "shape",
        colouring: Colouring | None = None,
        surface: MeshAttributes | None = None,
        *,
        joined: bool = False,
    ) -> None:
        self._chunks: list[bytes] = []
        self._size = 0
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self._faces, self._surface = faces, surface
        self.rows = np.arange(len(vertices)) if surface is None else surface.split.vertex
        attributes = {
            "POSITION": self.add(vertices[self.rows], bounds=True, target=ARRAY_BUFFER),
            "NORMAL": self.add(self.normals(vertices), target=ARRAY_BUFFER),
        }
        #: Common to all primitives; there is one for each material.
        self.primitive: dict[str, Any] = {"attributes": attributes}
        #: Common to all meshes.
        self.mesh: dict[str, Any] = {}
        colors = colouring.linear if colouring else None
        if colouring:
            self.mesh["extras"] = {"color": colouring.legend}
        elif surface and surface.colors is not None:
            colors = linear(surface.colors)
        if surface:
            if surface.split.uv is not None:
                # From the upper left.
                uv = surface.split.uv * [1, -1] + [0, 1]
                attributes["TEXCOORD_0"] = self.add(uv, target=ARRAY_BUFFER)
            labels = None if joined else surface.objects
            several = labels is not None and len(np.unique(labels.of)) > 1
            if several or len(self.rows) > len(vertices):
                # As real numbers: integers of that size are not allowed here (3.7.2.1).
                attributes["_VERTEX"] = self.add(self.rows.astype(np.float32), target=ARRAY_BUFFER)
        if colors is not None:
            attributes["COLOR_0"] = self.add(colors[self.rows], target=ARRAY_BUFFER)
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "shapespace"}, "scene": 0}
        plain = MATERIAL if colors is None else WHITE
        self.tree["materials"] = [plain]
        triangles = faces if surface is None else surface.split.faces
        pieces = [_Piece(NONE, NONE, np.arange(0))]
        if surface:
            pieces = _pieces(surface, objects=not joined, materials=not colouring)
            used = sorted({piece.material for piece in pieces})
            if used != [NONE]:
                pictures = self._pictures(surface, {surface.materials[k].texture for k in used if k != NONE})
                looks = [plain if k == NONE else _material(surface.materials[k], pictures) for k in used]
                self.tree["materials"] = looks
        else:
            used = [NONE]
        #: Primitives by the index of the object that they belong to.
        self._primitives: dict[int, list[dict[str, int]]] = {}
        for piece in pieces:
            some = triangles if len(pieces) == 1 else triangles[piece.triangles]
            primitive = {"indices": self._indices(some), "material": used.index(piece.material)}
            self._primitives.setdefault(piece.object, []).append(primitive)
        given = surface and surface.objects
        first = given.names[0] if given else name
        self._names = [given.names[k] if given and k != NONE else first for k in self._primitives]
        self.nodes = len(self._names)
        self.tree["scenes"] = [{"nodes": [*range(self.nodes)]}]
        self.tree["nodes"] = [{"name": own, "mesh": k} for k, own in enumerate(self._names)]

    def normals(self, vertices: FloatArray) -> FloatArray:
        """(V', 3) normals of a shape (V, 3) at the document's vertices."""
        if self._surface is None:
            return vertex_normals(vertices, self._faces)
        return surface_normals(vertices, self._surface)[self._surface.split.normal]

    def _indices(self, faces: IntArray) -> int:
        return self.add(faces.ravel(), target=ELEMENT_ARRAY_BUFFER)

    def _pictures(self, surface: MeshAttributes, names: set[str | None]) -> dict[str | None, int]:
        """Numbers of the textures by name."""
        found = sorted(name for name in names if name is not None)
        if found:
            self.tree["images"] = [
                {"name": name, "mimeType": picture_type(surface.textures[name]), "bufferView": self._view(data)}
                for name in found
                for data in [surface.textures[name]]
            ]
            self.tree["textures"] = [{"source": k} for k in range(len(found))]
        return {name: k for k, name in enumerate(found)}

    def _view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes and return the number of their view."""
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.views.append(view)
        # Pictures are of any length, and arrays have components of four bytes.
        self._chunks += [data, bytes(-len(data) % 4)]
        self._size += len(data) + -len(data) % 4
        return len(self.views) - 1

    def add(self, array: NDArray, *, bounds: bool = False, target: int | None = None) -> int:
        """Append an array, scalars or vectors, and return the index of its accessor."""
        indices = np.issubdtype(array.dtype, np.integer)
        data = np.ascontiguousarray(array, dtype="<u4" if indices else "<f4")
        accessor: dict[str, Any] = {
            "bufferView": self._view(data.tobytes(), target),
            "componentType": UNSIGNED_INT if indices else FLOAT,
            "count": len(data),
            "type": "SCALAR" if data.ndim == 1 else f"VEC{data.shape[1]}",
        }
        if bounds:
            # As float32, or rounding could leave a position outside its own bounds. By components that lie together:
            # twenty times as fast as over rows of three.
            components = np.ascontiguousarray(data.reshape(len(data), -1).T)
            accessor["min"], accessor["max"] = (
                extreme(components, axis=1).astype(float).tolist() for extreme in (np.min, np.max)
            )
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_targets(
        self,
        moves: Iterable[NDArray],
        normals: Iterable[NDArray],
        names: Sequence[str] = (),
        colors: Iterable[NDArray] | None = None,
    ) -> None:
        """Add morph targets, at rest with weights 0.

        Args:
            moves: of each (V, 3) what it adds to the positions.
            normals: of each (V', 3) what it adds to the normals of the document's vertices.
            names: of each, where they have some.
            colors: of each (V, 3) what it adds to the colours, where there are some.
        """
        self.primitive["targets"] = [
            {
                "POSITION": self.add(move[self.rows], bounds=True, target=ARRAY_BUFFER),
                "NORMAL": self.add(normal, target=ARRAY_BUFFER),
            }
            for move, normal in zip(moves, normals, strict=True)
        ]
        for target, change in zip(self.primitive["targets"], colors or (), strict=colors is not None):
            target["COLOR_0"] = self.add(change[self.rows], target=ARRAY_BUFFER)
        self.mesh["weights"] = [0.0] * len(self.primitive["targets"])
        if names:
            self.mesh.setdefault("extras", {})["targetNames"] = [*names]

    def _json(self, buffer: dict[str, Any]) -> bytes:
        entries = [
            {"name": name, **self.mesh, "primitives": [{**self.primitive, **one} for one in primitives]}
            for name, primitives in zip(self._names, self._primitives.values(), strict=True)
        ]
        lists = {"meshes": entries, "accessors": self.accessors, "bufferViews": self.views, "buffers": [buffer]}
        return json.dumps({**self.tree, **lists}, separators=(",", ":")).encode()

    def glb(self) -> bytes:
        """The document as one binary file."""
        binary = b"".join(self._chunks)
        text = self._json({"byteLength": len(binary)})
        text += b" " * (-len(text) % 4)
        header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
        return b"".join(
            [
                header,
                struct.pack("<I4s", len(text), b"JSON"),
                text,
                struct.pack("<I4s", len(binary), b"BIN\0"),
                binary,
            ]
        )

    def gltf(self) -> bytes:
        """The document as JSON, with its buffer as a data URI."""
        binary = b"".join(self._chunks)
        uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
        return self._json({"byteLength": len(binary), "uri": uri})


def write_glb(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as GLB; see `formats.MeshWriter`."""
    return GltfBuilder(vertices, faces, colouring=colouring, surface=surface).glb()


def write_gltf(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as glTF with its buffer inside; see `formats.MeshWriter`."""
    return GltfBuilder(vertices, faces, colouring=colouring, surface=surface).gltf()
