"""Vertices of shapes in correspondence: drop unused vertices, merge coinciding vertices, find open seams.

Exporters split a vertex along seams of texture or shading, and STL has no shared vertices at all. Vertices become one
if they coincide in every shape. Vertices that coincide in some shapes only stay apart: they touch by chance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import Connectivity, PlaceError, diagonal
from shapespace.training.collection.checks import TOLERANCES
from shapespace.training.collection.large_arrays import some_vertices


@dataclass(frozen=True, eq=False)
class NumberedShapes:
    """Shapes in correspondence, and the numbers of their vertices in the files."""

    vertices: FloatArray  # (n, V, 3)
    faces: IntArray  # (F, 3)
    file_numbers: IntArray  # (V,) index that the files give each vertex, or the first of the vertices merged into it
    file_vertices: IntArray  # (N,) index here of each vertex of a file, −1 for vertices that were left out

    @classmethod
    def from_files(cls, vertices: FloatArray, faces: IntArray) -> NumberedShapes:
        """Number shapes (n, N, 3) as their files do, without the vertices that are in no face."""
        every = np.arange(vertices.shape[1])
        return cls(vertices, faces, every, every).only(faces)

    @cached_property
    def connectivity(self) -> Connectivity:
        """Edges and faces. Raises MeshError if they form no oriented manifold."""
        return Connectivity(self.faces, self.vertices.shape[1])

    def only(self, faces: IntArray, merged: IntArray | None = None) -> NumberedShapes:
        """Keep the vertices of some faces.

        Args:
            faces: (G, 3) indices of vertices.
            merged: (V,) index of the vertex that replaces each vertex; every vertex stays itself if left out.
        """
        kept = np.unique(faces)
        number = np.full(self.vertices.shape[1], -1)
        number[kept] = np.arange(len(kept))
        if merged is not None:
            number = number[merged]
        return NumberedShapes(
            some_vertices(self.vertices, kept),
            np.searchsorted(kept, faces),
            self.file_numbers[kept],
            np.where(self.file_vertices >= 0, number[self.file_vertices], -1),
        )


class Coincidences(NamedTuple):
    """Vertices of shapes (n, V, 3) that coincide in every shape."""

    first: IntArray  # (V,) index of the first vertex that each vertex coincides with
    shares: FloatArray  # (n,) share of the first shape's coinciding pairs that coincide in each shape
    apart: int  # number of the first shape's coinciding pairs that don't coincide in every shape


def find_coincidences(vertices: FloatArray) -> Coincidences:
    """Find the vertices of shapes (n, V, 3) that coincide in every shape."""
    tolerance = TOLERANCES.weld * diagonal(vertices)
    pairs = KDTree(vertices[0]).query_pairs(tolerance[0], output_type="ndarray")
    near = np.ones(len(pairs), dtype=bool)
    shares = np.ones(len(vertices))
    for k, (shape, radius) in enumerate(zip(vertices, tolerance, strict=True)):
        here = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1) <= radius
        shares[k] = here.mean() if len(pairs) else 1
        near &= here
    i, j = pairs[near].T
    count = vertices.shape[1]
    graph = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count))
    _, group = sparse.csgraph.connected_components(graph, directed=False)
    _, first = np.unique(group, return_index=True)
    return Coincidences(first[group], shares, int((~near).sum()))


def weld(shapes: NumberedShapes, first: IntArray) -> NumberedShapes:
    """Replace each vertex by the first one that it coincides with, (V,).

    Raises:
        MeshError: two vertices of a face coincide in every shape.
    """
    faces = first[shapes.faces]
    thin = np.flatnonzero((faces == np.roll(faces, 1, axis=1)).any(axis=1))
    if len(thin):
        raise PlaceError(
            "face {face} has no area: in every shape two of its vertices coincide (to "
            f"{TOLERANCES.weld:g} of the mesh's size); collapse that edge in all meshes",
            {"face": [int(thin[0])]},
        )
    return shapes.only(faces, first)


def find_open_seams(shapes: NumberedShapes) -> IntArray:
    """Find pairs (k, 2) of border vertices that no edge joins and that almost coincide in every shape."""
    vertices, connectivity = shapes.vertices, shapes.connectivity
    border = np.unique(connectivity.edges[~connectivity.interior])
    if not len(border):
        return np.zeros((0, 2), int)
    tolerance = TOLERANCES.seam * diagonal(vertices)
    pairs = border[KDTree(vertices[0][border]).query_pairs(tolerance[0], output_type="ndarray")].reshape(-1, 2)
    for shape, radius in zip(vertices, tolerance, strict=True):
        pairs = pairs[np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1) <= radius]
    joined = connectivity.edges @ [connectivity.vertex_count, 1]
    pairs.sort(axis=1)
    seams: IntArray = pairs[~np.isin(pairs @ [connectivity.vertex_count, 1], joined)]
    return seams
