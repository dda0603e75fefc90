"""Reader of glTF 2.0: the triangles of the scene as the file poses it.

Morph targets have the weights that the file gives them, and skins the pose of their joints. Animations, cameras, lights
and materials are ignored. A file is refused if it requires something that would change the triangles and that is not
read here. Each node is visited once, and the size of the scene is known before its data are unpacked. Sections in
comments are sections of the Khronos Group's glTF 2.0 specification.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, count
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.archives import Place
from shapespace.files.gltf_document import (
    Accessor,
    Buffers,
    GltfDocument,
    PlacedMesh,
    entry_at,
    objects,
    read_document,
)
from shapespace.files.limits import UNLIMITED, Limits, label
from shapespace.files.polygon_reading import strip_triangles
from shapespace.mesh.triangle_mesh import MeshError, require_vertices

#: Most primitives of a scene, counted at each of their places.
_MOST_PRIMITIVES = 1000
#: Modes of primitives that have triangles (3.7.2.1).
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
#: Modes of primitives that are points or lines.
_WITHOUT_FACES = (0, 1, 2, 3)
#: Component types that positions and indices may have.
_POSITIONS, _INDICES = (5120, 5121, 5122, 5123, 5126), (5121, 5123, 5125)
#: Component types of attributes whose elements are integers: glTF allows no larger ones there (3.7.2.1).
_NUMBERS = (5121, 5123, 5126)
#: Component types of joints and of their weights (3.7.3.3).
_JOINTS, _WEIGHTS = (5121, 5123), (5121, 5123, 5126)


def read_gltf(
    data: memoryview, limits: Limits, *, binary: bool, beside: Place | None = None
) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3) of the default scene; arguments and errors as for `open_scene`.

    Primitives follow one another. If the attribute _VERTEX numbers the vertices, they are in the order of these
    numbers, and vertices with the same number are one.
    """
    scene = open_scene(data, limits, binary=binary, beside=beside)
    return scene.vertices, scene.faces


def open_scene(data: memoryview, limits: Limits, *, binary: bool, beside: Place | None = None) -> Scene:
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


@dataclass(frozen=True, eq=False)
class MorphShapes:
    """Shapes of one file: the base, and each morph target with weight 1 alone.

    Attributes:
        names: names of the n shapes.
        vertices: (n, V, 3).
        faces: (F, 3), the same as `read_gltf` returns.
    """

    names: tuple[str, ...]
    vertices: FloatArray
    faces: IntArray


def read_morph_shapes(data: memoryview, *, binary: bool, beside: Place | None = None) -> MorphShapes:
    """Return the shapes of a file whose morph targets are shapes; arguments and errors as for `open_scene`.

    A target has the name that ``extras.targetNames`` of its mesh gives it, or else "target 1" and so on. Targets of
    several meshes that have one name make one shape. A mesh without such a target stays as it is at weight 0. Targets
    that move no vertices are left out. The first shape is called "base", or "base 2" if a target has that name. Skins
    and nodes pose every shape alike.

    Raises:
        MeshError: two targets of a mesh have one name.
    """
    document, buffers = read_document(data, binary=binary, beside=beside)
    scene = Scene(document, buffers, UNLIMITED, every_target=True)
    names = list(dict.fromkeys(target.name for part in scene.read for target in part.targets))
    base = next(name for name in chain(["base"], (f"base {k}" for k in count(2))) if name not in names)

    def alone(name: str) -> FloatArray:
        return scene.posed(lambda target: float(target.name == name))

    return MorphShapes((base, *names), np.stack([alone(name) for name in (base, *names)]), scene.faces)


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

    def __init__(self, document: GltfDocument, buffers: Buffers, limits: Limits, *, every_target: bool = False) -> None:
        """Read a scene, with all morph targets of ``parts`` if ``every_target``, or else the active ones."""
        self.document, self.buffers = document, buffers
        self.parts = _placed_primitives(document, every_target=every_target)
        numbered = all(part.numbers for part in self.parts)
        # Files of this project have one primitive for each material, with common vertices.
        still = [part.place is None and part.skin is None for part in self.parts]
        sources = [
            (part.positions, part.numbers, part.targets) if numbered and still[k] else k
            for k, part in enumerate(self.parts)
        ]
        self.read = [self.parts[sources.index(source)] for source in dict.fromkeys(sources)]
        limits.check(sum(part.positions.count for part in self.read), sum(part.most_faces for part in self.parts))
        begins = np.cumsum([0, *(part.positions.count for part in self.read)])
        place = dict(zip(dict.fromkeys(sources), begins.tolist(), strict=False))
        parts = zip(sources, self.parts, strict=True)
        self.corners = np.concatenate([place[source] + part.faces(buffers) for source, part in parts])
        self._numbers = self._vertex_numbers(int(begins[-1])) if numbered else None
        everyone = np.arange(begins[-1])
        self.first = everyone if self._numbers is None else np.unique(self._numbers, return_index=True)[1]
        self.faces = self.corners if self._numbers is None else self._numbers[self.corners]
        self.vertices = self.posed(lambda target: target.weight)

    def posed(self, weight: Callable[[MorphTarget], float]) -> FloatArray:
        """Return the vertices (V, 3) with a weight for each morph target.

        Raises:
            MeshError: _VERTEX has one number for vertices at different places.
        """
        listed = np.concatenate([part.vertices(self.buffers, weight) for part in self.read])
        if self._numbers is None:
            return listed
        vertices: FloatArray = listed[self.first]
        if not np.array_equal(listed, vertices[self._numbers], equal_nan=True):
            raise MeshError("its _VERTEX gives one number to vertices at different positions")
        return vertices

    def _vertex_numbers(self, count: int) -> IntArray:
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
class MorphTarget:
    """A morph target that moves vertices (3.7.2.2)."""

    moves: Accessor  # motion of each vertex at weight 1
    weight: float  # weight that the file gives it
    name: str  # its name, see `read_morph_shapes`; empty where only active targets are read


