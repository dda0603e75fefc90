"""Reader of glTF 2.0: the triangles of the scene at rest.

Skins, morph targets, animations, cameras, lights and materials are ignored. A file is refused if it requires something
that would change the triangles and that is not read here. Each node is visited once, and the size of the scene is known
before its data are unpacked. Sections in comments are sections of the Khronos Group's glTF 2.0 specification.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.gltf_document import Accessor, Buffers, GltfDocument, entry_at, objects, read_document
from shapespace.files.limits import Limits
from shapespace.mesh.triangle_mesh import MeshError

#: Most primitives of a scene, counted at each of their places.
_MOST_PRIMITIVES = 1000
#: Modes of primitives that have triangles (3.7.2.1).
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Component types that positions and indices may have.
_POSITIONS, _INDICES = (5120, 5121, 5122, 5123, 5126), (5121, 5123, 5125)
#: Component types of attributes whose elements are integers: glTF allows no larger ones there (3.7.2.1).
_NUMBERS = (5121, 5123, 5126)


def read_gltf(
    data: memoryview, limits: Limits, *, binary: bool, beside: Path | None = None
) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of the default scene; arguments and errors as for `open_scene`.

    Primitives follow one another. If the attribute _VERTEX numbers the vertices, they are in the order of these
    numbers, and vertices with the same number are one.
    """
    scene = open_scene(data, limits, binary=binary, beside=beside)
    return scene.vertices, scene.faces


def open_scene(data: memoryview, limits: Limits, *, binary: bool, beside: Path | None = None) -> Scene:
    """Return the default scene of a file.

    Args:
        data: content of the file.
        limits: largest numbers of vertices and faces of the whole scene.
        binary: whether the file is GLB.
        beside: path of the file, if buffers in files beside it may be read.

    Raises:
        MeshError: the scene is too large or too deep, has no mesh, or has something that isn't read.
        Exception: the file is damaged; the class can be any.
    """
    document, buffers = read_document(data, binary=binary, beside=beside)
    return Scene(document, buffers, limits)


class Scene:
    """The triangles of a scene.

    The *listed* vertices are the vertices of the primitives in `read`, one primitive after the other. `vertices` has
    each listed vertex once.

    Attributes:
        parts: the primitives, each at one of its places.
        read: primitives with vertices of their own. The other primitives use the vertices of one of these.
        vertices: (V, 3).
        faces: (F, 3), one part after the other.
        corners: (F, 3) faces as indices of listed vertices.
        first: (V,) for each vertex the first listed vertex with its number.
    """

    def __init__(self, document: GltfDocument, buffers: Buffers, limits: Limits) -> None:
        self.document, self.buffers, self.parts = document, buffers, _placed_primitives(document)
        numbered = all(part.numbers for part in self.parts)
        # Files of this project have one primitive for each material, with common vertices.
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
        """Return the attribute _VERTEX of the listed vertices (count,)."""
        values = np.concatenate([part.numbers.read(self.buffers).ravel() for part in self.read if part.numbers])
        if not ((values >= 0) & (values < count) & (values == np.floor(values))).all():
            raise MeshError("its _VERTEX has entries that number no vertex")
        numbers = values.astype(np.int64)
        used = np.zeros(numbers.max() + 1, bool)
        used[numbers] = True
        if not used.all():
            raise MeshError(f"its _VERTEX leaves out the number {int(used.argmin())}")
        return numbers


@dataclass(frozen=True)
class PlacedPrimitive:
    """A primitive at one of its places (3.7.2)."""

    positions: Accessor  # accessor of the vertices
    indices: Accessor | None  # accessor of the corners; None if each vertex is one corner, in order
    numbers: Accessor | None  # accessor of the attribute _VERTEX, if any
    mode: int  # how the corners form triangles
    place: FloatArray | None  # matrix (4, 4) of the place; None for the identity
    primitive: dict[str, Any]  # entry of the primitive in the file
    mesh: dict[str, Any]  # entry of its mesh

    @property
    def corners(self) -> int:
        """Number of corners."""
        return (self.indices or self.positions).count

    @property
    def most_faces(self) -> int:
        """Upper bound of the number of faces: some faces of a strip may have no area."""
        return self.corners // 3 if self.mode == _TRIANGLES else max(0, self.corners - 2)

    def vertices(self, buffers: Buffers) -> FloatArray:
        """Return the vertices (count, 3) at this place."""
        vertices = self.positions.real(buffers)
        if self.place is not None:
            # The caller decides about coordinates that aren't finite.
            with np.errstate(all="ignore"):
                vertices = vertices @ self.place[:3, :3].T + self.place[:3, 3]
        return vertices

    def faces(self, buffers: Buffers) -> IntArray:
        """Return the faces (F, 3) as indices of the vertices of this primitive."""
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
            # Triangles without area join strips.
            faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        mirrored = self.place is not None and np.linalg.det(self.place[:3, :3]) < 0
        return faces[:, ::-1] if mirrored else faces


def _placed_primitives(document: GltfDocument) -> list[PlacedPrimitive]:
    """Return every primitive of the scene, once for each of its places."""
    found: list[PlacedPrimitive] = []
    for number, place in document.placed_meshes():
        mesh = entry_at(document.meshes, number)
        for primitive in objects(mesh, "primitives"):
            if len(found) == _MOST_PRIMITIVES:
                raise MeshError(f"its scene comes to more than {_MOST_PRIMITIVES} parts")
            found.append(_placed_primitive(document, primitive, place, mesh))
    if not found:
        raise MeshError("holds no mesh")
    return found


def _placed_primitive(
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
