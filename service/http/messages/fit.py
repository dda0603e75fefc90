"""Options of a fit, as parameters of a query or as a field of a form, and its answer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

from fastapi import Query
from pydantic import BaseModel, Field, TypeAdapter

from shapespace.model.fit import LANDMARKS, FitOptions, Landmark, Prior, ScaleChoice
from shapespace.service.http.messages.bodies import read
from shapespace.service.http.messages.json_query import read_query
from shapespace.service.http.messages.schemas import DiagnosticsAnswer, PlacementAnswer
from shapespace.service.use_cases.fields import Body, Number, NumbersByIndex, Whole

#: Most codes that are drawn from one posterior.
MOST_SAMPLES = 1000


class LandmarkRequest(Body):
    """A vertex whose place on the scan is known."""

    vertex: Whole = Field(description="Index in the fine mesh, from 0.")
    position: Annotated[list[Number], Field(fail_fast=True)] = Field(
        min_length=3, max_length=3, description="In the scan's units and frame."
    )
    sigma: Number | None = Field(
        None, gt=0, description="Standard deviation of the position there; by default a hundredth of the diagonal."
    )


_Landmarks = Annotated[list[LandmarkRequest], Field(fail_fast=True, max_length=LANDMARKS)]
_FIXED: TypeAdapter[dict[int, float]] = TypeAdapter(NumbersByIndex)
_LANDMARKS: TypeAdapter[list[LandmarkRequest]] = TypeAdapter(_Landmarks)


class FitRequest(Body):
    """What is asked for."""

    scale: ScaleChoice = ScaleChoice.FIXED
    partial: bool = False
    noise: Number | None = Field(None, gt=0)
    distribution: Prior = Prior.POPULATION
    seed: Whole = Field(0, ge=0, lt=2**63)
    fixed: NumbersByIndex = Field({})
    landmarks: _Landmarks = Field(default_factory=list)
    samples: Whole = Field(0, ge=0, le=MOST_SAMPLES)
    points: bool = False
    used: bool = False

    def options(self) -> FitOptions:
        """As a fit takes them."""
        return FitOptions(
            scale=self.scale,
            partial=self.partial,
            noise=self.noise,
            landmarks=[Landmark(each.vertex, each.position, each.sigma) for each in self.landmarks],
            fixed=self.fixed,
            prior=self.distribution,
            samples=self.samples,
            points=self.points,
            used=self.used,
            seed=self.seed,
        )


async def fit_options(
    scale: Annotated[
        ScaleChoice, Query(description="`fixed`: the scan has the model's size; `free`: its size is found too.")
    ] = ScaleChoice.FIXED,
    partial: Annotated[
        bool, Query(description="Whether the scan shows a part of the shape only, as from one camera.")
    ] = False,
    noise: Annotated[
        float | None,
        Query(gt=0, description="Standard deviation of the scan's points in its units; estimated by default."),
    ] = None,
    distribution: Annotated[
        Prior,
        Query(
            description="What codes are like: `population`, the Gaussian of the training codes, or `box`, any inside."
        ),
    ] = Prior.POPULATION,
    seed: Annotated[int, Query(ge=0, lt=2**63, description="Of random numbers: one seed gives one answer.")] = 0,
    fixed: Annotated[
        str | None,
        Query(
            description='Coordinates that keep a value, as JSON: `{"3": 0.2}`.',
            json_schema_extra={"contentMediaType": "application/json"},
        ),
    ] = None,
    landmarks: Annotated[
        str | None,
        Query(
            description="Vertices of the fine mesh whose places are known, as JSON: "
            '`[{"vertex": 5, "position": [0, 1, 0], "sigma": 0.01}]`. Three or more decide where the search begins.',
            json_schema_extra={"contentMediaType": "application/json"},
        ),
    ] = None,
    samples: Annotated[int, Query(ge=0, le=MOST_SAMPLES, description="Codes to draw from the posterior.")] = 0,
    points: Annotated[bool, Query(description="Also answer the distance of each point and each vertex.")] = False,
    used: Annotated[
        bool, Query(description="Also answer the points that stood for the scan, to be shown beside the shape.")
    ] = False,
) -> Callable[[str], FitOptions]:
    """The options, once a form's field ``options`` is known: what it says wins over the query."""
    given: dict[str, Any] = {
        "scale": scale,
        "partial": partial,
        "noise": noise,
        "distribution": distribution,
        "seed": seed,
        "samples": samples,
        "points": points,
        "used": used,
    }
    if fixed is not None:
        given["fixed"] = read_query(fixed, "fixed", _FIXED)
    if landmarks is not None:
        given["landmarks"] = read_query(landmarks, "landmarks", _LANDMARKS)

    def options(said: str) -> FitOptions:
        asked = read(said.encode(), FitRequest) if said.strip() else None
        told = {} if asked is None else {name: getattr(asked, name) for name in asked.model_fields_set}
        return FitRequest.model_construct(**{**FitRequest().__dict__, **given, **told}).options()

    return options


class DistancesAnswer(BaseModel):
    """Distances in the scan's units."""

    mean: float
    p95: float
    max: float
    points: list[float] | None = Field(None, description="With `points`: each of them.")


class UsedAnswer(BaseModel):
    """Points that stood for the scan, at most a few thousand."""

    positions: list[list[float]] = Field(description="In the scan's units and frame.")
    distances: list[float] = Field(description="Of each from the model's surface, in the scan's units.")


class BothDistances(BaseModel):
    """Distances both ways."""

    scan: DistancesAnswer = Field(description="Of the scan's points from the model's surface.")
    model: DistancesAnswer = Field(description="Of the model's vertices from the scan.")


class ShapesAnswer(BaseModel):
    """Shapes that the search looked at."""

    solved: int
    rough: int = Field(description="Without Gauss–Newton, at a third of the price.")


class FitAnswer(BaseModel):
    """What explains a scan."""

    latent: list[float]
    covariance: list[list[float]] = Field(
        description="m × m, of the code given the scan (Laplace); zero in coordinates that were fixed."
    )
    placement: PlacementAnswer = Field(description="Takes the mesh of `latent` to the scan.")
    distances: BothDistances
    explained: float = Field(description="Share of the scan that lies at the model.")
    seen: float = Field(description="Share of the model's area that lies at the scan.")
    noise: float = Field(description="Standard deviation of the scan about the model, in the scan's units.")
    mirrored: float | None = Field(
        description="Cost of the scan's mirror image as a share of its own, where the fit is poor: a small one says "
        "that the scan is mirrored."
    )
    status: str = Field(description="converged, ambiguous, poor, stalled.")
    reason: str = Field(description="The same in words.")
    sampled: bool = Field(description="Whether fewer points, or points spread over the faces, stood for the scan.")
    shapes: ShapesAnswer
    diagnostics: DiagnosticsAnswer = Field(description="Of the code's shape.")
    samples: list[list[float]] | None = Field(None, description="With `samples`: codes drawn from the posterior.")
    used: UsedAnswer | None = Field(None, description="With `used`: the points that stood for the scan.")
