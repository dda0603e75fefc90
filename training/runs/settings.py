"""The settings of each stage but `networks`: the tables of a configuration."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from shapespace.coordinates.reconstruction import DEFAULT_ETA
from shapespace.shell.energy import Material
from shapespace.shell.space import FirstStep
from shapespace.training.runs.latent_coordinates import Distribution

#: A mesh with at most this multiple of ``coarse_vertices`` keeps all its vertices. Simplification would lose more in
#: accuracy than it gains in time.
NEARLY_COARSE = 1.5
#: Default number of samples of each factor alone: few suffice, because a factor has few modes.
FACTOR_SAMPLES = 1000
#: Default number of joint samples with derivatives.
DIFFERENTIATED_SAMPLES = 60


class SettingsTable(BaseModel):
    """A table of a configuration."""

    # Docstrings under the fields are their descriptions, from which docs/reference/configuration.md is written.
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)
    #: Settings that version 0.2 did not have. They are left out of dumps where they have their defaults. So stages and
    #: networks of its runs keep their keys, which are digests of dumps.
    SINCE_0_3: ClassVar[frozenset[str]] = frozenset()

    @model_serializer(mode="wrap")
    def _without_new_defaults(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        fields = type(self).model_fields
        usual = {name for name in self.SINCE_0_3 if getattr(self, name) == fields[name].default}
        return {name: value for name, value in dump(self).items() if name not in usual}


def _expression(text: str) -> str:
    try:
        re.compile(text)
    except re.error as error:
        raise ValueError(f"is no regular expression: {error}") from None
    return text


class CollectionSettings(SettingsTable):
    """The shapes: a built-in generator, or meshes in correspondence."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"file", "related"})

    generator: Literal["freaky-torus", "figure", "expressive", "people"] | None = None
    """Built-in generator, instead of ``data``. ``expressive``, a body with hands and face, and ``people``, 24 bodies in
    14 poses each, need the extra ``people``."""
    data: Path | None = None
    """Folder of meshes, NPZ file with ``vertices`` (n, V, 3) and ``faces``, or GLB or glTF file with [morph
    targets](files.md#morph-targets-as-a-collection), relative to the configuration's folder."""
    file: str | None = None
    """File to read from each folder in ``data``, if every subject has a folder: ``surf/pial.ply`` or ``*_mesh.ply``."""
    reference: str | None = None
    """Name of the [reference](glossary.md#reference); by default the most central mesh."""
    parts: list[str] = []
    """[Parts](files.md#several-parts) to keep, the main part first. By default all, the largest as the main part."""
    coarse_vertices: int = Field(1000, ge=0)
    """Vertices to compute with. Meshes with more than 1.5 times as many are simplified; 0 computes with all."""
    mirror: bool = True
    """Also learn from [mirror images](glossary.md#mirror-image), if one shape has exactly one plane of symmetry."""
    related: Annotated[str, AfterValidator(_expression)] | None = None
    """The part of names that [related shapes](../explanation/choosing.md#related-shapes) share, such as ``sub-[0-9]+``
    for several scans of a patient: a [regular expression](https://docs.python.org/3/library/re.html). To measure errors
    on unseen shapes, they are left out together."""

    @model_validator(mode="after")
    def _one_source(self) -> CollectionSettings:
        if self.generator is not None and self.data is not None:
            raise ValueError("give either a generator or data, not both")
        return self


class MaterialSettings(SettingsTable):
    """Elastic parameters of the surface, a thin shell of area 1."""

    mu: float = Field(Material.mu, gt=0)
    """Lamé's μ of the membrane."""
    lambda_: float = Field(Material.lambda_, ge=0, alias="lambda")
    """Lamé's λ of the membrane."""
    eta: float = Field(Material.eta, gt=0)
    """Weight η of bending, about the squared thickness of the shell. Triangles may collapse if it is large."""


class ExponentialSettings(SettingsTable):
    """The discrete exponential, which makes a shape from a code in K time steps."""

    first_step: FirstStep = "centred"
    """First of the K steps; it changes what codes mean. ``centred`` costs one more step. With ``paper``, also in runs
    of version 0.2, the error falls only like 1/K."""


