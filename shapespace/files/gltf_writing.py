"""Writer of glTF 2.0: one mesh, still or animated, as GLB or as JSON with its buffer inside.

Written here because trimesh writes no animations, and because every served mesh passes through it.
"""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import components, cross, dot
from shapespace.files.colouring import Colouring

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
#: Vertex colours are multiplied with the material's.
WHITE = MATERIAL | {
    "name": "coloured",
    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.75},
}


def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Unit normals (V, 3) at the vertices of a shape (V, 3): means of the face normals, weighted by area."""
    x, corners = components(vertices), np.ascontiguousarray(faces.T)
    a, b, c = (x.take(corner, axis=1) for corner in corners)
    by_face = cross(b - a, c - a)
    normals = np.empty((len(vertices), 3))
    for axis, normal in enumerate(by_face):
        normals[:, axis] = np.bincount(corners.ravel(), np.tile(normal, 3), minlength=len(vertices))
    length = np.sqrt(dot(normals.T, normals.T))
    # A vertex whose faces cancel out has no normal, but the format insists on a unit vector.
    normals[length == 0] = 0.0, 0.0, 1.0
    normals /= np.where(length > 0, length, 1)[:, None]
    return normals


class Document:
    """A glTF document with one mesh on one node, filled from arrays.

    Args:
        vertices: (V, 3) positions at rest, in any unit.
        faces: (F, 3).
        name: of the mesh and its node.
        colouring: of the vertices; its legend goes into the mesh's extras.
    """

    def __init__(
        self, vertices: FloatArray, faces: IntArray, name: str = "shape", colouring: Colouring | None = None
    ) -> None:
        self._chunks: list[bytes] = []
        self.accessors: list[dict[str, Any]] = []
        self.views: list[dict[str, Any]] = []
        self.primitive: dict[str, Any] = {
            "attributes": {
                "POSITION": self.add(vertices, bounds=True, target=ARRAY_BUFFER),
                "NORMAL": self.add(vertex_normals(vertices, faces), target=ARRAY_BUFFER),
            },
            "indices": self.add(faces.ravel(), target=ELEMENT_ARRAY_BUFFER),
            "material": 0,
        }
        self.mesh: dict[str, Any] = {"name": name, "primitives": [self.primitive]}
        if colouring:
            self.primitive["attributes"]["COLOR_0"] = self.add(colouring.linear, target=ARRAY_BUFFER)
            self.mesh["extras"] = {"color": colouring.legend}
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "shapespace"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": name, "mesh": 0}],
            "meshes": [self.mesh],
            "materials": [WHITE if colouring else MATERIAL],
        }

    def add(self, array: NDArray, *, bounds: bool = False, target: int | None = None) -> int:
        """Append an array, scalars or 3-vectors, and return the index of its accessor."""
        indices = np.issubdtype(array.dtype, np.integer)
        data = np.ascontiguousarray(array, dtype="<u4" if indices else "<f4")
        accessor: dict[str, Any] = {
            "bufferView": len(self.views),
            "componentType": UNSIGNED_INT if indices else FLOAT,
            "count": len(data),
            "type": "SCALAR" if data.ndim == 1 else "VEC3",
        }
        if bounds:
            # As float32, or rounding could leave a position outside its own bounds.
            accessor["min"], accessor["max"] = (
                np.atleast_1d(extreme(data, axis=0)).astype(float).tolist() for extreme in (np.min, np.max)
            )
        view = {"buffer": 0, "byteOffset": sum(map(len, self._chunks)), "byteLength": data.nbytes}
        if target is not None:
            view["target"] = target
        self.views.append(view)
        self.accessors.append(accessor)
        self._chunks.append(data.tobytes())
        return len(self.accessors) - 1

    def _json(self, buffer: dict[str, Any]) -> bytes:
        tree = {**self.tree, "accessors": self.accessors, "bufferViews": self.views, "buffers": [buffer]}
        return json.dumps(tree, separators=(",", ":")).encode()

    def glb(self) -> bytes:
        """The document as one binary file."""
        # Every array has components of four bytes, so the buffer needs no padding.
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
