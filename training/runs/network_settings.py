"""The settings of the stage `networks`: factor networks, combiners, and how they are trained."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator

from shapespace.training.runs.settings import SettingsTable

#: The edges from which a convolution takes its input, see convolutions.EdgeConvolution.
Neighbourhood = Literal["star", "flaps"]
#: Where batch normalisation stands in a layer: before its activation, after it, or nowhere.
Normalisation = Literal["before", "after", "none"]


class FitSettings(SettingsTable):
    """Training of a network by gradient descent."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"weight_decay"})

    optimiser: Literal["adam", "muon"] = "adam"
    """``adam``, as in the paper, or ``muon``: orthogonalised momentum for matrices, with fewer steps for large
    batches."""
    schedule: Literal["plateau", "cosine"] = "plateau"
    """``cosine`` lets the learning rate fall to zero over ``max_epochs``. ``plateau``, as in the paper, divides it by
    ten after ``patience`` epochs without progress, and needs more epochs."""
    learning_rate: float = Field(1e-3, gt=0)
    """Initial learning rate."""
    weight_decay: float = Field(0, ge=0)
    """Share of each weight that a step removes, per unit of the learning rate."""
    final_rate: float = Field(1e-6, gt=0)
    """Training ends below this learning rate."""
    patience: int = Field(10, ge=1)
    """Epochs without a smaller validation loss before ``plateau`` divides the rate."""
    max_epochs: int = Field(500, ge=1)
    """Most passes over the training samples."""
    batch_size: int = Field(64, ge=2)
    """Samples per step."""
    minutes: float | None = Field(None, gt=0)
    """Most minutes of training."""


class LatentNetworkSettings(SettingsTable):
    """A network from codes to NRIC."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"normalisation", "eta"})

    hidden: list[int] = Field([128, 128])
    """Width of each hidden layer."""
    normalisation: Normalisation = "before"
    """Batch normalisation before or after the activation of each hidden layer."""
    fourier: int = Field(1, ge=0)
    """Highest frequency of periodic coordinates among the inputs; 0, as in the paper, takes the angle itself."""
    skip_orders: list[int] = Field([])
    """Highest frequency of each periodic coordinate in a linear layer beside the hidden ones, fitted by ridge
    regression."""
    skip_degree: int = Field(3, ge=0)
    """Degree of the polynomials in such a layer without periodic coordinates; 0 for none. At most 20,000 are used."""
    patches: int = Field(1, ge=1)
    """Groups of neighbouring edges, each with its own principal basis in the last layer."""
    energy: float = Field(0.9999, gt=0, le=1)
    """Share of the variance that this basis keeps. With 1, as in the paper, the last layer is dense."""
    support: float = Field(1, gt=0, le=1)
    """Share of the variance on the edges in this basis. Below 1 other edges keep their mean, and files get smaller."""
    integrability: float = Field(0, ge=0)
    """Weight in the loss of lengths and angles that fit no surface."""
    eta: float | None = Field(None, gt=0)
    """Weight of angles in the loss. By default lengths and angles get the same variance."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, max_epochs=60)
    """How it is trained."""

    @model_validator(mode="after")
    def _of_low_rank(self) -> LatentNetworkSettings:
        if self.energy == 1 and (self.support < 1 or self.integrability):
            raise ValueError("support and integrability need energy < 1")
        return self


class KernelSettings(SettingsTable):
    """Kernel ridge regression on principal coefficients of the factors' shapes, with a learned metric."""

    kind: Literal["kernel"] = "kernel"
    coefficients: int = Field(12, ge=1)
    """Principal coefficients of each factor in a patch."""
    patches: int = Field(8, ge=1)
    """Patches of edges, each with its own regression."""


class ProductSettings(SettingsTable):
    """Ridge regression on products of two factors' principal coefficients."""

    kind: Literal["products"] = "products"
    coefficients: int = Field(8, ge=1)
    """Principal coefficients of each factor."""


class SumSettings(SettingsTable):
    """No correction: the affine sum, which is exact for straight lines."""

    kind: Literal["sum"] = "sum"