class ModeSettings(SettingsTable):
    """The directions in which shapes differ from their mean."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"geometry"})

    count: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Number of modes m, less than the number of shapes. ``auto`` minimises the relative error of held-out shapes plus
    0.5 % for each mode. It may add modes that move single regions."""
    geometry: Literal["auto", "vertices", "nric", "differential", "exponential"] = "exponential"
    """The map from codes to shapes; ``init`` writes ``auto``. ``exponential`` bends an elastic shell. The others are
    straight lines: ``vertices`` like blend shapes, ``nric`` (lengths and angles) so that limbs bend, ``differential``
    (rotations and stretches of faces) so that they turn far. Straight lines train in minutes, have one factor and dense
    modes, use no ``norm`` or ``sparsity``, and need few samples, for the evaluation. ``auto`` takes the cheapest map
    whose error on held-out shapes is at most 2 % above every other straight line, and at most 5 % above
    exponentials."""
    norm: Literal["mixed", "vertices", "shell"] = "mixed"
    """Norm in which modes approximate shapes. ``vertices``: distances, weighted by area. ``shell``: the metric of the
    shell space, with much weight on wrinkles. ``mixed``: ``vertices`` plus a tenth of ``shell``."""
    sparsity: Annotated[float, Field(ge=0, lt=1)] | Literal["auto"] = "auto"
    """Weight s of sparsity, as a share of the weight at which all modes vanish. Larger values make modes more local.
    ``auto`` takes the largest that raises the error of held-out shapes by at most 2 %, or else 0."""
    log_steps: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Number K of [time steps](glossary.md#time-steps) of logarithms. ``auto`` takes 8 (16 with the paper's first
    step), or 1 if held-out shapes get no worse and at most a tenth of random shapes fold."""
    max_iterations: int = Field(200, ge=1)
    """Most iterations of the search for sparse modes. A warning tells if they were too few."""


class FactorSettings(SettingsTable):
    """Groups of modes that move the same part of the surface."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"modes"})

    count: int | None = Field(None, ge=1)
    """Number of factors; by default the overlap of the modes decides."""
    modes: list[Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]] | None = Field(None, min_length=1)
    """Your own factors: the modes of each, such as ``[[0, 3], [1], [2, 4]]``, counted from 0, the strongest first. Each
    mode belongs to one factor. Set ``modes.count`` too. For exponentials only."""

    @model_validator(mode="after")
    def _each_mode_once(self) -> FactorSettings:
        if self.modes is None:
            return self
        if self.count is not None:
            raise ValueError("give either count or modes, not both")
        listed = [mode for factor in self.modes for mode in factor]
        if twice := sorted({mode for mode in listed if listed.count(mode) > 1}):
            raise ValueError(f"modes has {' and '.join(map(str, twice))} more than once; leave each mode in one factor")
        return self

    def require_partition(self, count: int) -> None:
        """Raise ValueError if the given factors name a mode that is not there, or leave one of ``count`` modes out."""
        listed, every = {mode for factor in self.modes or () for mode in factor}, set(range(count))
        problems = {"there is no mode": listed - every, "these modes are in no factor:": every - listed}
        if faults := [f"{words} {', '.join(map(str, sorted(modes)))}" for words, modes in problems.items() if modes]:
            raise ValueError(
                f"factors.modes can't be used: {'; '.join(faults)}. There are {count} modes, counted from 0 to "
                f"{count - 1}"
            )


