"""Ridge regression by Gaussian kernels and their gradients, of values and of derivatives.

Beside derivatives kernels alone are a poor space: what suits best, of all functions, is a sum of kernels at the samples
and of the kernels' gradients where there are derivatives (Hermite–Birkhoff interpolation; Wendland 2005, chapter 16).
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
    """Functions ``k(u, a)`` of each anchor a, and ``√(2γ) k(u, b) (u − b)`` of each node b; ``k = exp(−γ |u − u'|²)``.

    In the space of the kernel all of them have the norm one. There may be leading dimensions of a batch.

    Attributes:
        anchors: (…, n, r).
        nodes: (…, k, r).
        gamma: γ, (…, 1, 1).
    """

    anchors: Tensor
    nodes: Tensor
    gamma: Tensor

    def __call__(self, u: Tensor) -> Tensor:
        """(…, m, n + k r) their values at u (…, m, r)."""
        values = _kernel(u, self.anchors, self.gamma)
        if not self.nodes.shape[-2]:
            return values
        apart = u[..., :, None, :] - self.nodes[..., None, :, :]
        weights = (2 * self.gamma).sqrt() * _kernel(u, self.nodes, self.gamma)
        return torch.cat([values, (weights[..., None] * apart).flatten(-2)], dim=-1)

    def along(self, u: Tensor, directions: Tensor) -> Tensor:
        """(m, n + k r) derivatives at u (m, r), each along another direction (m, r)."""
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
        """(n + k r, n + k r) inner products of the functions."""
        return torch.cat([self(self.anchors), self.along(*every_axis(self.nodes)) / (2 * self.gamma).sqrt()])

    def fit(
        self,
        own: tuple[Tensor, Tensor],
        slopes: tuple[Tensor, Tensor, Tensor] | None,
        held_out: tuple[Tensor, Tensor],
        penalties: Sequence[float],
    ) -> Ridge:
        """Ridge regression with these functions.

        Args:
            own: coordinates (m, r) of samples, and values (m, q).
            slopes: coordinates (s, r), directions (s, r), and derivatives along these (s, q).
            held_out: samples that choose the penalty.
            penalties: candidates.

        Returns:
            Weights (n + k r, q) of the functions.
        """
        theirs = self(held_out[0]), held_out[1]
        if own[0] is self.anchors and slopes is None:  # the dual form needs no other basis
            return ridge(self.gram, own[1], theirs, penalties)
        features, values = self(own[0]), own[1]
        if slopes:
            at, directions, changes = slopes
            features, values = torch.cat([features, self.along(at, directions)]), torch.cat([values, changes])
        return kernel_ridge(self.gram, features, values, theirs, penalties)

    def some(self, share: float) -> Centres:
        """A share of the anchors and of the nodes, the first ones."""
        n, k = (math.ceil(share * len(centres)) for centres in (self.anchors, self.nodes))
        return Centres(self.anchors[:n], self.nodes[:k], self.gamma)


def every_axis(u: Tensor) -> tuple[Tensor, Tensor]:
    """Each of the points (k, r), r times, and a direction along each axis there: both (k r, r)."""
    k, r = u.shape
    return u.repeat_interleave(r, dim=0), torch.eye(r, dtype=u.dtype).repeat(k, 1)


def _kernel(u: Tensor, centres: Tensor, gamma: Tensor) -> Tensor:
    """(…, m, n) of coordinates (…, m, r) and (…, n, r)."""
    squares = u.square().sum(dim=-1, keepdim=True) + centres.square().sum(dim=-1)[..., None, :]
    # A sum, as onnxruntime fuses products with numbers into an operation that old ones don't have for doubles.
    return torch.exp(-gamma * (squares - (u + u) @ centres.mT))
