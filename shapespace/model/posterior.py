"""How sure a code is: a Gaussian around it, from data that it was found by and from what codes are like."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from shapespace.arrays import FloatArray, IntArray
from shapespace.model.latent_space import Codes, LatentSpace
from shapespace.model.population import Population

#: Numbers of patches in which residuals are added up to see how they correlate, as far as a mesh has vertices for them.
PATCHES = (16, 32, 64, 128, 256, 512)
#: Fewest vertices of a patch, on average.
SMALLEST = 2


@dataclass(frozen=True, eq=False)
class Posterior:
    """A Gaussian around a code: Laplace's approximation.

    Attributes:
        covariance: (m, m), zero in the rows and columns of fixed coordinates.
        root: (m, f) with f free coordinates, ``root rootᵀ = covariance``.
    """

    covariance: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, normal: FloatArray, population: Population, fixed: NDArray[np.bool_]) -> Posterior:
        """Where half the squared misfit of data, each by its standard deviation, has a Hessian at the optimum.

        The covariance is ``(Σ⁻¹ + JᵀJ)⁻¹``, Σ that of the population, with fixed coordinates known (the inverse is of
        the rows and columns of the others).

        Args:
            normal: (m, m) JᵀJ, or another Hessian.
            population: what codes are like without the data.
            fixed: (m,) which coordinates are known.
        """
        free = np.flatnonzero(~fixed)
        whitening = solve_triangular(population.root, np.eye(len(fixed)), lower=True)[:, free]
        # Lower triangular K with K Kᵀ the precision; then K⁻ᵀ is a root of its inverse.
        factor = cholesky(whitening.T @ whitening + normal[np.ix_(free, free)], lower=True)
        root = np.zeros((len(fixed), len(free)))
        root[free] = solve_triangular(factor, np.eye(len(free)), lower=True).T
        return cls(root @ root.T, root)

    def sample(self, latents: LatentSpace, code: Codes, count: int, seed: int) -> Codes:
        """Random codes (count, m) around a code (m,), the same on every machine; not cut off at the bounds."""
        normal = np.random.Generator(np.random.PCG64(seed)).standard_normal((count, self.root.shape[1]))
        return latents.codes(code + normal @ self.root.T)[0]


def independent_share(residuals: FloatArray, patches: Iterable[IntArray]) -> float:
    """What share of the residuals (V, 3) of a mesh's vertices counts as independent observations, 1 at most.

    Neighbours miss their places alike: a sum over a patch of b vertices has a variance of b · τ times that of one
    vertex, where independent ones would have τ = 1. The share is 1/τ, for patches of the size at which τ is largest
    (integrated autocorrelation by batch means; Geyer 1992).

    Args:
        residuals: of a fit.
        patches: of the vertices, see ``patches_of``.
    """
    count, square = len(residuals), float((residuals**2).mean())
    if square == 0:
        return 1.0
    inflation = 1.0
    for patch in patches:
        sums = np.stack([np.bincount(patch, column) for column in residuals.T], axis=1)
        inflation = max(inflation, float((sums**2).sum() / (3 * count * square)))
    return 1 / inflation


def patches_of(points: FloatArray) -> list[IntArray]:
    """(V,) for each number of PATCHES, the patch of each point (V, 3): that of the nearest of as many far apart."""
    sizes = [size for size in PATCHES if SMALLEST * size <= len(points)]
    found, away, nearest, following = [], np.full(len(points), np.inf), np.zeros(len(points), np.int64), 0
    for k in range(max(sizes, default=0)):
        distance = ((points - points[following]) ** 2).sum(axis=1)
        nearest = np.where(distance < away, k, nearest)
        away = np.minimum(away, distance)
        following = int(away.argmax())
        if k + 1 in sizes:
            found.append(nearest.copy())
    return found
