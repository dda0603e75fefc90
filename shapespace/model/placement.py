"""Start placements of a model's shapes in a scan's frame, from which a fit begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import Placement
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.model.scan import Scan, nearest_points
from shapespace.solve.deadline import Deadline

#: Share of the distances that count. The farthest points may belong to a limb in another pose, or to something else.
TRIMMED = 0.8
#: Number of shapes that are tried in all rotations. The other shapes are tried in the best of these rotations.
FIRST = 4
#: Smallest angle between different placements, in radians.
DIFFERENT = 0.35
#: Distance of the places at which a shape begins to move to a part of it, as a fraction of the shape's size. The middle
#: of what a camera sees is up to 0.18 away from the middle of the shape; from there most searches end elsewhere.
ASIDE = 0.12


@dataclass(frozen=True)
class PlacementEffort:
    """Effort of the search for placements, and of the search for codes that begins there."""

    points: int  # number of the scan's points by which placements are scored
    rotations: int  # number of rotations beside principal axes
    kept: int  # number of placements that go on to closest-point steps
    polished: int  # additional number of these placements, with other shapes
    steps: int  # number of closest-point steps
    count: int  # maximum number of start placements
    # number of closest-point steps before placements are kept; 0 begins at the middle of the scan only
    first_steps: int = 0
    shape_points: int = 150  # number of points of a shape
    # for each round of the search for codes, the share of the placements that take part, at least two, and their steps
    rounds: tuple[tuple[float, int], ...] = ((1.0, 2), (0.5, 2), (0.0, 3))


#: Effort for most scans.
QUICK = PlacementEffort(points=150, rotations=60, kept=8, polished=6, steps=5, count=4)
#: Effort where the best fit is poor: for whole scans, and for scans of a part. Only many points of a shape tell its
#: front from its back, or one finger from another.
MORE = PlacementEffort(
    points=300,
    rotations=120,
    kept=24,
    polished=48,
    steps=8,
    count=16,
    shape_points=1000,
    rounds=((1.0, 3), (0.5, 3), (0.25, 6)),
)
THOROUGH = replace(MORE, points=150, rotations=100, kept=48, steps=15, count=24, first_steps=4)


@dataclass(frozen=True, eq=False)
class StartPlacement:
    """Placement at which a fit may begin."""

    shape: int  # index of the shape
    placement: Placement  # placement of the shape in the scan's frame
    score: float  # mean of the distances that count, in the model's units


class _Placements(NamedTuple):
    """Several placements of one shape."""

    rotations: FloatArray  # (n, 3, 3)
    translations: FloatArray  # (n, 3)
    scales: FloatArray  # (n,)

    @classmethod
    def of(cls, placements: Sequence[Placement]) -> _Placements:
        """Collect placements."""
        return cls(
            np.stack([each.rotation for each in placements]),
            np.stack([each.translation for each in placements]),
            np.array([each.scale for each in placements]),
        )

    def there(self, points: FloatArray) -> FloatArray:
        """Map points (k, 3) of the shape to the scan's frame (n, k, 3)."""
        return self.scales[:, None, None] * points @ np.swapaxes(self.rotations, 1, 2) + self.translations[:, None]

    def back(self, points: FloatArray) -> FloatArray:
        """Map points (k, 3) of the scan to the shape's frame (n, k, 3)."""
        return (points - self.translations[:, None]) @ self.rotations / self.scales[:, None, None]

    def or_between(
        self, points: FloatArray, there: FloatArray, used: NDArray[np.bool_], *, scaled: bool
    ) -> _Placements:
        """Return ``Placement.between`` of the used ones of points and their positions (n, k, 3).

        Where the scale is no positive number, the placement stays.
        """
        share = used / used.sum(axis=1, keepdims=True)
        middle, centre = (np.einsum("nk,nkx->nx", share, each) for each in (points, there))
        x = points - middle[:, None]
        weighted = np.swapaxes(share[..., None] * x, 1, 2)
        u, s, vt = np.linalg.svd(weighted @ (there - centre[:, None]))
        s[:, 2] *= (sign := np.sign(np.linalg.det(u @ vt)))
        u[:, :, 2] *= sign[:, None]
        rotations = np.swapaxes(u @ vt, 1, 2)
        scales = np.ones(len(s))
        if scaled:
            spread = np.einsum("nxk,nkx->n", weighted, x)
            scales = s.sum(axis=1) / np.maximum(spread, np.finfo(float).tiny)
        found = rotations, centre - scales[:, None] * np.einsum("nxy,ny->nx", rotations, middle), scales
        valid = (scales > 0) & np.isfinite(scales)
        return _Placements(*(
            np.where(valid.reshape(-1, *[1] * (each.ndim - 1)), each, old)
            for each, old in zip(found, self, strict=True)
        ))  # fmt: skip


