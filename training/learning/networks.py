"""Factor networks, which also serve as monolithic baselines, and the start network (paper, sections 3 and 4)."""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.training.learning.latent_features import FourierProducts, LatentFeatures, Polynomials, affordable_degree
from shapespace.training.learning.layers import PatchBasis, Scaling, perceptron
from shapespace.training.learning.linear import regression
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.network_settings import LatentNetworkSettings


def predict(network: Callable[[Tensor], Tensor], inputs: Tensor, batch_size: int = 32) -> Tensor:
    """Apply a network batch by batch without gradients."""
    with torch.no_grad():
        return torch.cat([network(part) for part in inputs.split(batch_size)])


class ShapeNetwork(nn.Module):
    """Network that puts out NRIC, and defines the coordinates in which training compares it with samples."""

    @property
    def metadata(self) -> dict[str, str]:
        """Text stored in its file next to the tensors."""
        return {}

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Return the output in the coordinates of the loss."""
        raise NotImplementedError

    def target(self, z: Tensor) -> Tensor:
        """Return the exact `coefficients` of NRIC (n, 2E)."""
        raise NotImplementedError

    def error(self, found: Tensor, target: Tensor) -> Tensor:
        """Return the mean square error in these coordinates, by which epochs are compared."""
        return nn.functional.mse_loss(found, target)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        """Return this error, or an estimate of it, for training."""
        return self.error(self.coefficients(inputs), target)


class FactorNetwork(ShapeNetwork):
    """ψ_j: latents of one factor (n, m_j) → NRIC (n, 2E).

    A perceptron puts out coefficients, and a last layer maps them to scaled differences. Without ``basis`` the
    perceptron's own last layer does so. ``skip`` is a linear map from latents to coefficients, added to the
    perceptron. It starts from Fourier products, for detail too fine for a perceptron, or from polynomials, since an
    exponential is smooth in its velocity.
    """

    skip: Tensor

    def __init__(
        self, settings: LatentNetworkSettings, coordinates: Coordinates, scaling: Scaling, basis: PatchBasis | None
    ) -> None:
        super().__init__()
        self.scaling, self.basis = scaling, basis
        self.metric: Tensor | None  # (rank, rank) factor of coefficient errors, for training only
        self.register_buffer("metric", None, persistent=False)
        size = basis.rank if basis is not None else len(scaling.mean)
        self.features = LatentFeatures(coordinates, settings.fourier)
        self.hidden = perceptron([self.features.size, *settings.hidden, size], settings.normalisation)
        self.skip_features: FourierProducts | Polynomials | None = None
        if settings.skip_orders:
            self.skip_features = FourierProducts(coordinates, settings.skip_orders)
        elif settings.skip_degree and not np.isfinite(coordinates.period).any():
            self.skip_features = Polynomials(coordinates, affordable_degree(settings.skip_degree, len(coordinates)))
        if self.skip_features is not None:
            self.register_buffer("skip", torch.zeros(self.skip_features.size, size))
            # Training starts from the fitted layer only.
            for parameter in self.hidden[-1].parameters():
                nn.init.zeros_(parameter)

    def target(self, z: Tensor) -> Tensor:
        """Return coefficients (n, rank), or scaled differences, of NRIC (n, 2E)."""
        y = self.scaling.down(z)
        return y if self.basis is None else self.basis.encode(y)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Return the output of all layers but the last."""
        result: Tensor = self.hidden(self.features(inputs))
        if self.skip_features is not None:
            result = result + self.skip_features(inputs) @ self.skip
        return result

    def penalise(self, basis: PatchBasis, closing: sparse.csr_array, weight: float) -> None:
        """Give more weight to errors that are not the change of any surface.

        ``closing`` (q, 2E) are derivatives of the closing conditions by NRIC, see `Integrability`. The weight of their
        squares is relative to the mean square of errors that are equal in all directions.
        """
        each = (basis(torch.eye(basis.rank)) - basis.mean) * self.scaling.inverse
        change = closing @ each.double().numpy().T
        gram = torch.from_numpy(change.T @ change)
        scale = float(gram.trace()) / len(gram) or 1.0  # a strip has no inner vertex
        self.metric = torch.linalg.cholesky(torch.eye(len(gram)) + weight / scale * gram).float()

    def error(self, found: Tensor, target: Tensor) -> Tensor:
        """Return the mean square error of coefficients, in the metric if there is one."""
        missed = found - target
        return (missed if self.metric is None else missed @ self.metric).square().mean()

    def fit_skip(self, latent: Tensor, target: Tensor, held_out: tuple[Tensor, Tensor]) -> None:
        """Fit the linear layer to coefficients by ridge regression; held-out pairs choose its penalty."""
        if self.skip_features is not None:
            features, chosen = (predict(self.skip_features, x) for x in (latent, held_out[0]))
            self.skip.copy_(regression(features, target, (chosen, held_out[1])).weights)

    def forward(self, latent: Tensor) -> Tensor:
        y = self.coefficients(latent)
        return self.scaling.up(y if self.basis is None else self.basis(y))


class StartNetwork(nn.Module):
    """Codes (n, m) → rough vertices (n, V, 3), where reconstruction starts if lengths and angles give no start.

    Polynomials of the latents (cosine and sine of a periodic latent), and a linear map of low rank. A position depends
    on all rotations between it and the middle of the shape, so polynomials of low degree are not accurate. The error
    on the figure is 0.8 % of the diagonal at degree 2 and 0.7 % at degree 3; frames have 0.1 %. But the error is never
    large, and for that degree 2 is enough.
    """

    #: Total degree of the polynomials, and largest rank of the linear map.
    DEGREE, RANK = 2, 32

    reference: Tensor
    weights: Tensor
    basis: Tensor

    def __init__(self, coordinates: Coordinates, reference: FloatArray) -> None:
        super().__init__()
        self.features = LatentFeatures(coordinates, order=1)
        size = self.features.size
        box = Coordinates(np.full(size, -1.0), np.ones(size), np.full(size, np.nan))
        self.polynomials = Polynomials(box, self.DEGREE)
        rank = min(self.polynomials.size, self.RANK)
        self.register_buffer("reference", torch.tensor(reference, dtype=torch.float32))
        self.register_buffer("weights", torch.zeros(self.polynomials.size, rank))
        self.register_buffer("basis", torch.zeros(rank, reference.size))

    def fit(self, latents: Tensor, vertices: NDArray, held_out: tuple[Tensor, NDArray]) -> None:
        """Fit to codes (n, m) and vertices (n, V, 3) by ridge regression; held-out pairs choose the penalty."""
        reference = self.reference.double().numpy()

        def pair(latents: Tensor, vertices: NDArray) -> tuple[Tensor, Tensor]:
            offsets = align(np.asarray(vertices, dtype=np.float64), reference) - reference
            return self.polynomials(self.features(latents)), torch.as_tensor(offsets).flatten(1)

        weights, basis = regression(*pair(latents, vertices), pair(*held_out)).low_rank(len(self.basis))
        self.weights.copy_(weights)
        self.basis.copy_(basis)

    def forward(self, latent: Tensor) -> Tensor:
        offsets = self.polynomials(self.features(latent)) @ self.weights @ self.basis
        return self.reference + offsets.unflatten(1, self.reference.shape)
