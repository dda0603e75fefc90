"""Writer of glTF 2.0: still and animated shapes, as GLB or as JSON with the buffer inside.

The writer of trimesh has no animations. Every mesh that the server sends as glTF comes from this module.
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
from shapespace.files.colouring import Colouring
from shapespace.mesh.attributes import NONE, MeshAttributes, SurfaceMaterial, linear
from shapespace.mesh.triangle_mesh import vertex_normals
from shapespace.mesh.vectors import dots

FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 5126, 5123, 5125
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
#: Default material. Without one, viewers assume bare metal, which is black if there is nothing to reflect.
MATERIAL = {
    "name": "clay",
    "doubleSided": True,
    "pbrMetallicRoughness": {
        "baseColorFactor": [0.72, 0.76, 0.82, 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.75,
    },
}
#: Material of meshes with vertex colours, which viewers multiply with the colour of the material.
WHITE = MATERIAL | {"name": "coloured", "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.75}}


def surface_normals(vertices: FloatArray, surface: MeshAttributes) -> FloatArray:
    """Return unit normals (N, 3) of a shape (V, 3), in the order of `MeshAttributes.normal_corners`."""
    corners = None if surface.shading is None else surface.normal_corners[surface.triangle_corners]
    return _filled(vertex_normals(vertices, surface.triangles, corners))


def _filled(normals: FloatArray) -> FloatArray:
    """Replace zero normals, where face normals cancel out: the format requires unit vectors."""
    normals[dots(normals, normals) < 0.5] = 0.0, 0.0, 1.0
    return normals


def picture_type(data: bytes) -> str:
    """Return the media type of a PNG or JPEG picture."""
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


class _TriangleGroup(NamedTuple):
    """Indices of the triangles with one object and one material; NONE for no object or no material."""

    object: int
    material: int
    triangles: IntArray


def _triangle_groups(surface: MeshAttributes, *, objects: bool, materials: bool) -> list[_TriangleGroup]:
    """Group the triangles of a surface by object, by material, or by both."""
    count = len(surface.triangle_polygons)
    of_objects = surface.objects.of if objects and surface.objects else None
    of_materials = surface.material_of if materials else None
    nothing, of_polygon = np.full(count, NONE), surface.triangle_polygons
    columns = [nothing if of is None else of[of_polygon] for of in (of_objects, of_materials)]
    # Sorting one number for each pair is much faster than sorting pairs.
    width = int(columns[1].max()) + 2
    pairs, of = np.unique(columns[0] * width + columns[1], return_inverse=True)
    found = []
    for k, pair in enumerate(pairs.tolist()):
        object, material = divmod(pair + 1, width)
        found.append(_TriangleGroup(object, material - 1, np.flatnonzero(of == k)))
    return found


class GltfBuilder:
    """Builder of a glTF document. Each object of the surface is a mesh on a node; all meshes share one set of arrays.

    Args:
        vertices: (V, 3) positions at rest, in any unit.
        faces: (F, 3).
        name: name of the mesh and its node, if the surface has no names.
        colouring: colours of the vertices, instead of materials. The legend goes into the mesh's ``extras``.
        surface: polygons, texture coordinates and materials, if any. A vertex with several texture coordinates or
            normals is repeated; the attribute _VERTEX then has the index of the vertex.
        joined: whether all objects are one mesh, with one set of sliders.

    Attributes:
        nodes: number of nodes.
        rows: (V',) index of the vertex for each vertex of the document.
    """

    def __init__(
        self,
        vertices: FloatArray,
        faces: IntArray,
        colouring: Colouring | None = None,
        surface: MeshAttributes | None = None,
        *,
        name: str = "shape",
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
        #: Members that all primitives have. There is one primitive for each material.
        self.primitive: dict[str, Any] = {"attributes": attributes}
        #: Members that all meshes have.
        self.mesh: dict[str, Any] = {}
        colors = colouring.linear if colouring else None
        if colouring:
            self.mesh["extras"] = {"color": colouring.legend}
        elif surface and surface.colors is not None:
            colors = linear(surface.colors)
        if surface:
            if surface.split.uv is not None:
                # The origin of glTF's texture coordinates is the upper left corner.
                uv = surface.split.uv * [1, -1] + [0, 1]
                attributes["TEXCOORD_0"] = self.add(uv, target=ARRAY_BUFFER)
            labels = None if joined else surface.objects
            several = labels is not None and len(np.unique(labels.of)) > 1
            if several or len(self.rows) > len(vertices):
                # As real numbers, because attributes can't be integers of this size (3.7.2.1).
                attributes["_VERTEX"] = self.add(self.rows.astype(np.float32), target=ARRAY_BUFFER)
        if colors is not None:
            attributes["COLOR_0"] = self.add(colors[self.rows], target=ARRAY_BUFFER)
        self.tree: dict[str, Any] = {"asset": {"version": "2.0", "generator": "shapespace"}, "scene": 0}
        plain = MATERIAL if colors is None else WHITE
        self.tree["materials"] = [plain]
        triangles = faces if surface is None else surface.split.faces
        pieces = [_TriangleGroup(NONE, NONE, np.arange(0))]
        if surface:
            pieces = _triangle_groups(surface, objects=not joined, materials=not colouring)
            used = sorted({piece.material for piece in pieces})
            if used != [NONE]:
                pictures = self._pictures(surface, {surface.materials[k].texture for k in used if k != NONE})
                looks = [plain if k == NONE else _material(surface.materials[k], pictures) for k in used]
                self.tree["materials"] = looks
        else:
            used = [NONE]
        #: Primitives by the index of their object.
        self._primitives: dict[int, list[dict[str, int]]] = {}
        for piece in pieces:
            some = triangles if len(pieces) == 1 else triangles[piece.triangles]
            indices = self.add(some.ravel(), target=ELEMENT_ARRAY_BUFFER)
            primitive = {"indices": indices, "material": used.index(piece.material)}
            self._primitives.setdefault(piece.object, []).append(primitive)
        given = surface and surface.objects
        first = given.names[0] if given else name
        self._names = [given.names[k] if given and k != NONE else first for k in self._primitives]
        self.nodes = len(self._names)
        self.tree["scenes"] = [{"nodes": [*range(self.nodes)]}]
        self.tree["nodes"] = [{"name": own, "mesh": k} for k, own in enumerate(self._names)]

    def normals(self, vertices: FloatArray) -> FloatArray:
        """Return normals (V', 3) of a shape (V, 3) at the vertices of the document."""
        if self._surface is None:
            return _filled(vertex_normals(vertices, self._faces))
        return surface_normals(vertices, self._surface)[self._surface.split.normal]

    def _pictures(self, surface: MeshAttributes, names: set[str | None]) -> dict[str | None, int]:
        """Add the textures; return their indices by name."""
        found = sorted(name for name in names if name is not None)
        if found:
            data = [surface.textures[name] for name in found]
            self.tree["images"] = [
                {"name": name, "mimeType": picture_type(picture), "bufferView": self._view(picture)}
                for name, picture in zip(found, data, strict=True)
            ]
            self.tree["textures"] = [{"source": k} for k in range(len(found))]
        return {name: k for k, name in enumerate(found)}

    def _view(self, data: bytes, target: int | None = None) -> int:
        """Append bytes; return the index of their buffer view."""
        view = {"buffer": 0, "byteOffset": self._size, "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.views.append(view)
        # Pictures can have any length, and arrays need an alignment of four bytes.
        self._chunks += [data, bytes(-len(data) % 4)]
        self._size += len(data) + -len(data) % 4
        return len(self.views) - 1

    def add(self, array: NDArray, *, bounds: bool = False, target: int | None = None) -> int:
        """Append an array of scalars or vectors; return the index of its accessor.

        Numbers become float32. Indices become uint16 where they fit; the largest uint16 is reserved (3.7.2.1).
        """
        component, dtype = FLOAT, "<f4"
        if np.issubdtype(array.dtype, np.integer):
            short = array.max(initial=0) < np.iinfo(np.uint16).max
            component, dtype = (UNSIGNED_SHORT, "<u2") if short else (UNSIGNED_INT, "<u4")
        data = np.ascontiguousarray(array, dtype)
        accessor: dict[str, Any] = {
            "bufferView": self._view(data.tobytes(), target),
            "componentType": component,
            "count": len(data),
            "type": "SCALAR" if data.ndim == 1 else f"VEC{data.shape[1]}",
        }
        if bounds:
            # From float32 values, because rounding could put a position outside the bounds. Contiguous components are
            # twenty times as fast as rows of three.
            components = np.ascontiguousarray(data.reshape(len(data), -1).T)
            accessor["min"], accessor["max"] = (e(components, axis=1).astype(float).tolist() for e in (np.min, np.max))
        self.accessors.append(accessor)
        return len(self.accessors) - 1

    def add_targets(
        self,
        moves: Iterable[NDArray],
        normals: Iterable[NDArray],
        names: Sequence[str] = (),
        colors: Iterable[NDArray] | None = None,
    ) -> None:
        """Add morph targets, whose weights at rest are 0.

        Args:
            moves: for each target the change (V, 3) of the positions.
            normals: for each target the change (V', 3) of the normals at the vertices of the document.
            names: names of the targets, if any.
            colors: for each target the change (V, 3) of the colours, if there are colours.
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
        """Return the document as one binary file."""
        binary = b"".join(self._chunks)
        text = self._json({"byteLength": len(binary)})
        text += b" " * (-len(text) % 4)
        header = struct.pack("<4sIII4s", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary), len(text), b"JSON")
        return b"".join([header, text, struct.pack("<I4s", len(binary), b"BIN\0"), binary])

    def gltf(self) -> bytes:
        """Return the document as JSON, with the buffer as a data URI."""
        binary = b"".join(self._chunks)
        uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
        return self._json({"byteLength": len(binary), "uri": uri})


def write_glb(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as GLB; see `MeshFormat.encode`."""
    return GltfBuilder(vertices, faces, colouring, surface).glb()


def write_gltf(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as glTF with its buffer inside; see `MeshFormat.encode`."""
    return GltfBuilder(vertices, faces, colouring, surface).gltf()
