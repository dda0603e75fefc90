"""Posterior of a code: a Gaussian around it, from the data of the search and the population of codes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from shapespace.arrays import FloatArray, IntArray
from shapespace.model.latent_space import Codes, LatentSpace
from shapespace.model.population import Population

#: Numbers of patches over which residuals are summed to measure their correlation, as far as vertices suffice.
PATCHES = (16, 32, 64, 128, 256, 512)
#: Least average number of vertices of a patch.
SMALLEST = 2


@dataclass(frozen=True, eq=False)
class Posterior:
    """Gaussian around a code (Laplace's approximation)."""

    covariance: FloatArray  # (m, m) covariance, zero in the rows and columns of fixed coordinates
    root: FloatArray  # (m, f) with f free coordinates, ``root rootᵀ = covariance``

    @classmethod
    def of(cls, normal: FloatArray, population: Population, fixed: NDArray[np.bool_]) -> Posterior:
        """Compute the posterior from the Hessian of the data's misfit at the optimum.

        The covariance is ``(Σ⁻¹ + JᵀJ)⁻¹`` over the free coordinates, with Σ the covariance of the population. J is the
        derivative of the residuals divided by their standard deviations. ``normal`` (m, m) is JᵀJ, or another Hessian
        of half the squared misfit.
        """
        free = np.flatnonzero(~fixed)
        whitening = solve_triangular(population.root, np.eye(len(fixed)), lower=True)[:, free]
        # K is lower triangular and K Kᵀ is the precision, so K⁻ᵀ is a root of the covariance.
        factor = cholesky(whitening.T @ whitening + normal[np.ix_(free, free)], lower=True)
        root = np.zeros((len(fixed), len(free)))
        root[free] = solve_triangular(factor, np.eye(len(free)), lower=True).T
        return cls(root @ root.T, root)

    def sample(self, latents: LatentSpace, code: Codes, count: int, seed: int) -> Codes:
        """Return random codes (count, m) around a code (m,), the same on every machine; not cut off at the bounds."""
        normal = np.random.Generator(np.random.PCG64(seed)).standard_normal((count, self.root.shape[1]))
        return latents.codes(code + normal @ self.root.T)[0]


def independent_share(residuals: FloatArray, patches: Iterable[IntArray]) -> float:
    """Return the share of residuals (V, 3) at vertices that counts as independent observations, at most 1.

    Residuals of neighbours are correlated. The sum over a patch of b vertices has b · τ times the variance of one
    vertex, and τ = 1 without correlation. The share is 1/τ for the patch size with the largest τ (integrated
    autocorrelation by batch means; Geyer 1992). For patches see ``patches_of``.
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
    """Return, for each number in PATCHES, the patch (V,) of each point (V, 3): its nearest of the patch centres."""
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
