"""Triangle meshes: connectivity, checked once, and positions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.counted import counted
from shapespace.mesh.vectors import components, cross, unit


class MeshError(ValueError):
    """The mesh can't be used; the message says why."""


class PlaceError(MeshError):
    """A fault at some vertices or faces, which the caller may count in another way.

    The sentence has a field ``{name}`` for each entry of ``numbers``; names of faces begin with ``face``. Numbers are
    indices by name, counted from 0; several indices are written as ``(2, 48)``.
    """

    def __init__(self, sentence: str, numbers: Mapping[str, Sequence[int]]) -> None:
        super().__init__(sentence, numbers)
        self.sentence, self.numbers = sentence, numbers

    def numbered(self, first: int = 0, vertices: IntArray | None = None) -> str:
        """Format the sentence with indices counted from ``first``, and with vertices renamed by ``vertices`` (V,)."""
        shown = self.sentence
        for name, numbers in self.numbers.items():
            known = numbers if vertices is None or name.startswith("face") else vertices[list(numbers)].tolist()
            text = ", ".join(str(number + first) for number in known)
            # Replace once only: the name of a file may contain braces too.
            shown = shown.replace(f"{{{name}}}", f"({text})" if len(known) > 1 else text, 1)
        return shown

    def __str__(self) -> str:
        return self.numbered()


def require_vertices(corners: IntArray, count: int) -> None:
    """Raise MeshError if a corner is none of ``count`` vertices."""
    if corners.size and not 0 <= corners.min() <= corners.max() < count:
        raise MeshError(f"faces name vertices {corners.min()} to {corners.max()}, but there are {count} vertices")


