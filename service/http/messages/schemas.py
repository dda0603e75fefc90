"""Bodies of requests and answers, as OpenAPI describes them."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

from shapespace.bundle.schema import AttributesEntry
from shapespace.files.colouring import Quantity
from shapespace.model.decoder import MeshChoice, Quality
from shapespace.model.encode_faults import EncodeCause
from shapespace.model.latent_space import Bounds, Distribution
from shapespace.model.options import EditOptions, EncodeOptions, Target
from shapespace.service.http.messages.options import body_of, query_of
from shapespace.service.use_cases.fields import Body, Number, Whole

#: Each list fails at its first fault, because every element may have a fault.
Latent = Annotated[
    list[Number],
    Field(
        fail_fast=True,
        description="One latent code: as many numbers as the card's `latent_dimension`.",
        examples=[[1, 2, 3, 4]],
        json_schema_extra={"minItems": 1},
    ),
]
Latents = Annotated[
    list[Latent],
    Field(
        fail_fast=True,
        description="Latent codes, one shape each.",
        examples=[[[1, 2, 3, 4], [0, 0, 0, 0]]],
        json_schema_extra={"minItems": 1},
    ),
]
MeshField = Annotated[MeshChoice, Field(description="Which mesh to answer, where the model has a finer one.")]
QualityField = Annotated[
    Quality,
    Field(
        description="`draft` leaves Gauss–Newton out where the first guess is near enough, in a fraction of the time; "
        "the card's `draft_error` says how near. `Shape-Diagnostics.quality` says what was answered."
    ),
]
BoundsField = Annotated[
    Bounds, Field(description="Outside the bounds: extrapolate, clamp to the nearest bound, or reject.")
]


class MeshRequest(Body):
    """One code, and how to shape it."""

    latent: Latent
    mesh: MeshField = MeshChoice.FINE
    bounds: BoundsField = Bounds.ALLOW
    quality: QualityField = Quality.FULL
    covariance: Annotated[list[Annotated[list[Number], Field(fail_fast=True)]] | None, Field(fail_fast=True)] = Field(
        None, description="With `?color=spread`: m × m, of codes around this one, as `edit` and `encode` answer it."
    )


class VerticesRequest(Body):
    """Several codes, and how to shape them."""

    latents: Latents
    exact: bool = Field(
        False,
        strict=True,
        description="Also answer the true discrete exponentials, of models with a tangent space, and their distances.",
    )
    mesh: MeshField = MeshChoice.FINE
    bounds: BoundsField = Bounds.ALLOW
    quality: QualityField = Quality.FULL
    faces: bool = Field(True, strict=True, description="Whether NPZ has the mesh's faces too; JSON never has.")


@body_of(Target)
class TargetRequest(Body):
    """A vertex and the position that it should have."""


@body_of(EditOptions, without=["sigma"])
class EditRequest(Body):
    """A code to start from, vertices that should be elsewhere, and the options of an edit."""

    latent: Latent
    targets: Annotated[
        list[TargetRequest], Field(fail_fast=True, min_length=1, examples=[[{"vertex": 0, "position": [0.3, 0.1, 0]}]])
    ] = Field(description="At least one target, in the frame of the mesh that `latent` is answered with.")


@query_of(EncodeOptions)
class EncodeQuery(BaseModel):
    """Options of ``encode`` in the query."""


@body_of(EncodeOptions)
class EncodeRequest(Body):
    """Options of ``encode`` in the field `options` of a form."""


class SampleRequest(Body):
    """How many random codes, and which."""

    count: Whole = Field(1, ge=1, description="Number of codes.", examples=[3])
    seed: Whole = Field(0, ge=0, lt=2**63, description="The same codes for the same seed.")
    distribution: Distribution = Field(
        Distribution.UNIFORM,
        description="In the bounds uniform, or gaussian: around their middle, with a standard deviation of a quarter "
        "of their width, and cut off at them. Or the population: the Gaussian with shrinkage fitted to the codes of "
        "the training shapes, not cut off.",
    )
    temperature: Number = Field(
        1.0, ge=0, description="With `population`: factor of the differences from its mean. Otherwise it is 1."
    )

    @model_validator(mode="after")
    def _of_the_population(self) -> SampleRequest:
        if self.temperature != 1 and self.distribution is not Distribution.POPULATION:
            raise ValueError('temperature goes with "distribution": "population"')
        return self


class NRICRequest(Body):
    """Several codes, and whether to answer each factor's own lengths and angles too."""

    latents: Latents
    factors: bool = Field(False, strict=True, description="Also answer ψ_j of each factor j.")
    bounds: BoundsField = Bounds.ALLOW


