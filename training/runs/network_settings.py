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
    """How a network is trained by gradient descent."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"weight_decay"})

    optimiser: Literal["adam", "muon"] = "adam"
    """``adam``, as in the paper, or ``muon``. Muon updates matrices by their orthogonalised momentum and all else as
    Adam does. With large batches it needs fewer steps."""
    schedule: Literal["plateau", "cosine"] = "plateau"
    """Schedule of the learning rate. ``plateau`` divides it by ten whenever the validation loss has not fallen for
    ``patience`` epochs, as in the paper (section 4). ``cosine`` lets it fall along half a cosine, to zero after
    ``max_epochs``. It needs fewer epochs."""
    learning_rate: float = Field(1e-3, gt=0)
    """Initial learning rate."""
    weight_decay: float = Field(0, ge=0)
    """Share of each weight that a step removes, per unit of the learning rate."""
    final_rate: float = Field(1e-6, gt=0)
    """Training ends when the learning rate falls below this."""
    patience: int = Field(10, ge=1)
    """Epochs without a smaller validation loss before ``plateau`` divides the rate."""
    max_epochs: int = Field(500, ge=1)
    """Most passes over the training samples."""
    batch_size: int = Field(64, ge=2)
    """Number of samples per step."""
    minutes: float | None = Field(None, gt=0)
    """Most minutes of training. The time of the first epoch decides how many epochs fit."""


class LatentNetworkSettings(SettingsTable):
    """A network from latent codes to NRIC: a factor network, or a baseline on the whole code.

    The baseline ``monolithic`` is this network with one factor. ``monolithic_paper`` is the paper's monolithic network.
    """

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"normalisation", "eta"})

    hidden: list[int] = Field([128, 128])
    """Width of each hidden layer."""
    normalisation: Normalisation = "before"
    """Batch normalisation in each hidden layer: ``before`` or ``after`` its activation, or ``none``."""
    fourier: int = Field(1, ge=0)
    """Highest frequency of a periodic coordinate among the inputs. 0 takes the angle itself, as the paper does."""
    skip_orders: list[int] = Field([])
    """Largest frequency of each coordinate in a linear layer of Fourier products, beside the hidden layers and fitted
    by ridge regression. An empty list leaves the layer out. All coordinates must be periodic."""
    skip_degree: int = Field(3, ge=0)
    """Total degree of the polynomials in such a layer, for factors without a periodic coordinate. 0 leaves the layer
    out. The degree is lower for a factor that would have more than 20,000 polynomials."""
    patches: int = Field(1, ge=1)
    """Groups of neighbouring edges, each with a principal basis of its own, in the last layer."""
    energy: float = Field(0.9999, gt=0, le=1)
    """Share of the variance that this basis keeps. 1 makes the last layer dense, as in the paper."""
    support: float = Field(1, gt=0, le=1)
    """Share of the variance on the edges that have entries in this basis. Below 1 the network is sparse: edges that
    vary little keep their mean. This makes files smaller if the basis has a large rank."""
    integrability: float = Field(0, ge=0)
    """Weight, in gradient descent, of lengths and angles that fit no surface. They leave a gap between the first and
    the last face around a vertex. The gap is linearised at the mean and scaled to the mean square error."""
    eta: float | None = Field(None, gt=0)
    """Weight of angles in the loss, as ``evaluation.eta`` is their weight in R². By default the loss scales lengths and
    angles to the same variance."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, max_epochs=60)
    """How the network is trained."""

    @model_validator(mode="after")
    def _of_low_rank(self) -> LatentNetworkSettings:
        if self.energy == 1 and (self.support < 1 or self.integrability):
            raise ValueError("support and integrability need energy < 1")
        return self


class KernelSettings(SettingsTable):
    """Kernel ridge regression on principal coefficients of the factors' shapes, with a learned metric.

    Each patch of edges has a regression of its own.
    """

    kind: Literal["kernel"] = "kernel"
    coefficients: int = Field(12, ge=1)
    """Principal coefficients of each factor in a patch."""
    patches: int = Field(8, ge=1)
    """Number of patches."""


