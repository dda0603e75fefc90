"""Start placements of a model's shapes in a scan's frame, from which a fit begins."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.scan import Scan, nearest_points

#: Share of the distances that count. The farthest points may belong to a limb in another pose, or to something else.
TRIMMED = 0.8
#: Number of shapes that are tried in all rotations. The other shapes are tried in the best of these rotations.
FIRST = 4
#: Smallest angle between different placements, in radians.
DIFFERENT = 0.35


@dataclass(frozen=True)
class PlacementEffort:
    """Effort of the search for placements."""

    points: int  # number of the scan's points by which placements are scored
    rotations: int  # number of rotations beside principal axes
    kept: int  # number of placements that go on to closest-point steps
    polished: int  # additional number of these placements, with other shapes
    steps: int  # number of closest-point steps
    count: int  # maximum number of start placements


#: Effort for most scans, and for scans of a part: a flat shape looks alike from both sides.
QUICK = PlacementEffort(points=150, rotations=60, kept=8, polished=6, steps=5, count=4)
MORE = PlacementEffort(points=150, rotations=240, kept=24, polished=24, steps=8, count=12)
THOROUGH = PlacementEffort(points=300, rotations=240, kept=48, polished=48, steps=20, count=32)


@dataclass(frozen=True, eq=False)
class StartPlacement:
    """Placement at which a fit may begin."""

    shape: int  # index of the shape
    placement: Placement  # placement of the shape in the scan's frame
    score: float  # mean of the distances that count, in the model's units


def start_placements(
    scan: Scan, shapes: FloatArray, *, partial: bool, free: bool, effort: PlacementEffort
) -> list[StartPlacement]:
    """Find the best placements of shapes in a scan, each clearly different from the better ones.

    The k shapes are evenly spread points (k, n, 3) in the units of the scan. If ``partial``, points of a shape may be
    far from the scan. If ``free``, the size may change too.
    """
    some = scan.some(effort.points).points
    turns = np.concatenate([_grid(effort.rotations), *(_principal(shape, some) for shape in shapes[:1])])
    tried: list[StartPlacement] = []
    for k, shape in enumerate(shapes[:FIRST]):
        tried += _scored(k, shape, some, turns, partial=partial, free=free)
    kept = _different(tried, effort.kept, DIFFERENT)
    again = np.stack([start.placement.rotation for start in kept])
    for k, shape in enumerate(shapes[FIRST:], FIRST):
        tried += _scored(k, shape, some, again, partial=partial, free=free)
    # At least one placement of each rotation, so that a wrong rotation with the right code doesn't take all places.
    chosen = [*kept, *sorted(tried, key=lambda start: start.score)[: 2 * effort.polished]]
    unique = list({(start.shape, id(start.placement)): start for start in chosen}.values())
    polished = [
        _polished(start, shapes[start.shape], some, effort.steps, partial=partial, free=free)
        for start in unique[: effort.kept + effort.polished]
    ]
    return _different(polished, effort.count, DIFFERENT / 2)


def _different(starts: list[StartPlacement], count: int, apart: float) -> list[StartPlacement]:
    """Return the best placements, without placements whose rotation is close to a better placement's."""
    found: list[StartPlacement] = []
    for start in sorted(starts, key=lambda start: start.score):
        if all(start.placement.angle_to(other.placement) > apart for other in found):
            found.append(start)
            if len(found) == count:
                break
    return found


def _scored(
    k: int, shape: FloatArray, some: FloatArray, turns: FloatArray, *, partial: bool, free: bool
) -> list[StartPlacement]:
    """Score a shape in many rotations, with its centroid at the centre of the scan."""
    middle, centre = shape.mean(axis=0), np.median(some, axis=0) if not partial else some.mean(axis=0)
    ratio = float(np.sqrt(some.var(axis=0).sum() / shape.var(axis=0).sum())) if free else 1.0
    # The scan is rotated instead of the shape, so one tree serves all rotations; and vice versa below.
    there = (some - centre) @ turns / ratio + middle
    to_shape = nearest_points(cKDTree(shape), there.reshape(-1, 3))[0].reshape(len(turns), -1)
    scores = _trimmed(to_shape)
    if not partial:
        back = ratio * (shape - middle) @ np.swapaxes(turns, 1, 2) + centre
        to_scan = nearest_points(cKDTree(some), back.reshape(-1, 3))[0].reshape(len(turns), -1) / ratio
        scores = scores + _trimmed(to_scan)
    return [
        StartPlacement(k, Placement(turn, centre - ratio * turn @ middle, ratio), float(score))
        for turn, score in zip(turns, scores, strict=True)
    ]


def _polished(
    start: StartPlacement, shape: FloatArray, some: FloatArray, steps: int, *, partial: bool, free: bool
) -> StartPlacement:
    placement = start.placement
    for _ in range(steps):
        apart = cdist(placement.back(some), shape)  # faster than trees for so few points
        pairs = [(shape[apart.argmin(axis=1)], some, apart.min(axis=1))]
        if not partial:
            pairs.append((shape, some[apart.argmin(axis=0)], apart.min(axis=0)))
        here, there, away = (np.concatenate([pair[i] for pair in pairs]) for i in range(3))
        close = away <= np.quantile(away, TRIMMED)
        placement = Placement.between(here[close], there[close], scaled=free)
        if not 0 < placement.scale < np.inf:
            return start
    apart = cdist(placement.back(some), shape)
    score = _trimmed(apart.min(axis=1))
    if not partial:
        score = score + _trimmed(apart.min(axis=0))
    return StartPlacement(start.shape, placement, float(score))


def _trimmed(distances: FloatArray) -> FloatArray:
    """Return the mean (…) of the smallest distances (…, n), a share TRIMMED of them."""
    count = max(1, int(TRIMMED * distances.shape[-1]))
    return np.partition(distances, count - 1, axis=-1)[..., :count].mean(axis=-1)


def _grid(count: int) -> FloatArray:
    """Return evenly spread rotations (count, 3, 3), always the same (super-Fibonacci spirals: Alexa 2022)."""
    s = np.arange(count) + 0.5
    r, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    phi, psi = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    quaternions = np.stack([r * np.sin(phi), r * np.cos(phi), outer * np.sin(psi), outer * np.cos(psi)], axis=1)
    return Rotation.from_quat(quaternions).as_matrix()


def _principal(shape: FloatArray, some: FloatArray) -> FloatArray:
    """Return the rotations (4, 3, 3) that map the shape's principal axes to the points' principal axes."""
    own, there = (np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2] for x in (shape, some))
    own[2] *= np.linalg.det(own)
    there[2] *= np.linalg.det(there)
    flips = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return np.stack([(there.T * flip) @ own for flip in flips])


def evenly(points: FloatArray, count: int, first: int = 0) -> IntArray:
    """Return indices of points (n, 3) or codes (n, m), each the farthest from all points chosen before."""
    chosen = [first]
    away = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        away = np.minimum(away, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(away.argmax()))
    return np.array(chosen)
