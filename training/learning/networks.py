"""Factor networks, combiner and monolithic baseline (paper, sections 3 and 4).

All of them put out NRIC ``z`` (n, 2E) in normalised units. Inside they work in *scaled differences*: ``(z − z̄)`` times
the square roots of the weights of ``‖·‖_{2,z̄}``, lengths and angles each divided by their own standard deviation, so
that a mean square over entries is the loss with both halves normalised.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.training.learning.corrections import KernelCorrection, PairwiseProducts, ridge_regression
from shapespace.training.learning.crops import Crops
from shapespace.training.learning.layers import (
    EdgeConvolution,
    Flaps,
    FourierProducts,
    LatentFeatures,
    PatchBasis,
    Polynomials,
    Star,
    perceptron,
)
from shapespace.training.learning.polynomials import Pairs, PatchPolynomials
from shapespace.training.runs.config import CombinerSettings, LatentNetworkSettings
from shapespace.training.runs.coordinates import Coordinates


def predict(network: Callable[[Tensor], Tensor], inputs: Tensor, batch_size: int = 32) -> Tensor:
    """Apply a network batch by batch without gradients."""
    with torch.no_grad():
        return torch.cat([network(part) for part in inputs.split(batch_size)])


class Scaling(nn.Module):
    """Affine map between NRIC and scaled differences.

    Args:
        mean: z̄ of the reference, (2E,).
        factor: (2E,) what one unit of z is worth; zero where an entry carries no weight (boundary angles).
    """

    mean: Tensor
    factor: Tensor
    inverse: Tensor

    def __init__(self, mean: FloatArray, factor: FloatArray) -> None:
        super().__init__()
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("factor", torch.as_tensor(factor, dtype=torch.float32))
        inverse = np.divide(1.0, factor, out=np.zeros_like(factor), where=factor > 0)
        self.register_buffer("inverse", torch.as_tensor(inverse, dtype=torch.float32))

    @classmethod
    def blank(cls, size: int) -> Scaling:
        """One to load a saved one into."""
        return cls(np.zeros(size), np.zeros(size))

    @classmethod
    def of(cls, reference: FloatArray, weights: FloatArray, samples: NDArray) -> Scaling:
        """Scale so that samples (n, 2E) have unit mean square about their mean, per half; weights (2E,) at η = 1."""
        root, half = np.sqrt(weights), len(weights) // 2
        spread = (samples - samples.mean(axis=0)) * root
        factor = root.copy()
        for part in (slice(0, half), slice(half, None)):
            factor[part] /= max(float(np.sqrt(np.mean(spread[:, part] ** 2))), 1e-12)
        return cls(reference, factor)

    def down(self, z: Tensor) -> Tensor:
        """NRIC to scaled differences."""
        return (z - self.mean) * self.factor

    def up(self, y: Tensor) -> Tensor:
        """Scaled differences to NRIC."""
        return self.mean + y * self.inverse


class ShapeNetwork(nn.Module):
    """A network that puts out NRIC, and says in which coordinates its answers are compared while it learns."""

    def coefficients(self, inputs: Tensor) -> Tensor:
        """The answer in the coordinates of the loss."""
        raise NotImplementedError

    def target(self, z: Tensor) -> Tensor:
        """What `coefficients` ought to be for NRIC (n, 2E)."""
        raise NotImplementedError

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        """Mean square of what is missed, or an estimate of it while the network learns."""
        return nn.functional.mse_loss(self.coefficients(inputs), target)


class FactorNetwork(ShapeNetwork):
    """ψ_j: latents of one factor (n, m_j) → NRIC (n, 2E).

    A fully connected network onto the coefficients of a last layer; ``basis`` None makes that layer dense. ``skip``
    adds a linear map of Fourier products, for factors whose detail is finer than a perceptron finds by itself, or
    of polynomials, since an exponential is smooth in its velocity.
    """

    skip: Tensor

    def __init__(
        self, settings: LatentNetworkSettings, coordinates: Coordinates, scaling: Scaling, basis: PatchBasis | None
    ) -> None:
        super().__init__()
        self.scaling, self.basis = scaling, basis
        size = basis.rank if basis is not None else len(scaling.mean)
        self.features = LatentFeatures(coordinates, settings.fourier)
        self.hidden = perceptron([self.features.size, *settings.hidden, size])
        self.skip_features: FourierProducts | Polynomials | None = None
        if settings.skip_orders:
            self.skip_features = FourierProducts(coordinates, settings.skip_orders)
        elif settings.skip_degree and not np.isfinite(coordinates.period).any():
            self.skip_features = Polynomials(coordinates, settings.skip_degree)
        if self.skip_features is not None:
            self.register_buffer("skip", torch.zeros(self.skip_features.size, size))
            # The perceptron starts from nothing beside the fitted layer.
            for parameter in self.hidden[-1].parameters():
                nn.init.zeros_(parameter)

    def target(self, z: Tensor) -> Tensor:
        """Coefficients (n, rank), or scaled differences, of NRIC (n, 2E)."""
        y = self.scaling.down(z)
        return y if self.basis is None else self.basis.encode(y)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Output of all layers but the last."""
        result: Tensor = self.hidden(self.features(inputs))
        if self.skip_features is not None:
            result = result + self.skip_features(inputs) @ self.skip
        return result

    def fit_skip(self, latent: Tensor, target: Tensor, held_out: tuple[Tensor, Tensor]) -> None:
        """Fit the linear layer to coefficients by ridge regression; pairs held out choose its penalty."""
        if self.skip_features is not None:
            chosen = self.skip_features(held_out[0]), held_out[1]
            h, b = ridge_regression(self.skip_features(latent), target, chosen)
            self.skip.copy_(h @ b)

    def forward(self, latent: Tensor) -> Tensor:
        y = self.coefficients(latent)
        return self.scaling.up(y if self.basis is None else self.basis(y))


