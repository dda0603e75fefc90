"""Products of two factors' coefficients, which correct the affine sum."""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import torch
from torch import Tensor

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.learning.linear import principal_axes, regression
from shapespace.training.runs.network_settings import ProductSettings


class ProductCorrection(Correction):
    """Bilinear map of the factor shapes, fitted by ridge regression.

    Features are a few principal coefficients of each factor and their products between every two factors. The linear
    map from these has a low rank. Where two factors overlap widely, their interaction is smooth and global, and a few
    products replace many convolutions.
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
        """Return the correction with these tensors, which determine the sizes; see `Correction`."""
        factors, size, coefficients = tensors["axes"].shape
        result = cls(factors, coefficients, size)
        result.load_state_dict(tensors)
        return result

    @classmethod
    def fit(
        cls, settings: ProductSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> ProductCorrection:
        """Fit axes and weights to samples; see `Correction`."""
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
        """Find principal axes of each factor's shapes, scaled to coefficients with a variance of one."""
        self.centre.copy_(y.mean(dim=0))
        for j in range(y.shape[1]):
            s, axes = principal_axes(y[:, j] - self.centre[j], by="svd")
            count = min(self.axes.shape[2], len(s))
            # Equal variances, so that one penalty suits all products. Coefficients with almost no variance are rounding
            # errors and stay small.
            self.axes[j, :, :count] = (axes[:count] / s[:count, None].clamp_min(1e-2 * s[0]) * len(y) ** 0.5).T

    def _features(self, y: Tensor) -> Tensor:
        """Return features (n, 1 + J d + ½ J (J − 1) d²) of factor shapes (n, J, 2E)."""
        c = torch.einsum("njs,jsr->njr", y - self.centre, self.axes)
        products = [(c[:, i, :, None] * c[:, j, None, :]).flatten(1) for i, j in self.pairs]
        return torch.cat([torch.ones_like(c[:, 0, :1]), c.flatten(1), *products], dim=1)

    def difference(self, y: Tensor) -> Tensor:
        return self._features(y) @ self.weights @ self.basis
