"""Results of fitting a model to a scan, intermediate and final."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Codes
from shapespace.model.shape import Shape


class FitStatus(StrEnum):
    """How a fit ended.

    ``ambiguous``: another code or placement fits nearly as well, or the scan says little about a part. ``poor``: the
    scan is no such shape, or the search failed. ``stalled``: the last step was still long. ``deadline``: the time was
    over.
    """

    CONVERGED = "converged"
    AMBIGUOUS = "ambiguous"
    POOR = "poor"
    STALLED = "stalled"
    DEADLINE = "deadline"


@dataclass(frozen=True, eq=False)
class FitState:
    """Intermediate result of a fit."""

    code: FloatArray  # (m,) code
    shape: FloatArray  # (V, 3) coarse shape of the code, in the frame that ``placement`` takes to the scan's frame
    placement: Placement  # placement of the shape in the scan's frame
    sigma: float = np.inf  # standard deviation of the distances of pairs that count, normal to the surface
    cost: float = np.inf  # robust share of scan and model that is not explained, plus the cost of the code
    settled: bool = False  # whether the last step was short enough to be the last one
    moved: float = np.inf  # largest movement of the shape in the last step, as a fraction of the diagonal
    derivatives: VertexDerivatives | None = None  # derivatives that the next step may use


@dataclass(frozen=True, eq=False)
class VertexDerivatives:
    """Derivatives of the vertices of a mesh by the movable coordinates of a code."""

    code: FloatArray  # (m,) code at which they were computed
    fields: FloatArray  # (V, 3, f) derivatives, normalised
    mesh: MeshChoice


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances in the scan's units.

    Attributes:
        mean, p95, max: mean, 95th percentile and maximum over the points that represent the scan, or over vertices.
        points: (n,) distance of each point or vertex, if the options ask for it.
    """

    mean: float
    p95: float
    max: float
    points: FloatArray | None = None

    @classmethod
    def of(cls, distances: FloatArray, points: FloatArray | None) -> Distances:
        """Summarise distances (n,)."""
        return cls(float(distances.mean()), float(np.quantile(distances, 0.95)), float(distances.max()), points)

    def answer(self) -> dict[str, Any]:
        """Return the members of the JSON answer."""
        figures: dict[str, Any] = {"mean": self.mean, "p95": self.p95, "max": self.max}
        return figures if self.points is None else figures | {"points": _float32(self.points)}


@dataclass(frozen=True, eq=False)
class Fitted:
    """Code, placement and size that explain a scan.

    Attributes:
        code: (m,) code, float32, as the networks take it.
        covariance: (m, m) covariance of the code given the scan (Laplace); zero in fixed coordinates.
        placement: takes positions of ``shape`` to the scan's frame.
        shape: shape of the code on the fine mesh, as ``decode`` returns it.
        scan: distances of the scan's points from the shape.
        model: distances of the shape's vertices from the scan.
        explained: share of the scan that lies at the shape.
        seen: share of the shape's area that lies at the scan.
        noise: standard deviation of the scan about the shape, normal to it, in the scan's units.
        mirrored: cost of the scan's mirror image as a share of the scan's own cost, if the fit is poor. A small value
            means that the scan is mirrored.
        status: how the fit ended.
        reason: the status in words.
        samples: (n, m) codes drawn from the posterior.
        sampled: whether fewer points, or points spread over the faces, represented the scan.
        used: (n, 4) these points in the scan's units, and their distances from the shape, if the options ask for it.
        solved, rough: number of solved shapes, and of rough shapes, which take a third of the time.
    """

    code: Codes
    covariance: FloatArray
    placement: Placement
    shape: Shape
    scan: Distances
    model: Distances
    explained: float
    seen: float
    noise: float
    mirrored: float | None
    status: FitStatus
    reason: str
    samples: Codes
    sampled: bool
    used: FloatArray | None
    solved: int
    rough: int

    def answer(self) -> dict[str, Any]:
        """Return the members of the JSON answer, with NumPy arrays; positions and distances are float32."""
        content: dict[str, Any] = {
            "latent": self.code,
            "covariance": self.covariance,
            "placement": self.placement.answer(),
            "distances": {"scan": self.scan.answer(), "model": self.model.answer()},
            "explained": self.explained,
            "seen": self.seen,
            "noise": self.noise,
            "mirrored": self.mirrored,
            "status": self.status,
            "reason": self.reason,
            "sampled": self.sampled,
            "shapes": {"solved": self.solved, "rough": self.rough},
            "diagnostics": asdict(self.shape.diagnostics),
        }
        if self.used is not None:
            content["used"] = {"positions": _float32(self.used[:, :3]), "distances": _float32(self.used[:, 3])}
        return content | ({"samples": self.samples} if len(self.samples) else {})


def _float32(array: FloatArray) -> NDArray[np.float32]:
    return np.ascontiguousarray(array, dtype=np.float32)
