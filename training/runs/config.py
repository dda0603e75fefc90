"""The typed configuration of a run, read from TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tomlkit
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from shapespace.coordinates.reconstruction import DEFAULT_ETA
from shapespace.shell.energy import Material

#: Which edges a convolution hears of, see networks.EdgeConvolution.
Neighbourhood = Literal["star", "flaps"]

#: Default number of samples of each factor alone: few suffice, as a factor has few modes.
FACTOR_SAMPLES = 1000


def _grid(nodes: int) -> int:
    if 0 < nodes < 3:
        raise ValueError("a grid has at least 3 nodes per coordinate, and 0 leaves it out")
    return nodes


class ConfigError(ValueError):
    """A configuration that can't be used, with a line for each fault."""


class _Section(BaseModel):
    # Docstrings under the fields are their descriptions, from which docs/configuration.md is written.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class CollectionSettings(_Section):
    """Where the shapes come from: a generator of ours, or meshes in correspondence."""

    generator: Literal["freaky-torus", "figure"] | None = None
    """A collection of ours, made by a program; see training/collection/generators.py."""
    data: Path | None = None
    """Folder of OBJ, PLY, STL, OFF or glTF files, or one NPZ file with ``vertices`` (n, V, 3) and ``faces``; relative
    to the configuration's own folder. The command's ``--data`` takes precedence."""
    reference: str | None = None
    """Name of the mesh that is scaled to area 1 and whose position and orientation served shapes have; by default the
    most central one."""
    coarse_vertices: int = Field(1000, ge=0)
    """Vertices to compute with: meshes with more are simplified to about this number. 0 computes with all vertices."""

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

    count: int = Field(20, ge=1)
    """Number of modes m; at most the number of shapes less one."""
    sparsity: float = Field(0.1, ge=0, lt=1)
    """Weight λ of the sparsity term, as a share of the weight at which every principal mode would vanish. Larger
    values make each mode move a smaller part; 0 is plain principal geodesic analysis."""
    log_steps: int = Field(16, ge=2)
    """Time steps K of the discrete logarithms. Best equal to ``samples.steps``: only logarithms and exponentials with
    the same K are inverse to each other."""
    max_iterations: int = Field(200, ge=1)
    """Most rounds of the sparse analysis through all modes."""


class FactorSettings(_Section):
    """Groups of modes whose supports overlap."""

    count: int | None = Field(None, ge=1)
    """Number of factors J; by default it follows from how much the modes overlap."""


class SampleSettings(_Section):
    """Codes drawn uniformly from the hypercube, and how they are split."""

    count: int = Field(4000, ge=10)
    """Joint samples: random codes whose shapes are computed. They take most of a run's time."""
    steps: int = Field(16, ge=2)
    """Time steps K of the discrete exponentials."""
    factor_counts: list[int] | int | None = None
    """Samples of each factor alone, one number for all or one for each. They have the factor's part of the joint
    codes, and of further codes beyond ``count``. By default 1000, or ``count`` where that is less; the paper takes
    ``count``."""
    part_size: int = Field(50, ge=1)
    """Samples in a file: what a worker is given at a time, and what is lost with it."""
    test_fraction: float = Field(0.2, gt=0, lt=1)
    """Share of the joint samples that only the evaluation sees."""
    validation_fraction: float = Field(0.1, gt=0, lt=1)
    """Share of the other joint samples that chooses the learning rate and the best epoch."""
    seed: int = 0
    """Of the codes and of the split."""

    def own(self, factors: int) -> list[int]:
        """Samples of each factor alone."""
        counts = min(self.count, FACTOR_SAMPLES) if self.factor_counts is None else self.factor_counts
        return counts if isinstance(counts, list) else [counts] * factors


class FitSettings(_Section):
    """Adam. Its rate is divided by ten whenever the validation loss stops falling, as in the paper (section 4), or
    falls along half a cosine to nothing at the last epoch, which is better where the number of epochs is what counts.
    """

    schedule: Literal["plateau", "cosine"] = "plateau"
    learning_rate: float = Field(1e-3, gt=0)
    final_rate: float = Field(1e-6, gt=0)
    patience: int = Field(10, ge=1)
    max_epochs: int = Field(500, ge=1)
    batch_size: int = Field(64, ge=2)


