"""Bodies of requests and answers, as OpenAPI describes them."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from shapespace.files.colouring import Quantity
from shapespace.model.decoder import MeshChoice
from shapespace.model.encode_faults import EncodeCause
from shapespace.model.latent_space import Bounds, Distribution
from shapespace.model.options import EditOptions, EncodeOptions, Target
from shapespace.model.shape import Quality
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
MeshField = Annotated[MeshChoice, Field(description="Which mesh to answer, if the model has a fine one.")]
QualityField = Annotated[
    Quality,
    Field(
        description="`auto` stops Gauss–Newton where more steps would not bring the shape closer to the exact one: it "
        "is on average at most 1.1 times as far away as `full`. `full` solves to convergence. `draft` leaves out "
        "Gauss–Newton if the first guess is accurate enough. The card's `auto_error` and `draft_error` are the "
        "distances from `full`. `Shape-Diagnostics.quality` says which quality was answered."
    ),
]
ExamplesField = Annotated[
    bool,
    Field(
        strict=True,
        description="Whether the shape has what the model remembers of training shapes: corrections that vanish away "
        "from their codes. `false` leaves them out.",
    ),
]
BoundsField = Annotated[
    Bounds,
    Field(
        description="For a code outside the bounds: extrapolate (`allow`), move it to the nearest bound "
        "(`clamp`), or refuse it (`reject`)."
    ),
]


class MeshRequest(Body):
    """One code, and how to shape it."""

    latent: Latent
    mesh: MeshField = MeshChoice.FINE
    bounds: BoundsField = Bounds.ALLOW
    quality: QualityField = Quality.AUTO
    examples: ExamplesField = True
    covariance: Annotated[list[Annotated[list[Number], Field(fail_fast=True)]] | None, Field(fail_fast=True)] = Field(
        None, description="With `?color=spread`: m × m covariance of the code, as `edit`, `encode` and `fit` answer it."
    )


class VerticesRequest(Body):
    """Several codes, and how to shape them."""

    latents: Latents
    exact: bool = Field(
        False,
        strict=True,
        description="Also answer the true discrete exponentials and their distances, for models with a tangent space.",
    )
    mesh: MeshField = MeshChoice.FINE
    bounds: BoundsField = Bounds.ALLOW
    quality: QualityField = Quality.AUTO
    faces: bool = Field(True, strict=True, description="Whether NPZ has the faces too. JSON never has them.")


@body_of(Target)
class TargetRequest(Body):
    """A vertex and the position that it should have."""


#: The limit of a server, which its settings may change.
FEW_SAMPLES = {
    "description": "Number of random codes to draw from the posterior, a Gaussian around the code with the "
    "`covariance` of the answer: at most `SHAPESPACE_MAX_CODES`, 256 by default."
}


@body_of(EditOptions, without=["sigma"], samples=FEW_SAMPLES)
class EditRequest(Body):
    """A code to start from, vertices that should be elsewhere, and the options of an edit."""

    latent: Latent
    targets: Annotated[
        list[TargetRequest], Field(fail_fast=True, min_length=1, examples=[[{"vertex": 0, "position": [0.3, 0.1, 0]}]])
    ] = Field(description="At least one target, in the frame in which the server answers the mesh of `latent`.")


@query_of(EncodeOptions, samples=FEW_SAMPLES)
class EncodeQuery(BaseModel):
    """Options of ``encode`` in the query."""


@body_of(EncodeOptions, samples=FEW_SAMPLES)
class EncodeRequest(Body):
    """Options of ``encode`` in the field `options` of a form."""


class SampleRequest(Body):
    """How many random codes, and which."""

    count: Whole = Field(
        1, ge=1, description="Number of codes, at most `SHAPESPACE_MAX_CODES`, 256 by default.", examples=[3]
    )
    seed: Whole = Field(0, ge=0, lt=2**63, description="Seed of the random codes. The same seed gives the same codes.")
    distribution: Distribution = Field(
        Distribution.UNIFORM,
        description="`uniform` in the bounds. `gaussian`: around the middle of the bounds, with a standard deviation "
        "of a quarter of their width, truncated at the bounds. `population`: a Gaussian with shrinkage fitted to the "
        "training codes, not truncated.",
    )
    temperature: Number = Field(1.0, ge=0, description="With `population`: multiplies the deviations from the mean.")

    @model_validator(mode="after")
    def _of_the_population(self) -> SampleRequest:
        if self.temperature != 1 and self.distribution is not Distribution.POPULATION:
            raise ValueError('temperature is only for "distribution": "population"; leave it out otherwise')
        return self


class NRICRequest(Body):
    """Several codes, and whether to answer each factor's own lengths and angles too."""

    latents: Latents
    factors: bool = Field(False, strict=True, description="Also answer the lengths and angles of each factor alone.")
    bounds: BoundsField = Bounds.ALLOW


class ColorAnswer(BaseModel):
    """How a mesh differs from another one, vertex by vertex."""

    quantity: Quantity
    range: list[float] = Field(description="Smallest and largest value of the legend.", min_length=2, max_length=2)
    map: str = Field(description="Name of the colour map that the other formats use.")
    values: list[float] = Field(description="V values.")


class MeshAnswer(BaseModel):
    """A mesh as JSON, in the units of the training meshes."""

    vertices: list[list[float]] = Field(description="V positions.")
    faces: list[list[int]] = Field(description="F triples of vertex indices, from 0.")
    color: ColorAnswer | None = Field(None, description="Only if the request has `color`.")


