"""The settings of each stage but `networks`: the tables of a configuration."""

from __future__ import annotations

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


class CollectionSettings(SettingsTable):
    """Where the shapes come from: a built-in generator, or meshes in correspondence."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"file"})

    generator: Literal["freaky-torus", "figure", "expressive", "people"] | None = None
    """Built-in generator that makes the shapes. ``expressive`` is a body in 149 poses: 100 with moving hands and face,
    49 with moving limbs. ``people`` is 24 bodies in 14 poses each. Both need ``pip install
    'shapespace[train,people]'``. Give either ``generator`` or ``data``."""
    data: Path | None = None
    """Folder of OBJ, PLY, STL, OFF, glTF or VTK files, or one NPZ file with ``vertices`` (n, V, 3) and ``faces``, or
    one GLB or glTF file whose morph targets are the shapes. The path is relative to the configuration's folder. The
    command's ``--data`` takes precedence."""
    file: str | None = None
    """Name of the file to read from each folder in ``data``, if every subject has a folder. It may be a path, such as
    ``surf/pial.ply``, and have ``*`` and ``?`` in it, as in ``*_mesh.ply``. Shapes have the names of the folders."""
    reference: str | None = None
    """Name of the reference mesh, which gives served shapes their position and orientation. By default it is the most
    central mesh."""
    parts: list[str] = []
    """Names of the parts to keep, for meshes of several parts. The model predicts the first part and attaches the
    others to it. By default it keeps all parts, and predicts the largest. Parts have the names of the file's objects,
    groups or materials, or ``part 1``, ``part 2`` and so on. ``run --until ingest`` prints the names."""
    coarse_vertices: int = Field(1000, ge=0)
    """Vertices to compute with: meshes with more than 1.5 times this number are simplified to about this number. 0
    computes with all vertices."""
    mirror: bool = True
    """Whether to learn from the shapes' mirror images too. A pose of the left arm is then also a pose of the right arm.
    One of the shapes must have exactly one plane of symmetry, to pair each vertex with its mirror image."""

    @model_validator(mode="after")
    def _one_source(self) -> CollectionSettings:
        if self.generator is not None and self.data is not None:
            raise ValueError("give either a generator or data, not both")
        return self


class MaterialSettings(SettingsTable):
    """Elastic parameters of the surface, which is treated as a thin shell. The reference is scaled to area 1."""

    mu: float = Field(Material.mu, gt=0)
    """Lamé's μ of the membrane."""
    lambda_: float = Field(Material.lambda_, ge=0, alias="lambda")
    """Lamé's λ of the membrane."""
    eta: float = Field(Material.eta, gt=0)
    """Weight η of bending against stretching, about the squared thickness of the shell, where the reference has area 1.
    Triangles may collapse if it is large."""


class ExponentialSettings(SettingsTable):
    """The discrete exponential, which makes a shape from a code in K time steps."""

    first_step: FirstStep = "centred"
    """The first of the K steps. ``centred`` adds the acceleration, for the price of one step more. With ``paper`` the
    error falls only like 1/K. Codes mean other shapes with each. A run directory of version 0.2 keeps ``paper`` by
    default."""


class ModeSettings(SettingsTable):
    """The modes: the directions in which shapes differ from their mean, found by sparse principal geodesic analysis."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"geometry"})

    count: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Number of modes m, at most one less than the number of shapes. ``auto`` minimises the error of held-out shapes,
    as a share of their distance from the mean shape, plus half a percent for each mode."""
    geometry: Literal["auto", "vertices", "nric", "differential", "exponential"] = "exponential"
    """The map from codes to shapes; ``init`` writes ``auto``. ``vertices`` moves every vertex along a straight line, so
    modes add up like blend shapes. ``nric`` does the same with lengths and angles, so limbs can bend. ``differential``
    does it with rotations and stretches of faces, so limbs can turn far. ``exponential`` bends the surface as an
    elastic shell. Straight lines are found in minutes: they have dense modes, one factor, and need neither ``norm``,
    ``sparsity`` nor samples to learn from. ``auto`` takes the cheapest of the four whose error on held-out shapes is at
    most 2 % above the least, or 5 % above exponentials."""
    norm: Literal["mixed", "vertices", "shell"] = "mixed"
    """The norm in which modes approximate the shapes. ``vertices`` takes distances of vertices, weighted by area.
    ``shell`` is the metric of the shell space, which gives small wrinkles much weight. ``mixed`` is ``vertices`` plus a
    tenth of ``shell``."""
    sparsity: Annotated[float, Field(ge=0, lt=1)] | Literal["auto"] = "auto"
    """Weight λ of the sparsity term, as a share of the weight at which every mode would vanish. Larger values make each
    mode move a smaller part; 0 is plain principal geodesic analysis. ``auto`` takes the largest of some candidates that
    increases the error of held-out shapes by at most 2 %, and 0 if none does."""
    log_steps: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    """Number K of time steps of the discrete logarithms. With one step, modes move vertices along straight lines and
    add up like blend shapes. With many, modes bend the surface. ``auto`` takes 8 (16 with the paper's first step), or 1
    if that does not raise the error of held-out shapes and at most a tenth of random shapes fold."""
    max_iterations: int = Field(200, ge=1)
    """Most iterations of the sparse analysis, each over all modes."""


