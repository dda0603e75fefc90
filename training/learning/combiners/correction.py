"""The interface of corrections of the affine sum, and the samples that they are fitted to."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.layers import Scaling
from shapespace.training.runs.config import FitSettings
from shapespace.training.runs.sampling import FeaturePositions

#: Factor shapes (n, J, 2E), and the residual (n, 2E) of their affine sum to the joint shape, as scaled differences.
Pairs = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Slopes:
    """Derivatives at some joint samples by the latents, each in halves of its bounds' width; scaled differences.

    Attributes:
        inputs: (k, J, 2E) the factors' shapes of these samples.
        latents: of each factor, see `JointSamples`.
        own: (k, m, 2E) derivatives of that factor's shape.
        missed: (k, m, 2E) derivatives of the difference between the joint shape and the affine sum.
    """

    inputs: Tensor
    latents: list[list[int]]
    own: Tensor
    missed: Tensor

    def coefficients(self, axes: Tensor, columns: NDArray | slice = slice(None)) -> Tensor:
        """(k m, J d) derivatives of coefficients of the factors' shapes, along axes (J, S, d) in S entries of NRIC."""
        own = self.own[:, :, columns].to(axes.dtype)
        result = torch.zeros(*own.shape[:2], len(axes), axes.shape[2], dtype=axes.dtype)
        for j, index in enumerate(self.latents):
            result[:, index, j] = own[:, index] @ axes[j]
        return result.flatten(2).flatten(0, 1)

    def repeated(self, inputs: Tensor) -> Tensor:
        """(k m, …) something (k, …) of each sample, once for each latent."""
        return inputs.repeat_interleave(self.own.shape[1], dim=0)


@dataclass(frozen=True)
class Motion:
    """Where features are that codes move over the surface.

    Attributes:
        codes: (n, m) of the joint samples, as angles; images under symmetries have none and come after.
        places: of the latents at the edges.
    """

    codes: Tensor
    places: FeaturePositions


@dataclass(frozen=True)
class JointSamples:
    """What a correction is fitted to, or chosen by.

    Attributes:
        factors: (n, J, 2E) NRIC of the factors' shapes.
        joint: (n, 2E) NRIC of the joint shapes.
        scaling: to scaled differences.
        latents: of each factor; no other factor's shape depends on them.
        slopes: derivatives to fit to as well, where there are some.
        motion: of features, where codes move them.
    """

    factors: Tensor
    joint: Tensor
    scaling: Scaling
    latents: list[list[int]]
    slopes: Slopes | None = None
    motion: Motion | None = None

    @property
    def inputs(self) -> Tensor:
        """(n, J, 2E) scaled differences of the factors' shapes."""
        return self.scaling.down(self.factors)

    @property
    def pairs(self) -> Pairs:
        """`inputs` and `missed`."""
        return self.inputs, self.missed

    @property
    def missed(self) -> Tensor:
        """(n, 2E) scaled differences of the joint shapes from the affine sums, in NRIC of single precision."""
        # In parts, since all inputs together take J times the room of the result.
        sums = torch.cat([self.scaling.up(self.scaling.down(part).sum(dim=1)) for part in self.factors.split(32)])
        return (self.joint - sums) * self.scaling.factor


class Correction(nn.Module, ABC):
    """The joint shape from those of the factors, (n, J, 2E) → (n, 2E), all of them as scaled differences.

    Every kind implements `fit`, `difference` (or `forward`) and `load`; its state is its ``state_dict()``.
    """

    @classmethod
    @abstractmethod
    def fit(cls, settings: Any, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int) -> Self:
        """Fit all that has a closed form.

        Args:
            settings: of this kind.
            reference: the mesh.
            own: samples to fit to.
            held_out: samples that choose penalties.
            seed: of whatever is random.
        """

    @classmethod
    @abstractmethod
    def load(cls, settings: Any, reference: TriangleMesh, tensors: Mapping[str, Tensor]) -> Self:
        """What a ``state_dict()`` was of."""

    @property
    def descent(self) -> FitSettings | None:
        """How to train it by gradient descent after `fit`; None where there is nothing to train."""
        return None

    def difference(self, y: Tensor) -> Tensor:
        """(n, 2E) what is added to the affine sum."""
        raise NotImplementedError

    def forward(self, y: Tensor) -> Tensor:
        return y.sum(dim=1) + self.difference(y)

    def loss(self, y: Tensor, target: Tensor) -> Tensor:
        """Mean square error, or an estimate of it, to train with."""
        return nn.functional.mse_loss(self(y), target)
