"""The composite network ``Φ = Ψ ∘ (ψ_1, …, ψ_J)`` (paper, section 3), and the affine sum that it corrects."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from numpy.typing import NDArray
from torch import Tensor

from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.networks import ShapeNetwork


@dataclass(frozen=True)
class Composite:
    """Factor networks ψ_j and the combiner Ψ, which maps their outputs to the joint shape."""

    factors: list[list[int]]  # latent indices of each factor
    networks: Sequence[ShapeNetwork]  # the factor networks ψ_j
    combiner: CombinerNetwork  # Ψ

    @property
    def parts(self) -> list[ShapeNetwork]:
        """All networks, the combiner last."""
        return [*self.networks, self.combiner]

    def __call__(self, latents: Tensor) -> Tensor:
        """Return NRIC (n, 2E) of codes (n, m)."""
        return self.combiner(self.factor_shapes(latents))

    def factor_shapes(self, latents: Tensor) -> Tensor:
        """Return the outputs (n, J, 2E) of the factor networks for codes (n, m)."""
        return factor_shapes(self.networks, self.factors, latents)


def factor_shapes(networks: Sequence[ShapeNetwork], factors: list[list[int]], latents: Tensor) -> Tensor:
    """Return NRIC (n, J, 2E) of each factor's network for its part of codes (n, m)."""
    return torch.stack([network(latents[:, index]) for network, index in zip(networks, factors, strict=True)], dim=1)


def affine_sum(reference: NDArray, factors: NDArray) -> NDArray:
    """Return ``z̄ + Σ_j (x_j − z̄)`` for factor shapes (n, J, 2E), the direct sum of the paper's condition (2)."""
    return reference + (factors - reference).sum(axis=1)