@dataclass(frozen=True)
class PlacedPrimitive:
    """A primitive as one node of the scene poses it (3.7.2)."""

    positions: Accessor  # accessor of the vertices
    indices: Accessor | None  # accessor of the corners; None if each vertex is one corner, in order
    numbers: Accessor | None  # accessor of the attribute _VERTEX, if any
    mode: int  # how the corners form triangles
    targets: tuple[MorphTarget, ...]  # morph targets, in the order of the file
    skin: Skin | None  # joints that move the vertices, if any
    place: FloatArray | None  # matrix (4, 4); None for the identity, and for a skin, whose node has no effect (3.7.3.3)
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

    def vertices(self, buffers: Buffers, weight: Callable[[MorphTarget], float]) -> FloatArray:
        """Return the vertices (count, 3) in the scene, with a weight for each morph target."""
        vertices = self.positions.real(buffers)
        # The caller decides about coordinates that aren't finite.
        with np.errstate(all="ignore"):
            for target in self.targets:
                if share := weight(target):
                    vertices += share * target.moves.real(buffers)
            if self.skin:
                return self.skin.posed(vertices, buffers)
            if self.place is not None:
                vertices = vertices @ self.place[:3, :3].T + self.place[:3, 3]
        return vertices

    def faces(self, buffers: Buffers) -> IntArray:
        """Return the faces (F, 3) as indices of the vertices of this primitive."""
        count = self.positions.count
        if self.indices is None:
            corners = np.arange(count)
        else:
            corners = self.indices.read(buffers).ravel().astype(np.int64)
            require_vertices(corners, count)
        if self.mode == _TRIANGLES:
            faces = corners.reshape(-1, 3)
        elif self.mode == _STRIP:
            faces = strip_triangles(corners, np.array([0, len(corners)]))
        else:
            faces = np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
            faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]  # without area
        matrices = self.skin.matrices(buffers) if self.skin else self.place
        mirrored = matrices is not None and (np.linalg.det(matrices[..., :3, :3]) < 0).all()
        return faces[:, ::-1] if mirrored else faces


@dataclass(frozen=True, eq=False)
class Skin:
    """Joints of a skin with their influence on the vertices of a primitive (3.7.3).

    Attributes:
        places: (J, 4, 4) matrices of the joints in the scene.
        inverse_bind: accessor of matrices (J, 16) that take the mesh to the joints; None for identities.
        joints, weights: accessors of sets of four joints for each vertex, and of their weights.
    """

    places: FloatArray
    inverse_bind: Accessor | None
    joints: tuple[Accessor, ...]
    weights: tuple[Accessor, ...]

    def matrices(self, buffers: Buffers) -> FloatArray:
        """Return the motion (J, 4, 4) of each joint from the mesh at rest to the scene."""
        if self.inverse_bind is None:
            return self.places
        inverse = self.inverse_bind.real(buffers)[: len(self.places)].reshape(-1, 4, 4)
        return self.places @ inverse.transpose(0, 2, 1)

    def posed(self, vertices: FloatArray, buffers: Buffers) -> FloatArray:
        """Return the vertices (count, 3) moved by the joints, by linear blend skinning."""
        matrices = self.matrices(buffers)
        joints = np.hstack([accessor.read(buffers) for accessor in self.joints])
        weights = np.hstack([accessor.real(buffers) for accessor in self.weights])
        if joints[weights != 0].max(initial=0) >= len(matrices):
            raise ValueError(f"its skin has {len(matrices)} joints, and a vertex names joint {joints.max()}")
        # Viewers normalise weights, and let the first joint carry a vertex that has none.
        weights[weights.sum(axis=1) == 0, 0] = 1.0
        weights /= weights.sum(axis=1, keepdims=True)
        posed = np.zeros_like(vertices)
        for joint, weight in zip(joints.T, weights.T, strict=True):
            used = np.flatnonzero(weight)
            moved = (
                np.einsum("nij,nj->ni", matrices[joint[used], :3, :3], vertices[used]) + matrices[joint[used], :3, 3]
            )
            posed[used] += weight[used, None] * moved
        return posed


