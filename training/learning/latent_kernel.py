"""Kernel ridge regression from codes to lengths and angles: the plain baseline without factors or networks."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from shapespace.training.learning.layers import LatentFeatures, Scaling
from shapespace.training.learning.linear import Ridge, principal_axes, ridge
from shapespace.training.runs.latent_coordinates import Coordinates

#: Candidates for the length of the kernel, in multiples of the root of the number of inputs, and for the penalty.
LENGTHS = (0.5, 1.0, 2.0, 4.0, 8.0)
PENALTIES = tuple(10.0**k for k in range(-11, -1))
#: Principal coefficients of the shapes by which these are chosen.
CHOSEN_BY = 128


class LatentKernel(nn.Module):
    """``z = mean + Σ_i k(x, x_i) w_i`` with the Gaussian kernel ``exp(−½ |x − x_i|² / ℓ²)``, in double precision.

    The inputs x are bounded coordinates in [−1, 1], and cosine and sine of periodic ones. Length ℓ and penalty are
    those that suit held-out codes best.

    Args:
        coordinates: of the codes.
        scaling: of the values.
        own: codes (n, m) to fit to, and their NRIC (n, 2E).
        held_out: pairs that choose length and penalty.
    """

    anchors: Tensor
    weights: Tensor
    mean: Tensor

    def __init__(
        self,
        coordinates: Coordinates,
        scaling: Scaling,
        own: tuple[Tensor, Tensor],
        held_out: tuple[Tensor, Tensor],
    ) -> None:
        super().__init__()
        self.features, self.scaling = LatentFeatures(coordinates, order=1), scaling
        x, others = (self.features(codes).double() for codes, _ in (own, held_out))
        y, wanted = (scaling.down(z).double() for _, z in (own, held_out))
        mean = y.mean(dim=0)
        axes = principal_axes(y - mean, by="rows")[1][:CHOSEN_BY]
        few, known = (y - mean) @ axes.T, (wanted - mean) @ axes.T

        def fitted(length: float) -> tuple[Ridge, float]:
            return ridge(_kernel(x, x, length), few, (_kernel(others, x, length), known), PENALTIES), length

        lengths = [times * self.features.size**0.5 for times in LENGTHS]
        best, self.length = min(map(fitted, lengths), key=lambda fit: fit[0].error)
        gram = _kernel(x, x, self.length) + best.penalty * torch.eye(len(x))
        self.register_buffer("anchors", x)
        self.register_buffer("weights", torch.cholesky_solve(y - mean, torch.linalg.cholesky(gram)))
        self.register_buffer("mean", mean)

    def forward(self, codes: Tensor) -> Tensor:
        """NRIC (n, 2E) of codes (n, m)."""
        kernel = _kernel(self.features(codes).double(), self.anchors, self.length)
        return self.scaling.up((self.mean + kernel @ self.weights).float())


def _kernel(x: Tensor, anchors: Tensor, length: float) -> Tensor:
    return torch.exp(-0.5 * torch.cdist(x, anchors).square() / length**2)
