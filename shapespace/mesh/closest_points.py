"""Closest points on triangles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import face_normals


class VertexFaces:
    """The faces around each vertex of a connectivity, in rows of equal length.

    Args:
        faces: (F, 3).
        count: V.

    Attributes:
        faces: (F, 3).
        around: (V, k) faces at each vertex, the first one repeated where there are fewer.
    """

    def __init__(self, faces: IntArray, count: int) -> None:
        self.faces = faces
        order = np.argsort(faces.ravel(), kind="stable")
        valence = np.bincount(faces.ravel(), minlength=count)
        start = np.concatenate([[0], np.cumsum(valence)[:-1]])
        column = np.arange(valence.max())
        rows = np.where(column < valence[:, None], start[:, None] + column, start[:, None])
        self.around: IntArray = order[rows] // 3


@dataclass(frozen=True, eq=False)
class Closest:
    """Closest points of a surface to n points.

    Attributes:
        distances: (n,).
        faces: (n,) on which they lie.
        shares: (n, 3) weights of the corners there.
        places: (n, 3).
    """

    distances: FloatArray
    faces: IntArray
    shares: FloatArray
    places: FloatArray


class MeshProximity:
    """Triangles in which closest points are looked for: among the faces around the closest vertex.

    Args:
        vertices: (V, 3), finite.
        fans: of its connectivity.
    """

    def __init__(self, vertices: FloatArray, fans: VertexFaces) -> None:
        self.vertices, self.fans = vertices, fans

    @cached_property
    def tree(self) -> cKDTree:
        """Of the vertices."""
        return cKDTree(self.vertices)

    @cached_property
    def face_normals(self) -> FloatArray:
        """(F, 3), zero for a face without area."""
        return unit(face_normals(self.vertices, self.fans.faces, normalised=False))

    @cached_property
    def vertex_normals(self) -> FloatArray:
        """(V, 3) sums of the normals around, weighted by area, of unit length."""
        faces, n = self.fans.faces, face_normals(self.vertices, self.fans.faces, normalised=False)
        sums: FloatArray = np.stack(
            [np.bincount(faces.ravel(), np.repeat(n[:, k], 3), minlength=len(self.vertices)) for k in range(3)], axis=1
        )
        return unit(sums)

    def closest(self, points: FloatArray) -> Closest:
        """Of points (n, 3)."""
        _, nearest = self.tree.query(points)
        candidates = self.fans.around[nearest]
        shares = nearest_shares(points[:, None], self.vertices[self.fans.faces[candidates]])
        places = np.einsum("nkc,nkcx->nkx", shares, self.vertices[self.fans.faces[candidates]])
        squares = ((places - points[:, None]) ** 2).sum(axis=-1)
        best = (np.arange(len(points)), squares.argmin(axis=1))
        return Closest(np.sqrt(squares[best]), candidates[best], shares[best], places[best])


def nearest_shares(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Weights (…, 3) of the corners (…, 3, 3) of triangles, at the point of each that is closest to points (…, 3).

    The foot of the perpendicular where it lies inside, otherwise the best of the feet on the three sides.
    """
    a, b, c = (corners[..., k, :] for k in range(3))
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (ab * ab).sum(-1), (ab * ac).sum(-1), (ac * ac).sum(-1)
    d20, d21 = (ap * ab).sum(-1), (ap * ac).sum(-1)
    tiny = np.finfo(float).tiny
    scale = d00 * d11 - d01**2
    has_area = scale > 1e-12 * d00 * d11
    scale = np.where(has_area, scale, 1)
    v, w = (d11 * d20 - d01 * d21) / scale, (d00 * d21 - d01 * d20) / scale
    inside = has_area & (v >= 0) & (w >= 0) & (v + w <= 1)
    # Along ab, ac, and bc; squares of distances up to |ap|².
    s = np.clip(d20 / np.maximum(d00, tiny), 0, 1)
    t = np.clip(d21 / np.maximum(d11, tiny), 0, 1)
    d_bc = d00 - 2 * d01 + d11
    u = np.clip(((d21 - d20) - (d01 - d00)) / np.maximum(d_bc, tiny), 0, 1)
    zero = np.zeros_like(s)
    best_v, best_w = s, zero
    best = s * s * d00 - 2 * s * d20
    for v_side, w_side in ((zero, t), (1 - u, u)):
        square = v_side**2 * d00 + 2 * v_side * w_side * d01 + w_side**2 * d11 - 2 * (v_side * d20 + w_side * d21)
        better = square < best
        best = np.where(better, square, best)
        best_v, best_w = np.where(better, v_side, best_v), np.where(better, w_side, best_w)
    v, w = np.where(inside, v, best_v), np.where(inside, w, best_w)
    return np.stack([1 - v - w, v, w], axis=-1)


def unit(vectors: FloatArray) -> FloatArray:
    """(n, 3) of length one; zero where they were."""
    found: FloatArray = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), np.finfo(float).tiny)
    return found