class ColorAnswer(BaseModel):
    """How a mesh differs from another one, vertex by vertex."""

    quantity: Quantity
    range: list[float] = Field(description="Values at the ends of the legend.", min_length=2, max_length=2)
    map: str = Field(description="Name of the colour map that the other formats use.")
    values: list[float] = Field(description="V values.")


class MeshAnswer(BaseModel):
    """A mesh as JSON, in the units of the training meshes."""

    vertices: list[list[float]] = Field(description="V positions.")
    faces: list[list[int]] = Field(description="F triples of vertex indices, from 0.")
    color: ColorAnswer | None = Field(None, description="Only where `color` was asked for.")


class DiagnosticsAnswer(BaseModel):
    """How well a shape was found."""

    status: str = Field(description="How Gauss–Newton ended: converged, stalled, iteration_limit.")
    iterations: int = Field(description="Its iterations.")
    residual: float = Field(description="Relative misfit of lengths and angles in the weighted norm.")
    flipped_faces: int = Field(description="Faces folded more than π/2 away from what the networks ask for.")
    integrability: float = Field(
        description="How far the predicted lengths and angles are from those of any surface: root mean square over "
        "vertices of the sine of half the angle by which the faces around it fail to close."
    )
    plausibility: float | None = Field(
        description="Distance to the nearest training shape's code, in multiples of the distance that these typically "
        "have from each other; null where the model was not made from shapes."
    )
    inside_bounds: bool = Field(description="Whether the code lies inside the model's bounds.")
    model: str = Field(description="SHA-256 of the model's manifest.")
    quality: Quality = Field(description="`draft` where Gauss–Newton was left out, otherwise `full`.")


class VertexError(BaseModel):
    """Distances over vertices, in the units of the training meshes."""

    mean: float
    max: float


class VerticesAnswer(BaseModel):
    """Positions of n shapes."""

    vertices: list[list[list[float]]] = Field(description="n × V × 3 positions, in the units of the training meshes.")
    diagnostics: list[DiagnosticsAnswer] = Field(description="One for each shape.")
    exact: list[list[list[float]] | None] | None = Field(
        None, description="With `exact`: positions of the true exponentials, null where one could not be found."
    )
    distance: list[VertexError | None] | None = Field(
        None, description="With `exact`: how far the vertices are from those, null where one could not be found."
    )
    exact_status: list[str] | None = Field(None, description="With `exact`: how each exponential's solver ended.")


class PlacementAnswer(BaseModel):
    """Takes positions from one frame to another: `scale` · `rotation` · x + `translation`."""

    rotation: list[list[float]] = Field(description="3 × 3.", min_length=3, max_length=3)
    translation: list[float] = Field(min_length=3, max_length=3)
    scale: float


_COVARIANCE = "m × m, of codes around `latent`; zero in the rows and columns of what is fixed."
_SAMPLED = "Random codes around `latent` of that covariance, as many as `samples`; not cut off at the bounds."


class EncodeAnswer(BaseModel):
    """The code of a mesh."""

    latent: list[float]
    residual: float = Field(description="Relative misfit of the mesh's lengths and angles in the weighted norm.")
    vertex_error: VertexError = Field(description="Between the mesh and the code's shape, after rigid alignment.")
    vertex_errors: list[float] = Field(description="The same vertex by vertex.")
    inside_bounds: bool = Field(description="Whether the code lies inside the model's bounds.")
    status: str = Field(
        description="How the search ended: converged, stalled, iteration_limit, deadline (with the best result so "
        "far), or poor: the mesh is no shape of the model, so do not use the code."
    )
    reason: str = Field(description="The status in words.")
    cause: EncodeCause | None = Field(
        description="With `poor`: all vertices have another `order`, some are `exchanged` or are `outliers` far off, "
        "or the mesh is `mirrored`. Otherwise null."
    )
    misplaced: list[int] = Field(description="Vertices that are exchanged or lie far off, from 0.")
    iterations: int = Field(description="Shapes that it looked at; evaluations of the networks if by `nric`.")
    mesh: MeshChoice = Field(description="Which mesh of the model was sent.")
    diagnostics: DiagnosticsAnswer = Field(description="Of the code's shape.")
    covariance: list[list[float]] = Field(description=_COVARIANCE)
    samples: list[list[float]] = Field(description=_SAMPLED)


