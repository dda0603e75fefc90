"""Closest points on triangles."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import vertex_normals


class VertexFaces:
    """The faces (V, k) around each vertex of a connectivity. The first is repeated where a vertex has fewer than k."""

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
    """Closest points on a surface to n points."""

    distances: FloatArray  # (n,)
    # faces, barycentric: (n,) faces that contain the closest points, and (n, 3) coordinates there
    faces: IntArray
    barycentric: FloatArray
    places: FloatArray  # (n, 3) positions


class MeshProximity:
    """Closest points on a mesh (V, 3). The search looks at the faces around the closest vertex only."""

    def __init__(self, vertices: FloatArray, vertex_faces: VertexFaces) -> None:
        self.vertices, self.vertex_faces = vertices, vertex_faces

    @cached_property
    def tree(self) -> cKDTree:
        """k-d tree of the vertices."""
        return cKDTree(self.vertices)

    @cached_property
    def vertex_normals(self) -> FloatArray:
        """(V, 3) unit normals, see `triangle_mesh.vertex_normals`."""
        return vertex_normals(self.vertices, self.vertex_faces.faces, order="C")

    def closest(self, points: FloatArray) -> Closest:
        """Find the closest points to points (n, 3)."""
        _, nearest = self.tree.query(points)
        candidates = self.vertex_faces.around[nearest]
        corners = self.vertices[self.vertex_faces.faces[candidates]]
        barycentric = closest_barycentric(points[:, None], corners)
        places = np.einsum("nkc,nkcx->nkx", barycentric, corners)
        gaps = places - points[:, None]
        squares = np.vecdot(gaps, gaps)
        best = (np.arange(len(points)), squares.argmin(axis=1))
        return Closest(np.sqrt(squares[best]), candidates[best], barycentric[best], places[best])


def closest_barycentric(points: FloatArray, corners: FloatArray) -> FloatArray:
    """Barycentric coordinates (…, 3) of the closest point to each of points (…, 3) in a triangle (…, 3, 3).

    The closest point is the foot of the perpendicular where the foot lies inside. Otherwise it is the best of the
    closest points on the three sides. Triangles without area are treated as segments.
    """
    a, b, c = (corners[..., k, :] for k in range(3))
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11, d20, d21 = (np.vecdot(u, v) for u, v in ((ab, ab), (ab, ac), (ac, ac), (ap, ab), (ap, ac)))
    tiny = np.finfo(float).tiny
    scale = d00 * d11 - d01**2
    has_area = scale > 1e-12 * d00 * d11
    scale = np.where(has_area, scale, 1)
    v, w = (d11 * d20 - d01 * d21) / scale, (d00 * d21 - d01 * d20) / scale
    inside = has_area & (v >= 0) & (w >= 0) & (v + w <= 1)
    # Along ab, ac and bc; squares are relative to |ap|².
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
