"""The interface of corrections of the affine sum, and the samples that they are fitted to."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.coordinates.integrability import Integrability
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.layers import Scaling
from shapespace.training.runs.network_settings import FitSettings
from shapespace.training.runs.sampling import FeaturePositions

#: Factor shapes (n, J, 2E), and joint shapes minus affine sums (n, 2E), as scaled differences.
Pairs = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Slopes:
    """Derivatives at some joint samples by the latents, per half width of their bounds, as scaled differences."""

    inputs: Tensor  # (k, J, 2E) factor shapes of these samples
    latents: list[list[int]]  # latents of each factor, see `JointSamples`
    own: Tensor  # (k, m, 2E) derivatives of the shape of the latent's factor
    missed: Tensor  # (k, m, 2E) derivatives of the difference between the joint shape and the affine sum

    def coefficients(self, axes: Tensor, columns: NDArray | slice = slice(None)) -> Tensor:
        """Return derivatives (k m, J d) of coefficients of factor shapes along axes (J, S, d), in S entries of NRIC."""
        own = self.own[:, :, columns].to(axes.dtype)
        result = torch.zeros(*own.shape[:2], len(axes), axes.shape[2], dtype=axes.dtype)
        for j, index in enumerate(self.latents):
            result[:, index, j] = own[:, index] @ axes[j]
        return result.flatten(2).flatten(0, 1)


@dataclass(frozen=True)
class Motion:
    """Positions of the features that codes move over the surface."""

    # (n, m) codes of the joint samples as angles. Images under symmetries come after these and have no codes.
    codes: Tensor
    places: FeaturePositions  # positions of the latents relative to the edges


@dataclass(frozen=True)
class JointSamples:
    """Samples that a correction is fitted to, or chosen by."""

    factors: Tensor  # (n, J, 2E) NRIC of the factor shapes
    joint: Tensor  # (n, 2E) NRIC of the joint shapes
    scaling: Scaling  # maps NRIC to scaled differences
    latents: list[list[int]]  # latents of each factor; no other factor's shape depends on them
    slopes: Slopes | None = None  # derivatives to fit as well, if there are any
    motion: Motion | None = None  # positions of features, if codes move features

    @property
    def rest(self) -> Tensor:
        """Lengths and angles (E, 2) of the reference, each with mean 0 and variance 1."""
        rest = self.scaling.mean.view(2, -1).T
        return (rest - rest.mean(dim=0)) / rest.std(dim=0).clamp_min(1e-6)

    @property
    def inputs(self) -> Tensor:
        """Scaled differences (n, J, 2E) of the factor shapes."""
        return self.scaling.down(self.factors)

    @property
    def pairs(self) -> Pairs:
        """`inputs` and `missed`."""
        return self.inputs, self.missed

    @property
    def missed(self) -> Tensor:
        """Scaled differences (n, 2E) between joint shapes and affine sums, from NRIC in single precision."""
        # In parts, since all inputs together take J times the memory of the result.
        sums = torch.cat([self.scaling.up(self.scaling.down(part).sum(dim=1)) for part in self.factors.split(32)])
        return (self.joint - sums) * self.scaling.factor


class Correction(nn.Module, ABC):
    """Map from factor shapes (n, J, 2E) to the joint shape (n, 2E), all as scaled differences.

    Every kind implements `fit` and `difference` (or `forward`); its state is its ``state_dict()``. Kinds without
    trained parameters are made of these tensors.
    """

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.gaps: SurfaceGaps | None = None
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    @classmethod
    @abstractmethod
    def fit(cls, settings: Any, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int) -> Self:
        """Fit all parts that have a closed form to training samples; held-out samples choose penalties."""

    @classmethod
    def load(cls, settings: Any, reference: TriangleMesh, tensors: Mapping[str, Tensor]) -> Self:
        """Return the correction with this ``state_dict()``."""
        return cls(tensors)

    @property
    def descent(self) -> FitSettings | None:
        """Settings of gradient descent after `fit`; None if there is nothing to train."""
        return None

    def difference(self, y: Tensor) -> Tensor:
        """Return the correction (n, 2E) of the affine sum."""
        raise NotImplementedError

    def forward(self, y: Tensor) -> Tensor:
        return y.sum(dim=1) + self.difference(y)

    def penalise_gaps(self, weight: float, reference: TriangleMesh, scaling: Scaling) -> None:
        """Add a penalty to the loss on whole shapes, for training only. Without a weight, do nothing."""
        if weight:
            self.gaps = SurfaceGaps(weight, reference, scaling)

    def loss(self, y: Tensor, target: Tensor) -> Tensor:
        """Return the mean square error, or an estimate of it, for training, with the penalty if there is one."""
        missed = self(y) - target
        error = missed.square().mean()
        return error if self.gaps is None else error + self.gaps(missed)


class SurfaceGaps(nn.Module):
    """Penalty for errors (n, 2E) of scaled differences that are not the change of any surface.

    Such lengths and angles leave a gap between the first and the last face around a vertex. The penalty is the mean
    square of the gaps, linearised at the reference. Its scale is such that errors which are equal in all directions
    have ``weight`` times their mean square as penalty.
    """

    rows: Tensor
    columns: Tensor
    values: Tensor

    def __init__(self, weight: float, reference: TriangleMesh, scaling: Scaling) -> None:
        super().__init__()
        closing = Integrability(reference.connectivity).jacobian(scaling.mean.double().numpy())
        change = (closing * scaling.inverse.double().numpy()[None]).tocoo()
        values = torch.as_tensor(change.data) * (weight / max(np.square(change.data).sum(), 1e-30)) ** 0.5
        self.count = closing.shape[0]
        # No part of the model: bundles and files of networks do not have it.
        self.register_buffer("rows", torch.as_tensor(change.row, dtype=torch.long), persistent=False)
        self.register_buffer("columns", torch.as_tensor(change.col, dtype=torch.long), persistent=False)
        self.register_buffer("values", values.float(), persistent=False)

    def forward(self, missed: Tensor) -> Tensor:
        """Return the mean penalty of errors (n, 2E)."""
        gaps = missed.new_zeros(self.count, len(missed))
        gaps = gaps.index_add(0, self.rows, (missed[:, self.columns] * self.values).T)
        return gaps.square().sum() / len(missed)