class FactorSettings(SettingsTable):
    """The factors: groups of modes that move the same part of the surface. Each factor has a network of its own."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"modes"})

    count: int | None = Field(None, ge=1)
    """Number of factors J. By default it follows from the overlap of the modes."""
    modes: list[Annotated[list[Annotated[int, Field(ge=0)]], Field(min_length=1)]] | None = Field(None, min_length=1)
    """The factors, if you choose them yourself: the modes of each factor, such as ``[[0, 3], [1], [2, 4]]``. Modes are
    counted from 0, the strongest first. Every mode has to be in exactly one factor. Set ``modes.count`` too, so that
    their number is known. By default, modes that move the same part form a factor."""

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


class SampleSettings(SettingsTable):
    """The samples to learn from: shapes of random codes, and of the collection's own codes."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"distribution"})

    distribution: Distribution = "box"
    """How random codes are drawn. ``box`` is uniform within the bounds. ``ball`` is uniform, in each factor, in the
    ellipsoid that touches the bounds, so it leaves out the corners, where shapes fold most. ``normal`` is normal,
    truncated at the bounds, with half of the distance from the middle to the bounds as standard deviation. Periodic
    coordinates are always uniform."""
    count: int = Field(4000, ge=10)
    """Number of joint samples: shapes of random codes. They take most of a run's time. 500 are enough for a first
    look."""
    steps: int | None = Field(None, ge=1)
    """Number K of time steps of the discrete exponentials. By default it is ``modes.log_steps``. If that is ``auto``
    and the first step is centred, it is the smallest of 8, 12, 16, 24 and 32 whose error 1 − R² against many steps is
    at most 1e-5."""
    factor_counts: list[int] | int | None = None
    """Number of samples of each factor alone: one number for all factors, or one for each. Their codes are the factor's
    part of the joint codes, and of further codes beyond ``count``. By default 1000, but at most ``count``."""
    shapes: bool = True
    """Whether the codes of the collection's own shapes are training samples too. Few random codes lie near these
    shapes. Their number is at most a quarter of ``count``, spread evenly over the shapes."""
    derivatives: int | None = Field(None, ge=0)
    """Number of joint samples with derivatives by the code, which the networks learn too. Such a sample takes as long
    as about ten others. It helps more than ten others if there are only a few hundred. By default 60, but at most a
    tenth of ``count``."""
    part_size: int = Field(50, ge=1)
    """Number of samples per file, and ten times the number of derivatives. A worker computes one file at a time, and
    loses it if it dies."""
    test_fraction: float = Field(0.2, gt=0, lt=1)
    """Share of the joint samples that are used for the evaluation only."""
    validation_fraction: float = Field(0.1, gt=0, lt=1)
    """Share of the remaining joint samples that are used to choose the learning rate and the best epoch."""
    seed: int = 0
    """Seed of the random codes and of their split."""

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
    """How the model is measured on the test samples."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"baselines"})

    eta: float = Field(1e-2, gt=0)
    """Weight of angles against lengths in the norm of all figures."""
    baselines: bool = False
    """Whether the run also trains networks with one factor, ``monolithic`` and ``monolithic_paper``, for comparison.
    This about doubles the time of the stage ``networks``."""
    grid_nodes: Annotated[int, Field(ge=0), AfterValidator(_grid)] = 0
    """Most nodes per coordinate of the multilinear grid of Sassen et al. 2020, for comparison. It may take as long as
    all samples. 0 leaves it out. Needs ``baselines``."""
    grid_size: int = Field(1000, ge=1)
    """Most nodes of the grid of one factor. A factor gets no grid if this leaves fewer than 3 nodes per coordinate."""
    exact_factors: int = Field(200, ge=2)
    """Number of test codes for which the affine sum of exact factor shapes is computed, for comparison."""
    reconstructions: int = Field(100, ge=1)
    """Number of test shapes whose vertices are reconstructed."""
    fresh: int = Field(100, ge=0)
    """Number of fresh codes on which every model is measured once more, at most the number of test codes. They are
    drawn after training, with a digest of the networks as seed. 0 leaves this out."""


#: An axis of the collection's coordinates, with its direction.
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


class ExportSettings(SettingsTable):
    """Name and description of the exported bundle."""

    SINCE_0_3: ClassVar[frozenset[str]] = frozenset({"decoder"})

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=64)
    """Name of the model in addresses and file names."""
    version: int = Field(1, ge=1, lt=10**9)
    """Version of the bundle, which is written to ``models/NAME/VERSION``. A bundle with this version is replaced."""
    title: str
    """Title of the model, shown to people."""
    description: str
    """A sentence that describes the model, shown to people."""
    licence: str
    """Licence of the meshes, and so of the model."""
    eta_reconstruction: float = Field(DEFAULT_ETA, gt=0)
    """Weight η of angles against lengths when Gauss–Newton finds the vertices."""
    examples: bool = True
    """Whether the bundle stores the errors of modes and networks at the training shapes, and corrects them at the codes
    of these shapes. Other codes change very little. The bundle grows by a byte for each length and angle of each
    shape."""
    decoder: bool = True
    """Whether the bundle has ``decoder.onnx``, one graph from codes to vertices for other programs than the server."""
    tolerance: float = Field(1e-4, gt=0)
    """Largest allowed relative difference between the ONNX and the PyTorch networks, in the weighted norm."""
    faces: Axis | None = None
    """The axis along which the body looks. Left and right in names are then the body's own. By default they are the
    left and right of a viewer who has x to the right, y up and z towards the eye."""
    up: Axis = "+y"
    """The axis that points to the body's head. Only used with ``faces``."""
    names: dict[str, str] = {}
    """New names of factors and coordinates, by the name in the report: ``{"upper right bends" = "left arm"}``.
    Coordinates follow their factor unless they are named themselves."""

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