class LatentNetworkSettings(_Section):
    """A network from latents to NRIC: a factor network or the monolithic baseline."""

    hidden: list[int] = [128, 128]
    fourier: int = Field(1, ge=0)
    """Highest frequency of a periodic coordinate among the inputs; 0 feeds the bare angle, as the paper does."""
    skip_orders: list[int] | None = None
    """Largest frequency of each coordinate in a linear layer beside the hidden ones, fitted by ridge regression."""
    skip_degree: int = Field(3, ge=0)
    """The same layer of polynomials up to this total degree, where no coordinate has a period; 0 leaves it out."""
    patches: int = Field(1, ge=1)
    """Groups of neighbouring edges with a principal basis each, as the last layer."""
    energy: float = Field(0.9999, gt=0, le=1)
    """Variance kept by that basis; 1 makes the last layer a dense one, as the paper's are."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, max_epochs=60)


class CombinerSettings(_Section):
    """From J factor shapes to the joint one: graph convolutions on edges, a kernel, polynomials in patches of edges."""

    width: int = Field(24, ge=1)
    layers: int = Field(0, ge=0)
    """Graph convolutions; 0 leaves all to the corrections below."""
    neighbourhood: Neighbourhood = "star"
    crop: int = Field(0, ge=0)
    """Edges of the part of each shape that the convolutions learn on, drawn anew in each epoch by what is missed there
    without them: a network that mends details learns faster so. 0 for whole shapes. Needs ``flaps``."""
    residual: bool = True
    """Learn the difference to the affine sum of the factors instead of the shape itself; pass each layer's input on."""
    edge_channels: int = Field(4, ge=0)
    """Learned constants of each edge, given to the first convolution beside the factors."""
    kernel: int = Field(12, ge=0)
    """Principal coefficients of each factor, on which kernel ridge regression corrects what the convolutions
    leave; 0 leaves it out, as the paper does."""
    polynomial: int = Field(0, ge=0)
    """Principal coefficients of each factor in a patch of edges, of which a polynomial corrects it instead: for many
    factors that do little to each other, each for itself."""
    monomials: int = Field(1800, ge=1)
    """Of second and third degree that such a polynomial has."""
    pairwise: int = Field(0, ge=0)
    """Principal coefficients of each factor whose products, two factors at a time, correct a residual's affine sum
    before the convolutions do."""
    dropout: float = Field(0.0, ge=0, lt=1)
    symmetries: bool = True
    """Learn from the training samples' images under the collection's symmetries too, where it has any."""
    fit: FitSettings = FitSettings(schedule="cosine", learning_rate=2e-3, batch_size=16, max_epochs=12)

    @model_validator(mode="after")
    def _something(self) -> CombinerSettings:
        if not self.layers and not (self.residual and (self.kernel or self.polynomial or self.pairwise)):
            raise ValueError("without convolutions there must be a residual with a kernel, polynomials or products")
        if self.kernel and self.polynomial:
            raise ValueError("either a kernel or polynomials, the other 0")
        if self.crop and self.neighbourhood != "flaps":
            raise ValueError("crops need the neighbourhood flaps")
        return self


class NetworkSettings(_Section):
    """Everything that decides what is learned from the samples."""

    factors: list[LatentNetworkSettings] | LatentNetworkSettings = LatentNetworkSettings()
    """One for each factor, or one for all."""
    combiner: CombinerSettings = CombinerSettings()
    seed: int = 0
    fractions: list[Annotated[float, Field(gt=0, lt=1)]] = []
    """Shares of the training codes to learn from as well, for the study of their number: each once with the factors'
    parts of these codes only, as the paper does, and once with all the samples of the factors."""
    seeds: list[int] = []
    """Further seeds, of split and networks, to learn with as well, for the spread of the figures."""


class VariantSettings(_Section):
    """One row of the ablation: what differs from the main recipe."""

    title: str
    factors: list[LatentNetworkSettings] | LatentNetworkSettings | None = None
    combiner: CombinerSettings | None = None


class EvaluationSettings(_Section):
    """How the test split is measured."""

    eta: float = Field(1e-2, gt=0)
    """Weight of angles against lengths in the norm of all figures."""
    grid_nodes: Annotated[int, Field(ge=0), AfterValidator(_grid)] = 0
    """Nodes per coordinate, at most, of the multilinear grid of Sassen et al. 2020, a baseline whose nodes may take as
    long as all samples; 0 leaves it out."""
    grid_size: int = Field(1000, ge=1)
    """Nodes of the grid of one factor, at most; a factor for which that leaves fewer than 3 per coordinate gets no
    grid."""
    exact_factors: int = Field(200, ge=2)
    """Test codes whose factors' own exponentials are computed, for the affine sum of exact factors."""
    reconstructions: int = Field(100, ge=1)
    """Test shapes whose vertices are reconstructed."""


class ExportSettings(_Section):
    """What the bundle says of itself."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)
    """In addresses and file names."""
    version: int = Field(1, ge=1, lt=10**9)
    """The bundle is ``models/NAME/VERSION``; one of the same version is replaced."""
    title: str
    """Name of the model for people."""
    description: str
    """A sentence on the model for people."""
    licence: str
    """Of the meshes, and so of the model."""
    eta_reconstruction: float = Field(DEFAULT_ETA, gt=0)
    """Weight η of angles against lengths when vertices are found from them (Gauss–Newton)."""
    tolerance: float = Field(1e-4, gt=0)
    """Largest relative difference of ONNX and PyTorch, in the weighted norm."""


class Config(_Section):
    """What a configuration consists of."""

    collection: CollectionSettings
    material: MaterialSettings = MaterialSettings()
    modes: ModeSettings = ModeSettings()
    factors: FactorSettings = FactorSettings()
    samples: SampleSettings = SampleSettings()
    networks: NetworkSettings = NetworkSettings()
    monolithic: LatentNetworkSettings = LatentNetworkSettings(
        hidden=[256, 256], skip_degree=0, energy=1, fit=FitSettings(max_epochs=150)
    )
    variants: dict[str, VariantSettings] = {}
    evaluation: EvaluationSettings = EvaluationSettings()
    export: ExportSettings


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
        faults = "\n".join(f"  {'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise ConfigError(f"{source}: these settings can't be used\n{faults}") from error


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
