"""The composite network ``Φ = Ψ ∘ (ψ_1, …, ψ_J)`` (paper, section 3), and the affine sum that it corrects."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

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


class TunedNetwork(ShapeNetwork):
    """A composite as one network from codes (n, m) to NRIC (n, 2E), whose parts are trained together."""

    def __init__(self, composite: Composite) -> None:
        super().__init__()
        self.factors = composite.factors
        self.networks, self.combiner = nn.ModuleList(composite.networks), composite.combiner

    def target(self, z: Tensor) -> Tensor:
        """Return scaled differences (n, 2E) of NRIC."""
        return self.combiner.target(z)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Return scaled differences (n, 2E) of the joint shape for codes (n, m)."""
        return self.combiner.coefficients(factor_shapes(self.networks, self.factors, inputs))

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        """Return the combiner's loss for codes (n, m)."""
        return self.combiner.loss(factor_shapes(self.networks, self.factors, inputs), target)


def factor_shapes(networks: Iterable[nn.Module], factors: list[list[int]], latents: Tensor) -> Tensor:
    """Return NRIC (n, J, 2E) of each factor's network for its part of codes (n, m)."""
    columns = latents.unbind(dim=1)
    parts = (torch.stack([columns[j] for j in index], dim=1) for index in factors)
    return torch.stack([network(part) for network, part in zip(networks, parts, strict=True)], dim=1)


def affine_sum(reference: NDArray, factors: NDArray) -> NDArray:
    """Return ``z̄ + Σ_j (x_j − z̄)`` for factor shapes (n, J, 2E), the direct sum of the paper's condition (2)."""
    return reference + (factors - reference).sum(axis=1)