class ConvolutionSettings(SettingsTable):
    """Graph convolutions on the edges, trained by gradient descent."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"normalisation", "integrability"})

    kind: Literal["convolutions"] = "convolutions"
    layers: int = Field(3, ge=1)
    """Number of convolutions."""
    width: int = Field(24, ge=1)
    """Features of each edge after each layer."""
    neighbourhood: Neighbourhood = "star"
    """Further inputs of a convolution. ``star``, as in the paper: the sum over all edges at the edge's ends. ``flaps``:
    the edges of its two faces, each with its own weights."""
    crop: int = Field(0, ge=0)
    """Edges in the loss of a training step: a connected part, chosen where the affine sum is bad; 0 takes all. Needs
    ``neighbourhood = "flaps"``."""
    residual: bool = True
    """Learn the difference from the affine sum. ``false``, as in the paper, learns the joint shape."""
    edge_channels: int = Field(4, ge=0)
    """Learned constants for each edge, as further inputs."""
    products: int = Field(0, ge=0)
    """Principal coefficients for a first correction by ``products``; 0 for none. Needs ``residual``."""
    dropout: float = Field(0.0, ge=0, lt=1)
    """Share of features set to zero in training."""
    normalisation: Normalisation = "before"
    """Batch normalisation before or after the activation of each hidden layer."""
    integrability: float = Field(0, ge=0)
    """Weight in the loss of lengths and angles that fit no surface. Needs ``crop = 0``."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, batch_size=16, max_epochs=12)
    """How it is trained."""

    @model_validator(mode="after")
    def _consistent(self) -> ConvolutionSettings:
        if self.crop and self.integrability:
            raise ValueError("integrability needs whole shapes: set crop = 0")
        if self.crop and self.neighbourhood != "flaps":
            raise ValueError('crop needs neighbourhood = "flaps"')
        if self.products and not self.residual:
            raise ValueError("products need residual = true")
        return self


class DenseSettings(SettingsTable):
    """A fully connected, large network on the shapes of all factors (section 3 of the paper)."""

    kind: Literal["dense"] = "dense"
    hidden: list[Annotated[int, Field(ge=1)]] = Field([256, 256])
    """Width of each hidden layer."""
    residual: bool = True
    """Learn the difference from the affine sum. ``false``, as in the paper, learns the joint shape."""
    dropout: float = Field(0.0, ge=0, lt=1)
    """Share of features set to zero in training."""
    normalisation: Normalisation = "after"
    """Batch normalisation before or after the activation of each hidden layer."""
    integrability: float = Field(0, ge=0)
    """Weight in the loss of lengths and angles that fit no surface."""
    fit: FitSettings = FitSettings(schedule="cosine", max_epochs=60)
    """How it is trained."""


class FieldSettings(SettingsTable):
    """A perceptron at every edge, for the collection ``freaky-torus`` only. Its inputs are angles to the features that
    codes move over the surface.
    """

    kind: Literal["field"] = "field"
    layers: int = Field(4, ge=1)
    """Number of hidden layers."""
    width: int = Field(128, ge=1)
    """Width of each layer."""
    concentrations: list[Annotated[float, Field(gt=0)]] = Field([1, 4, 16, 64])
    """Concentrations κ of the inputs exp(κ (cos r − 1)), where r is the angle to a feature. Narrow features need large
    values."""
    relative: bool = True
    """Whether inputs depend only on angles to features, or else on positions."""
    edges: int = Field(128, ge=1)
    """Edges of each shape in the loss of a training step, half of them where the affine sum is bad."""
    fit: FitSettings = FitSettings(
        optimiser="muon", schedule="cosine", learning_rate=2e-2, batch_size=64, max_epochs=80
    )
    """How it is trained."""


