"""What codes of a population of shapes are like: a Gaussian with shrinkage."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, solve_triangular

from shapespace.arrays import FloatArray

#: A coordinate whose codes differ by less than this share of the bounds' width is taken to differ by that much.
NARROWEST = 1e-3
#: Correlations shrink by this share at least, so that two codes have a Gaussian too.
LEAST = 1e-6


@dataclass(frozen=True)
class Population:
    """A Gaussian of codes.

    Attributes:
        mean: (m,).
        covariance: (m, m), positive definite.
        root: (m, m) lower triangular, ``root rootᵀ = covariance``.
    """

    mean: FloatArray
    covariance: FloatArray
    root: FloatArray

    @classmethod
    def of(cls, codes: FloatArray, width: FloatArray) -> Population:
        """Of codes (n, m), n ≥ 1, given what counts as equally far in each coordinate (m,).

        Correlations shrink towards 0 by what expected squared error is smallest for (Ledoit and Wolf 2004, with
        variances kept): with few shapes most correlations of codes are chance.
        """
        count = len(codes)
        mean = codes.mean(axis=0)
        spread = np.maximum(codes.std(axis=0), NARROWEST * width)
        scores = (codes - mean) / spread
        correlation = scores.T @ scores / count
        off = correlation - np.diag(correlation.diagonal())
        # Variance of the entries of the correlation, which is what chance adds to their squares.
        chance = ((scores**2).T @ scores**2 / count - correlation**2) / count
        np.fill_diagonal(chance, 0)
        share = float(np.clip(chance.sum() / max(float((off**2).sum()), np.finfo(float).tiny), LEAST, 1))
        return cls._of(mean, np.outer(spread, spread) * ((1 - share) * off + np.eye(len(mean))))

    @classmethod
    def in_box(cls, lower: FloatArray, upper: FloatArray) -> Population:
        """With mean and variances of codes uniform in a box (m,), for a model that was made from no shapes."""
        return cls._of((lower + upper) / 2, np.diag((upper - lower) ** 2 / 12))

    @classmethod
    def _of(cls, mean: FloatArray, covariance: FloatArray) -> Population:
        return cls(mean, covariance, cholesky(covariance, lower=True))

    def scores(self, codes: FloatArray) -> FloatArray:
        """Codes (…, m) in coordinates in which the Gaussian is standard; their squares sum to Mahalanobis distances."""
        result: FloatArray = solve_triangular(self.root, np.atleast_2d(codes - self.mean).T, lower=True).T
        return result.reshape(codes.shape)

    def sample(self, count: int, seed: int, temperature: float = 1.0) -> FloatArray:
        """Random codes (count, m), the same on every machine; a temperature scales their differences from the mean."""
        normal = np.random.Generator(np.random.PCG64(seed)).standard_normal((count, len(self.mean)))
        return self.mean + temperature * normal @ self.root.T
