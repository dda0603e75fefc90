"""Differential coordinates, a simple model of shapes for comparison (von Tycowicz et al. 2018).

Each face has the gradient of the map from the mean. It is split into a rotation and a stretch, and their logarithms are
the coordinates of the face. Modes are principal components of these, weighted by area. A shape of a code comes from one
Poisson solve.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.training.space.codes import nearest_code

#: Entries of a symmetric matrix, and the factors with which their squares add up to the squares of the matrix.
UPPER, FACTORS = np.triu_indices(3), np.sqrt([1, 2, 2, 1, 2, 1])
#: Step of difference quotients, in units of the modes.
STEP = 1e-4


class DifferentialCoordinates:
    """Principal components of rotations and stretches of faces, between the mean and shapes (n, V, 3)."""

    def __init__(self, shapes: FloatArray, reference: TriangleMesh) -> None:
        shapes = align(shapes, align(shapes, reference.vertices).mean(axis=0))
        self._faces, self._mean = reference.faces, shapes.mean(axis=0)
        self._inverse = np.linalg.inv(self._frames(self._mean))
        areas = face_areas(self._mean, self._faces)
        self._weights = np.repeat(areas / areas.sum(), 9)
        # Gradient of a function of vertices, constant on each face: the sum over its corners.
        corners = self._inverse[:, :2]
        hats = np.concatenate([-corners.sum(axis=1, keepdims=True), corners], axis=1)  # (F, 3 corners, 3)
        rows = np.repeat(np.arange(3 * len(areas)).reshape(-1, 1, 3), 3, axis=1)
        columns = np.repeat(self._faces[:, :, None], 3, axis=2)
        shape = (3 * len(areas), len(self._mean))
        gradient = sparse.csr_array((hats.ravel(), (rows.ravel(), columns.ravel())), shape)
        self._divergence = gradient.T @ sparse.diags_array(np.repeat(areas, 3))
        laplacian = self._divergence @ gradient
        shift = 1e-10 * laplacian.diagonal().mean()  # a shape may be moved
        self._solve = splu(sparse.csc_array(laplacian + shift * sparse.eye_array(shape[1])))
        rows = np.stack([self._coordinates(shape) for shape in shapes])
        self._middle = rows.mean(axis=0)
        u, s, axes = np.linalg.svd((rows - self._middle) * np.sqrt(self._weights), full_matrices=False)
        peaks = np.abs(u * s).max(axis=0)
        self._modes = axes / np.sqrt(self._weights) * peaks[:, None]

    def _frames(self, vertices: FloatArray) -> FloatArray:
        """Return two edges and the unit normal of each face as columns, (F, 3, 3)."""
        a, b, c = (vertices[self._faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        return np.stack([b - a, c - a, normal / np.linalg.norm(normal, axis=1, keepdims=True)], axis=2)

    def _coordinates(self, vertices: FloatArray) -> FloatArray:
        """Return rotation vectors and logarithms of stretches of all faces (9F,)."""
        left, values, right = np.linalg.svd(self._frames(vertices) @ self._inverse)
        rotations = Rotation.from_matrix(left @ right).as_rotvec()
        logarithms = (right.swapaxes(1, 2) * np.log(values)[:, None]) @ right
        return np.concatenate([rotations, logarithms[:, *UPPER] * FACTORS], axis=1).ravel()

    def _shape(self, coordinates: FloatArray) -> FloatArray:
        """Return the shape (V, 3) whose gradients are closest to coordinates (9F,)."""
        rotations, logarithms = np.split(coordinates.reshape(-1, 9), [3], axis=1)
        matrices = np.zeros((len(rotations), 3, 3))
        matrices[:, *UPPER] = logarithms / FACTORS
        values, vectors = np.linalg.eigh(matrices, UPLO="U")
        stretches = (vectors * np.exp(values)[:, None]) @ vectors.swapaxes(1, 2)
        gradients = Rotation.from_rotvec(rotations).as_matrix() @ stretches
        return self._solve.solve(self._divergence @ gradients.swapaxes(1, 2).reshape(-1, 3))

    def nearest(self, shapes: FloatArray, count: int) -> FloatArray:
        """Return the shapes of ``count`` coordinates that come closest to shapes (n, V, 3), in vertices."""
        modes = self._modes[:count]
        squares = (modes**2) @ self._weights

        def shape_of(code: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]]:
            at = self._middle + code @ modes

            def derivative() -> FloatArray:
                pairs = ((self._shape(at + STEP * mode), self._shape(at - STEP * mode)) for mode in modes)
                return np.stack([(ahead - behind) / (2 * STEP) for ahead, behind in pairs])

            return self._shape(at), derivative

        found = []
        for shape in align(shapes, self._mean):
            start = ((self._coordinates(shape) - self._middle) * self._weights) @ modes.T / squares
            found.append(nearest_code(shape_of, shape, start).vertices)
        return np.stack(found)
