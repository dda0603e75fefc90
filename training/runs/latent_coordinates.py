"""Latent coordinates: their bounds and periods, and codes of one factor."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import ndtr, ndtri

from shapespace.arrays import FloatArray

#: How random codes are drawn, see `Coordinates.drawn`.
Distribution = Literal["box", "ball", "normal"]


@dataclass(frozen=True)
class Coordinates:
    """Bounds (m,) of the hypercube of latent coordinates, and their periods, NaN where there is none."""

    lower: FloatArray
    upper: FloatArray
    period: FloatArray

    def __getitem__(self, index: list[int]) -> Coordinates:
        return Coordinates(self.lower[index], self.upper[index], self.period[index])

    def __len__(self) -> int:
        return len(self.lower)

    def uniform(self, count: int, rng: np.random.Generator) -> FloatArray:
        """Draw codes (count, m) uniformly in the hypercube."""
        return rng.uniform(self.lower, self.upper, (count, len(self)))

    def drawn(
        self, distribution: Distribution, factors: Iterable[list[int]], count: int, rng: np.random.Generator
    ) -> FloatArray:
        """Draw codes (count, m): in the hypercube, or each factor's part in an ellipsoid, or normally distributed.

        The ellipsoid touches the bounds. Normal distributions have half of the half width as standard deviation, and
        end at the bounds. Coordinates with a period are uniform.
        """
        if distribution == "box":
            return self.uniform(count, rng)
        codes = self.uniform(count, rng)
        centre, radius = (self.lower + self.upper) / 2, (self.upper - self.lower) / 2
        for index in factors:
            bounded = [j for j in index if np.isnan(self.period[j])]
            if distribution == "normal":
                units = ndtri(rng.uniform(ndtr(-2), ndtr(2), (count, len(bounded)))) / 2
            else:
                units = rng.standard_normal((count, len(bounded)))
                length = np.linalg.norm(units, axis=1, keepdims=True).clip(1e-300)
                units *= rng.uniform(size=(count, 1)) ** (1 / max(len(bounded), 1)) / length
            codes[:, bounded] = centre[bounded] + radius[bounded] * units
        return codes


def alone(latents: FloatArray, factor: list[int]) -> FloatArray:
    """Return codes (n, m) with the latents of one factor, and zero for all others."""
    result = np.zeros_like(latents)
    result[:, factor] = latents[:, factor]
    return result