class MonolithicNetwork(FactorNetwork):
    """Φ̃: all latents (n, m) → NRIC (n, 2E), the paper's fully connected baseline."""


class CombinerNetwork(ShapeNetwork):
    """Ψ: J factor shapes (n, J, 2E) → the joint shape's NRIC (n, 2E), by graph convolutions on edges and a correction.

    ELU, batch normalisation and dropout after each convolution. It sees nothing but the factors' outputs.
    """

    rest: Tensor

    def __init__(
        self, settings: CombinerSettings, connectivity: Connectivity, scaling: Scaling, factor_count: int
    ) -> None:
        super().__init__()
        self.scaling, self.residual = scaling, settings.residual
        self.pairwise: PairwiseProducts | None = None
        self.correction: KernelCorrection | PatchPolynomials | None = None
        self.convolutions, self.norms = nn.ModuleList(), nn.ModuleList()
        self.crops: Crops | None = None
        if settings.layers:
            self._add_convolutions(settings, connectivity, factor_count)
        if settings.residual and settings.pairwise:
            self.pairwise = PairwiseProducts(factor_count, settings.pairwise, 2 * connectivity.edge_count)

    def _add_convolutions(self, settings: CombinerSettings, connectivity: Connectivity, factor_count: int) -> None:
        # Differences alone would not tell what an edge is like at rest.
        rest = self.scaling.mean.view(2, -1).T
        self.register_buffer("rest", (rest - rest.mean(dim=0)) / rest.std(dim=0).clamp_min(1e-6))
        self.edge_constants = nn.Parameter(0.1 * torch.randn(connectivity.edge_count, settings.edge_channels))
        widths = [2 * factor_count + 2 + settings.edge_channels] + [settings.width] * settings.layers
        around = Star(connectivity) if settings.neighbourhood == "star" else Flaps(connectivity)
        self.convolutions.extend(EdgeConvolution(around, a, b) for a, b in itertools.pairwise(widths))
        self.norms.extend(nn.BatchNorm1d(width) for width in widths[1:])
        self.dropout = nn.Dropout(settings.dropout)
        self.readout = nn.Linear(widths[-1], 2)
        if settings.residual:
            nn.init.zeros_(self.readout.weight)
            nn.init.zeros_(self.readout.bias)

    def target(self, z: Tensor) -> Tensor:
        """Scaled differences (n, 2E) of NRIC (n, 2E)."""
        return self.scaling.down(z)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Scaled differences (n, 2E) for factor shapes (n, J, 2E)."""
        y = self.scaling.down(inputs)
        out = self._without_convolutions(y)
        return out + self._convolved(y) if self.convolutions else out

    def _without_convolutions(self, y: Tensor) -> Tensor:
        """What there is to (n, 2E) beside the convolutions, of scaled differences (n, J, 2E)."""
        out = y.sum(dim=1) if self.residual else torch.zeros_like(y[:, 0])
        if self.pairwise is not None:
            out = out + self.pairwise(y)
        return out if self.correction is None else out + self.correction(y)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        """On crops, where the network has any, the mean square over their inner edges."""
        if self.crops is None:
            return super().loss(inputs, target)
        y = self.scaling.down(inputs)
        n, j, double = y.shape
        missed = (target - self._without_convolutions(y)).view(n, 2, double // 2)
        crop = self.crops.draw(missed.square().sum(dim=1))

        def at(channels: Tensor) -> Tensor:
            """(n, c, E) → (nK, c)."""
            return channels.take_along_dim(crop.edges[:, None], dim=2).transpose(1, 2).flatten(0, 1)

        constants = torch.cat([self.rest, self.edge_constants], dim=1)[crop.edges.flatten()]
        x = torch.cat([at(y.view(n, 2 * j, double // 2)), constants], dim=1)[:, None]
        inner = crop.inner.flatten()
        return nn.functional.mse_loss(self._layers(x, crop.neighbours)[inner, 0], at(missed)[inner])

    def _convolved(self, y: Tensor) -> Tensor:
        """(n, 2E) of scaled differences (n, J, 2E)."""
        n, j, double = y.shape
        # Edges come first: a neighbour sum then adds whole rows.
        channels = y.view(n, 2 * j, double // 2).permute(2, 0, 1)
        constants = torch.cat([self.rest, self.edge_constants], dim=1)[:, None, :].expand(-1, n, -1)
        return self._layers(torch.cat([channels, constants], dim=2)).permute(1, 2, 0).reshape(n, double)

    def _layers(self, x: Tensor, neighbours: Tensor | None = None) -> Tensor:
        """(E, n, 2) of features (E, n, C) of edges."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            new = norm(convolution(x, neighbours).flatten(0, 1))
            new = self.dropout(nn.functional.elu(new)).view(*x.shape[:2], -1)
            x = x + new if self.residual and x.shape == new.shape else new
        return self.readout(x)

    def fit_pairwise(self, factors: Tensor, z: Tensor, held_out: tuple[Tensor, Tensor]) -> None:
        """Fit the bilinear correction, where there is one, to samples (n, J, 2E) and (n, 2E), and others held out."""
        if self.pairwise is not None:
            (y, residual), other = self._residual(factors, z), self._residual(*held_out)
            self.pairwise.fit(y, residual, other)

    def fit_correction(
        self, settings: CombinerSettings, midpoints: FloatArray, own: Pairs, held_out: Pairs, seed: int
    ) -> None:
        """Fit a kernel or polynomials to what this network, as it is, misses of samples, (n, J, 2E) and (n, 2E)."""

        def missed(factors: Tensor, z: Tensor) -> Pairs:
            return self.scaling.down(factors), (z - predict(self, factors)) * self.scaling.factor

        first, other = missed(*own), missed(*held_out)
        if settings.polynomial:
            self.correction = PatchPolynomials.fit(
                settings.polynomial, settings.monomials, midpoints, first, other, seed
            )
        else:
            self.correction = KernelCorrection.fit(settings.kernel, *first, other)

    def load_state_dict(self, state_dict: Mapping[str, Any], *args: Any, **options: Any) -> Any:
        """The correction, if there is one, has the sizes that its samples gave it."""
        prefix = "correction."
        saved = {k.removeprefix(prefix): v for k, v in state_dict.items() if k.startswith(prefix)}
        kind = PatchPolynomials if "metric" in saved else KernelCorrection
        self.correction = kind.blank(saved) if saved else None
        return super().load_state_dict(state_dict, *args, **options)

    def _residual(self, factors: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        y = self.scaling.down(factors)
        return y, self.scaling.down(z) - y.sum(dim=1)

    def forward(self, factors: Tensor) -> Tensor:
        return self.scaling.up(self.coefficients(factors))


def affine_sum(reference: NDArray, factors: NDArray) -> NDArray:
    """``z̄ + Σ_j (x_j − z̄)`` for factor shapes (n, J, 2E): the direct sum of the paper's condition (2)."""
    return reference + (factors - reference).sum(axis=1)