class PaperSettings(SettingsTable):
    """The paper's combiner (section 4): convolutions on stars that learn the joint shape, with dropout 0.1."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"normalisation", "integrability"})

    kind: Literal["paper"] = "paper"
    layers: int = Field(3, ge=1)
    """Number of convolutions."""
    width: int = Field(24, ge=1)
    """Features of each edge after each layer."""
    normalisation: Normalisation = "before"
    """Batch normalisation before or after the activation of each hidden layer."""
    integrability: float = Field(0, ge=0)
    """Weight in the loss of lengths and angles that fit no surface."""
    fit: FitSettings = FitSettings()
    """How it is trained."""

    @property
    def convolutions(self) -> ConvolutionSettings:
        """The equivalent convolutions, with every setting written out."""
        own = {name: getattr(self, name) for name in ("layers", "width", "normalisation", "integrability", "fit")}
        return ConvolutionSettings(residual=False, edge_channels=0, dropout=0.1, **own)


class AutoSettings(SettingsTable):
    """``kernel`` for most collections. If codes move something over the surface, also ``field`` for ``freaky-torus``,
    otherwise ``convolutions``. The run takes this second kind if its squared error on validation codes is at
    least a tenth smaller.
    """

    kind: Literal["auto"] = "auto"
    minutes: float = Field(30, ge=0)
    """Most minutes of training for the second kind, which is skipped if the kernel alone took longer."""


#: All kinds of corrections; ``auto`` and ``paper`` stand for one of them.
ResolvedCorrection = Annotated[
    KernelSettings | ProductSettings | SumSettings | ConvolutionSettings | DenseSettings | FieldSettings,
    Field(discriminator="kind"),
]
CorrectionSettings = Annotated[ResolvedCorrection | PaperSettings | AutoSettings, Field(discriminator="kind")]

#: Settings of a combiner in version 0.1, and how ``correction`` is written in their place.
_COMBINER_OF_0_1 = {
    '{ kind = "kernel", coefficients }': ["kernel", "polynomial", "monomials"],
    '{ kind = "products", coefficients } or { kind = "convolutions", products, … }': ["pairwise"],
    '{ kind = "convolutions", … } with the same names': [
        "layers", "width", "neighbourhood", "crop", "residual", "edge_channels", "dropout", "fit",
    ],
}  # fmt: skip


class CombinerSettings(SettingsTable):
    """The map from factor shapes to the joint shape: their affine sum plus a correction."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"eta"})

    correction: CorrectionSettings = AutoSettings()
    """A table with ``kind``, by default ``"auto"``, and the settings of this kind."""
    symmetries: bool = True
    """Add images of the samples under the collection's symmetries, if it has any."""
    eta: float | None = Field(None, gt=0)
    """Weight of angles in the loss. By default lengths and angles get the same variance."""

    @model_validator(mode="before")
    @classmethod
    def _not_of_0_1(cls, values: Any) -> Any:
        written = values if isinstance(values, dict) else {}
        moved = [
            f"{', '.join(found)} as correction = {new}"
            for new, old in _COMBINER_OF_0_1.items()
            if (found := [name for name in old if name in written])
        ]
        if moved:
            raise ValueError(f"settings of version 0.1: write {'; '.join(moved)}; leave out what was 0")
        return values


class Recipe(SettingsTable):
    """The parts of the composite network."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"fine_tuning"})

    factors: list[LatentNetworkSettings] | LatentNetworkSettings = LatentNetworkSettings()
    """The factor networks: one table for all, or one for each."""
    combiner: CombinerSettings = CombinerSettings()
    """The network that joins the factors' shapes."""
    fine_tuning: FitSettings | None = None
    """Train all networks together afterwards. Parts of a combiner in closed form stay."""


class NetworkSettings(Recipe):
    """The networks that are exported, and networks for comparison."""

    SINCE_0_3: ClassVar[frozenset[str]] = Recipe.SINCE_0_3 | {"device"}

    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Processor, NVIDIA or AMD GPU (``cuda``), or Apple GPU (``mps``) for gradient descent. ``auto`` takes [a
    GPU](../how-to/gpu.md) if there is one. Changing only this keeps finished networks."""
    seed: int = 0
    """Seed of initial weights and of the order of samples."""
    fractions: list[Annotated[float, Field(gt=0, lt=1)]] = Field([])
    """Not used any more; ``python -m benchmarks.studies`` trains with shares of the training codes now."""
    seeds: list[int] = Field([])
    """Not used any more; ``python -m benchmarks.studies`` trains with several seeds now."""
    paper: bool = False
    """Also train the paper's own system, for comparison. The stage takes about twice as long."""
