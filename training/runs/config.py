"""The typed configuration of a run, read from TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import tomlkit
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from shapespace.coordinates.reconstruction import DEFAULT_ETA
from shapespace.shell.energy import Material

#: Which edges a convolution takes its input from, see convolutions.EdgeConvolution.
Neighbourhood = Literal["star", "flaps"]

#: Default number of samples of each factor alone: few suffice, as a factor has few modes.
FACTOR_SAMPLES = 1000

#: Default number of joint samples with derivatives.
DERIVATIVES = 60


def _grid(nodes: int) -> int:
    if 0 < nodes < 3:
        raise ValueError("a grid has at least 3 nodes per coordinate, and 0 leaves it out")
    return nodes


class ConfigError(ValueError):
    """A configuration that can't be used, with a line for each fault."""


class _Section(BaseModel):
    # Docstrings under the fields are their descriptions, from which docs/reference/configuration.md is written.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class CollectionSettings(_Section):
    """Where the shapes come from: a built-in generator, or meshes in correspondence."""

    generator: Literal["freaky-torus", "figure"] | None = None
    """A built-in generator of a collection; see training/collection/generators."""
    data: Path | None = None
    """Folder of OBJ, PLY, STL, OFF or glTF files, or one NPZ file with ``vertices`` (n, V, 3) and ``faces``; relative
    to the configuration's own folder. The command's ``--data`` takes precedence."""
    reference: str | None = None
    """Name of the mesh that is scaled to area 1 and whose position and orientation served shapes have; by default the
    most central one."""
    parts: list[str] = []
    """Of meshes of several parts, the names of those to keep: the first is the shell that the model computes with, the
    others are carried along with it. By default all are kept, and the largest is the shell. Names are those of the
    file's objects, groups or materials, or ``part 1``, ``part 2`` and so on; ``run --until ingest`` prints them."""
    coarse_vertices: int = Field(1000, ge=0)
    """Vertices to compute with: meshes with more are simplified to about this number. 0 computes with all vertices."""
    mirror: bool = True
    """Whether to learn from the shapes' mirror images too, if one of the shapes has a plane of symmetry, and only one:
    its vertices say which vertex each is the mirror image of. So a pose of the left arm is one of the right arm too."""

    @model_validator(mode="after")
    def _one_source(self) -> CollectionSettings:
        if self.generator is not None and self.data is not None:
            raise ValueError("give either a generator or data, not both")
        return self


class MaterialSettings(_Section):
    """Elastic parameters of the shell, at unit area of the reference; see shapespace.shell.energy.Material."""

    mu: float = Field(Material.mu, gt=0)
    """Lamé's μ of the membrane."""
    lambda_: float = Field(Material.lambda_, ge=0, alias="lambda")
    """Lamé's λ of the membrane."""
    eta: float = Field(Material.eta, gt=0)
    """Weight η of bending against stretching, about the squared thickness. Larger values make stiffer shells, whose
    triangles may collapse on the way to far shapes."""


class ModeSettings(_Section):
    """Sparse principal geodesic analysis of the collection at its mean."""

    count: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Number of modes m, at most one less than the number of shapes. ``auto`` adds modes until one more would lower the
    mean error of held-out shapes by less than half a percent of the mean distance of shapes from the mean shape."""
    norm: Literal["mixed", "vertices", "shell"] = "mixed"
    """The norm in which modes approximate the shapes: ``vertices``, distances of vertices weighted by area; ``shell``,
    the metric of the shell space, as in the paper, in which small wrinkles count much; or ``mixed``, the first plus a
    tenth of the second."""
    sparsity: Annotated[float, Field(ge=0, lt=1)] | Literal["auto"] = "auto"
    """Weight λ of the sparsity term, as a share of the weight at which every principal mode would vanish. Larger
    values make each mode move a smaller part; 0 is plain principal geodesic analysis. ``auto`` takes the largest of
    some candidates that increases the squared error of held-out shapes by at most 3 %."""
    log_steps: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Time steps K of the discrete logarithms. In one step a mode moves every vertex along a straight line, and modes
    add up in vertices, as blend shapes do; in many they bend the surface. ``auto`` takes 16, or one where shapes that
    are held out come no less near so and at most a tenth of random shapes fold."""
    max_iterations: int = Field(200, ge=1)
    """Most iterations of the sparse analysis, each over all modes."""


