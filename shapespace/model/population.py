"""Distribution of a population's codes: a Gaussian with shrinkage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from shapespace.arrays import FloatArray

#: Least standard deviation of a coordinate, as a share of the bounds' width.
NARROWEST = 1e-3
#: Least shrinkage of correlations, so that even two codes have a Gaussian.
LEAST = 1e-6


@dataclass(frozen=True)
class Population:
    """Gaussian distribution of codes.

    Attributes:
        mean: (m,) mean.
        covariance: (m, m) positive definite covariance.
        root: (m, m) lower triangular, ``root rootᵀ = covariance``.
    """

    mean: FloatArray
    covariance: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, codes: FloatArray, width: FloatArray) -> Population:
        """Fit a Gaussian to codes (n, m), n ≥ 1, given the unit of distance (m,) in each coordinate.

        Correlations shrink towards 0 by the share with the smallest expected squared error (Ledoit and Wolf 2004, with
        variances kept). With few shapes, most correlations are chance.
        """
        count = len(codes)
        mean = codes.mean(axis=0)
        spread = np.maximum(codes.std(axis=0), NARROWEST * width)
        scores = (codes - mean) / spread
        correlation = scores.T @ scores / count
        off = correlation - np.diag(correlation.diagonal())
        # Variance of the entries of the correlation: chance adds it to their squares.
        chance = ((scores**2).T @ scores**2 / count - correlation**2) / count
        np.fill_diagonal(chance, 0)
        share = float(np.clip(chance.sum() / max(float((off**2).sum()), np.finfo(float).tiny), LEAST, 1))
        return cls._of(mean, np.outer(spread, spread) * ((1 - share) * off + np.eye(len(mean))))

    @classmethod
    def in_box(cls, lower: FloatArray, upper: FloatArray) -> Population:
        """Return the Gaussian with mean and variances of uniform codes in a box (m,), for models without shapes."""
        return cls._of((lower + upper) / 2, np.diag((upper - lower) ** 2 / 12))

    @classmethod
    def _of(cls, mean: FloatArray, covariance: FloatArray) -> Population:
        return cls(mean, covariance, cholesky(covariance, lower=True))

    def scores(self, codes: FloatArray) -> FloatArray:
        """Return codes (…, m) in standard coordinates; their squares sum to squared Mahalanobis distances."""
        result: FloatArray = solve_triangular(self.root, np.atleast_2d(codes - self.mean).T, lower=True).T
        return result.reshape(codes.shape)

    def sample(self, count: int, seed: int, temperature: float = 1.0) -> FloatArray:
        """Return random codes (count, m), the same on every machine; temperature scales their differences."""
        normal = np.random.Generator(np.random.PCG64(seed)).standard_normal((count, len(self.mean)))
        return self.mean + temperature * normal @ self.root.T
