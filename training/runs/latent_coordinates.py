"""Latent coordinates: their bounds and periods, and codes of one factor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray


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


def alone(latents: FloatArray, factor: list[int]) -> FloatArray:
    """Return codes (n, m) with the latents of one factor, and zero for all others."""
    result = np.zeros_like(latents)
    result[:, factor] = latents[:, factor]
    return result