class DiagnosticsAnswer(BaseModel):
    """How well a shape was found."""

    status: str = Field(description="How Gauss–Newton ended: converged, stalled, iteration_limit.")
    iterations: int = Field(description="Number of iterations of Gauss–Newton.")
    residual: float = Field(description="Relative error of lengths and angles in the weighted norm.")
    flipped_faces: int = Field(description="Number of faces folded more than π/2 away from the predicted angle.")
    integrability: float = Field(
        description="How far the predicted lengths and angles are from the lengths and angles of any surface. It is "
        "the sine of half the angle by which the faces around a vertex fail to close, as root mean square over "
        "vertices."
    )
    plausibility: float | None = Field(
        description="Distance to the nearest training code, in multiples of the typical distance between training "
        "codes; null for models without training codes."
    )
    inside_bounds: bool = Field(description="Whether the code lies inside the model's bounds.")
    model: str = Field(description="SHA-256 of the model's manifest.")
    quality: Quality = Field(description="The quality that was answered.")


class VertexError(BaseModel):
    """Distances over vertices, in the units of the training meshes."""

    mean: float
    max: float


class VerticesAnswer(BaseModel):
    """Positions of n shapes."""

    vertices: list[list[list[float]]] = Field(description="n × V × 3 positions, in the units of the training meshes.")
    diagnostics: list[DiagnosticsAnswer] = Field(description="Diagnostics of each shape.")
    exact: list[list[list[float]] | None] | None = Field(
        None, description="With `exact`: positions of the true exponentials; null for each that was not found."
    )
    distance: list[VertexError | None] | None = Field(
        None,
        description="With `exact`: distance of the vertices from the true exponentials; null for each that was "
        "not found.",
    )
    exact_status: list[str] | None = Field(None, description="With `exact`: how the solver of each exponential ended.")


class PlacementAnswer(BaseModel):
    """Takes positions from one frame to another: `scale` · `rotation` · x + `translation`."""

    rotation: list[list[float]] = Field(description="3 × 3.", min_length=3, max_length=3)
    translation: list[float] = Field(min_length=3, max_length=3)
    scale: float


_COVARIANCE = "m × m covariance of codes around `latent`; zero in the rows and columns of fixed coordinates."
_SAMPLED = (
    "With `samples`: this number of random codes around `latent` with this covariance. They may lie outside the bounds."
)


class EncodeAnswer(BaseModel):
    """The code of a mesh."""

    latent: list[float]
    residual: float = Field(description="Relative error of the mesh's lengths and angles in the weighted norm.")
    vertex_error: VertexError = Field(
        description="Distance between the mesh and the shape of the code, after rigid alignment."
    )
    vertex_errors: list[float] = Field(description="The same distance for each vertex.")
    inside_bounds: bool = Field(description="Whether the code lies inside the model's bounds.")
    status: str = Field(
        description="How the search ended: converged, stalled, iteration_limit, deadline (with the best result so "
        "far), or poor: the mesh is not a shape of the model, so do not use the code."
    )
    reason: str = Field(description="The status in words.")
    cause: EncodeCause | None = Field(
        description="With `poor`: all vertices have another `order`, some vertices are `exchanged` or far off "
        "(`outliers`), the mesh is `mirrored` or has another `size`, or no shape of the model is near (`far`). "
        "Otherwise null."
    )
    misplaced: list[int] = Field(description="Indices of vertices that are exchanged or lie far off, from 0.")
    iterations: int = Field(
        description="Number of shapes that the search computed; with `nric`, number of evaluations of the networks."
    )
    mesh: MeshChoice = Field(description="Whether the request had the fine or the coarse mesh.")
    diagnostics: DiagnosticsAnswer = Field(description="Of the code's shape.")
    covariance: list[list[float]] = Field(description=_COVARIANCE)
    samples: list[list[float]] = Field(description=_SAMPLED)


class EditAnswer(BaseModel):
    """The code whose shape comes closest to the targets."""

    latent: list[float]
    residual: float = Field(
        description="Root mean square distance from the targets, in the units of the training meshes, after "
        "`placement`."
    )
    distances: list[float] = Field(description="Distance from each target, in the same frame.")
    placement: PlacementAnswer = Field(
        description="The motion that takes the mesh of the new code into the frame of the mesh of the old code; "
        "`scale` is 1."
    )
    covariance: list[list[float]] = Field(description=_COVARIANCE)
    samples: list[list[float]] = Field(description=_SAMPLED)
    status: str = Field(
        description="How the search ended: converged, stalled, iteration_limit, deadline (with the best result so far)."
    )
    iterations: int = Field(description="Number of shapes that the search computed.")
    diagnostics: DiagnosticsAnswer = Field(description="Of the code's shape.")


class SampleAnswer(BaseModel):
    """Random codes."""

    latents: Latents


class NRICAnswer(BaseModel):
    """Lengths and angles as the networks predict them, edges in lexicographic order."""

    lengths: list[list[float]] = Field(description="n × E edge lengths, in the units of the training meshes.")
    angles: list[list[float]] = Field(description="n × E signed dihedral angles in radians, positive where convex.")
    factors: list[list[list[float]]] | None = Field(
        None, description="n × J × 2E: lengths, then angles, of each factor alone."
    )


class InterpolationAnswer(BaseModel):
    """A new interpolation; its id holds all of it and stays valid as long as the model is served."""

    id: str
    frames: int = Field(description="Number of frames. Their indices start at 0.")
    links: dict[str, str]


class Health(BaseModel):
    """Open Inference Protocol: server live."""

    live: bool


class Readiness(BaseModel):
    """Open Inference Protocol: server ready."""

    ready: bool
    faults: list[str] | None = Field(None, description="Sentences about default versions that are not served.")


class Problem(BaseModel):
    """Problem details, RFC 9457."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(
        description="Stable name of the kind of problem.", examples=["urn:shapespace:problem:wrong-length"]
    )
    title: str
    status: int
    detail: str = Field(description="A sentence that says what to do.")
