"""Products of two factors' coefficients, which correct the affine sum."""

from __future__ import annotations

import itertools

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

    centre: Tensor  # (J, 2E) mean shape of each factor
    axes: Tensor  # (J, 2E, d) principal axes of each factor's shapes, scaled to coefficients with a variance of one
    weights: Tensor  # (1 + J d + ½ J (J − 1) d², r)
    basis: Tensor  # (r, 2E)
    #: Largest rank of the linear map.
    RANK = 64

    @classmethod
    def fit(
        cls, settings: ProductSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> ProductCorrection:
        y, others = own.inputs, held_out.inputs
        residual, wanted = (s.scaling.down(s.joint) - x.sum(dim=1) for s, x in ((own, y), (held_out, others)))
        centre = y.mean(dim=0)
        axes = torch.zeros(*centre.shape, settings.coefficients)
        for j in range(len(centre)):
            s, vectors = principal_axes(y[:, j] - centre[j], by="svd")
            count = min(settings.coefficients, len(s))
            # Equal variances, so that one penalty suits all products. Coefficients with almost no variance are rounding
            # errors and stay small.
            axes[j, :, :count] = (vectors[:count] / s[:count, None].clamp_min(1e-2 * s[0]) * len(y) ** 0.5).T
        result = cls({"centre": centre, "axes": axes})
        features = result._features(y)
        fitted = regression(features, residual, (result._features(others), wanted))
        weights, basis = fitted.low_rank(min(features.shape[1], cls.RANK))
        return cls({"centre": centre, "axes": axes, "weights": weights.float(), "basis": basis.float()})

    def _features(self, y: Tensor) -> Tensor:
        """Return features (n, 1 + J d + ½ J (J − 1) d²) of factor shapes (n, J, 2E)."""
        c = torch.einsum("njs,jsr->njr", y - self.centre, self.axes)
        pairs = itertools.combinations(range(c.shape[1]), 2)
        products = [(c[:, i, :, None] * c[:, j, None, :]).flatten(1) for i, j in pairs]
        return torch.cat([torch.ones_like(c[:, 0, :1]), c.flatten(1), *products], dim=1)

    def difference(self, y: Tensor) -> Tensor:
        return self._features(y) @ self.weights @ self.basis
