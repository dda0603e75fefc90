"""Signs in the edges of a mesh that its vertices are in another order than in meshes with the same faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import Connectivity


@dataclass(frozen=True)
class OrderThresholds:
    """Differences from other meshes with the same faces that are signs of another order.

    Attributes:
        stretch, long: a vertex is misplaced if its shortest edge is longer than ``stretch`` times its longest edge in
            other meshes, and longer than ``long`` times the median edge of the mesh.
        scrambled: all vertices have another order if the median of all ratios of edges to the same edges in other
            meshes is larger.
        quantile: "in other meshes" means this quantile over all of them, so that it is enough if a quarter is right.
    """

    stretch: float = 2.0
    long: float = 3.0
    scrambled: float = 2.5
    quantile: float = 0.25


ORDER = OrderThresholds()


class VertexEdges:
    """The edges at each vertex of a mesh."""

    def __init__(self, connectivity: Connectivity) -> None:
        tail, head = np.concatenate([connectivity.edges, connectivity.edges[:, ::-1]]).T
        order = np.argsort(tail, kind="stable")
        self.tail, self.head = tail[order], head[order]
        self.starts = np.flatnonzero(np.diff(self.tail, prepend=-1))

    def lengths(self, shape: FloatArray) -> FloatArray:
        """Return the lengths (2E,) of the edges of a shape (V, 3), each edge from both ends, sorted by vertex."""
        return np.linalg.norm(shape[self.tail] - shape[self.head], axis=1)

    def range(self, lengths: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the shortest (V,) and the longest edge (V,) at each vertex, from ``lengths``."""
        return np.minimum.reduceat(lengths, self.starts), np.maximum.reduceat(lengths, self.starts)

    def neighbours_mean(self, values: FloatArray) -> FloatArray:
        """Return the mean (V, …) of values (V, …) over the neighbours of each vertex."""
        sums = np.add.reduceat(values[self.head], self.starts)
        return sums / np.diff(self.starts, append=len(self.head))[:, None]


def extent(shape: FloatArray) -> float:
    """Return the median distance of vertices (V, 3) from their median. A vertex far off would hide itself in a mean."""
    return float(np.median(np.linalg.norm(shape - np.median(shape, axis=0), axis=1)))


def times_longer(values: NDArray, extents: FloatArray, usual: NDArray, usual_extents: FloatArray) -> NDArray:
    """Divide lengths by the lengths in other meshes, both as they are and as shares of the extent; take the smaller.

    A mesh may be in another unit, or rolled up. An edge counts as long only if it is long in both senses.

    Args:
        values: (n, k) lengths in n meshes.
        extents: (n,) extents of these meshes.
        usual: (N, k) lengths in the other meshes.
        usual_extents: (N,) extents of the other meshes.
    """
    own, others = extents[:, None], usual_extents[:, None]
    raw = values / np.quantile(usual, ORDER.quantile, axis=0)
    scaled = (values / own) / np.quantile(usual / others, ORDER.quantile, axis=0)
    return np.minimum(raw, scaled)