class Connectivity:
    """Faces and edges, shared by all meshes of a collection.

    Edges are undirected, stored as ``(i, j)`` with ``i < j``, and sorted lexicographically. All arrays over edges have
    this order.

    Args:
        faces: (F, 3) vertex indices, consistently oriented.
        vertex_count: V; every vertex must belong to a face.

    Raises:
        MeshError: a face is out of range or repeats a vertex, an edge has more than two faces, neighbouring faces have
            opposite orientations, or a vertex has no face.
    """

    def __init__(self, faces: ArrayLike, vertex_count: int) -> None:
        f = np.asarray(faces)
        if f.ndim != 2 or f.shape[1] != 3 or len(f) == 0:
            raise MeshError(f"faces must be a non-empty (F, 3) array of vertex indices, not of shape {f.shape}")
        if not np.issubdtype(f.dtype, np.integer):
            raise MeshError(f"faces must be integers, not {f.dtype}")
        f = f.astype(np.int64)
        require_vertices(f, vertex_count)
        repeated = np.flatnonzero((f[:, 0] == f[:, 1]) | (f[:, 1] == f[:, 2]) | (f[:, 2] == f[:, 0]))
        if len(repeated):
            raise PlaceError("face {face} names the same vertex twice", {"face": [int(repeated[0])]})
        unused = np.setdiff1d(np.arange(vertex_count), f)
        if len(unused):
            raise MeshError(
                f"vertex {unused[0]} belongs to no face ({counted(len(unused), 'such vertex', 'such vertices')})"
            )

        self.faces: IntArray = f
        self.vertex_count = int(vertex_count)
        # Side k of a face is opposite to its corner k; sides are numbered k * F + f.
        tail = np.concatenate([f[:, 1], f[:, 2], f[:, 0]])
        head = np.concatenate([f[:, 2], f[:, 0], f[:, 1]])
        apex = np.concatenate([f[:, 0], f[:, 1], f[:, 2]])
        key = np.minimum(tail, head) * vertex_count + np.maximum(tail, head)
        unique, side_edge, count = np.unique(key, return_inverse=True, return_counts=True)
        self.edges: IntArray = np.stack([unique // vertex_count, unique % vertex_count], axis=1)
        self.face_edges: IntArray = side_edge.reshape(3, -1).T.copy()
        """(F, 3) edges of each face; edge k is opposite to corner k."""
        if count.max() > 2:
            i, j = self.edges[count.argmax()].tolist()
            raise PlaceError(f"edge {{edge}} has {count.max()} faces; at most two are allowed", {"edge": (i, j)})
        forward = tail < head
        if np.bincount(side_edge[forward]).max(initial=0) > 1 or np.bincount(side_edge[~forward]).max(initial=0) > 1:
            twice = np.bincount(side_edge, weights=np.where(forward, 1, -1), minlength=len(unique))
            i, j = self.edges[int(np.flatnonzero(np.abs(twice) > 1)[0])].tolist()
            raise PlaceError("the two faces at edge {edge} are oriented oppositely", {"edge": (i, j)})

        # The face to the left of i → j, then the face to the right; −1 on the boundary.
        side_face = np.tile(np.arange(len(f)), 3)
        self.edge_faces: IntArray = np.full((len(unique), 2), -1)
        self.edge_opposite: IntArray = np.full((len(unique), 2), -1)
        for column, mask in enumerate((forward, ~forward)):
            self.edge_faces[side_edge[mask], column] = side_face[mask]
            self.edge_opposite[side_edge[mask], column] = apex[mask]
        self.interior: NDArray[np.bool_] = count == 2
        for array in (self.faces, self.edges, self.face_edges, self.edge_faces, self.edge_opposite, self.interior):
            array.setflags(write=False)
        self.hinge_edges: IntArray = np.flatnonzero(self.interior)
        """(H,) interior edges."""
        self.hinges: IntArray = np.concatenate([self.edges, self.edge_opposite], axis=1)[self.interior]
        """(H, 4) tail, head, left and right opposite vertex of every interior edge, in edge order."""
        # Contiguous columns of these arrays, (2, E), (4, H), (3, F) and (3, F): gathering with them is several times
        # faster.
        self.edge_ends, self.hinge_corners, self.face_corners, self.face_sides = (
            np.ascontiguousarray(array.T) for array in (self.edges, self.hinges, self.faces, self.face_edges)
        )

    @property
    def edge_count(self) -> int:
        """Number of edges, E."""
        return len(self.edges)

    @property
    def is_closed(self) -> bool:
        """Whether there is no boundary edge."""
        return bool(self.interior.all())


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A shape of a connectivity, checked once and then immutable.

    Args:
        vertices: (V, 3) positions, finite.
        connectivity: faces and edges.

    Raises:
        MeshError: the array has the wrong shape, a coordinate is not finite, or a face has no area.
    """

    vertices: FloatArray
    connectivity: Connectivity

    def __post_init__(self) -> None:
        v = np.array(self.vertices, dtype=np.float64)
        if v.shape != (self.connectivity.vertex_count, 3):
            raise MeshError(f"vertices must be ({self.connectivity.vertex_count}, 3), not {v.shape}")
        bad = np.flatnonzero(~np.isfinite(v).all(axis=1))
        if len(bad):
            raise PlaceError("vertex {vertex} has a coordinate that is not finite", {"vertex": [int(bad[0])]})
        v.setflags(write=False)
        object.__setattr__(self, "vertices", v)
        areas = self.face_areas
        flat = np.flatnonzero(areas <= 1e-12 * areas.mean())
        if len(flat):
            raise PlaceError(f"face {{face}} has no area ({counted(len(flat), 'such face')})", {"face": [int(flat[0])]})

    @classmethod
    def from_arrays(cls, vertices: ArrayLike, faces: ArrayLike) -> TriangleMesh:
        """Build and check connectivity and mesh from plain arrays."""
        v = np.asarray(vertices)
        if v.ndim != 2 or v.shape[1] != 3:
            raise MeshError(f"vertices must be a (V, 3) array, not of shape {v.shape}")
        return cls(v, Connectivity(faces, len(v)))

    @classmethod
    def from_mapping(cls, arrays: Mapping[str, NDArray]) -> TriangleMesh:
        """Build from a mapping with ``vertices`` and ``faces``, such as an opened NPZ file."""
        return cls.from_arrays(arrays["vertices"], arrays["faces"])

    def with_vertices(self, vertices: ArrayLike) -> TriangleMesh:
        """Return another shape of the same connectivity."""
        return TriangleMesh(np.asarray(vertices, dtype=np.float64), self.connectivity)

    @property
    def faces(self) -> IntArray:
        """(F, 3) vertex indices."""
        return self.connectivity.faces

    @property
    def edges(self) -> IntArray:
        """(E, 2) vertex indices."""
        return self.connectivity.edges

    @cached_property
    def face_areas(self) -> FloatArray:
        """(F,) areas."""
        return face_areas(self.vertices, self.faces)

    @property
    def area(self) -> float:
        """Surface area."""
        return float(self.face_areas.sum())

    @property
    def diagonal(self) -> float:
        """Length of the diagonal of the bounding box."""
        return float(diagonal(self.vertices))

    @property
    def edge_midpoints(self) -> FloatArray:
        """(E, 3) midpoints of the edges."""
        return self.vertices[self.edges].mean(axis=1)


def face_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Compute the areas (…, F) of the faces of shapes (…, V, 3)."""
    return 0.5 * np.linalg.norm(face_normals(vertices, faces, normalised=False), axis=-1)


def vertex_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Compute the areas (V,) of the vertices of a shape (V, 3): a third of each face around."""
    thirds = np.repeat(face_areas(vertices, faces) / 3, 3)
    return np.bincount(faces.ravel(), thirds, minlength=len(vertices)).astype(np.float64, copy=False)


def on_shared_vertices(
    corners: FloatArray, faces: IntArray, count: int, tolerance: float
) -> tuple[FloatArray, IntArray]:
    """Put the corners (F, 3, 3) of triangles on the vertices of faces (F, 3).

    Returns:
        The ``count`` vertices, at the origin if they are in no face. And the torn faces: a corner is farther from its
        vertex than ``tolerance``, as a share of the diagonal.
    """
    vertices = np.zeros((count, 3))
    vertices[faces] = corners
    apart = np.linalg.norm(vertices[faces] - corners, axis=-1).max(axis=1)
    return vertices, np.flatnonzero(apart > tolerance * diagonal(corners.reshape(-1, 3)))


def diagonal(vertices: FloatArray) -> FloatArray:
    """Compute the lengths (…) of the diagonals of the bounding boxes of shapes (…, V, 3)."""
    return np.linalg.norm(np.ptp(vertices, axis=-2), axis=-1)


def face_normals(vertices: FloatArray, faces: IntArray, *, normalised: bool = True) -> FloatArray:
    """Compute the face normals (…, F, 3) of shapes (…, V, 3), with length twice the area unless ``normalised``."""
    a, b, c = (vertices.take(faces[:, k], axis=-2) for k in range(3))
    n = cross((b - a).T, (c - a).T).T
    return n / np.linalg.norm(n, axis=-1, keepdims=True) if normalised else n


def vertex_normals(
    vertices: FloatArray, faces: IntArray, corners: IntArray | None = None, *, order: Literal["C", "F"] = "F"
) -> FloatArray:
    """Compute unit normals (N, 3) at the vertices of a shape (V, 3): means of the face normals, weighted by area.

    A normal is zero where the normals of the faces around cancel.

    ``corners`` (F, 3) has the index of the normal at each corner. By default N = V and a corner has the normal of its
    vertex. Sums are computed face by face (``order`` C) or corner by corner (F). Their results differ by rounding;
    files and fits each keep the order of version 0.2.
    """
    x = components(vertices)
    a, b, c = (x.take(k, axis=1) for k in np.ascontiguousarray(faces.T))
    into, spread = (faces if corners is None else corners).ravel(order), np.repeat if order == "C" else np.tile
    count = len(vertices) if corners is None else 0
    sums = [np.bincount(into, spread(n, 3), minlength=count) for n in cross(b - a, c - a)]
    return unit(np.stack(sums, axis=1))
