"""Derivatives of the networks by difference quotients, and factors on grids."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.model.decoder import Decoder

#: Step of a difference quotient, as a fraction of the coordinate's range. An angle may move a feature as small as a
#: bump around the shape. For other coordinates, smaller steps are dominated by rounding in the networks' float32.
PERIODIC_DIFFERENCE, DIFFERENCE = 1e-3, 1e-2
#: Step of a difference quotient through alignment and prolongation, as a fraction of the diagonal.
SMALL_MOVE = 1e-4
#: Number of nodes along each periodic coordinate of a factor, and maximum number of nodes of a factor's grid.
NODES, MOST_NODES = 32, 1024
#: Number of random sums of lengths and angles in a sketch.
SKETCH = 1024


def derivatives(model: Decoder, x: FloatArray) -> FloatArray:
    """Return derivatives (2E, m) of the networks at a code (m,), by differences.

    One code at a time is faster than a batch: the combiner's arrays for many codes do not fit into the cache.
    """
    steps = _steps(model)
    z, *moved = model.nric_nearby(x, steps)
    return np.stack([(there - z) / step for there, step in zip(moved, steps, strict=True)], axis=1)


def factor_derivatives(model: Decoder, x: FloatArray) -> FloatArray:
    """Return derivatives (2E, m) of the sum of the factors at a code (m,), by central differences."""
    columns = []
    for j, factor in enumerate(model.manifest.factors):
        own = x[factor.start : factor.stop]
        steps = np.diag(_steps(model)[factor.start : factor.stop])
        ahead, behind = np.split(model.factor(j, np.concatenate([own + steps, own - steps])), 2)
        columns.append((ahead - behind) / (2 * steps.diagonal()[:, None]))
    return np.concatenate(columns).T


def carried(
    model: Decoder, place: Callable[[FloatArray], FloatArray], shape: FloatArray, fields: FloatArray
) -> FloatArray:
    """Differentiate a function of a shape, for example alignment and prolongation, by differences.

    ``place`` maps shapes (…, V, 3) to points (…, k, 3). Returns derivatives (m, k, 3) at a normalised shape (V, 3),
    along fields (m, V, 3).
    """
    h = SMALL_MOVE * model.reference.diagonal / max(np.abs(fields).max(), np.finfo(float).tiny)
    return (place(shape + h * fields) - place(shape)) / h


def _steps(model: Decoder) -> FloatArray:
    latents = model.latents
    return np.where(latents.periodic, PERIODIC_DIFFERENCE, DIFFERENCE) * latents.width


def nodes(model: Decoder, j: int) -> FloatArray:
    """Return grid nodes (n, m_j) over the coordinates of a factor if all are periodic, otherwise none.

    Along a period the misfit may have to grow before it falls, so that descent alone does not find the minimum.
    """
    factor, latents = model.manifest.factors[j], model.latents
    own, size = slice(factor.start, factor.stop), factor.stop - factor.start
    if not latents.periodic[own].all():
        return np.zeros((0, size))
    count = max(2, int(min(NODES, MOST_NODES ** (1 / size) + 1e-9)))
    shares = np.stack(np.meshgrid(*[np.arange(count) / count] * size, indexing="ij"), axis=-1).reshape(-1, size)
    return latents.lower[own] + shares * latents.width[own]


def batches(nodes: FloatArray) -> list[FloatArray]:
    """Split nodes into batches whose shapes fit into the cache."""
    return np.array_split(nodes, -(-len(nodes) // 16)) if len(nodes) else []


@dataclass(frozen=True, eq=False)
class FactorGrids:
    """Sketches of a model's periodic factors on grids, which keep scalar products to a few percent.

    Each length or angle, weighted by its norm, is added with a random sign to one of SKETCH sums (a count sketch:
    Charikar, Chen and Farach-Colton 2002), which takes a tenth of the memory.
    """

    images: dict[int, FloatArray]  # for each factor, sketches (n, SKETCH) of ``ψ_j − z̄`` at its nodes
    _matrix: sparse.csr_array

    @classmethod
    def of(cls, model: Decoder, centre: FloatArray, root: FloatArray) -> FactorGrids:
        """Run the factors of a model on their grids, given z̄ (2E,) and roots (2E,) of the norm's weights."""
        rng = np.random.default_rng(0)
        signs, sums = rng.choice([-1.0, 1.0], len(root)), rng.integers(SKETCH, size=len(root))
        matrix = sparse.csr_array((signs, (sums, np.arange(len(root)))), shape=(SKETCH, len(root)))
        images = {}
        for j in range(len(model.manifest.factors)):
            parts = [(matrix @ (root * (model.factor(j, part) - centre)).T).T for part in batches(nodes(model, j))]
            if parts:
                images[j] = np.concatenate(parts)
        return cls(images, matrix)

    def sketch(self, weighted: FloatArray) -> FloatArray:
        """Return the sketch (SKETCH,) of a weighted difference (2E,) of NRIC."""
        return self._matrix @ weighted