def _placed_primitives(document: GltfDocument, *, every_target: bool) -> list[PlacedPrimitive]:
    """Return every primitive of the scene, once for each node that places it. Points and lines are left out."""
    found: list[PlacedPrimitive] = []
    left_out = False
    for placed in document.placed_meshes():
        for primitive in objects(placed.mesh, "primitives"):
            if primitive.get("mode", _TRIANGLES) in _WITHOUT_FACES:
                left_out = True
                continue
            if len(found) == _MOST_PRIMITIVES:
                raise MeshError(f"its scene has more than {_MOST_PRIMITIVES} parts")
            found.append(_placed_primitive(document, primitive, placed, every_target=every_target))
    if not found:
        raise MeshError("has only points or lines: export triangles" if left_out else "holds no mesh")
    return found


def _placed_primitive(
    document: GltfDocument, primitive: dict[str, Any], placed: PlacedMesh, *, every_target: bool
) -> PlacedPrimitive:
    mode, attributes = primitive.get("mode", _TRIANGLES), primitive["attributes"]
    if mode not in (_TRIANGLES, _STRIP, _FAN):
        raise ValueError("a primitive has an unknown mode")
    positions = Accessor.of(document, attributes["POSITION"], "VEC3", _POSITIONS)
    indices = None
    if "indices" in primitive:
        indices = Accessor.of(document, primitive["indices"], "SCALAR", _INDICES)
    numbers = None
    if "_VERTEX" in attributes:
        numbers = Accessor.of(document, attributes["_VERTEX"], "SCALAR", _NUMBERS)
        if numbers.count != positions.count:
            raise ValueError(f"_VERTEX numbers {numbers.count} of {positions.count} vertices")
    targets = tuple(_targets(document, primitive, placed, positions.count, every_target=every_target))
    skin = None
    if "skin" in placed.node and "JOINTS_0" in attributes:
        skin = _skin(document, attributes, placed, positions.count)
    place = None if skin else placed.place
    part = PlacedPrimitive(positions, indices, numbers, mode, targets, skin, place, primitive, placed.mesh)
    if part.corners < 3 or (mode == _TRIANGLES and part.corners % 3):
        raise ValueError(f"{part.corners} corners make no triangles")
    return part


def _targets(
    document: GltfDocument, primitive: dict[str, Any], placed: PlacedMesh, vertices: int, *, every_target: bool
) -> Iterator[MorphTarget]:
    """Yield the morph targets that move vertices: all, or only active targets. The weights of a node win (3.7.2.2)."""
    weights = placed.node.get("weights", placed.mesh.get("weights", []))
    targets = objects(primitive, "targets")
    names = _target_names(placed.mesh, len(targets)) if every_target else [""] * len(targets)
    for k, (target, name) in enumerate(zip(targets, names, strict=True)):
        weight = float(weights[k]) if k < len(weights) else 0.0
        if "POSITION" not in target or not (weight or every_target):
            continue
        if not entry_at(document.accessors, target["POSITION"]).keys() & {"bufferView", "sparse"}:
            continue  # zeros, as Blender leaves them out
        moves = Accessor.of(document, target["POSITION"], "VEC3", _POSITIONS)
        if moves.count != vertices:
            raise ValueError(f"a morph target has {moves.count} of {vertices} vertices")
        yield MorphTarget(moves, weight, name)


def _target_names(mesh: dict[str, Any], count: int) -> list[str]:
    """Return the names of a mesh's morph targets: "target 1" and so on where the file has none."""
    extras = mesh.get("extras")
    given = extras.get("targetNames") if isinstance(extras, dict) else None
    given = given[:count] if isinstance(given, list) else []
    labels = [label(name) if isinstance(name, str) else None for name in (*given, *[None] * (count - len(given)))]
    names = [name or f"target {k}" for k, name in enumerate(labels, 1)]
    if len(set(names)) < count:
        twice = next(name for k, name in enumerate(names) if name in names[:k])
        raise MeshError(f"two morph targets are called {twice!r}; give each its own name")
    return names


def _skin(document: GltfDocument, attributes: dict[str, Any], placed: PlacedMesh, vertices: int) -> Skin:
    entry = entry_at(document.skins, placed.node["skin"])
    places = np.array([placed.joint_place(joint) for joint in entry["joints"]])
    inverse = entry.get("inverseBindMatrices")
    inverse_bind = None if inverse is None else Accessor.of(document, inverse, "MAT4", (5126,))
    if inverse_bind is not None and inverse_bind.count < len(places):
        raise ValueError(f"its skin has {len(places)} joints and {inverse_bind.count} matrices for them")
    joints, weights = [], []
    for k in count():
        if f"JOINTS_{k}" not in attributes:
            break
        joints.append(Accessor.of(document, attributes[f"JOINTS_{k}"], "VEC4", _JOINTS))
        weights.append(Accessor.of(document, attributes[f"WEIGHTS_{k}"], "VEC4", _WEIGHTS))
    if any(accessor.count != vertices for accessor in (*joints, *weights)):
        raise ValueError("its skin has other numbers of joints and weights than of vertices")
    return Skin(places, inverse_bind, tuple(joints), tuple(weights))
