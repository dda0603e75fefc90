"""The networks of a model: factor networks, combiner, start network; and the monolithic baseline.

Paper, sections 3 and 4. All but the start network put out NRIC ``z`` (n, 2E).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter
from scipy import sparse
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.convolutions import ConvolutionCorrection
from shapespace.training.learning.corrections import Correction, JointSamples, ProductCorrection
from shapespace.training.learning.fields import FieldCorrection
from shapespace.training.learning.kernels import KernelCorrection
from shapespace.training.learning.layers import (
    FourierProducts,
    LatentFeatures,
    PatchBasis,
    Polynomials,
    Scaling,
    affordable_degree,
    perceptron,
)
from shapespace.training.learning.linear import principal_axes, regression
from shapespace.training.runs.config import (
    AutoSettings,
    ConvolutionSettings,
    CorrectionSettings,
    FieldSettings,
    FitSettings,
    KernelSettings,
    LatentNetworkSettings,
    PaperSettings,
    ResolvedCorrection,
)
from shapespace.training.runs.latent_coordinates import Coordinates


def predict(network: Callable[[Tensor], Tensor], inputs: Tensor, batch_size: int = 32) -> Tensor:
    """Apply a network batch by batch without gradients."""
    with torch.no_grad():
        return torch.cat([network(part) for part in inputs.split(batch_size)])


class ShapeNetwork(nn.Module):
    """A network that puts out NRIC, and names the coordinates in which it is compared with samples in training."""

    @property
    def metadata(self) -> dict[str, str]:
        """What its file says beside its tensors."""
        return {}

    def coefficients(self, inputs: Tensor) -> Tensor:
        """The output in the coordinates of the loss."""
        raise NotImplementedError

    def target(self, z: Tensor) -> Tensor:
        """The exact `coefficients` of NRIC (n, 2E)."""
        raise NotImplementedError

    def error(self, found: Tensor, target: Tensor) -> Tensor:
        """Mean square error in these coordinates, by which epochs are compared."""
        return nn.functional.mse_loss(found, target)

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        """This error, or an estimate of it, to train with."""
        return self.error(self.coefficients(inputs), target)


class FactorNetwork(ShapeNetwork):
    """ψ_j: latents of one factor (n, m_j) → NRIC (n, 2E).

    A perceptron, and a last layer that maps its coefficients to scaled differences; without ``basis`` the perceptron's
    own last layer does so. ``skip`` is a linear map from latents to the coefficients beside the perceptron: of Fourier
    products, for detail too fine for a perceptron, or of polynomials, since an exponential is smooth in its velocity.

    Attributes:
        metric: (rank, rank) that errors of coefficients are multiplied with; None for the mean square error.
    """

    skip: Tensor

    def __init__(
        self, settings: LatentNetworkSettings, coordinates: Coordinates, scaling: Scaling, basis: PatchBasis | None
    ) -> None:
        super().__init__()
        self.scaling, self.basis = scaling, basis
        self.metric: Tensor | None = None
        size = basis.rank if basis is not None else len(scaling.mean)
        self.features = LatentFeatures(coordinates, settings.fourier)
        self.hidden = perceptron([self.features.size, *settings.hidden, size])
        self.skip_features: FourierProducts | Polynomials | None = None
        if settings.skip_orders:
            self.skip_features = FourierProducts(coordinates, settings.skip_orders)
        elif settings.skip_degree and not np.isfinite(coordinates.period).any():
            self.skip_features = Polynomials(coordinates, affordable_degree(settings.skip_degree, len(coordinates)))
        if self.skip_features is not None:
            self.register_buffer("skip", torch.zeros(self.skip_features.size, size))
            # Training starts from the fitted layer alone.
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

    def penalise(self, basis: PatchBasis, closing: sparse.csr_array, weight: float) -> None:
        """Let errors that no change of a surface makes count more.

        Args:
            basis: the last layer.
            closing: (q, 2E) derivatives of the closing conditions by NRIC, see `Integrability`.
            weight: of their squares, scaled to the mean square of errors that are alike in all directions.
        """
        each = (basis(torch.eye(basis.rank)) - basis.mean) * self.scaling.inverse
        change = closing @ each.double().numpy().T
        gram = torch.from_numpy(change.T @ change)
        scale = float(gram.trace()) / len(gram) or 1.0  # a strip has no vertex that faces close around
        self.metric = torch.linalg.cholesky(torch.eye(len(gram)) + weight / scale * gram).float()

    def error(self, found: Tensor, target: Tensor) -> Tensor:
        """Mean square error of coefficients, in the metric if there is one."""
        missed = found - target
        return (missed if self.metric is None else missed @ self.metric).square().mean()

    def fit_skip(self, latent: Tensor, target: Tensor, held_out: tuple[Tensor, Tensor]) -> None:
        """Fit the linear layer to coefficients by ridge regression; pairs held out choose its penalty."""
        if self.skip_features is not None:
            features, chosen = (predict(self.skip_features, x) for x in (latent, held_out[0]))
            self.skip.copy_(regression(features, target, (chosen, held_out[1])).weights)

    def forward(self, latent: Tensor) -> Tensor:
        y = self.coefficients(latent)
        return self.scaling.up(y if self.basis is None else self.basis(y))


#: The classes of corrections, by the kinds of their settings.
CORRECTIONS: dict[str, type[Correction]] = {
    "kernel": KernelCorrection,
    "products": ProductCorrection,
    "convolutions": ConvolutionCorrection,
    "field": FieldCorrection,
}


#: Share of the kernel's squared error on held-out codes below which another kind, which takes longer, is chosen.
BETTER = 0.9
#: Of how many shapes of a factor principal components are counted until they hold 99 % of the variance, and from how
#: many on, in all and for each latent, something wanders over the surface. A bump on a torus needs hundreds for its two
#: latents; factors of bodies, faces and hippocampi with up to 80 latents at most 3.4 for each.
LOOKED_AT, WANDERING, FOR_EACH_LATENT = 500, 100, 5
#: Convolutions that follow a bump over a torus (docs/measurements/notes.md, Freaky Torus for three epochs).
FOLLOWING = ConvolutionSettings(
    layers=5,
    width=40,
    neighbourhood="flaps",
    crop=900,
    products=8,
    fit=FitSettings(schedule="cosine", learning_rate=2e-3, batch_size=16, max_epochs=30),
)


def choices(settings: CorrectionSettings) -> list[ResolvedCorrection]:
    """All that ``auto`` may choose; nothing for other settings."""
    return [KernelSettings(), FieldSettings(), FOLLOWING] if isinstance(settings, AutoSettings) else []


def _follower(own: JointSamples) -> FieldSettings | ConvolutionSettings | None:
    """What ``auto`` tries beside the kernel, by a quick look: nothing where nothing wanders over the surface."""
    if own.motion:
        return FieldSettings()
    usual = (max(WANDERING, FOR_EACH_LATENT * len(index)) for index in own.latents)
    shapes = own.scaling.down(own.factors[:LOOKED_AT]).unbind(dim=1)
    return FOLLOWING if any(_components(y) > most for y, most in zip(shapes, usual, strict=True)) else None


def _components(y: Tensor) -> int:
    """How many principal components hold 99 % of the variance of y (n, p)."""
    s, _ = principal_axes(y - y.mean(dim=0), by="rows")
    variance = s.square().cumsum(0)
    return 1 + int((variance < 0.99 * variance[-1]).sum())


class CombinerNetwork(ShapeNetwork):
    """Ψ: J factor shapes (n, J, 2E) → NRIC (n, 2E) of the joint shape. Nothing but these shapes is its input.

    Args:
        scaling: to scaled differences.
        settings: of the correction.
        correction: what maps scaled differences to scaled differences.
        tried: where it was chosen, by kind the mean square error of scaled differences on held-out codes.
    """

    def __init__(
        self, scaling: Scaling, settings: ResolvedCorrection, correction: Correction, tried: Mapping[str, float]
    ) -> None:
        super().__init__()
        self.scaling, self.settings, self.correction, self.tried = scaling, settings, correction, tried

    @classmethod
    def fit(
        cls,
        settings: CorrectionSettings,
        reference: TriangleMesh,
        own: JointSamples,
        held_out: JointSamples,
        seed: int,
        train: Callable[[CombinerNetwork], Any] = lambda network: None,
    ) -> CombinerNetwork:
        """Fit all that has a closed form, see `Correction.fit`, and choose by held-out samples where there is a choice.

        Args:
            settings: of the correction.
            reference: the mesh.
            own: samples to fit to.
            held_out: samples that choose.
            seed: of whatever is random.
            train: called with each network that was fitted, to train what has no closed form.
        """

        def fit(each: ResolvedCorrection) -> CombinerNetwork:
            network = cls(own.scaling, each, CORRECTIONS[each.kind].fit(each, reference, own, held_out, seed), {})
            train(network)
            return network

        if isinstance(settings, PaperSettings):
            settings = settings.convolutions
        if not isinstance(settings, AutoSettings):
            return fit(settings)

        wanted = own.scaling.down(held_out.joint)

        def error(network: CombinerNetwork) -> float:
            return float((predict(network.coefficients, held_out.factors) - wanted).square().mean())

        start = time.monotonic()
        chosen = fit(KernelSettings())
        tried = {"kernel": error(chosen)}
        follower = _follower(own)
        if follower and time.monotonic() - start < 60 * settings.minutes:
            within = follower.fit.model_copy(update={"minutes": settings.minutes})
            other = fit(follower.model_copy(update={"fit": within}))
            tried[follower.kind] = error(other)
            if tried[follower.kind] < BETTER * tried["kernel"]:
                chosen = other
        return cls(own.scaling, chosen.settings, chosen.correction, tried)

    @classmethod
    def load(
        cls, metadata: Mapping[str, str], reference: TriangleMesh, tensors: Mapping[str, Tensor]
    ) -> CombinerNetwork:
        """The network whose ``metadata`` and ``state_dict()`` these are."""
        settings: ResolvedCorrection = TypeAdapter(ResolvedCorrection).validate_json(metadata["correction"])
        parts: dict[str, dict[str, Tensor]] = {"scaling": {}, "correction": {}}
        for name, tensor in tensors.items():
            part, _, own = name.partition(".")
            parts[part][own] = tensor
        scaling = Scaling.blank(len(parts["scaling"]["mean"]))
        scaling.load_state_dict(parts["scaling"])
        correction = CORRECTIONS[settings.kind].load(settings, reference, parts["correction"])
        return cls(scaling, settings, correction, json.loads(metadata.get("tried", "{}")))

    @property
    def metadata(self) -> dict[str, str]:
        """``correction``: its settings, with its kind, and ``tried``, as JSON."""
        return {"correction": self.settings.model_dump_json(), "tried": json.dumps(self.tried)}

    def target(self, z: Tensor) -> Tensor:
        """Scaled differences (n, 2E) of NRIC (n, 2E)."""
        return self.scaling.down(z)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Scaled differences (n, 2E) of the joint shape for factor shapes (n, J, 2E)."""
        result: Tensor = self.correction(self.scaling.down(inputs))
        return result

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        """The correction's own, which may be an estimate."""
        return self.correction.loss(self.scaling.down(inputs), target)

    def forward(self, factors: Tensor) -> Tensor:
        return self.scaling.up(self.coefficients(factors))


