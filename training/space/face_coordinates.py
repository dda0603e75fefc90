"""Differential coordinates of a shape: the rotation and the stretch of each of its faces.

Straight lines in these coordinates bend and stretch the surface (von Tycowicz et al. 2018). Vertices come from one
Poisson equation, so there is no iteration that could fail. The stretch itself is a coordinate here, not its logarithm.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray
from shapespace.coordinates.frame_integration import FrameIntegration
from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas, face_normals

#: Coordinates of a face: a rotation vector, and the entries of a symmetric matrix on and above the diagonal.
PER_FACE = 9
#: Upper entries of a symmetric matrix, and factors with which their squares add up to the squares of the matrix.
UPPER, FACTORS = np.triu_indices(3), np.sqrt([1, 2, 2, 1, 2, 1])


def symmetric_matrices() -> FloatArray:
    """Return the matrix (6, 9) from the six entries of a stretch to all entries of its symmetric matrix."""
    matrices = np.zeros((len(FACTORS), 3, 3))
    for k, (i, j) in enumerate(zip(*UPPER, strict=True)):
        matrices[k, i, j] = matrices[k, j, i] = 1 / FACTORS[k]
    return matrices.reshape(len(FACTORS), 9)


class FaceCoordinates:
    """Coordinates (9F,) of shapes with the faces of a base mesh.

    The affine map that takes a face of the base, with its unit normal, to the same face of a shape is ``R (I + S)``.
    The rotation vector of R and the symmetric stretch S are the coordinates of the face.
    """

    def __init__(self, base: TriangleMesh) -> None:
        self.base = base
        self._inverse = np.linalg.inv(self._frames(base.vertices[None])[0])
        areas = face_areas(base.vertices, base.faces)
        #: Weights (9F,) of squares in the norm: areas of faces, with the sum 1.
        self.weights: FloatArray = np.repeat(areas / areas.sum(), PER_FACE)

    @cached_property
    def sides(self) -> FloatArray:
        """Vectors (3, F, 3) of the sides of the base; side k of a face is opposite to its corner k."""
        corners = self.base.vertices[self.base.faces]
        return np.stack([corners[:, (k + 2) % 3] - corners[:, (k + 1) % 3] for k in range(3)])

    @cached_property
    def integration(self) -> FrameIntegration:
        """The Poisson equation of the base."""
        return FrameIntegration(self.base)

    @cached_property
    def _rest(self) -> FloatArray:
        return self.integration.positions(np.zeros((3 * len(self.base.faces), 3)))

    def _frames(self, shapes: FloatArray) -> FloatArray:
        """Return two sides and the unit normal of each face of shapes (n, V, 3) as columns, (n, F, 3, 3)."""
        a, b, c = (shapes[:, self.base.faces[:, k]] for k in range(3))
        return np.stack([b - a, c - a, face_normals(shapes, self.base.faces)], axis=3)

    def __call__(self, shapes: FloatArray) -> FloatArray:
        """Return the coordinates (n, 9F) of shapes (n, V, 3) in any position."""
        rows = []
        for frames in self._frames(align(shapes, self.base.vertices)):
            left, values, right = np.linalg.svd(frames @ self._inverse)
            rotations = Rotation.from_matrix(left @ right).as_rotvec()
            stretches = right.swapaxes(1, 2) @ (values[:, :, None] * right) - np.eye(3)
            rows.append(np.concatenate([rotations, stretches[:, *UPPER] * FACTORS], axis=1).ravel())
        return np.stack(rows)

    def along(self, fields: FloatArray) -> FloatArray:
        """Return derivatives (n, 9F) of the base's coordinates along vertex fields (n, V, 3)."""
        moved = without_rigid_motion(fields, self.base.vertices)[:, self.base.faces]
        corners, normals = self.base.vertices[self.base.faces], face_normals(self.base.vertices, self.base.faces)
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        da, db = moved[:, :, 1] - moved[:, :, 0], moved[:, :, 2] - moved[:, :, 0]
        turned = (np.cross(da, b) + np.cross(a, db)) / np.linalg.norm(np.cross(a, b), axis=1)[:, None]
        turned -= (turned * normals).sum(axis=2, keepdims=True) * normals
        maps = np.stack([da, db, turned], axis=3) @ self._inverse
        # The base is not turned or stretched, so these are the parts of the map itself.
        stretches, spins = (maps + maps.swapaxes(2, 3)) / 2, (maps - maps.swapaxes(2, 3)) / 2
        rotations = np.stack([spins[..., 2, 1], spins[..., 0, 2], spins[..., 1, 0]], axis=2)
        found = np.concatenate([rotations, stretches[..., *UPPER] * FACTORS], axis=2)
        return found.reshape(len(fields), -1)

    def _parts(self, row: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return rotation vectors (…, F, 3) and stretches (…, F, 3, 3) of coordinates (…, 9F)."""
        faces = row.reshape(*row.shape[:-1], -1, PER_FACE)
        return faces[..., :3], (faces[..., 3:] @ symmetric_matrices()).reshape(*faces.shape[:-1], 3, 3)

    def shape(self, row: FloatArray) -> FloatArray:
        """Return the shape (V, 3) that fits coordinates (9F,) best, in the pose of the base."""
        turns, stretches = self._parts(row)
        maps = Rotation.from_rotvec(turns).as_matrix() @ (np.eye(3) + stretches)
        return self.integration.positions(self._moved_sides(maps))

    def _moved_sides(self, maps: FloatArray) -> FloatArray:
        """Return the vectors (3F, 3) to which linear maps (F, 3, 3) take the sides."""
        return np.einsum("fij,kfj->kfi", maps, self.sides).reshape(-1, 3)

    def change(self, row: FloatArray, directions: FloatArray) -> FloatArray:
        """Return derivatives (m, V, 3) of the shape of coordinates (9F,) along directions (m, 9F)."""
        turns, stretches = self._parts(row)
        rotations, grown = Rotation.from_rotvec(turns).as_matrix(), np.eye(3) + stretches
        own = _right_jacobians(turns)
        found = []
        for turned, stretched in zip(*self._parts(directions), strict=True):
            spin = np.einsum("fij,fj->fi", own, turned)
            maps = rotations @ (np.cross(spin[:, None], grown.swapaxes(1, 2)).swapaxes(1, 2) + stretched)
            found.append(self.integration.positions(self._moved_sides(maps)) - self._rest)
        return np.stack(found)


def _right_jacobians(turns: FloatArray) -> FloatArray:
    """Return the matrices (F, 3, 3) that take changes of rotation vectors (F, 3) to angular velocities in the body:
    ``R(r + h) ≈ R(r) (I + [J h]×)``.
    """
    angles = np.linalg.norm(turns, axis=1).clip(1e-4)[:, None, None]  # below, both factors round badly
    cross = np.cross(turns[:, None], np.eye(3)).swapaxes(1, 2)  # [r]×
    first, second = (1 - np.cos(angles)) / angles**2, (angles - np.sin(angles)) / angles**3
    return np.eye(3) - first * cross + second * (cross @ cross)
