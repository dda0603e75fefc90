"""What is fitted in closed form to what a sum of factors, or the convolutions after it, miss of a joint shape."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn

from shapespace.training.learning.layers import half_precision

#: Weights of the penalty that `ridge_regression` chooses from, as shares of the mean square of a feature.
RIDGES = tuple(10.0**k for k in range(-6, 3))


def ridge_regression(x: Tensor, y: Tensor, held_out: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The linear map from features x (n, p) to y (n, q) whose penalty suits held-out pairs best.

    Features ought to have a mean square of about one.

    Returns:
        H (p, p) and B (p, q), whose product is the map; the columns of x H are orthonormal but for the penalty.
    """
    x, y = x.double(), y.double()
    value, vector = torch.linalg.eigh(x.T @ x / len(x))
    right, other = vector.T @ (x.T @ y / len(x)), held_out[0].double() @ vector

    def error(ridge: float) -> float:
        return float((other @ (right / (value + ridge)[:, None]) - held_out[1]).square().mean())

    scale = (value.clamp_min(0) + min(RIDGES, key=error)).rsqrt()
    return vector * scale, right * scale[:, None]


def low_rank(h: Tensor, b: Tensor, rank: int) -> tuple[Tensor, Tensor]:
    """The map of low rank, as two factors, whose values are nearest to those of ``h b`` from `ridge_regression`."""
    strongest = torch.linalg.eigh(b @ b.T)[1][:, -rank:]
    return h @ strongest, strongest.T @ b


class PairwiseProducts(nn.Module):
    """A bilinear correction of the affine sum, (n, J, 2E) → (n, 2E), fitted by ridge regression.

    Each factor is brought to a few principal coefficients; a linear map of low rank takes these and their products
    between every two factors to scaled differences. What two factors do to each other is smooth and global where they
    overlap widely, and there a few products do what many convolutions would.
    """

    centre: Tensor
    axes: Tensor
    weights: Tensor
    basis: Tensor
    #: Largest rank of the linear map.
    RANK = 64

    def __init__(self, factor_count: int, rank: int, size: int) -> None:
        super().__init__()
        self.pairs = list(itertools.combinations(range(factor_count), 2))
        self.register_buffer("centre", torch.zeros(factor_count, size))
        self.register_buffer("axes", torch.zeros(factor_count, size, rank))
        features = 1 + factor_count * rank + len(self.pairs) * rank**2
        self.register_buffer("weights", torch.zeros(features, min(features, self.RANK)))
        self.register_buffer("basis", torch.zeros(min(features, self.RANK), size))

    def _features(self, y: Tensor) -> Tensor:
        c = torch.einsum("njs,jsr->njr", y - self.centre, self.axes)
        products = [(c[:, i, :, None] * c[:, j, None, :]).flatten(1) for i, j in self.pairs]
        return torch.cat([torch.ones_like(c[:, 0, :1]), c.flatten(1), *products], dim=1)

    def fit(self, y: Tensor, residual: Tensor, held_out: tuple[Tensor, Tensor]) -> None:
        """Fit axes and weights to factor shapes (n, J, 2E) and what the affine sum misses (n, 2E)."""
        self.centre.copy_(y.mean(dim=0))
        for j in range(y.shape[1]):
            _, s, vt = torch.linalg.svd(y[:, j] - self.centre[j], full_matrices=False)
            rank = min(self.axes.shape[2], len(s))
            # Coefficients of unit variance, so that one ridge suits all products; those that are hardly there stay
            # small, or they would be made of rounding errors.
            self.axes[j, :, :rank] = (vt[:rank] / s[:rank, None].clamp_min(1e-2 * s[0]) * len(y) ** 0.5).T
        h, b = ridge_regression(self._features(y), residual, (self._features(held_out[0]), held_out[1]))
        weights, basis = low_rank(h, b, len(self.basis))
        self.weights.copy_(weights)
        self.basis.copy_(basis)

    def forward(self, y: Tensor) -> Tensor:
        return self._features(y) @ self.weights @ self.basis


