"""Crops of a mesh: connected groups of edges on which convolutions are trained."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.csgraph import dijkstra
from torch import Tensor

from shapespace.arrays import FloatArray, IntArray

#: Share of the crops whose centres are drawn uniformly from all edges.
UNIFORM = 0.25


@dataclass(frozen=True)
class Crop:
    """The K edges nearest to one edge of each of n shapes, as one graph of n K edges."""

    edges: Tensor  # (n, K) their indices in the mesh
    neighbours: Tensor  # (n K, k) indices of each edge's neighbours in the graph; n K for a missing neighbour
    inner: Tensor  # (n, K) whether all inputs of all layers are in the crop: the output is the whole mesh's


class Crops:
    """Draws crops of a mesh.

    Midpoints (E, 3) of the edges define the distances between neighbours. A convolution has ``neighbours`` (E, k) of
    each edge, E for a missing neighbour. The largest K is ``size``. Raises ValueError if crops are so small that none
    of their edges is an inner edge.
    """

    def __init__(self, midpoints: FloatArray, neighbours: IntArray, size: int, layers: int) -> None:
        self._neighbours, self._layers = torch.as_tensor(neighbours), layers
        self._nearest = torch.as_tensor(_nearest(midpoints, neighbours, min(size, len(midpoints))))
        if not self.about(torch.zeros(1, dtype=torch.long)).inner.any():
            raise ValueError(f"a crop of {size} edges is too small for {layers} convolutions")

    def draw(self, missed: Tensor) -> Crop:
        """Draw a crop of each shape, around an edge chosen in proportion to the squared error (n, E) or uniformly."""
        count = missed.shape[1]
        share = missed / missed.sum(dim=1, keepdim=True).clamp_min(1e-30)
        return self.about(torch.multinomial((1 - UNIFORM) * share + UNIFORM / count, 1)[:, 0])

    def about(self, centres: Tensor) -> Crop:
        """Return the crops around edges (n,)."""
        device = centres.device
        self._nearest, self._neighbours = self._nearest.to(device), self._neighbours.to(device)  # moved at most once
        edges = self._nearest[centres]
        (n, size), neighbours = edges.shape, self._neighbours[edges]
        place = torch.full((n, len(self._neighbours) + 1), -1, device=device)
        place.scatter_(1, edges, torch.arange(size, device=device).expand(n, -1))
        # Positions (n, K, k) of neighbours in the crops, −1 outside.
        local = place.gather(1, neighbours.flatten(1)).view_as(neighbours)
        first = size * torch.arange(n, device=device)[:, None, None]
        graph = torch.where(local < 0, n * size, local + first).flatten(0, 1)
        # An edge is an inner edge if no path with one step for each layer leads out of the crop.
        inner = ~((local < 0) & (neighbours < len(self._neighbours))).any(dim=2)
        for _ in range(self._layers - 1):
            known = torch.cat([inner.flatten(), torch.ones(1, dtype=torch.bool, device=device)])
            inner = inner & known[graph].all(dim=1).view_as(inner)
        return Crop(edges, graph, inner)


def _nearest(midpoints: FloatArray, neighbours: IntArray, size: int) -> IntArray:
    """Return the nearest edges (E, size) of each edge, by shortest paths over midpoints (E, 3) of neighbours (E, k)."""
    count = len(midpoints)
    edge, column = np.nonzero(neighbours < count)
    other = neighbours[edge, column]
    lengths = np.linalg.norm(midpoints[edge] - midpoints[other], axis=1)
    graph = sparse.csr_array((lengths, (edge, other)), shape=(count, count))
    # In parts, since all distances together are E² numbers.
    parts = np.array_split(np.arange(count), count // 256 + 1)
    distances = (dijkstra(graph, indices=part) for part in parts)
    return np.concatenate([np.argpartition(d, size - 1, axis=1)[:, :size] for d in distances])