@dataclass(frozen=True)
class Composite:
    """``Φ = Ψ ∘ (ψ_1, …, ψ_J)``.

    Attributes:
        factors: latent indices of each factor.
        networks: the ψ_j.
        combiner: Ψ.
    """

    factors: list[list[int]]
    networks: list[FactorNetwork]
    combiner: CombinerNetwork

    @property
    def parts(self) -> list[ShapeNetwork]:
        """All its networks."""
        return [*self.networks, self.combiner]

    def __call__(self, latents: Tensor) -> Tensor:
        """NRIC (n, 2E) of codes (n, m)."""
        result: Tensor = self.combiner(self.factor_shapes(latents))
        return result

    def factor_shapes(self, latents: Tensor) -> Tensor:
        """(n, J, 2E) outputs of the ψ_j."""
        return factor_shapes(self.networks, self.factors, latents)


def factor_shapes(networks: list[FactorNetwork], factors: list[list[int]], latents: Tensor) -> Tensor:
    """(n, J, 2E) NRIC of each factor's network, of its part of codes (n, m)."""
    return torch.stack([network(latents[:, index]) for network, index in zip(networks, factors, strict=True)], dim=1)


class StartNetwork(nn.Module):
    """Codes (n, m) → vertices (n, V, 3), roughly: where the reconstruction starts if lengths and angles give no start.

    Polynomials of the latents (cosine and sine of a periodic one), and a linear map of low rank. A position depends on
    all rotations between it and the middle of the shape, so that polynomials of low degree are not accurate (the
    figure: 0.8 % of the diagonal at degree 2, 0.7 % at degree 3, where frames leave 0.1 %); but they are never far off,
    and for that degree 2 is enough.
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
        """Fit to codes (n, m) and their shapes (n, V, 3) by ridge regression; held-out pairs choose its penalty."""
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


def affine_sum(reference: NDArray, factors: NDArray) -> NDArray:
    """``z̄ + Σ_j (x_j − z̄)`` for factor shapes (n, J, 2E): the direct sum of the paper's condition (2)."""
    return reference + (factors - reference).sum(axis=1)