class KernelCorrection(nn.Module):
    """A smooth correction of the joint shape, (n, J, 2E) → (n, 2E): kernel ridge regression on the factors' shapes.

    Two samples are as alike as their factors' shapes are near, ``exp(−½ Σ_j ‖x_j − x_j'‖² / (ℓ σ_j)²)`` with σ_j the
    spread of factor j along its strongest direction. Each shape is brought to a few principal coefficients first. What
    is predicted are principal coefficients of what is missed without it. Products of coefficients, two or three at a
    time, are among the functions that such a kernel spans, at the weight that their smoothness deserves.
    """

    centre: Tensor
    axes: Tensor
    anchors: Tensor
    gamma: Tensor
    weights: Tensor
    mean: Tensor
    basis: Tensor
    #: Samples that it is fitted to, at most.
    ANCHORS = 4000
    #: Lengths ℓ and penalties, as shares of the kernel's value at no distance, of which held-out samples choose one.
    #: Below 1e-4 weights grow beyond what single precision keeps of them.
    LENGTHS = (2.0, 4.0, 8.0, 16.0)
    RIDGES = tuple(10.0 ** (k / 2) for k in range(-8, -1))
    #: Samples that the principal axes of factors are taken from, at most.
    AXES = 500
    #: Variance that the basis of the correction keeps, and its largest rank.
    ENERGY, RANK = 0.995, 512

    def __init__(self, factor_count: int, coefficients: int, size: int, anchors: int, rank: int) -> None:
        super().__init__()
        self.register_buffer("centre", torch.zeros(factor_count, size))
        self.register_buffer("axes", torch.zeros(factor_count, size, coefficients))
        self.register_buffer("anchors", torch.zeros(anchors, factor_count * coefficients))
        self.register_buffer("gamma", torch.ones(()))
        self.register_buffer("weights", torch.zeros(anchors, rank))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("basis", torch.zeros(rank, size))

    @classmethod
    def blank(cls, tensors: dict[str, Tensor]) -> KernelCorrection:
        """One of the sizes of a saved one, to load it into; ``tensors`` are the saved one's, by their own names."""
        (factors, size, coefficients), anchors = tensors["axes"].shape, len(tensors["anchors"])
        return cls(factors, coefficients, size, anchors, len(tensors["basis"]))

    @classmethod
    def fit(cls, coefficients: int, y: Tensor, residual: Tensor, held_out: tuple[Tensor, Tensor]) -> KernelCorrection:
        """Fit to factor shapes (n, J, 2E) and what is missed so far (n, 2E), both as scaled differences."""
        y, residual = y[: cls.ANCHORS], residual[: cls.ANCHORS]
        mean = residual.mean(dim=0)
        s, vt = _principal((residual - mean)[: 3 * cls.RANK])
        energy = s.square().cumsum(0)
        rank = min(int((energy < cls.ENERGY * energy[-1]).sum()) + 1, cls.RANK)
        result = cls(y.shape[1], coefficients, y.shape[2], len(y), rank)
        result.mean.copy_(mean)
        result.basis.copy_(half_precision(vt[:rank]))
        result.centre.copy_(y.mean(dim=0))
        for j in range(y.shape[1]):
            some = y[: cls.AXES, j] - result.centre[j]
            s, vt = _principal(some)
            count = min(coefficients, len(s))
            result.axes[j, :, :count] = half_precision(vt[:count].T * (len(some) ** 0.5 / s[0].clamp_min(1e-12)))
        result.anchors.copy_(result._inputs(y))
        result._fit_weights(result._wanted(residual), result._inputs(held_out[0]), result._wanted(held_out[1]))
        return result

    def _fit_weights(self, target: Tensor, held_out: Tensor, wanted: Tensor) -> None:
        best = float("inf")
        for length in self.LENGTHS:
            gamma = torch.tensor(0.5 / length**2)
            kernel, other = self._kernel(self.anchors, gamma), self._kernel(held_out, gamma)
            for ridge in self.RIDGES:
                weights = torch.cholesky_solve(target, torch.linalg.cholesky(kernel + ridge * torch.eye(len(kernel))))
                error = float((other @ weights - wanted).square().mean())
                if error < best:
                    best = error
                    self.gamma.copy_(gamma)
                    self.weights.copy_(weights)

    def _wanted(self, residual: Tensor) -> Tensor:
        return ((residual - self.mean) @ self.basis.T).double()

    def _inputs(self, y: Tensor) -> Tensor:
        # Not einsum, which would transpose the axes anew for every code once it is exported.
        return torch.matmul((y - self.centre)[:, :, None], self.axes).flatten(1)

    def _kernel(self, inputs: Tensor, gamma: Tensor) -> Tensor:
        """(n, anchors), in double precision: used to fit."""
        return torch.exp(-gamma.double() * torch.cdist(inputs.double(), self.anchors.double()).square())

    def forward(self, y: Tensor) -> Tensor:
        # Large weights of opposite signs: in single precision up to 3 % of the correction would be rounding.
        c, anchors = self._inputs(y).double(), self.anchors.double()
        squares = c.square().sum(dim=1, keepdim=True) - 2 * c @ anchors.T + anchors.square().sum(dim=1)
        coefficients = torch.exp(-self.gamma.double() * squares) @ self.weights.double()
        return self.mean + coefficients.to(y.dtype) @ self.basis


def _principal(x: Tensor) -> tuple[Tensor, Tensor]:
    """Singular values, falling, and right singular vectors of x (n, p), by the Gram matrix of its n < p rows."""
    value, vector = torch.linalg.eigh(x.double() @ x.double().T)
    s = value.flip(0).clamp_min(1e-30).sqrt()
    return s.to(x.dtype), (vector.flip(1).T @ x.double() / s[:, None]).to(x.dtype)
