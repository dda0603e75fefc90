"""Corrections of the affine sum of the factors' shapes: what they have in common, and products of two factors."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.layers import Scaling
from shapespace.training.learning.linear import principal_axes, regression
from shapespace.training.runs.config import FitSettings, ProductSettings
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


class ProductCorrection(Correction):
    """A bilinear map of the factors' shapes, fitted by ridge regression.

    Features are a few principal coefficients of each factor and their products between every two factors; the linear
    map from these has a low rank. Where two factors overlap widely, their interaction is smooth and global, and a few
    products represent what many convolutions would be needed for.
    """

    centre: Tensor
    axes: Tensor
    weights: Tensor
    basis: Tensor
    #: Largest rank of the linear map.
    RANK = 64

    def __init__(self, factor_count: int, coefficients: int, size: int) -> None:
        super().__init__()
        self.pairs = list(itertools.combinations(range(factor_count), 2))
        self.register_buffer("centre", torch.zeros(factor_count, size))
        self.register_buffer("axes", torch.zeros(factor_count, size, coefficients))
        features = 1 + factor_count * coefficients + len(self.pairs) * coefficients**2
        self.register_buffer("weights", torch.zeros(features, min(features, self.RANK)))
        self.register_buffer("basis", torch.zeros(min(features, self.RANK), size))

    @classmethod
    def load(
        cls, settings: ProductSettings, reference: TriangleMesh, tensors: Mapping[str, Tensor]
    ) -> ProductCorrection:
        """See `Correction`; sizes are those of the tensors."""
        factors, size, coefficients = tensors["axes"].shape
        result = cls(factors, coefficients, size)
        result.load_state_dict(tensors)
        return result

    @classmethod
    def fit(
        cls, settings: ProductSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> ProductCorrection:
        """See `Correction`."""
        y, others = own.inputs, held_out.inputs
        residual, wanted = (s.scaling.down(s.joint) - x.sum(dim=1) for s, x in ((own, y), (held_out, others)))
        result = cls(y.shape[1], settings.coefficients, y.shape[2])
        result._fit_axes(y)
        fitted = regression(result._features(y), residual, (result._features(others), wanted))
        weights, basis = fitted.low_rank(len(result.basis))
        result.weights.copy_(weights)
        result.basis.copy_(basis)
        return result

    def _fit_axes(self, y: Tensor) -> None:
        """Principal axes of the shapes of each factor, scaled so that coefficients have a variance of one."""
        self.centre.copy_(y.mean(dim=0))
        for j in range(y.shape[1]):
            s, axes = principal_axes(y[:, j] - self.centre[j], by="svd")
            count = min(self.axes.shape[2], len(s))
            # Equal variances, so that one penalty suits all products; those of almost no variance are rounding errors
            # and stay small.
            self.axes[j, :, :count] = (axes[:count] / s[:count, None].clamp_min(1e-2 * s[0]) * len(y) ** 0.5).T

    def _features(self, y: Tensor) -> Tensor:
        """(n, 1 + J d + ½ J (J − 1) d²) of the factors' shapes (n, J, 2E)."""
        c = torch.einsum("njs,jsr->njr", y - self.centre, self.axes)
        products = [(c[:, i, :, None] * c[:, j, None, :]).flatten(1) for i, j in self.pairs]
        return torch.cat([torch.ones_like(c[:, 0, :1]), c.flatten(1), *products], dim=1)

    def difference(self, y: Tensor) -> Tensor:
        return self._features(y) @ self.weights @ self.basis
