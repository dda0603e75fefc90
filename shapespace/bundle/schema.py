"""What a bundle ``models/NAME/VERSION/`` is made of: its files, its manifest, and the arrays of its geometry.

The writer and the reader both go by this module, and nothing else spells these names.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    model_validator,
)

SCHEMA_VERSION = 1
MANIFEST = "manifest.json"
NAME_PATTERN = r"^[a-z0-9][a-z0-9._-]{0,63}$"
VERSION_PATTERN = r"^[1-9][0-9]{0,8}$"
#: A plain file name: without a folder, so that it can't leave the bundle, and not hidden.
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*(\.[A-Za-z0-9_-]+)*$", max_length=100)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Network(_Strict):
    """An ONNX file with the names of its one input and its one output."""

    file: FileName
    input: str
    output: str


class _Range(_Strict):
    name: str
    start: int = Field(ge=0)
    stop: PositiveInt


class FactorEntry(Network, _Range):
    """The network ψ_j of one factor, fed with latents from ``start`` to just before ``stop``."""


class GeometryFile(_Strict):
    """The NPZ file that holds the arrays of `ARRAYS`."""

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
    """Names of parts and materials of the finest mesh, whose arrays begin with `SURFACE`; see mesh.attributes."""

    objects: Labels
    groups: Labels
    materials: list[MaterialEntry] = Field(max_length=10_000)
    #: Whether the file had normals.
    normals: bool

    @property
    def textures(self) -> list[str]:
        """Files of textures, each once."""
        return sorted({material.texture for material in self.materials if material.texture is not None})


class Tolerance(_Strict):
    """The largest allowed difference between ONNX and PyTorch, and the measured one: relative, in the weighted norm."""

    required: PositiveFloat
    measured: NonNegativeFloat


class DraftError(_Strict):
    """How far drafts are from solved shapes, over vertices and codes inside the bounds, as shares of the diagonal."""

    mean: NonNegativeFloat
    p95: NonNegativeFloat


class Origin(_Strict):
    """Where a bundle comes from."""

    config: Any
    data_digest: str
    code_version: str


class FileEntry(_Strict):
    """What a file's content must be."""

    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    bytes: int = Field(ge=0)


class Manifest(_Strict):
    """What a bundle says about itself. Lengths are normalised: one unit is ``scale`` units of the user."""

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
    #: K, the number of time steps of the exponentials that codes stand for, where the bundle has modes.
    exponential_steps: PositiveInt | None = None
    scale: PositiveFloat
    combiner: Network
    start: Network | None
    geometry: GeometryFile
    surface: AttributesEntry | None = None
    onnx_tolerance: Tolerance
    figures: dict[str, Any]
    draft_error: DraftError | None = None
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
        named += [self.start.file] if self.start else []
        named += self.surface.textures if self.surface else []
        if sorted(named) != sorted(self.files):
            raise ValueError("files must list exactly the networks, the geometry and the textures")
        return self


class ArrayType(NamedTuple):
    """How ``geometry.npz`` holds an array.

    Attributes:
        shape: a letter is a number: m, V, F and E those of the manifest, another one any number above 0.
        dtype: as it is written; any other of the same kind, real or whole numbers, can be read.
    """

    shape: tuple[int | str, ...]
    dtype: type[np.number]


SURFACE = "surface_"
#: The arrays of ``geometry.npz``. The first three are always there; ``fine_*`` and ``prolongation_*`` all or none.
ARRAYS = {
    # The reference, normalised, and its edges in lexicographic order.
    "vertices": ArrayType(("V", 3), np.float64),
    "faces": ArrayType(("F", 3), np.int32),
    "edges": ArrayType(("E", 2), np.int32),
    # Vertex fields d_j at the reference, where codes are coefficients of tangent vectors.
    "modes": ArrayType(("m", "V", 3), np.float32),
    # Codes of the shapes that the model was made from.
    "training_codes": ArrayType(("n", "m"), np.float64),
    # For each vertex of the user's files the vertex of the finest mesh that it became, or -1.
    "file_vertices": ArrayType(("N",), np.int32),
    # A finer mesh at the reference, and what takes vertices of the coarse one to it: see mesh.prolongation.
    "fine_vertices": ArrayType(("W", 3), np.float64),
    "fine_faces": ArrayType(("G", 3), np.int32),
    "prolongation_faces": ArrayType(("F", 3), np.int32),
    "prolongation_indptr": ArrayType(("W + 1",), np.int32),
    "prolongation_indices": ArrayType(("weights",), np.int32),
    "prolongation_weights": ArrayType(("weights",), np.float64),
    # Where parts move rigidly: of each fine vertex the number of its part or -1, and places at rest of those with one.
    "prolongation_rigid": ArrayType(("W",), np.int32),
    "prolongation_rest": ArrayType(("R", 3), np.float64),
    # What the user's file had on the finest mesh beside triangles: P polygons with C corners. See mesh.attributes.
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
#: The files of a bundle as they are written. They are read under the names that the manifest gives them.
COMBINER = Network(file="combiner.onnx", input="factors", output="nric")
START = Network(file="start.onnx", input="latent", output="vertices")
GEOMETRY = GeometryFile(file="geometry.npz")


def factor_network(j: int) -> Network:
    """The file of ψ_j as it is written."""
    return Network(file=f"factor-{j}.onnx", input="latent", output="nric")
