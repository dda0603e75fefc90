"""Quadric error metrics (Garland and Heckbert 1997) of several shapes together: what it costs to move a vertex."""

from __future__ import annotations

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import Connectivity, face_normals

#: Weight of a plane across the boundary against that of the planes of the faces.
BOUNDARY_WEIGHT = 10.0


def monomials(points: FloatArray) -> FloatArray:
    """(Vf, 10n) products of the homogeneous coordinates of points (Vf, n, 3); the mixed ones twice."""
    h = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
    i, j = np.triu_indices(4)
    return (h[..., i] * h[..., j] * np.where(i == j, 1.0, 2.0)).reshape(len(points), -1)


def quadrics_of(connectivity: Connectivity, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared distances to the planes at a vertex in all shapes (n, Vf, 3), by area.

    Returns:
        (Vf, 10n) so that the sum over the shapes is a dot product with ``monomials``, and (Vf,) the areas
        around the vertices, both averaged over the shapes.
    """
    count, (i, j) = connectivity.vertex_count, np.triu_indices(4)

    def gather(normals: FloatArray, points: FloatArray, weights: FloatArray, corners: IntArray) -> FloatArray:
        plane = np.concatenate([normals, -(normals * points).sum(axis=-1, keepdims=True)], axis=-1)
        values = plane[..., i] * plane[..., j] * weights[..., None] / len(shapes)
        values = np.moveaxis(values, 0, 1).reshape(len(corners), -1)
        out = np.zeros((count, values.shape[1]))
        for column in corners.T:
            np.add.at(out, column, values)
        return out

    faces = connectivity.faces
    normals = face_normals(shapes, faces, normalised=False)
    doubled = np.linalg.norm(normals, axis=-1)
    normals /= np.maximum(doubled, 1e-300)[..., None]
    quadrics = gather(normals, shapes[:, faces[:, 0]], doubled / 2, faces)
    areas = np.bincount(faces.ravel(), np.repeat(doubled.mean(axis=0) / 2, 3), minlength=count)

    rim = connectivity.edges[~connectivity.interior]
    if len(rim):
        face = connectivity.edge_faces[~connectivity.interior].max(axis=1)
        along = shapes[:, rim[:, 1]] - shapes[:, rim[:, 0]]
        squared = (along**2).sum(axis=-1)
        across = np.cross(normals[:, face], along) / np.sqrt(np.maximum(squared, 1e-300))[..., None]
        quadrics += gather(across, shapes[:, rim[:, 0]], BOUNDARY_WEIGHT * squared, rim)
    return quadrics, areas / len(shapes)
