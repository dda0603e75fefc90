"""Placements of a model in a scan's frame, and the coarse ones from which a fit begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.scan import Scan, near

#: Share of the distances that count: the farthest may belong to a limb bent otherwise, or to something else.
TRIMMED = 0.8
#: Shapes that rotations are tried on. The others are tried at the best of them.
FIRST = 4
#: How far apart placements have to be to count as different, in radians.
DIFFERENT = 0.35


@dataclass(frozen=True)
class PlacementEffort:
    """How widely placements are looked for.

    Attributes:
        points: of the scan, that they are scored by.
        rotations: tried beside principal axes.
        kept, polished: placements, and more with other shapes, that go on to the next stage.
        steps: of closest points there.
        count: starts, at most.
    """

    points: int
    rotations: int
    kept: int
    polished: int
    steps: int
    count: int


#: What serves most scans; and what those of a part may need, since a flat shape looks alike from both sides.
NARROW = PlacementEffort(points=150, rotations=60, kept=8, polished=12, steps=6, count=5)
WIDE = PlacementEffort(points=300, rotations=240, kept=48, polished=48, steps=20, count=32)


@dataclass(frozen=True, eq=False)
class Start:
    """Where a fit may begin.

    Attributes:
        shape: index of the shape.
        placement: of it.
        score: mean of the distances that count, in the model's units.
    """

    shape: int
    placement: Placement
    score: float


def coarse(scan: Scan, shapes: FloatArray, *, partial: bool, free: bool, breadth: PlacementEffort) -> list[Start]:
    """The best placements of some shapes in a scan, each clearly different from the ones before.

    Args:
        scan: in the model's units.
        shapes: (k, n, 3) points evenly spread on shapes of a model.
        partial: whether the scan shows a part of the shape only: then nothing has to be near each of its points.
        free: whether the size may change too.
        breadth: how widely they are looked for.
    """
    some = scan.some(breadth.points).points
    turns = np.concatenate([_grid(breadth.rotations), *(_principal(shape, some) for shape in shapes[:1])])
    tried: list[Start] = []
    for k, shape in enumerate(shapes[:FIRST]):
        tried += _scored(k, shape, some, turns, partial=partial, free=free)
    kept = _different(tried, breadth.kept, DIFFERENT)
    again = np.stack([start.placement.rotation for start in kept])
    for k, shape in enumerate(shapes[FIRST:], FIRST):
        tried += _scored(k, shape, some, again, partial=partial, free=free)
    tree = cKDTree(some)
    # One of each rotation at least, so that a wrong one with the right code doesn't take all places.
    chosen = [*kept, *sorted(tried, key=lambda start: start.score)[: 2 * breadth.polished]]
    unique = list({(start.shape, id(start.placement)): start for start in chosen}.values())
    polished = [
        _polished(start, shapes[start.shape], some, tree, breadth.steps, partial=partial, free=free)
        for start in unique[: breadth.kept + breadth.polished]
    ]
    return _different(polished, breadth.count, DIFFERENT / 2)


def _different(starts: list[Start], count: int, apart: float) -> list[Start]:
    """The best of the starts, none of them the same shape in nearly the same rotation as a better one."""
    found: list[Start] = []
    for start in sorted(starts, key=lambda start: start.score):
        if all(start.placement.angle_to(other.placement) > apart for other in found):
            found.append(start)
            if len(found) == count:
                break
    return found


def _scored(
    k: int, shape: FloatArray, some: FloatArray, turns: FloatArray, *, partial: bool, free: bool
) -> list[Start]:
    """A shape in many rotations, its middle on that of the scan."""
    middle, centre = shape.mean(axis=0), np.median(some, axis=0) if not partial else some.mean(axis=0)
    ratio = float(np.sqrt(some.var(axis=0).sum() / shape.var(axis=0).sum())) if free else 1.0
    # Turning the scan instead lets one tree serve all rotations; the other way round likewise.
    there = (some - centre) @ turns / ratio + middle
    to_shape = near(cKDTree(shape), there.reshape(-1, 3))[0].reshape(len(turns), -1)
    scores = _trimmed(to_shape)
    if not partial:
        back = ratio * (shape - middle) @ np.swapaxes(turns, 1, 2) + centre
        to_scan = near(cKDTree(some), back.reshape(-1, 3))[0].reshape(len(turns), -1) / ratio
        scores = scores + _trimmed(to_scan)
    return [
        Start(k, Placement(turn, centre - ratio * turn @ middle, ratio), float(score))
        for turn, score in zip(turns, scores, strict=True)
    ]


def _polished(
    start: Start, shape: FloatArray, some: FloatArray, tree: cKDTree, steps: int, *, partial: bool, free: bool
) -> Start:
    """A few steps of closest points, for the motion alone."""
    placement, own = start.placement, cKDTree(shape)
    for _ in range(steps):
        to_shape, nearest = near(own, placement.back(some))
        pairs = [(shape[nearest], some, to_shape)]
        if not partial:
            to_scan, nearest = near(tree, placement(shape))
            pairs.append((shape, some[nearest], to_scan / placement.scale))
        here, there, away = (np.concatenate([pair[i] for pair in pairs]) for i in range(3))
        close = away <= np.quantile(away, TRIMMED)
        placement = Placement.between(here[close], there[close], scaled=free)
        if not 0 < placement.scale < np.inf:
            return start
    score = _trimmed(near(own, placement.back(some))[0])
    if not partial:
        score = score + _trimmed(near(tree, placement(shape))[0] / placement.scale)
    return Start(start.shape, placement, float(score))


def _trimmed(distances: FloatArray) -> FloatArray:
    """(…) mean of the smaller ones of (…, n)."""
    count = max(1, int(TRIMMED * distances.shape[-1]))
    return np.partition(distances, count - 1, axis=-1)[..., :count].mean(axis=-1)


def _grid(count: int) -> FloatArray:
    """(count, 3, 3) rotations all over, the same ones always (super-Fibonacci spirals: Alexa 2022)."""
    s = np.arange(count) + 0.5
    r, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    phi, psi = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    quaternions = np.stack([r * np.sin(phi), r * np.cos(phi), outer * np.sin(psi), outer * np.cos(psi)], axis=1)
    rotations: FloatArray = Rotation.from_quat(quaternions).as_matrix()
    return rotations


def _principal(shape: FloatArray, some: FloatArray) -> FloatArray:
    """(4, 3, 3) rotations that bring principal axes of a shape onto those of points, with every flip."""
    own, there = (np.linalg.svd(x - x.mean(axis=0), full_matrices=False)[2] for x in (shape, some))
    own[2] *= np.linalg.det(own)
    there[2] *= np.linalg.det(there)
    flips = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return np.stack([(there.T * flip) @ own for flip in flips])


def evenly(points: FloatArray, count: int, first: int = 0) -> IntArray:
    """Indices of points (n, 3) or codes (n, m), each the farthest from those before it."""
    chosen = [first]
    away = np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        away = np.minimum(away, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(away.argmax()))
    return np.array(chosen)
