"""Fixed Laplace equations as products with a few small dense matrices, for runtimes without sparse solvers.

The unknowns of a graph are split into blocks, none of which touches another, and a separator between them. The inverse
of each block, and of the Schur complement on the separator, then give the solution (substructuring: Przemieniecki
1963). Altogether these matrices are far smaller than one inverse: 0.5 million entries instead of 16.8 million for the
4096 faces of a torus.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components

from shapespace.arrays import FloatArray, IntArray

#: Largest number of halvings of the graph.
HALVINGS = 8


@dataclass(frozen=True, eq=False)
class Substructures:
    """A Laplace equation ``L x = b`` with k blocks of at most w unknowns, and s unknowns in the separator.

    Slots are the places of unknowns in the right-hand side and in the solution: k w for the blocks, then s for the
    separator. A block with fewer than w unknowns has empty slots, whose matrix entries are zero. Solutions have mean
    zero on each connected component of the graph, and so must right-hand sides.
    """

    unknowns: IntArray  # (k w + s,) the unknown in each slot, −1 in an empty slot
    slots: IntArray  # (n,) the slot of each unknown
    blocks: FloatArray  # (k, w, w) inverses of the blocks
    separator: FloatArray  # (s, s) pseudo-inverse of the Schur complement
    coupling: sparse.csr_array  # (s, k w) minus the entries of L between the separator and the blocks
    components: IntArray  # (n,) the connected component of each unknown

    @classmethod
    def of(cls, size: int, tails: IntArray, heads: IntArray, weights: FloatArray) -> Substructures:
        """Split the Laplacian of a weighted graph with ``size`` nodes, so that the matrices have the fewest entries."""
        graph = sparse.csr_array((weights, (tails, heads)), shape=(size, size))
        graph = sparse.csr_array(graph + graph.T)
        graph.setdiag(0)
        graph.eliminate_zeros()
        components = connected_components(graph, directed=False)[1].astype(np.int64)
        # Each component needs a node in the separator, so that the equation of a block has one solution.
        separator: IntArray = np.unique(components, return_index=True)[1].astype(np.int64)
        parts = _without(np.arange(size), separator, size)
        best, entries = (parts, separator), _entries(parts, separator)
        for _ in range(HALVINGS):
            halves = [half for part in parts for half in _halved(graph, part)]
            kept = np.concatenate([np.arange(0), *halves])
            separator = np.setdiff1d(np.arange(size), kept)
            parts = [half for half in halves if len(half)]
            if (now := _entries(parts, separator)) < entries:
                best, entries = (parts, separator), now
        return cls._eliminated(graph, *best, components)

    @classmethod
    def _eliminated(
        cls, graph: sparse.csr_array, parts: list[IntArray], separator: IntArray, components: IntArray
    ) -> Substructures:
        width, count = max((len(part) for part in parts), default=0), len(parts)
        unknowns = np.full(count * width + len(separator), -1)
        unknowns[count * width :] = separator
        slots = np.empty(graph.shape[0], dtype=np.int64)
        degree = graph.sum(axis=1)
        schur = np.diag(degree[separator]) - graph[separator][:, separator].toarray()
        blocks = np.zeros((count, width, width))
        for k, part in enumerate(parts):
            unknowns[k * width : k * width + len(part)] = part
            inverse = np.linalg.inv(np.diag(degree[part]) - graph[part][:, part].toarray())
            blocks[k, : len(part), : len(part)] = (inverse + inverse.T) / 2
            between = graph[separator][:, part]
            schur -= between @ (between @ inverse).T
        filled = unknowns >= 0
        slots[unknowns[filled]] = np.flatnonzero(filled)
        # The Schur complement is singular: its null space are the constants on each component.
        constants = (components[separator][:, None] == np.unique(components)).astype(float)
        constants /= np.sqrt(constants.sum(axis=0))
        shift = np.abs(schur).max(initial=1e-300) * (constants @ constants.T)
        inverse = np.linalg.inv(schur + shift)
        mean_free = np.eye(len(separator)) - constants @ constants.T
        inverse = mean_free @ ((inverse + inverse.T) / 2) @ mean_free
        to_slots = sparse.csr_array(
            (
                np.ones(len(unknowns[: count * width])),
                (np.maximum(unknowns[: count * width], 0), np.arange(count * width)),
            ),
            shape=(graph.shape[0], count * width),
        )
        to_slots.data[unknowns[: count * width][to_slots.indices] < 0] = 0
        coupling = sparse.csr_array(graph[separator] @ to_slots)
        coupling.eliminate_zeros()
        return cls(unknowns, slots, blocks, inverse, coupling, components)

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve for right-hand sides (n, c), as other runtimes do: products with the matrices in turn."""
        inner = self.blocks.shape[0] * self.blocks.shape[1]
        given = np.where(self.unknowns[:, None] >= 0, right[self.unknowns], 0)
        blocks = given[:inner].reshape(*self.blocks.shape[:2], -1)
        alone = (self.blocks @ blocks).reshape(inner, -1)
        between = self.separator @ (given[inner:] + self.coupling @ alone)
        across = (self.coupling.T @ between).reshape(blocks.shape)
        found = np.concatenate([alone + (self.blocks @ across).reshape(inner, -1), between])[self.slots]
        sums = np.zeros((self.components.max(initial=-1) + 1, found.shape[1]))
        np.add.at(sums, self.components, found)
        return found - (sums / np.bincount(self.components)[:, None])[self.components]


def _entries(parts: list[IntArray], separator: IntArray) -> int:
    return len(parts) * max((len(part) for part in parts), default=0) ** 2 + len(separator) ** 2


def _without(part: IntArray, separator: IntArray, size: int) -> list[IntArray]:
    rest = np.setdiff1d(part, separator)
    return [rest] if len(rest) else []


def _halved(graph: sparse.csr_array, part: IntArray) -> list[IntArray]:
    """Split some nodes into two halves that don't touch, without the nodes in between."""
    if len(part) < 4:
        return [part]
    own = sparse.csr_array(graph[part][:, part])
    order = _from_the_end(own)
    near = np.zeros(len(part), dtype=bool)
    near[order[: len(part) // 2]] = True
    borders = near & (own @ (~near).astype(float) > 0), ~near & (own @ near.astype(float) > 0)
    removed = min(borders, key=lambda border: int(border.sum()))
    return [part[near & ~removed], part[~near & ~removed]]


def _from_the_end(graph: sparse.csr_array) -> IntArray:
    """Order the nodes of a graph by their distance from one end, one connected component after another."""
    found = []
    labels = connected_components(graph, directed=False)[1]
    for label in range(labels.max(initial=-1) + 1):
        start = int(np.flatnonzero(labels == label)[0])
        for _ in range(3):
            order = breadth_first_order(graph, start, directed=False, return_predecessors=False)
            start = int(order[-1])
        found.append(order)
    return np.concatenate(found).astype(np.int64)
