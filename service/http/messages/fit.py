"""Options of a fit, in the query or in fields of a form, and its answer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, BaseModel, Field

from shapespace.model.fit_constraints import LANDMARKS
from shapespace.model.options import FitOptions, Landmark
from shapespace.service.http.messages.options import body_of, options_of, query_of
from shapespace.service.http.messages.schemas import DiagnosticsAnswer, PlacementAnswer
from shapespace.service.use_cases.fields import Body

#: Maximum number of codes that a fit draws from a posterior.
MOST_SAMPLES = 1000


@body_of(Landmark)
class LandmarkRequest(Body):
    """A vertex with a known position on the scan."""


_LANDMARKS = {
    Sequence[Landmark]: Annotated[
        list[LandmarkRequest],
        Field(fail_fast=True, max_length=LANDMARKS),
        AfterValidator(lambda given: [options_of(Landmark, each) for each in given]),
    ]
}


@query_of(FitOptions, _LANDMARKS, samples={"le": MOST_SAMPLES})
class FitQuery(BaseModel):
    """Options of a fit in the query."""


@body_of(FitOptions, _LANDMARKS, samples={"le": MOST_SAMPLES})
class FitRequest(Body):
    """Options of a fit in the field `options` of a form."""


class DistancesAnswer(BaseModel):
    """Distances in the scan's units."""

    mean: float
    p95: float
    max: float
    points: list[float] | None = Field(None, description="With `points`: distance of each point or vertex.")


class UsedAnswer(BaseModel):
    """Points that represented the scan, at most a few thousand."""

    positions: list[list[float]] = Field(description="Positions of the points, in the scan's units and frame.")
    distances: list[float] = Field(description="Distance of each point from the model's surface, in the scan's units.")


class BothDistances(BaseModel):
    """Distances from the scan to the model, and from the model to the scan."""

    scan: DistancesAnswer = Field(description="Distances of the scan's points from the model's surface.")
    model: DistancesAnswer = Field(description="Distances of the model's vertices from the scan.")


class ShapesAnswer(BaseModel):
    """Number of shapes that the search computed."""

    solved: int
    rough: int = Field(description="Number of shapes without Gauss–Newton, which take a third of the time.")


class FitAnswer(BaseModel):
    """Code, placement and size that explain a scan."""

    latent: list[float]
    covariance: list[list[float]] = Field(
        description="m × m covariance of the code, given the scan (Laplace approximation); zero for fixed coordinates."
    )
    placement: PlacementAnswer = Field(description="The motion and scale that take the mesh of `latent` to the scan.")
    distances: BothDistances
    explained: float = Field(description="Share of the scan that lies at the model.")
    seen: float = Field(description="Share of the model's area that lies at the scan.")
    noise: float = Field(description="Standard deviation of the scan about the model, in the scan's units.")
    mirrored: float | None = Field(
        description="Cost of the scan's mirror image as a share of the scan's own cost, if the fit is poor. A small "
        "value means that the scan is mirrored."
    )
    status: str = Field(description="converged, ambiguous, poor, stalled, or deadline (with the best result so far).")
    reason: str = Field(description="The status in words.")
    sampled: bool = Field(description="Whether the fit used a part of the points, or points spread over the faces.")
    shapes: ShapesAnswer
    diagnostics: DiagnosticsAnswer = Field(description="Diagnostics of the code's shape.")
    samples: list[list[float]] | None = Field(None, description="With `samples`: codes drawn from the posterior.")
    used: UsedAnswer | None = Field(None, description="With `used`: the points that the fit used.")
