"""Rotations of vertices from one shape to another, smooth over the mesh."""

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.mesh.prolongation import faces_at_vertices
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.mesh.vectors import components, cross, dot


class VertexRotations:
    """A rotation for each vertex: the mean over its faces, then ROUNDS times the mean over its neighbours.

    Means are computed from quaternions (Markley, Cheng, Crassidis and Oshman, "Averaging quaternions", 2007). For
    rotations close to each other the normalised weighted sum replaces their eigenvector. Between face frames a and b
    the quaternion is ``(1 + Σ_k a_k · b_k, Σ_k a_k × b_k)``, which is 4w times the unit quaternion (w, v). So sums
    don't depend on the sign of a quaternion, and rotations by nearly 180°, whose axis is uncertain, have little weight.

    Neighbours must rotate nearly alike. Differences of rotation stretch a shell, and it is much stiffer against
    stretching than against bending. Without these rounds, the rotated matrix of a captured body is further from the
    matrix of the new shape than the old matrix is.
    """

    #: Number of means over neighbours.
    ROUNDS = 6

    def __init__(self, connectivity: Connectivity) -> None:
        self._corners = connectivity.face_corners
        self._around = faces_at_vertices(connectivity.faces, connectivity.vertex_count)
        self._neighbours = sparse.csr_array((self._around @ self._around.T).astype(bool).astype(np.float64))

    def face_frames(self, vertices: FloatArray) -> FloatArray:
        """Compute frames (xyz, 3, F): unit vectors along a side of each face, across it, and along the normal."""
        a, b, c = (components(vertices).take(k, axis=1) for k in self._corners)
        side = b - a
        normal = cross(side, c - a)
        side /= np.sqrt(dot(side, side))
        normal /= np.sqrt(dot(normal, normal))
        return np.stack([side, cross(normal, side), normal], axis=1)

    def __call__(self, old: FloatArray, new: FloatArray) -> FloatArray:
        """Compute the rotations (V, 3, 3) from old to new face frames, both (xyz, 3, F).

        A rotation is not finite where all faces around a vertex rotate by 180°, or a face has no area.
        """
        quaternions = np.empty((4, old.shape[-1]))
        quaternions[0] = 1 + np.einsum("xkf,xkf->f", old, new)
        quaternions[1:] = cross(old, new).sum(axis=1)
        means = np.asarray(self._around @ quaternions.T)
        for _ in range(self.ROUNDS):
            means = np.asarray(self._neighbours @ means)
        # With length √2 the matrix needs no factors of 2.
        means *= np.sqrt(2) / np.linalg.norm(means, axis=1, keepdims=True)
        w, x, y, z = means.T
        rows = [
            [1 - y * y - z * z, x * y - w * z, x * z + w * y],
            [x * y + w * z, 1 - x * x - z * z, y * z - w * x],
            [x * z - w * y, y * z + w * x, 1 - x * x - y * y],
        ]
        return np.ascontiguousarray(np.moveaxis(np.array(rows), 2, 0))
