"""The combiner Ψ: the affine sum of factor shapes, plus a correction of the kind that suits the collection."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter
from torch import Tensor

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.convolutions import ConvolutionCorrection
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.learning.combiners.dense import DenseCorrection
from shapespace.training.learning.combiners.fields import FieldCorrection
from shapespace.training.learning.combiners.kernels import KernelCorrection
from shapespace.training.learning.combiners.products import ProductCorrection
from shapespace.training.learning.combiners.sums import SumCorrection
from shapespace.training.learning.layers import Scaling
from shapespace.training.learning.linear import principal_axes
from shapespace.training.learning.networks import ShapeNetwork, predict
from shapespace.training.runs.network_settings import (
    AutoSettings,
    ConvolutionSettings,
    CorrectionSettings,
    FieldSettings,
    FitSettings,
    KernelSettings,
    PaperSettings,
    ResolvedCorrection,
)

#: Classes of corrections, by the kind of their settings.
CORRECTIONS: dict[str, type[Correction]] = {
    "kernel": KernelCorrection,
    "products": ProductCorrection,
    "sum": SumCorrection,
    "convolutions": ConvolutionCorrection,
    "dense": DenseCorrection,
    "field": FieldCorrection,
}


@dataclass(frozen=True)
class AutoChoice:
    """Limits by which ``auto`` tries and chooses another kind than the kernel.

    A feature moves over the surface if the shapes of its factor have many principal components. A bump on a torus has
    hundreds for its two latents. Factors of bodies, faces and hippocampi with up to 80 latents have at most 3.4 for
    each latent.
    """

    # Share of the kernel's squared error on held-out codes below which the other kind, which takes longer, is chosen.
    better: float = 0.9
    shapes: int = 500  # number of shapes of a factor whose principal components are counted
    variance: float = 0.99  # share of the variance that the components hold
    components: int = 100  # least number of components that shows a moving feature
    components_per_latent: int = 5  # the same, for each latent of the factor


AUTO = AutoChoice()
#: Convolutions for features that move over the surface (benchmarks/NOTES.md, Freaky Torus for three epochs).
MOVING_FEATURES = ConvolutionSettings(
    layers=5,
    width=40,
    neighbourhood="flaps",
    crop=900,
    products=8,
    fit=FitSettings(schedule="cosine", learning_rate=2e-3, batch_size=16, max_epochs=30),
)


def choices(settings: CorrectionSettings) -> list[ResolvedCorrection]:
    """Return the settings that ``auto`` may choose from; an empty list for other settings."""
    return [KernelSettings(), FieldSettings(), MOVING_FEATURES] if isinstance(settings, AutoSettings) else []


def _alternative(own: JointSamples) -> FieldSettings | ConvolutionSettings | None:
    """Return the settings that ``auto`` tries next to the kernel; None if no feature moves over the surface."""
    if own.motion:
        return FieldSettings()
    usual = (max(AUTO.components, AUTO.components_per_latent * len(index)) for index in own.latents)
    shapes = own.scaling.down(own.factors[: AUTO.shapes]).unbind(dim=1)
    return MOVING_FEATURES if any(_components(y) > most for y, most in zip(shapes, usual, strict=True)) else None


def _components(y: Tensor) -> int:
    """Return the number of principal components that hold 99 % of the variance of y (n, p)."""
    s, _ = principal_axes(y - y.mean(dim=0), by="rows")
    variance = s.square().cumsum(0)
    return 1 + int((variance < AUTO.variance * variance[-1]).sum())


class CombinerNetwork(ShapeNetwork):
    """Ψ: factor shapes (n, J, 2E) → NRIC (n, 2E) of the joint shape. Its only input are these shapes.

    ``tried`` has, by kind, the mean square error on held-out codes in scaled differences; it is empty if nothing was
    chosen.
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
        """Fit all parts that have a closed form, see `Correction.fit`. Held-out samples choose between kinds.

        Each fitted network is passed to ``train``, which trains the parts without a closed form.
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
        alternative = _alternative(own)
        if alternative and time.monotonic() - start < 60 * settings.minutes:
            within = alternative.fit.model_copy(update={"minutes": settings.minutes})
            other = fit(alternative.model_copy(update={"fit": within}))
            tried[alternative.kind] = error(other)
            if tried[alternative.kind] < AUTO.better * tried["kernel"]:
                chosen = other
        return cls(own.scaling, chosen.settings, chosen.correction, tried)

    @classmethod
    def load(
        cls, metadata: Mapping[str, str], reference: TriangleMesh, tensors: Mapping[str, Tensor]
    ) -> CombinerNetwork:
        """Return the network with this ``metadata`` and this ``state_dict()``."""
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
        """``correction``: its settings and kind, and ``tried``, both as JSON."""
        return {"correction": self.settings.model_dump_json(), "tried": json.dumps(self.tried)}

    def target(self, z: Tensor) -> Tensor:
        return self.scaling.down(z)

    def coefficients(self, inputs: Tensor) -> Tensor:
        """Return scaled differences (n, 2E) of the joint shape for factor shapes (n, J, 2E)."""
        return self.correction(self.scaling.down(inputs))

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        return self.correction.loss(self.scaling.down(inputs), target)

    def forward(self, factors: Tensor) -> Tensor:
        return self.scaling.up(self.coefficients(factors))
