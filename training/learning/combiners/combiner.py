"""The combiner Ψ: the affine sum of factor shapes, plus a correction of the kind that suits the collection."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from typing import Any

from pydantic import TypeAdapter
from torch import Tensor

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.combiners.convolutions import ConvolutionCorrection
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.learning.combiners.fields import FieldCorrection
from shapespace.training.learning.combiners.kernels import KernelCorrection
from shapespace.training.learning.combiners.products import ProductCorrection
from shapespace.training.learning.layers import Scaling
from shapespace.training.learning.linear import principal_axes
from shapespace.training.learning.networks import ShapeNetwork, predict
from shapespace.training.runs.config import (
    AutoSettings,
    ConvolutionSettings,
    CorrectionSettings,
    FieldSettings,
    FitSettings,
    KernelSettings,
    PaperSettings,
    ResolvedCorrection,
)

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
