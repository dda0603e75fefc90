"""Ridge regression by Gaussian kernels and their gradients, fitted to values and to derivatives.

With derivatives, kernels at the samples alone are a poor space. The best space consists of kernels at the samples, and
of gradients of kernels where derivatives are known (Hermite–Birkhoff interpolation; Wendland 2005, chapter 16).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from shapespace.training.learning.linear import Ridge, kernel_ridge, ridge


@dataclass(frozen=True)
class Centres:
    """Functions ``k(u, a)`` for anchors a, and ``√(2γ) k(u, b) (u − b)`` for nodes b; ``k = exp(−γ |u − u'|²)``.

    All have norm one in the space of the kernel. Tensors may have leading batch dimensions.
    """

    anchors: Tensor  # (…, n, r) centres of the kernels
    nodes: Tensor  # (…, k, r) centres of the gradients
    gamma: Tensor  # γ, (…, 1, 1)

    def __call__(self, u: Tensor) -> Tensor:
        """Return the values (…, m, n + k r) of the functions at u (…, m, r)."""
        values = _kernel(u, self.anchors, self.gamma)
        if not self.nodes.shape[-2]:
            return values
        apart = u[..., :, None, :] - self.nodes[..., None, :, :]
        weights = (2 * self.gamma).sqrt() * _kernel(u, self.nodes, self.gamma)
        return torch.cat([values, (weights[..., None] * apart).flatten(-2)], dim=-1)

    def along(self, u: Tensor, directions: Tensor) -> Tensor:
        """Return derivatives (m, n + k r) of the functions at u (m, r), each row along its own direction (m, r)."""
        gamma, step = self.gamma, (u * directions).sum(dim=1, keepdim=True)
        values = 2 * gamma * (directions @ self.anchors.T - step) * _kernel(u, self.anchors, gamma)
        if not len(self.nodes):
            return values
        towards = directions @ self.nodes.T - step
        change = directions[:, None] + 2 * gamma * towards[:, :, None] * (u[:, None] - self.nodes)
        weights = (2 * gamma).sqrt() * _kernel(u, self.nodes, gamma)
        return torch.cat([values, (weights[:, :, None] * change).flatten(1)], dim=1)

    @property
    def gram(self) -> Tensor:
        """Inner products (n + k r, n + k r) of the functions."""
        return torch.cat([self(self.anchors), self.along(*every_axis(self.nodes)) / (2 * self.gamma).sqrt()])

    def fit(
        self,
        own: tuple[Tensor, Tensor],
        slopes: tuple[Tensor, Tensor, Tensor] | None,
        held_out: tuple[Tensor, Tensor],
        penalties: Sequence[float],
    ) -> Ridge:
        """Return weights (n + k r, q) of these functions by ridge regression.

        Held-out samples choose the penalty. Samples ``own`` have coordinates (m, r) and values (m, q). Slopes are
        coordinates (s, r), directions (s, r), and derivatives along the directions (s, q).
        """
        theirs = self(held_out[0]), held_out[1]
        if own[0] is self.anchors and slopes is None:  # the dual form needs no other basis
            return ridge(self.gram, own[1], theirs, penalties)
        features, values = self(own[0]), own[1]
        if slopes:
            at, directions, changes = slopes
            features, values = torch.cat([features, self.along(at, directions)]), torch.cat([values, changes])
        return kernel_ridge(self.gram, features, values, theirs, penalties)

    def first(self, share: float) -> Centres:
        """Return the functions of the first anchors and the first nodes, a share of each."""
        n, k = (math.ceil(share * len(centres)) for centres in (self.anchors, self.nodes))
        return Centres(self.anchors[:n], self.nodes[:k], self.gamma)


def every_axis(u: Tensor) -> tuple[Tensor, Tensor]:
    """Pair each of the points (k, r) with each of the r axes: points and directions, both (k r, r)."""
    k, r = u.shape
    return u.repeat_interleave(r, dim=0), torch.eye(r, dtype=u.dtype).repeat(k, 1)


def _kernel(u: Tensor, centres: Tensor, gamma: Tensor) -> Tensor:
    """Return kernel values (…, m, n) between coordinates (…, m, r) and centres (…, n, r)."""
    squares = u.square().sum(dim=-1, keepdim=True) + centres.square().sum(dim=-1)[..., None, :]
    # U + u, not 2 u: onnxruntime fuses products with numbers into an operation that old versions lack for doubles.
    return torch.exp(-gamma * (squares - (u + u) @ centres.mT))
