"""Parts of a mesh that convolutions learn on: where most is missed, at a fraction of what the whole mesh costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from shapespace.arrays import FloatArray, IntArray

#: Share of the crops whose centres are drawn from all edges alike.
UNIFORM = 0.25


@dataclass(frozen=True)
class Crop:
    """The edges near one edge of each of n shapes, as one graph of n K edges.

    Attributes:
        edges: (n, K) of the mesh.
        neighbours: (nK, k) places of each one's neighbours in the flat list, n K where there is none.
        inner: (n, K) whether all that the last layer hears of is there: it says what it would on the whole mesh.
    """

    edges: Tensor
    neighbours: Tensor
    inner: Tensor


class Crops:
    """Draws crops of a mesh.

    Args:
        midpoints: (E, 3) of the edges; neighbours are as far apart as these.
        neighbours: (E, k) table of a convolution, E where there is none.
        size: edges of a crop, at most.
        layers: convolutions, one after the other.

    Raises:
        ValueError: crops so small that none of their edges is an inner one.
    """

    def __init__(self, midpoints: FloatArray, neighbours: IntArray, size: int, layers: int) -> None:
        count = len(midpoints)
        self._neighbours, self._layers = torch.as_tensor(neighbours), layers
        edge, column = np.nonzero(neighbours < count)
        other = neighbours[edge, column]
        lengths = np.linalg.norm(midpoints[edge] - midpoints[other], axis=1)
        graph = sparse.csr_array((lengths, (edge, other)), shape=(count, count))
        size = min(size, count)
        self._nearest = torch.as_tensor(
            np.concatenate(
                [
                    np.argpartition(dijkstra(graph, indices=some), size - 1, axis=1)[:, :size]
                    for some in np.array_split(np.arange(count), count // 256 + 1)
                ]
            )
        )
        if not self.about(torch.zeros(1, dtype=torch.long)).inner.any():
            raise ValueError(f"a crop of {size} edges is too small for {layers} convolutions")

    def draw(self, missed: Tensor) -> Crop:
        """One crop of each shape about an edge drawn by what is missed there, (n, E) squares."""
        count = missed.shape[1]
        share = missed / missed.sum(dim=1, keepdim=True).clamp_min(1e-30)
        return self.about(torch.multinomial((1 - UNIFORM) * share + UNIFORM / count, 1)[:, 0])

    def about(self, centres: Tensor) -> Crop:
        """The crops about edges (n,)."""
        edges = self._nearest[centres]
        n, size = edges.shape
        place = torch.full((n, len(self._neighbours) + 1), -1)
        place.scatter_(1, edges, torch.arange(size).expand(n, -1))
        there = self._neighbours[edges]
        local = place.gather(1, there.flatten(1)).view_as(there)
        outside = (local < 0) & (there < len(self._neighbours))
        flat = torch.where(local < 0, n * size, local + size * torch.arange(n)[:, None, None]).flatten(0, 1)
        inner = ~outside.any(dim=2)
        for _ in range(self._layers - 1):
            known = torch.cat([inner.flatten(), torch.ones(1, dtype=torch.bool)])
            inner = inner & known[flat].all(dim=1).view(n, size)
        return Crop(edges, flat, inner)