def start_placements(
    scan: Scan,
    shapes: FloatArray,
    *,
    partial: bool,
    free: bool,
    effort: PlacementEffort,
    deadline: Deadline | None = None,
) -> list[StartPlacement]:
    """Find the best placements of shapes in a scan, each clearly different from the better ones.

    The k shapes are evenly spread points (k, n, 3) in the units of the scan. If ``partial``, points of a shape may be
    far from the scan. If ``free``, the size may change too. After the deadline, the best placements so far are
    returned.
    """

    def late() -> bool:
        return deadline is not None and deadline.passed

    some = scan.some(effort.points).points
    turns = np.concatenate([_grid(effort.rotations), *(_principal(shape, some) for shape in shapes[:1])])
    centre = np.median(some, axis=0) if not partial else some.mean(axis=0)
    places = centre[None]
    aside = 0.0
    if effort.first_steps:
        aside = ASIDE * float(diagonal(shapes[0]))
        axes = aside * np.linalg.svd(some - some.mean(axis=0), full_matrices=False)[2]
        places = np.concatenate([places, centre + axes, centre - axes])
    middles = shapes.mean(axis=1)
    tried: list[StartPlacement] = []

    def search(k: int, rotations: FloatArray, places: FloatArray, steps: int) -> None:
        begun = _at(shapes[k], some, rotations, places, free=free)
        tried.extend(_searched(k, shapes[k], some, begun, steps, partial=partial, free=free))

    for k in range(min(FIRST, len(shapes))):
        if k and late():
            break
        search(k, np.repeat(turns, len(places), axis=0), np.tile(places, (len(turns), 1)), effort.first_steps)
    kept = _different(tried, middles, effort.kept, DIFFERENT, aside)
    again = np.stack([start.placement.rotation for start in kept])
    there = np.stack([start.placement(middles[start.shape]) for start in kept])
    for k in range(FIRST, len(shapes)):
        if late():
            break
        search(k, again, there, 0)
    # At least one placement of each rotation, so that a wrong rotation with the right code doesn't take all places.
    chosen = [*kept, *sorted(tried, key=lambda start: start.score)[: 2 * effort.polished]]
    unique = list({id(start): start for start in chosen}.values())[: effort.kept + effort.polished]
    polished: list[StartPlacement] = []
    for k in sorted({start.shape for start in unique}):
        begun = _Placements.of([start.placement for start in unique if start.shape == k])
        steps = 0 if late() else effort.steps
        polished += _searched(k, shapes[k], some, begun, steps, partial=partial, free=free)
    return _different(polished, middles, effort.count, DIFFERENT / 2, aside / 2)


def _different(
    starts: list[StartPlacement], middles: FloatArray, count: int, apart: float, aside: float
) -> list[StartPlacement]:
    """Return the best placements, without those like a better one: at most ``apart`` radians and ``aside`` away.

    ``middles`` (k, 3) are the middles of the shapes. Without ``aside``, the angle alone decides.
    """
    ordered = sorted(starts, key=lambda start: start.score)
    turns = np.stack([start.placement.rotation.ravel() for start in ordered])
    there = np.stack([start.placement(middles[start.shape]) for start in ordered])
    found: list[StartPlacement] = []
    left = np.ones(len(ordered), bool)
    while len(found) < count and left.any():
        k = int(left.argmax())
        found.append(ordered[k])
        like = np.arccos(np.clip((turns @ turns[k] - 1) / 2, -1, 1)) <= apart
        if aside:
            like &= np.linalg.norm(there - there[k], axis=1) <= aside
        like[k] = True
        left &= ~like
    return found


def _at(shape: FloatArray, some: FloatArray, rotations: FloatArray, places: FloatArray, *, free: bool) -> _Placements:
    """Return placements with rotations (n, 3, 3) that bring the middle of a shape to places (n, 3)."""
    ratio = float(np.sqrt(some.var(axis=0).sum() / shape.var(axis=0).sum())) if free else 1.0
    return _Placements(rotations, places - ratio * rotations @ shape.mean(axis=0), np.full(len(places), ratio))


def _searched(
    k: int, shape: FloatArray, some: FloatArray, placements: _Placements, steps: int, *, partial: bool, free: bool
) -> list[StartPlacement]:
    """Move a shape by steps to the closest points, from several placements at once, and score where it ends."""
    tree, tree_of_scan = cKDTree(shape), None if partial else cKDTree(some)
    for left in range(steps, -1, -1):
        away, own = nearest_points(tree, placements.back(some))
        scores = _trimmed(away)
        if tree_of_scan is not None:
            to_scan, other = nearest_points(tree_of_scan, placements.there(shape))
            to_scan /= placements.scales[:, None]
            scores = scores + _trimmed(to_scan)
        if not left:
            break
        here, there = shape[own], np.broadcast_to(some, (*own.shape, 3))
        if tree_of_scan is not None:
            here = np.concatenate([here, np.broadcast_to(shape, (*other.shape, 3))], axis=1)
            there, away = np.concatenate([there, some[other]], axis=1), np.concatenate([away, to_scan], axis=1)
        close = away <= np.quantile(away, TRIMMED, axis=1, keepdims=True)
        placements = placements.or_between(here, there, close, scaled=free)
    return [
        StartPlacement(k, Placement(turn, shift, float(scale)), float(score))
        for turn, shift, scale, score in zip(*placements, scores, strict=True)
    ]


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
