"""Quadric error metrics (Garland and Heckbert 1997) summed over several shapes: the cost of moving a vertex."""

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import Connectivity, face_normals

#: Weight of a plane across the boundary, relative to the planes of the faces.
BOUNDARY_WEIGHT = 10.0


def monomials(points: FloatArray) -> FloatArray:
    """(Vf, 10n) products of the homogeneous coordinates of points (Vf, n, 3); mixed products are doubled."""
    h = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
    i, j = np.triu_indices(4)
    return (h[..., i] * h[..., j] * np.where(i == j, 1.0, 2.0)).reshape(len(points), -1)


def quadrics_of(connectivity: Connectivity, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute area-weighted squared distances to the planes at each vertex, in all shapes (n, Vf, 3).

    Returns quadrics (Vf, 10n), whose dot product with ``monomials`` is the sum over the shapes, and the areas (Vf,)
    around the vertices, both averaged over the shapes.
    """
    count, (i, j) = connectivity.vertex_count, np.triu_indices(4)
    faces, rim = connectivity.faces, connectivity.edges[~connectivity.interior]
    face = connectivity.edge_faces[~connectivity.interior].max(axis=1)
    at_faces, at_rim = _at_vertices(faces, count), _at_vertices(rim, count)

    def gather(normals: FloatArray, points: FloatArray, weights: FloatArray, at: sparse.csr_array) -> FloatArray:
        plane = np.concatenate([normals, -(normals * points).sum(axis=-1, keepdims=True)], axis=-1)
        return at @ (plane[:, i] * plane[:, j] * weights[:, None] / len(shapes))

    quadrics, areas = np.empty((count, 10 * len(shapes))), np.zeros(len(faces))
    # One shape at a time: the normals of all faces in all shapes take much memory.
    for k, shape in enumerate(shapes):
        normals = face_normals(shape, faces, normalised=False)
        doubled = np.linalg.norm(normals, axis=-1)
        normals /= np.maximum(doubled, 1e-300)[:, None]
        found = gather(normals, shape[faces[:, 0]], doubled / 2, at_faces)
        areas += doubled
        if len(rim):
            along = shape[rim[:, 1]] - shape[rim[:, 0]]
            squared = (along**2).sum(axis=-1)
            across = np.cross(normals[face], along) / np.sqrt(np.maximum(squared, 1e-300))[:, None]
            found += gather(across, shape[rim[:, 0]], BOUNDARY_WEIGHT * squared, at_rim)
        quadrics[:, 10 * k : 10 * (k + 1)] = found
    around = np.bincount(faces.ravel(), np.repeat(areas / len(shapes) / 2, 3), minlength=count)
    return quadrics, around / len(shapes)


def _at_vertices(corners: IntArray, count: int) -> sparse.csr_array:
    """(count, k) sparse matrix with 1 where a vertex is a corner of an element, given the corners (k, d)."""
    elements = len(corners)
    entries = (np.ones(corners.size), corners.T.ravel(), np.arange(corners.size + 1))
    by_vertex = sparse.csr_array(entries, shape=(corners.size, count)).tocsc()  # a counting sort
    return sparse.csr_array((by_vertex.data, by_vertex.indices % elements, by_vertex.indptr), shape=(count, elements))