class SampleSettings(SettingsTable):
    """Shapes of codes, from which networks learn."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"distribution"})

    distribution: Distribution = "box"
    """Distribution of random codes. ``box``: uniform within the bounds. ``ball``: uniform in each factor's largest
    ellipsoid inside the bounds, without the corners, where shapes fold most. ``normal``: a normal distribution,
    truncated at the bounds, two standard deviations from the middle."""
    count: int = Field(4000, ge=10)
    """Joint samples, which take most of a run's time. 500 are enough for a first look."""
    steps: int | None = Field(None, ge=1)
    """Number K of [time steps](glossary.md#time-steps) of exponentials. By default ``modes.log_steps``, or with
    ``auto`` the smallest of 8, 12, 16, 24 and 32 whose error 1 − R² against many steps is at most 1e-5."""
    factor_counts: list[int] | int | None = None
    """Samples of each factor alone: one number for all factors, or a list. By default 1000, but at most ``count``."""
    shapes: bool = True
    """Whether networks also learn from the codes of your own shapes, at most a quarter of ``count``."""
    derivatives: int | None = Field(None, ge=0)
    """Joint samples with derivatives by the code, each as slow as ten others. They help most if samples are few. By
    default 60, but at most a tenth of ``count``."""
    part_size: int = Field(50, ge=1)
    """Samples per file. A worker that dies loses the file that it computes."""
    test_fraction: float = Field(0.2, gt=0, lt=1)
    """Share of joint samples for the evaluation only."""
    validation_fraction: float = Field(0.1, gt=0, lt=1)
    """Share of the other samples that choose learning rate and best epoch."""
    seed: int = 0
    """Seed of the codes and of their split."""

    @property
    def differentiated(self) -> int:
        """Number of joint samples with derivatives."""
        return min(DIFFERENTIATED_SAMPLES, self.count // 10) if self.derivatives is None else self.derivatives

    def own(self, factors: int) -> list[int]:
        """Return the number of samples of each factor alone."""
        counts = min(self.count, FACTOR_SAMPLES) if self.factor_counts is None else self.factor_counts
        return counts if isinstance(counts, list) else [counts] * factors


def _grid(nodes: int) -> int:
    if 0 < nodes < 3:
        raise ValueError("a grid has at least 3 nodes per coordinate, and 0 leaves it out")
    return nodes


class EvaluationSettings(SettingsTable):
    """Measurements on the test samples."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"baselines"})

    eta: float = Field(1e-2, gt=0)
    """Weight of angles against lengths in all figures."""
    baselines: bool = False
    """Also train ``monolithic`` and ``monolithic_paper``, networks with one factor. The stage ``networks`` takes about
    twice as long."""
    grid_nodes: Annotated[int, Field(ge=0), AfterValidator(_grid)] = 0
    """Most nodes per coordinate of the grid of Sassen et al. 2020, for comparison; 0 for none. It may take as long as
    all samples. Needs ``baselines``."""
    grid_size: int = Field(1000, ge=1)
    """Most nodes of one factor's grid."""
    exact_factors: int = Field(200, ge=2)
    """Test codes for the affine sum of exact factor shapes."""
    reconstructions: int = Field(100, ge=1)
    """Test shapes whose vertices are reconstructed."""
    fresh: int = Field(100, ge=0)
    """[Fresh codes](glossary.md#fresh-codes), at most as many as test codes; 0 for none."""


#: An axis of the collection's coordinates, with its direction.
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


class ExportSettings(SettingsTable):
    """The exported bundle."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"decoder"})

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)
    """Name in addresses and file names."""
    version: int = Field(1, ge=1, lt=10**9)
    """Version. The bundle replaces one at ``models/NAME/VERSION``."""
    title: str
    """Title for people."""
    description: str
    """A sentence for people."""
    licence: str
    """Licence of the meshes and the model."""
    eta_reconstruction: float = Field(DEFAULT_ETA, gt=0)
    """Weight of angles against lengths in [Gauss–Newton](glossary.md#gaussnewton)."""
    examples: bool = True
    """Whether the model [remembers](glossary.md#remembers) training shapes. One shape takes a byte for each length and
    angle."""
    decoder: bool = True
    """Whether to write [``decoder.onnx``](bundle.md#the-decoder)."""
    tolerance: float = Field(1e-4, gt=0)
    """Largest relative difference between the ONNX and the PyTorch networks."""
    faces: Axis | None = None
    """Axis along which the body looks, so that left and right in names are its own. By default they are a viewer's with
    x to the right, y up and z towards the eye."""
    up: Axis = "+y"
    """Axis that points to the body's head. Needs ``faces``."""
    names: dict[str, str] = {}
    """New names for the names in the report: ``{"upper right bends" = "left arm"}``. Coordinates follow their
    factor."""

    @property
    def key(self) -> dict[str, Any]:
        """The settings in the key of the stage. Finished runs of version 0.2 keep their key, and their bundle."""
        return self.model_dump(mode="json", exclude={"decoder"} if self.decoder else None)

    @model_validator(mode="after")
    def _upright(self) -> ExportSettings:
        if self.faces is not None and self.faces[1] == self.up[1]:
            raise ValueError(f"a body that looks along {self.faces} cannot have its head along {self.up}")
        if blank := [old for old, new in self.names.items() if not new.strip()]:
            raise ValueError(f"names has nothing for {blank[0]!r}")
        return self
