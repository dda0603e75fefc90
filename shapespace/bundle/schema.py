"""Schema of a bundle ``models/NAME/VERSION/``: its files, its manifest, and the arrays of its geometry.

The reader and the writer use this module. No other module spells these names.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeFloat, PositiveFloat, PositiveInt, model_validator

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
#: The card, for people. It is optional.
CARD = "README.md"
NAME_PATTERN = r"^[a-z0-9][a-z0-9._-]{0,63}$"
VERSION_PATTERN = r"^[1-9][0-9]{0,8}$"
#: A plain file name: without a folder, so that it can't leave the bundle, and not hidden.
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*$", max_length=100)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Network(_Strict):
    """An ONNX file with one input and one output, and their names."""

    file: FileName
    input: str
    output: str


class DecoderEntry(_Strict):
    """The ONNX file of the whole way from latents to the vertices of drafts, with the names of input and outputs."""

    file: FileName
    input: str
    #: (n, V, 3) vertices of the fine mesh, aligned, in the user's units, and (n,) relative misfit.
    vertices: str
    misfit: str
    #: Largest distance from a draft that the export measured, as a share of the diagonal.
    error: NonNegativeFloat


class _Range(_Strict):
    name: str
    start: int = Field(ge=0)
    stop: PositiveInt


class FactorEntry(Network, _Range):
    """The network ψ_j of one factor. Its input are the latents from ``start`` to ``stop`` − 1."""


class GeometryFile(_Strict):
    """The NPZ file with the arrays of `ARRAYS`."""

    file: FileName


#: A name of a part or a material, on one line.
Label = Annotated[str, Field(min_length=1, max_length=110, pattern=r"^[^\x00-\x1f\x7f]+$")]
Labels = Annotated[list[Label], Field(max_length=10_000)]
Share = Annotated[float, Field(ge=0, le=1)]


class MaterialEntry(_Strict):
    """A material; see mesh.attributes."""

    name: Label
    color: tuple[Share, Share, Share, Share]
    metallic: Share
    roughness: Share
    texture: FileName | None


class AttributesEntry(_Strict):
    """Names of parts and materials of the finest mesh; see mesh.attributes. Its arrays have the prefix `SURFACE`."""

    objects: Labels
    groups: Labels
    materials: list[MaterialEntry] = Field(max_length=10_000)
    #: Whether the user's file had normals.
    normals: bool

    @property
    def textures(self) -> list[str]:
        """Names of the texture files, sorted and unique."""
        return sorted({material.texture for material in self.materials if material.texture is not None})


class Tolerance(_Strict):
    """Allowed and measured difference between ONNX and PyTorch: relative, in the weighted norm."""

    required: PositiveFloat
    measured: NonNegativeFloat


class DraftError(_Strict):
    """Vertex distances between drafts and solved shapes for codes inside the bounds, as fractions of the diagonal."""

    mean: NonNegativeFloat
    p95: NonNegativeFloat


class AutoError(DraftError):
    """Vertex distances between shapes of quality ``auto`` and ``full``, and how Gauss–Newton ends for ``auto``.

    A shape is final after a step that moves no vertex further than ``tolerance`` times the diagonal. Null: drafts are
    accurate enough. Drafts with a relative misfit of at most ``draft_misfit`` are answered as they are.
    """

    tolerance: PositiveFloat | None
    draft_misfit: NonNegativeFloat = 0.0


class Origin(_Strict):
    """Configuration, data and code that a bundle was made from."""

    config: Any
    data_digest: str
    code_version: str


class FileEntry(_Strict):
    """Digest and size of a file."""

    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    bytes: int = Field(ge=0)


class Manifest(_Strict):
    """Manifest of a bundle. Lengths are normalised: one unit is ``scale`` units of the user."""

    schema_version: Literal[1]  # SCHEMA_VERSION; a type can't name it
    name: str = Field(pattern=NAME_PATTERN)
    version: str = Field(pattern=VERSION_PATTERN)
    licence: str
    title: str
    description: str
    latent_dimension: PositiveInt
    latent_names: list[str]
    factors: list[FactorEntry] = Field(min_length=1)
    lower: list[float]
    upper: list[float]
    period: list[PositiveFloat | None]
    edges: PositiveInt
    vertices: PositiveInt
    faces: PositiveInt
    mu: PositiveFloat
    lambda_: NonNegativeFloat = Field(alias="lambda")
    eta: PositiveFloat
    eta_reconstruction: PositiveFloat
    #: K, the number of time steps of the exponentials, if the bundle has modes.
    exponential_steps: PositiveInt | None = None
    #: First step of the exponentials. Version 0.2 wrote none, and took the paper's.
    exponential_first_step: Literal["centred", "paper"] = "paper"
    scale: PositiveFloat
    combiner: Network
    start: Network | None
    decoder: DecoderEntry | None = None
    #: Why there is no decoder, if the export left it out.
    without_decoder: str | None = None
    geometry: GeometryFile
    surface: AttributesEntry | None = None
    onnx_tolerance: Tolerance
    figures: dict[str, Any]
    draft_error: DraftError | None = None
    #: Without it, ``auto`` answers full shapes.
    auto_error: AutoError | None = None
    origin: Origin
    files: dict[FileName, FileEntry]

    @model_validator(mode="after")
    def _consistent(self) -> Manifest:
        m = self.latent_dimension
        for field in ("latent_names", "lower", "upper", "period"):
            if len(getattr(self, field)) != m:
                raise ValueError(f"{field} has {len(getattr(self, field))} entries, not one for each of {m} latents")
        if any(low >= high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError("lower must lie below upper in every coordinate")
        stops = [0, *(factor.stop for factor in self.factors)]
        if [factor.start for factor in self.factors] != stops[:-1] or stops[-1] != m or sorted(set(stops)) != stops:
            raise ValueError(f"the factors must split the {m} latents into consecutive, non-empty ranges")
        named = [network.file for network in (*self.factors, self.combiner)] + [self.geometry.file]
        named += [each.file for each in (self.start, self.decoder) if each]
        named += self.surface.textures if self.surface else []
        named += [CARD] if CARD in self.files else []
        if sorted(named) != sorted(self.files):
            raise ValueError("files must list exactly the networks, the geometry and the textures")
        return self


class ArrayType(NamedTuple):
    """Shape and type of an array in ``geometry.npz``."""

    # Sizes. The letters m, V, F and E are sizes from the manifest; other letters stand for any size above 0.
    shape: tuple[int | str, ...]
    # Type in which the array is written. The reader accepts every real or every whole type, respectively.
    dtype: type[np.number]


SURFACE = "surface_"
#: The arrays of ``geometry.npz``. The first three are required. ``fine_*`` and ``prolongation_*`` come together.
ARRAYS = {
    # The reference, normalised, and its edges in lexicographic order.
    "vertices": ArrayType(("V", 3), np.float64),
    "faces": ArrayType(("F", 3), np.int32),
    "edges": ArrayType(("E", 2), np.int32),
    # Vertex fields d_j at the reference, if codes are coefficients of tangent vectors.
    "modes": ArrayType(("m", "V", 3), np.float32),
    # Codes of the training shapes.
    "training_codes": ArrayType(("n", "m"), np.float64),
    # For each vertex of the user's files its vertex of the finest mesh, or -1.
    "file_vertices": ArrayType(("N",), np.int32),
    # A fine mesh at the reference, and the map from coarse to fine vertices: see mesh.prolongation.
    "fine_vertices": ArrayType(("W", 3), np.float64),
    "fine_faces": ArrayType(("G", 3), np.int32),
    "prolongation_faces": ArrayType(("F", 3), np.int32),
    "prolongation_indptr": ArrayType(("W + 1",), np.int32),
    "prolongation_indices": ArrayType(("weights",), np.int32),
    "prolongation_weights": ArrayType(("weights",), np.float64),
    # If parts move rigidly: for each fine vertex the index of its part or -1, and rest positions of these vertices.
    "prolongation_rigid": ArrayType(("W",), np.int32),
    "prolongation_rest": ArrayType(("R", 3), np.float64),
    # If the fine mesh has detail that depends on the whole coarse shape: see mesh.fine_detail.
    "prolongation_detail_rest": ArrayType(("V", 3), np.float64),
    "prolongation_detail_axes": ArrayType(("r", "V", 3), np.float32),
    "prolongation_detail_fields": ArrayType(("r", "W", 3), np.float32),
    # Attributes of the finest mesh in the user's file, with P polygons and C corners: see mesh.attributes.
    "surface_starts": ArrayType(("P + 1",), np.int32),
    "surface_corners": ArrayType(("C",), np.int32),
    "surface_uv": ArrayType(("U", 2), np.float32),
    "surface_uv_corners": ArrayType(("C",), np.int32),
    "surface_shading": ArrayType(("C",), np.int32),
    "surface_colors": ArrayType(("W or V", 3), np.float32),
    "surface_object_of": ArrayType(("P",), np.int32),
    "surface_group_of": ArrayType(("P",), np.int32),
    "surface_material_of": ArrayType(("P",), np.int32),
}
#: Names with which files are written. The reader uses the names in the manifest.
COMBINER = Network(file="combiner.onnx", input="factors", output="nric")
START = Network(file="start.onnx", input="latent", output="vertices")
DECODER = "decoder.onnx"
GEOMETRY = GeometryFile(file="geometry.npz")


def factor_network(j: int) -> Network:
    """Return name, input and output with which ψ_j is written."""
    return Network(file=f"factor-{j}.onnx", input="latent", output="nric")
