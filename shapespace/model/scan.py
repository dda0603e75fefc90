"""Scans: points or triangles, reduced to a few thousand points with normals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import face_normals

#: Maximum number of points that represent a scan, and of points from which local planes are computed.
MOST, PLANES = 3000, 10_000
#: Least number of points of a scan, and number of neighbours that determine a point's local plane.
FEWEST, NEIGHBOURS = 10, 16
#: Neighbours have no plane if the ratio of their smallest to their middle moment exceeds the inverse of this number.
CLOUDY = 4
#: Number of points from which the correlation of residuals is computed.
CORRELATED = 600
#: A scan whose thickness is less than this share of its extent lies in a plane.
FLAT = 1e-6
#: Points farther from the median than this multiple of the median distance are strays.
FAR = 50


class InvalidScanError(ValueError):
    """A scan or an option that can't be used; the message says what to do."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Points and normals that represent a scan."""

    points: FloatArray  # (n, 3) evenly spread points in the scan's units, at most MOST
    normals: FloatArray  # (n, 3) unit normals
    trust: FloatArray  # (n,) weight of each normal, from 0 to 1; 0 where the neighbours form no plane
    oriented: bool  # whether normals point outwards; normals of local planes may point either way
    given: int  # number of points or vertices of the original scan
    sampled: bool  # whether ``points`` differ from the original points

    @property
    def size(self) -> float:
        """Root mean square distance of the points from their median, without the farthest tenth."""
        away = np.linalg.norm(self.points - np.median(self.points, axis=0), axis=1)
        return float(np.sqrt((np.sort(away)[: max(1, int(0.9 * len(away)))] ** 2).mean()))

    @property
    def replaced(self) -> str:
        """A sentence on the points that represent the original points or, if there are fewer, the original faces."""
        whose = f"Of {self.given} points," if len(self.points) <= self.given else f"In place of {self.given} vertices,"
        return f"{whose} {len(self.points)} points spread evenly over the scan were used."

    def some(self, count: int) -> Scan:
        """Return the first ``count`` points; their order is random."""
        return replace(self, points=self.points[:count], normals=self.normals[:count], trust=self.trust[:count])

    @cached_property
    def tree(self) -> cKDTree:
        """Tree of the points."""
        return cKDTree(self.points)

    @cached_property
    def gaps(self) -> FloatArray:
        """Distance (n,) of each point from its sixth neighbour."""
        away, _ = nearest_points(self.tree, self.points, min(7, len(self.points)))
        return away[:, -1]

    def distances(self, places: FloatArray) -> FloatArray:
        """Return distances (n,) of places (n, 3) from the surface that the points represent."""
        return self.nearest(places)[0]

    def nearest(self, places: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return distances (n,) of places (n, 3) from the surface that the points represent, and the nearest points.

        Near a point this is the distance from the point's plane, elsewhere the distance from the point.
        """
        away, nearest = nearest_points(self.tree, places)
        above = np.abs(((places - self.points[nearest]) * self.normals[nearest]).sum(axis=1))
        beside = np.sqrt(np.maximum(away**2 - above**2, 0))
        return np.where(beside <= self.gaps[nearest], above, away), nearest


def nearest_points(tree: cKDTree, places: FloatArray, count: int = 1) -> tuple[FloatArray, IntArray]:
    """Return distances and indices of a tree's nearest points to places (…, 3): (…), or (…, count) for several."""
    away, index = tree.query(places, k=count)
    return np.asarray(away), np.asarray(index)


def neighbours(points: FloatArray) -> IntArray:
    """Return the neighbours (c, k) of some points of a scan (n, 3), the nearest first."""
    # The order of points is random, so the first ones represent all.
    _, found = nearest_points(cKDTree(points), points[:CORRELATED], min(len(points) // 4, 200))
    return found[:, 1:]


def independent_points(beside: IntArray, residuals: FloatArray, weights: FloatArray) -> float:
    """Return the share of residuals (n,) that count as independent observations.

    The share is ``1 / (1 + Σ ρ_k)``, with ρ_k the correlation of residuals of k-th neighbours, up to the k where it
    falls below 5 %. ``beside`` (c, k) has the neighbours of the first points.
    """
    used = weights > 0.25
    if used.sum() < 50:
        return 1.0
    residuals = np.where(used, np.clip(residuals, *(np.quantile(residuals[used], [0.01, 0.99]))), 0)
    first = slice(len(beside))
    pairs = np.maximum((used[first, None] & used[beside]).sum(axis=0), 1)
    products = (residuals[first, None] * residuals[beside]).sum(axis=0) / pairs / (residuals[used] ** 2).mean()
    # Moving averages, because single neighbours are noisy.
    smooth = np.convolve(products, np.ones(5) / 5, mode="valid")
    below = np.flatnonzero(smooth < 0.05)
    end = int(below[0]) if len(below) else len(smooth)
    return float(1 / (1 + max(0.0, smooth[:end].sum())))


def scan_of(points: FloatArray, faces: IntArray, rng: np.random.Generator) -> Scan:
    """Check a scan and sample it. Points are (N, 3), faces (F, 3), and F may be 0. Faces without area are left out.
    Raises InvalidScanError if there are fewer than ten points, a point is not finite, all points lie in a plane or at
    one place, or indices of faces are out of range.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise InvalidScanError(f"A scan must be points (N, 3), not {points.shape}. Give x, y and z of each.")
    if len(points) < FEWEST:
        raise InvalidScanError(f"The scan has {len(points)} points. Give at least {FEWEST}, better a few thousand.")
    bad = np.flatnonzero(~(np.abs(points) < np.finfo(np.float32).max).all(axis=1))
    if len(bad):
        raise InvalidScanError(f"Point {bad[0]} has a coordinate that is not a finite number. Give finite positions.")
    if len(faces) and (faces.min() < 0 or faces.max() >= len(points)):
        raise InvalidScanError(
            f"The faces name points {faces.min()} to {faces.max()}, but there are {len(points)}, counted from 0."
        )
    if not np.ptp(points, axis=0).any():
        raise InvalidScanError("All points of the scan are the same. Give points from all over the surface.")
    if not np.ptp(points, axis=0).max() > np.finfo(np.float32).tiny:
        raise InvalidScanError("The scan is too small for its numbers. Give it in smaller units, such as millimetres.")
    # Strays may lie anywhere. Neither flatness nor the spacing of samples may depend on strays.
    away = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    if not np.median(away) > 0:
        raise InvalidScanError("More than half of the points lie at one place. Give each point once.")
    kept = away <= FAR * np.median(away)
    faces = faces[kept[faces].all(axis=1)]
    spread = np.linalg.svd(_thinned(points[kept] - points[kept].mean(axis=0), rng), compute_uv=False)
    if not spread[2] > FLAT * spread[0]:
        raise InvalidScanError(
            "All points of the scan lie in a plane, so they don't determine a shape. Give points from all of the "
            "surface."
        )
    twice_areas = np.linalg.norm(face_normals(points, faces, normalised=False), axis=1)
    # A scan with faces at few of its points counts as a point cloud.
    if twice_areas.sum() > 0 and 2 * len(np.unique(faces)) >= kept.sum():
        return _of_surface(points, faces, twice_areas, rng)
    return _of_points(points[kept], rng)


def _of_surface(points: FloatArray, faces: IntArray, weights: FloatArray, rng: np.random.Generator) -> Scan:
    """Return random points on the faces, each with the normal of its face."""
    # Three times too many points, which are then thinned to evenly spread points.
    chosen = rng.choice(len(faces), 3 * MOST, p=weights / weights.sum())
    shares = rng.dirichlet(np.ones(3), len(chosen))
    there = np.einsum("nk,nkx->nx", shares, points[faces[chosen]])
    kept = rng.permutation(_evenly(there, MOST))
    normals = face_normals(points, faces[chosen[kept]])
    return Scan(there[kept], normals, np.ones(len(kept)), True, len(points), True)


def _of_points(points: FloatArray, rng: np.random.Generator) -> Scan:
    """Return the points, or some of them, with normals of the planes through their neighbours."""
    some = _thinned(points, rng)
    kept = rng.permutation(_evenly(some, MOST))
    _, beside = nearest_points(cKDTree(some), some[kept], min(NEIGHBOURS, len(some)))
    around = some[beside] - some[beside].mean(axis=1, keepdims=True)
    moments, axes = np.linalg.eigh(np.swapaxes(around, 1, 2) @ around)
    trust = np.clip(1 - CLOUDY * moments[:, 0] / np.maximum(moments[:, 1], np.finfo(float).tiny), 0, 1)
    return Scan(some[kept], axes[:, :, 0], trust, False, len(points), len(kept) < len(points))


def _thinned(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    return points if len(points) <= PLANES else points[rng.choice(len(points), PLANES, replace=False)]


def _evenly(points: FloatArray, most: int) -> IntArray:
    """Return at most ``most`` indices of points (n, 3), one from each cell of the finest such grid."""
    if len(points) <= most:
        return np.arange(len(points))
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    coarse, fine, found = 1.0, 4096.0, np.arange(1)
    # Bisection of the number of cells along an edge.
    while fine - coarse > 0.02 * coarse:
        cells = np.sqrt(coarse * fine)
        index = ((points - low) * (cells / extent)).astype(np.int64)
        key = (index[:, 0] * 8192 + index[:, 1]) * 8192 + index[:, 2]
        first = np.unique(key, return_index=True)[1]
        if len(first) <= most:
            coarse, found = cells, first
        else:
            fine = cells
    return found