class ProductSettings(SettingsTable):
    """Ridge regression on products of the principal coefficients of every two factors."""

    kind: Literal["products"] = "products"
    coefficients: int = Field(8, ge=1)
    """Principal coefficients of each factor."""


class SumSettings(SettingsTable):
    """No correction: the affine sum of the factors. Straight-line models have it, because it is exact there."""

    kind: Literal["sum"] = "sum"


class ConvolutionSettings(SettingsTable):
    """Graph convolutions on the edges, trained by gradient descent."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"normalisation", "integrability"})

    kind: Literal["convolutions"] = "convolutions"
    layers: int = Field(3, ge=1)
    """Number of successive convolutions."""
    width: int = Field(24, ge=1)
    """Number of features of each edge after each layer."""
    neighbourhood: Neighbourhood = "star"
    """The inputs of a convolution, in addition to the edge itself. ``star``, as in the paper, takes the sum over all
    edges at its ends. ``flaps`` takes the edges of its two faces, each with weights of its own."""
    crop: int = Field(0, ge=0)
    """Number of edges in the loss of a training step, a connected part of each shape. The part is chosen at random in
    proportion to the error of the affine sum there. 0 takes whole shapes. Needs ``neighbourhood = "flaps"``."""
    residual: bool = True
    """Whether the network learns the difference from the affine sum of the factors, and each layer the difference from
    its input. If not, it learns the joint shape itself, as in the paper."""
    edge_channels: int = Field(4, ge=0)
    """Number of learned constants for each edge. They are inputs of the first layer, beside the factors' shapes."""
    products: int = Field(0, ge=0)
    """Principal coefficients of each factor whose products correct the affine sum first, as the kind ``products`` does.
    0 leaves them out. Needs ``residual``."""
    dropout: float = Field(0.0, ge=0, lt=1)
    """Share of the features that are set to zero after each layer during training."""
    normalisation: Normalisation = "before"
    """Batch normalisation in each layer: ``before`` or ``after`` its activation, or ``none``."""
    integrability: float = Field(0, ge=0)
    """Weight of lengths and angles that fit no surface, as in the factor networks. Needs ``crop = 0``."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, batch_size=16, max_epochs=12)
    """How the network is trained."""

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
    """A fully connected network on the shapes of all factors, which the paper names beside convolutions (section 3).

    It has a weight for each pair of a length or angle and a unit of the first layer, so it is large.
    """

    kind: Literal["dense"] = "dense"
    hidden: list[Annotated[int, Field(ge=1)]] = Field([256, 256])
    """Width of each hidden layer."""
    residual: bool = True
    """Whether the network learns the difference from the affine sum of the factors, or the joint shape itself."""
    dropout: float = Field(0.0, ge=0, lt=1)
    """Share of the features that are set to zero after each hidden layer during training."""
    normalisation: Normalisation = "after"
    """Batch normalisation in each hidden layer: ``before`` or ``after`` its activation, or ``none``."""
    integrability: float = Field(0, ge=0)
    """Weight of lengths and angles that fit no surface, as in the factor networks."""
    fit: FitSettings = FitSettings(schedule="cosine", max_epochs=60)
    """How the network is trained."""


class FieldSettings(SettingsTable):
    """A perceptron at every edge, trained by gradient descent. Its inputs are the angles from this edge to the features
    that codes move over the surface. The collection must know where its features are, as Freaky Torus does.
    """

    kind: Literal["field"] = "field"
    layers: int = Field(4, ge=1)
    """Number of hidden layers."""
    width: int = Field(128, ge=1)
    """Width of each layer."""
    concentrations: list[Annotated[float, Field(gt=0)]] = Field([1, 4, 16, 64])
    """Concentrations κ of the densities exp(κ (cos r − 1)) of the angle r to a feature. They are inputs, beside the
    cosine and the sine of r. Narrow features need large values."""
    relative: bool = True
    """Whether inputs are functions of the angles from an edge to features. The network then need not learn symmetries
    that move both. If not, inputs are the positions of features and edges."""
    edges: int = Field(128, ge=1)
    """Number of edges of each shape in the loss of a training step. Half of them are drawn in proportion to the squared
    error of the affine sum."""
    fit: FitSettings = FitSettings(
        optimiser="muon", schedule="cosine", learning_rate=2e-2, batch_size=64, max_epochs=80
    )
    """How the network is trained."""


class PaperSettings(SettingsTable):
    """The paper's combiner (section 4): convolutions on stars that learn the joint shape itself, with dropout 0.1.

    Adam starts with a learning rate of 1e-3 and divides it by ten on a plateau.
    """

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"normalisation", "integrability"})

    kind: Literal["paper"] = "paper"
    layers: int = Field(3, ge=1)
    """Number of successive convolutions."""
    width: int = Field(24, ge=1)
    """Number of features of each edge after each layer."""
    normalisation: Normalisation = "before"
    """Batch normalisation in each layer: ``before`` or ``after`` its activation, or ``none``. The paper has it after
    each layer."""
    integrability: float = Field(0, ge=0)
    """Weight of lengths and angles that fit no surface, which the paper suggests in its outlook."""
    fit: FitSettings = FitSettings()
    """How the network is trained."""

    @property
    def convolutions(self) -> ConvolutionSettings:
        """The equivalent convolutions, with every setting written out."""
        own = {name: getattr(self, name) for name in ("layers", "width", "normalisation", "integrability", "fit")}
        return ConvolutionSettings(residual=False, edge_channels=0, dropout=0.1, **own)


class AutoSettings(SettingsTable):
    """The kind with the smallest error on held-out codes.

    This is ``kernel`` for most collections. If codes move something over the surface, the run tries a second kind:
    ``field`` if the collection knows where its features are, otherwise ``convolutions``. It chooses the second kind if
    its error is at least a tenth smaller.
    """

    kind: Literal["auto"] = "auto"
    minutes: float = Field(30, ge=0)
    """Most minutes of training for the second kind. The run does not try it if the kernel alone took longer."""


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
    """The map from J factor shapes to the joint shape: their affine sum, plus a correction."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"eta"})

    correction: CorrectionSettings = AutoSettings()
    """How the difference between the joint shape and the affine sum is learned."""
    symmetries: bool = True
    """Whether the training samples include their images under the collection's symmetries, if it has any."""
    eta: float | None = Field(None, gt=0)
    """Weight of angles in the loss, as in the factor networks."""

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
    """Settings of the factor networks: one table for each factor, or one for all."""
    combiner: CombinerSettings = CombinerSettings()
    """The network that joins the factors' shapes."""
    fine_tuning: FitSettings | None = None
    """How all networks are trained once more, together, on the joint samples. By default the run trains factors and
    combiner one after the other. Parts of a combiner that were found in closed form stay."""


class NetworkSettings(Recipe):
    """The networks that are exported, and those that are trained for comparison."""

    SINCE_0_3: ClassVar[frozenset[str]] = Recipe.SINCE_0_3 | {"device"}

    device: Literal["auto", "cpu", "cuda", "mps"] = "auto"
    """Where networks are trained by gradient descent: on the processor, on an NVIDIA or AMD GPU (``cuda``), or on the
    GPU of an Apple computer (``mps``). ``auto`` takes a GPU if PyTorch finds one. See [how to train on a
    GPU](../how-to/gpu.md). If you change only the device, finished networks stay."""
    seed: int = 0
    """Seed of the networks' initial weights and of the order of the samples."""
    fractions: list[Annotated[float, Field(gt=0, lt=1)]] = Field([])
    """Not used any more. Version 0.2 trained with these shares of the training codes too; ``python -m
    benchmarks.studies`` does so now."""
    seeds: list[int] = Field([])
    """Not used any more. Version 0.2 trained with these seeds too; ``python -m benchmarks.studies`` does so now."""
    paper: bool = False
    """Whether the run also trains the paper's own system, for comparison. This takes hours on a processor."""