class EditAnswer(BaseModel):
    """The code whose shape comes closest to the targets."""

    latent: list[float]
    residual: float = Field(
        description="Root mean square distance from the targets, in the units of the training meshes, once "
        "`placement` is applied."
    )
    distances: list[float] = Field(description="Distance from each target, likewise.")
    placement: PlacementAnswer = Field(
        description="Takes the mesh of the new code into the frame of that of the old one; `scale` is 1."
    )
    covariance: list[list[float]] = Field(description=_COVARIANCE)
    samples: list[list[float]] = Field(description=_SAMPLED)
    status: str = Field(
        description="How the search ended: converged, stalled, iteration_limit, deadline (with the best result so far)."
    )
    iterations: int = Field(description="Shapes that it looked at.")
    diagnostics: DiagnosticsAnswer = Field(description="Of the code's shape.")


class SampleAnswer(BaseModel):
    """Random codes."""

    latents: Latents


class NRICAnswer(BaseModel):
    """Lengths and angles as the networks predict them, edges in lexicographic order."""

    lengths: list[list[float]] = Field(description="n × E edge lengths, in the units of the training meshes.")
    angles: list[list[float]] = Field(description="n × E signed dihedral angles in radians, positive where convex.")
    factors: list[list[list[float]]] | None = Field(
        None, description="n × J × 2E: lengths, then angles, of each factor on its own."
    )


class FactorSummary(BaseModel):
    """A factor and its range of latent coordinates, the last excluded."""

    name: str
    start: int
    stop: int


class ModelSummary(BaseModel):
    """A model in the list."""

    name: str
    version: str
    title: str
    description: str
    licence: str
    latent_dimension: int
    latent_names: list[str]
    factors: list[FactorSummary]
    lower: list[float] = Field(description="Lower bound of each coordinate.")
    upper: list[float] = Field(description="Upper bound of each coordinate.")
    period: list[float | None] = Field(description="Period of each coordinate that is an angle, else null.")
    vertices: int
    edges: int
    faces: int
    surface: AttributesEntry | None = Field(
        description="What answers of the fine mesh have from the training files beside triangles: names of parts, "
        "materials, textures, and whether these had normals; null where nothing."
    )
    links: dict[str, str] = Field(description="Addresses of the model's calls.")


class ModelList(BaseModel):
    """Every model, in its default version."""

    models: list[ModelSummary]


class DistanceAnswer(BaseModel):
    """Distance of vertices, as shares of the bounding box's diagonal."""

    mean: float
    p95: float = Field(description="95th percentile.")


class GeneralisationAnswer(DistanceAnswer):
    """Distance of vertices of shapes that were held out, beside as many principal components of aligned vertices."""

    components: DistanceAnswer
    shapes: int = Field(description="How many were held out.")
    modes: float = Field(description="How many modes; a mean where several folds differ.")


class BesideComponents(BaseModel):
    """A figure of a space, and the same of as many principal components of aligned vertices."""

    modes: float
    components: float


class ModelCard(ModelSummary):
    """What a model is, how good it is, and where it comes from."""

    model_config = ConfigDict(populate_by_name=True)

    versions: list[str] = Field(description="Versions that are served, oldest first.")
    digest: str = Field(description="SHA-256 of the manifest, which holds the digests of all its files.")
    scale: float = Field(description="Length of one normalised unit in the units of the training meshes.")
    mu: float
    lambda_: float = Field(alias="lambda")
    eta: float = Field(description="Weight of bending in the metric.")
    eta_reconstruction: float = Field(description="Weight of the angles in Gauss–Newton.")
    onnx_tolerance: dict[str, float]
    figures: dict[str, Any] = Field(description="Evaluation figures on the test split.")
    generalisation: GeneralisationAnswer | None = Field(
        description="How near the modes come to shapes that they were found without; null where that is not known."
    )
    compactness: BesideComponents | None = Field(
        description="Share of the variance of the training shapes that is explained; null where that is not known."
    )
    specificity: BesideComponents | None = Field(
        description="Mean distance of random shapes from the nearest training shape, as a share of the bounding box's "
        "diagonal; null where that is not known."
    )
    draft_error: DistanceAnswer | None = Field(
        description="How far drafts are from full shapes over codes inside the bounds; null where that is not known."
    )
    origin: dict[str, Any]


class InterpolationAnswer(BaseModel):
    """A new interpolation; its id holds all of it and stays valid as long as the model is served."""

    id: str
    frames: int = Field(description="Number of frames, from 0.")
    links: dict[str, str]


class Health(BaseModel):
    """Open Inference Protocol: server live."""

    live: bool


class Readiness(BaseModel):
    """Open Inference Protocol: server ready."""

    ready: bool
    faults: list[str] | None = Field(None, description="Sentences about default versions that can't be answered.")


class Problem(BaseModel):
    """Problem details, RFC 9457."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(
        description="Stable name of the kind of problem.", examples=["urn:shapespace:problem:wrong-length"]
    )
    title: str
    status: int
    detail: str = Field(description="A sentence that says what to do.")
