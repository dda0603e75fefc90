"""Sizes and thresholds of a fit to a scan."""

from dataclasses import dataclass
from enum import Enum, auto


class Attempt(Enum):
    """Attempt to improve a poor fit."""

    PULL = auto()  # steps that pull unmatched parts of both sides together
    EXCHANGE = auto()  # factors get the parts of other codes
    RESTART = auto()  # more start placements, also of training shapes


@dataclass(frozen=True)
class ScanFitSettings:
    """Sizes and thresholds of a fit. Distances are fractions of the reference's diagonal.

    Attributes:
        start_shapes, random_shapes: number of start shapes, chosen as far apart as possible from random shapes.
        coarse_vertices, fine_vertices: number of vertices of each mesh that look for a nearest scan point.
        behind: in the last round, a second start takes part if it costs at most this multiple of the best.
        middle_steps, last_steps: steps with solved shapes, first with few points, then with all on the fine mesh.
        both_steps: steps to a scan of a part with rough shapes that also look from the model to the scan.
        again_steps: further steps with few points after a feature has moved.
        attempts, attempts_of_part: attempts to improve a poor fit to a scan (of a part), one after another.
        attempt_steps: steps of each attempt,
        drawn_steps: of which this number pulls unmatched parts together.
        alike: a training shape at a smaller mean distance from a fit is not tried.
        units, units_of_part: a scan (of a part) that is this many times larger or smaller than the model's shapes is
            taken to be in other units, unless the scale is free.
        missed, unseen: a fit is poor if larger shares of the scan and of the model are far from the other side.
            Outliers raise only the first share, holes only the second. A limb in the wrong place raises both.
        missed_of_part: limit of the first share for a scan of a part.
        restless: a fit has not converged if its last step was longer than this distance.
        elsewhere: a fit is ambiguous if another fit differs by at least this mean distance,
        nearly, beside: and costs at most ``nearly`` times as much plus ``beside``.
        shown: the scan tells nothing of a coordinate if less than this share of its squared motion lies at the scan.
        certain: a fit is ambiguous if the mean standard deviation of its surface exceeds this distance.
        mirrored: a scan counts as mirrored if its mirror image costs less than this share.
        rivals: maximum number of other fits that are refined to the end.
    """

    start_shapes: int = 16
    random_shapes: int = 200
    coarse_vertices: int = 500
    fine_vertices: int = 2000
    behind: float = 1.5
    middle_steps: int = 8
    last_steps: int = 6
    both_steps: int = 12
    again_steps: int = 10
    attempts: tuple[Attempt, ...] = (
        *2 * (Attempt.PULL, Attempt.EXCHANGE),
        Attempt.RESTART,
        *2 * (Attempt.PULL, Attempt.EXCHANGE),
    )
    attempts_of_part: tuple[Attempt, ...] = (Attempt.RESTART, *3 * (Attempt.PULL, Attempt.EXCHANGE))
    attempt_steps: int = 9
    drawn_steps: int = 4
    units: float = 3.0
    units_of_part: float = 20.0
    missed: float = 0.015
    unseen: float = 0.008
    missed_of_part: float = 0.03
    restless: float = 5e-3
    alike: float = 0.003
    elsewhere: float = 0.01
    nearly: float = 1.1
    beside: float = 3e-3
    shown: float = 0.4
    certain: float = 5e-3
    mirrored: float = 0.6
    rivals: int = 2


SETTINGS = ScanFitSettings()