class FactorSettings(_Section):
    """Groups of modes whose supports overlap."""

    count: int | None = Field(None, ge=1)
    """Number of factors J; by default it follows from how much the modes overlap."""


class SampleSettings(_Section):
    """The samples to learn from: shapes of codes drawn uniformly from the hypercube, and of the collection's own
    codes.
    """

    count: int = Field(4000, ge=10)
    """Number of joint samples: shapes of random codes. Computing them takes most of a run's time."""
    steps: int | None = Field(None, ge=1)
    """Time steps K of the discrete exponentials, by default those of the logarithms: only with the same K are they
    inverse to each other."""
    factor_counts: list[int] | int | None = None
    """Samples of each factor alone, one number for all or one for each. They have the factor's part of the joint
    codes, and of further codes beyond ``count``. By default 1000, or ``count`` where that is less; the paper takes
    ``count``."""
    shapes: bool = True
    """Whether the codes of the collection's own shapes are training samples too, as few random codes lie near the
    shapes. At most a quarter as many as ``count``, spread evenly over the shapes."""
    derivatives: int | None = Field(None, ge=0)
    """Number of joint samples that are learned from together with their derivatives by the code. Each of these takes as
    long as about ten others, and beside some hundred others says more than so many. By default 60, or a tenth of
    ``count`` where that is less."""
    part_size: int = Field(50, ge=1)
    """Number of samples per file: as many as a worker computes at a time, and as are lost if it dies."""
    test_fraction: float = Field(0.2, gt=0, lt=1)
    """Share of the joint samples that are used for the evaluation only."""
    validation_fraction: float = Field(0.1, gt=0, lt=1)
    """Share of the other joint samples that are used to choose the learning rate and the best epoch."""
    seed: int = 0
    """Seed of the random codes and of their split."""

    @property
    def differentiated(self) -> int:
        """Joint samples with derivatives."""
        return min(DERIVATIVES, self.count // 10) if self.derivatives is None else self.derivatives

    def own(self, factors: int) -> list[int]:
        """Samples of each factor alone."""
        counts = min(self.count, FACTOR_SAMPLES) if self.factor_counts is None else self.factor_counts
        return counts if isinstance(counts, list) else [counts] * factors


class FitSettings(_Section):
    """Gradient descent."""

    optimiser: Literal["adam", "muon"] = "adam"
    """``adam``, as in the paper; or ``muon``, which updates matrices by their orthogonalised momentum, and all else as
    Adam does: fewer steps of large batches are needed."""
    schedule: Literal["plateau", "cosine"] = "plateau"
    """Schedule of the learning rate. ``plateau`` divides it by ten whenever the validation loss has not fallen for
    ``patience`` epochs, as in the paper (section 4). ``cosine`` lets it fall along half a cosine, to zero after
    ``max_epochs``: fewer epochs are needed."""
    learning_rate: float = Field(1e-3, gt=0)
    """Initial learning rate."""
    final_rate: float = Field(1e-6, gt=0)
    """Training ends when the learning rate falls below this."""
    patience: int = Field(10, ge=1)
    """Epochs without a smaller validation loss before ``plateau`` divides the rate."""
    max_epochs: int = Field(500, ge=1)
    """Most passes over the training samples."""
    batch_size: int = Field(64, ge=2)
    """Number of samples per step."""
    minutes: float | None = Field(None, gt=0)
    """Only as many epochs as take so long, by the time of the first."""


class LatentNetworkSettings(_Section):
    """A network from latents to NRIC: a factor network, or a baseline on all latents.

    The baselines are ``monolithic``, this network with one factor, and ``monolithic_paper``, the paper's.
    """

    hidden: list[int] = [128, 128]
    """Width of each hidden layer."""
    fourier: int = Field(1, ge=0)
    """Highest frequency of a periodic coordinate among the inputs; 0 takes the angle itself, as the paper does."""
    skip_orders: list[int] = []
    """Largest frequency of each coordinate in a linear layer of Fourier products beside the hidden ones, fitted by
    ridge regression; an empty list leaves it out. All coordinates must be periodic."""
    skip_degree: int = Field(3, ge=0)
    """Total degree of the polynomials in such a layer, for factors without a periodic coordinate; 0 leaves it out.
    Less for factors of so many coordinates that there would be more than 20,000 polynomials."""
    patches: int = Field(1, ge=1)
    """Groups of neighbouring edges, each with a principal basis of its own, in the last layer."""
    energy: float = Field(0.9999, gt=0, le=1)
    """Share of the variance that this basis keeps; 1 makes the last layer dense, as in the paper."""
    support: float = Field(1, gt=0, le=1)
    """Share of the variance on the edges that this basis has entries for. With less than 1 the network is sparse: edges
    that hardly vary keep their mean. Files are smaller where the basis has a large rank."""
    integrability: float = Field(0, ge=0)
    """Weight, in gradient descent, of errors that change lengths and angles as no surface can: how far faces around a
    vertex are from closing (to first order at the mean), scaled to the mean square error of errors in any direction."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, max_epochs=60)
    """How the network is trained."""

    @model_validator(mode="after")
    def _of_low_rank(self) -> LatentNetworkSettings:
        if self.energy == 1 and (self.support < 1 or self.integrability):
            raise ValueError("support and integrability need energy < 1")
        return self


class KernelSettings(_Section):
    """Kernel ridge regression on principal coefficients of the factors' shapes, another one for each patch of edges, in
    a metric that is learned.
    """

    kind: Literal["kernel"] = "kernel"
    coefficients: int = Field(12, ge=1)
    """Principal coefficients of each factor in a patch."""
    patches: int = Field(8, ge=1)
    """Number of patches."""


class ProductSettings(_Section):
    """Ridge regression on products of the principal coefficients of every two factors."""

    kind: Literal["products"] = "products"
    coefficients: int = Field(8, ge=1)
    """Principal coefficients of each factor."""


class ConvolutionSettings(_Section):
    """Graph convolutions on the edges, trained by gradient descent."""

    kind: Literal["convolutions"] = "convolutions"
    layers: int = Field(3, ge=1)
    """Number of successive convolutions."""
    width: int = Field(24, ge=1)
    """Number of features of each edge after each layer."""
    neighbourhood: Neighbourhood = "star"
    """What a convolution sees beside an edge itself: the sum over all edges at its ends (``star``, as in the paper), or
    the edges of its two faces, each with weights of its own (``flaps``)."""
    crop: int = Field(0, ge=0)
    """Edges of the connected part of each shape that the loss of a training step is computed on, chosen at random in
    proportion to the error of the affine sum there; 0 takes whole shapes. Needs the neighbourhood ``flaps``."""
    residual: bool = True
    """Whether the network learns the difference from the affine sum of the factors, and each layer the difference from
    its input. Otherwise it learns the joint shape itself, as in the paper."""
    edge_channels: int = Field(4, ge=0)
    """Number of learned constants of each edge, inputs of the first layer beside the factors' shapes."""
    products: int = Field(0, ge=0)
    """Principal coefficients of each factor whose products correct the affine sum first, as the kind ``products`` does;
    0 leaves them out. Needs ``residual``."""
    dropout: float = Field(0.0, ge=0, lt=1)
    """Share of the features that are set to zero after each layer during training."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, batch_size=16, max_epochs=12)
    """How the network is trained."""

    @model_validator(mode="after")
    def _consistent(self) -> ConvolutionSettings:
        if self.crop and self.neighbourhood != "flaps":
            raise ValueError("crop needs the neighbourhood flaps")
        if self.products and not self.residual:
            raise ValueError("products need residual = true")
        return self


class FieldSettings(_Section):
    """A perceptron at every edge, which sees how far the features that codes move over the surface are from this edge,
    trained by gradient descent. For collections that know where their features are: Freaky Torus.
    """

    kind: Literal["field"] = "field"
    layers: int = Field(4, ge=1)
    """Number of hidden layers."""
    width: int = Field(128, ge=1)
    """Width of each."""
    concentrations: list[Annotated[float, Field(gt=0)]] = [1, 4, 16, 64]
    """Concentrations κ of the densities exp(κ (cos r − 1)) of the angle r to a feature, inputs beside the cosine and
    the sine of r. Narrow features need large ones."""
    relative: bool = True
    """Whether inputs are functions of the angles from an edge to features, so that symmetries which move both need not
    be learned; otherwise of features and edges apart."""
    edges: int = Field(128, ge=1)
    """Edges of each shape that the loss of a training step is computed on, half of them drawn in proportion to the
    squared error of the affine sum."""
    fit: FitSettings = FitSettings(
        optimiser="muon", schedule="cosine", learning_rate=2e-2, batch_size=64, max_epochs=80
    )
    """How the network is trained."""


class PaperSettings(_Section):
    """The paper's combiner (section 4): convolutions on stars that learn the joint shape itself, dropout 0.1, Adam with
    a rate of 1e-3 that is divided by ten on a plateau.
    """

    kind: Literal["paper"] = "paper"
    layers: int = Field(3, ge=1)
    """Number of successive convolutions."""
    width: int = Field(24, ge=1)
    """Number of features of each edge after each layer."""
    fit: FitSettings = FitSettings()
    """How the network is trained."""

    @property
    def convolutions(self) -> ConvolutionSettings:
        """The same, with every setting written out."""
        return ConvolutionSettings(
            layers=self.layers, width=self.width, residual=False, edge_channels=0, dropout=0.1, fit=self.fit
        )


class AutoSettings(_Section):
    """The kind that suits the collection, by its error on held-out codes.

    That is ``kernel``; where codes move something over the surface, another is tried and chosen if it leaves a tenth
    less: ``field`` if the collection knows where, and ``convolutions`` otherwise.
    """

    kind: Literal["auto"] = "auto"
    minutes: float = Field(30, ge=0)
    """The other kind has only as many epochs as take so long, and is not tried where the kernel alone took longer."""


#: The kinds that a network can be of; ``auto`` and ``paper`` stand for one of them.
ResolvedCorrection = Annotated[
    KernelSettings | ProductSettings | ConvolutionSettings | FieldSettings,
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


class CombinerSettings(_Section):
    """The map from J factor shapes to the joint one: their affine sum, plus a correction."""

    correction: CorrectionSettings = AutoSettings()
    """How the difference between the joint shape and the affine sum is learned."""
    symmetries: bool = True
    """Whether the training samples include their images under the collection's symmetries, if it has any."""

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


class Recipe(_Section):
    """The parts of the composite network."""

    factors: list[LatentNetworkSettings] | LatentNetworkSettings = LatentNetworkSettings()
    """Settings of the factor networks: one table for each factor, or one for all."""
    combiner: CombinerSettings = CombinerSettings()
    """The network that joins the factors' shapes."""


class NetworkSettings(Recipe):
    """The networks that are exported, and those that are trained for comparison."""

    seed: int = 0
    """Seed of the networks' initial weights and of the order of the samples."""
    fractions: list[Annotated[float, Field(gt=0, lt=1)]] = []
    """Shares of the training codes to learn from as well, for the study of their number: each once with the factors'
    parts of these codes only, as the paper does, and once with all the samples of the factors."""
    seeds: list[int] = []
    """Further seeds, of split and networks, to learn with as well, for the spread of the figures."""
    paper: bool = False
    """Whether the paper's own system is trained too, for comparison: its factor networks, convolutions on stars and
    schedules. Takes hours on a processor."""


class VariantSettings(_Section):
    """One row of the ablation: what differs from the main recipe, or from another variant."""

    title: str
    """Its name in the report and the tables."""
    base: str | None = None
    """Name of the variant that this one differs from; it must stand before this one. None is the main recipe."""
    factors: list[dict[str, Any]] | dict[str, Any] = {}
    """Settings of the factor networks that differ: one table for each factor, or one that is applied to all."""
    combiner: dict[str, Any] = {}
    """Settings of the combiner that differ. A correction of another kind starts from that kind's defaults."""

    def applied(self, base: Recipe) -> Recipe:
        """The recipe that results from a base.

        Raises:
            ValueError: as many tables of factors as there are factors in the base are needed.
            ValidationError: settings that can't be used.
        """
        below = base.model_dump(include=set(Recipe.model_fields))
        mine, theirs = self.factors, below["factors"]
        if isinstance(mine, list) or isinstance(theirs, list):
            count = len(theirs if isinstance(theirs, list) else mine)
            theirs = theirs if isinstance(theirs, list) else [theirs] * count
            mine = mine if isinstance(mine, list) else [mine] * count
            if len(mine) != len(theirs):
                raise ValueError(f"factors: {len(mine)} tables over {len(theirs)}")
            factors: Any = [_merged(a, b) for a, b in zip(theirs, mine, strict=True)]
        else:
            factors = _merged(theirs, mine)
        return Recipe.model_validate({"factors": factors, "combiner": _merged(below["combiner"], self.combiner)})


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Nested tables, the values of ``above`` over those of ``below``; a table of another ``kind`` replaces its own."""
    result = dict(below)
    for name, value in above.items():
        old = below.get(name)
        if isinstance(value, dict) and isinstance(old, dict) and value.get("kind", old.get("kind")) == old.get("kind"):
            value = _merged(old, value)
        result[name] = value
    return result


class EvaluationSettings(_Section):
    """How the test split is measured."""

    eta: float = Field(1e-2, gt=0)
    """Weight of angles against lengths in the norm of all figures."""
    grid_nodes: Annotated[int, Field(ge=0), AfterValidator(_grid)] = 0
    """Most nodes per coordinate of the multilinear grid of Sassen et al. 2020, a baseline whose nodes may take as
    long as all samples; 0 leaves it out."""
    grid_size: int = Field(1000, ge=1)
    """Most nodes of the grid of one factor; a factor for which that leaves fewer than 3 per coordinate gets no
    grid."""
    exact_factors: int = Field(200, ge=2)
    """Number of test codes for which the affine sum of exact factors is computed."""
    reconstructions: int = Field(100, ge=1)
    """Number of test shapes whose vertices are reconstructed."""
    fresh: int = Field(100, ge=0)
    """Number of fresh codes on which every model is measured once more. They are drawn after training, with a digest of
    the networks as seed; at most as many as there are test codes. 0 leaves them out."""


#: An axis of the collection's coordinates, with its direction.
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


class ExportSettings(_Section):
    """Name and description of the exported bundle."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)
    """Name of the model in addresses and file names."""
    version: int = Field(1, ge=1, lt=10**9)
    """The bundle is written to ``models/NAME/VERSION``, replacing one that is there."""
    title: str
    """Title of the model, shown to people."""
    description: str
    """A sentence that describes the model, shown to people."""
    licence: str
    """Licence of the meshes, and so of the model."""
    eta_reconstruction: float = Field(DEFAULT_ETA, gt=0)
    """Weight η of angles against lengths when vertices are found from them (Gauss–Newton)."""
    examples: bool = True
    """Whether the model remembers what modes and networks miss of the training shapes, and adds it where a code is
    theirs. Other codes hardly notice. The bundle is larger by a byte for each length and angle of each shape."""
    tolerance: float = Field(1e-4, gt=0)
    """Largest relative difference of ONNX and PyTorch, in the weighted norm."""
    faces: Axis | None = None
    """The axis along which the body looks. Left and right in names are the body's own then; by default they are those
    of a viewer who has x to the right, y up and z towards the eye."""
    up: Axis = "+y"
    """The axis that points to the body's head, where ``faces`` is given."""
    names: dict[str, str] = {}
    """What factors and coordinates are called, by the name that the run gives them in its report:
    ``{"upper right" = "left arm"}``. Coordinates follow their factor unless they are named themselves."""

    @model_validator(mode="after")
    def _upright(self) -> ExportSettings:
        if self.faces is not None and self.faces[1] == self.up[1]:
            raise ValueError(f"a body that looks along {self.faces} cannot have its head along {self.up}")
        if blank := [old for old, new in self.names.items() if not new.strip()]:
            raise ValueError(f"names has nothing for {blank[0]!r}")
        return self


class Config(_Section):
    """What a configuration consists of."""

    collection: CollectionSettings
    material: MaterialSettings = MaterialSettings()
    modes: ModeSettings = ModeSettings()
    factors: FactorSettings = FactorSettings()
    samples: SampleSettings = SampleSettings()
    networks: NetworkSettings = NetworkSettings()
    monolithic: LatentNetworkSettings = LatentNetworkSettings(hidden=[256, 256])
    monolithic_paper: LatentNetworkSettings = LatentNetworkSettings(
        hidden=[256, 256], fourier=0, skip_degree=0, energy=1, fit=FitSettings()
    )
    variants: dict[str, VariantSettings] = {}
    evaluation: EvaluationSettings = EvaluationSettings()
    export: ExportSettings

    @property
    def shell_material(self) -> Material:
        """The elastic material of the shell."""
        return Material(self.material.mu, self.material.lambda_, self.material.eta)

    @cached_property
    def recipes(self) -> dict[str, Recipe]:
        """The full recipe of each variant.

        Raises:
            ValueError: naming the variant and its faults.
        """
        found: dict[str, Recipe] = {}
        for name, variant in self.variants.items():
            if variant.base is not None and variant.base not in found:
                raise ValueError(f"variants.{name}.base: no variant {variant.base!r} stands before it")
            try:
                found[name] = variant.applied(found[variant.base] if variant.base else self.networks)
            except ValidationError as error:
                raise ValueError("; ".join(f"variants.{name}.{fault}" for fault in _faults(error))) from error
            except ValueError as error:
                raise ValueError(f"variants.{name}.{error}") from error
        return found

    @model_validator(mode="after")
    def _usable_variants(self) -> Config:
        for name, recipe in {"networks": self.networks, **self.recipes}.items():
            if recipe.combiner.correction.kind == "field" and self.collection.generator != "freaky-torus":
                raise ValueError(
                    f'{name}: kind = "field" is for features that move over the surface, which only the generator '
                    "freaky-torus has"
                )
        return self


def _faults(error: ValidationError) -> list[str]:
    """One line for each setting that can't be used."""
    words = {"extra_forbidden": "there is no such setting here"}
    faults = ((".".join(map(str, e["loc"])), words.get(e["type"], e["msg"])) for e in error.errors())
    return [": ".join(filter(None, fault)) for fault in faults]


def parse(text: str, source: str) -> Config:
    """Read a configuration from TOML text.

    Raises:
        ConfigError: naming the source and every faulty setting.
    """
    try:
        values: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not TOML: {error}") from error
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        faults = "".join(f"\n  {fault}" for fault in _faults(error))
        raise ConfigError(f"{source}: these settings can't be used{faults}") from error


def load(path: Path, data: Path | None = None, fractions: Sequence[float] = ()) -> tuple[Config, str]:
    """Read a configuration file, and apply the options of the command line to it.

    Args:
        path: of the file.
        data: replaces ``collection.data``.
        fractions: replace ``networks.fractions``.

    Returns:
        The configuration, and the text that says the same from any folder: ``collection.data`` made absolute, the
        arguments written in, all else as it stands.

    Raises:
        ConfigError: naming the file and every faulty setting.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: can't be read: {error}") from error
    config = parse(text, str(path))
    if data is None and config.collection.data is not None:
        data = path.parent / config.collection.data
    if data is not None or fractions:
        document: Any = tomlkit.parse(text)
        if data is not None:
            document["collection"]["data"] = str(data.resolve())
        if fractions:
            document.setdefault("networks", {})["fractions"] = list(fractions)
        text = tomlkit.dumps(document)
        config = parse(text, str(path))
    return config, text
