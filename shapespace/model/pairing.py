"""Pairs of points that a scan and a model's surface have in common while a fit looks for its code."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.closest_points import MeshProximity, unit
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.scan import Scan, nearest_points

#: Cosine of the angle between the normals of a pair: below the first its weight is 0, above the second it is 1.
APART, ALIKE = 0.2, 0.6


@dataclass(frozen=True, eq=False)
class Pairs:
    """Points of the scan and of the model that stand for each other, in the model's frame.

    Attributes:
        gaps: (n, 3) from the model's points to the scan's.
        normals: (n, 3) of the model.
        distances: (n,).
        rows: (n, V) sparse, the model's points as means of its vertices.
        places: (n, 3) the model's points.
        agree: (n,) from 0 to 1, whether normals do.
        mass: (n,) what each pair stands for; those of the scan sum to 1.
        of_scan: how many of them begin at points of the scan; they come first.
        drawn: (n,) whether the pair is one of what was left over on both sides, drawn to each other from afar.
    """

    gaps: FloatArray
    normals: FloatArray
    distances: FloatArray
    rows: sparse.csr_array
    places: FloatArray
    agree: FloatArray
    mass: FloatArray
    of_scan: int
    drawn: NDArray[np.bool_]

    @property
    def heights(self) -> FloatArray:
        """(n,) of the scan's points over the model's planes."""
        return (self.gaps * self.normals).sum(axis=1)


class Pairing:
    """Looks for pairs of a scan and a surface.

    Args:
        scan: in the model's normalised units.
        count: of its points that look for the surface.
        vertices: those of the surface that look for the scan.
        both: whether they do; a scan that shows a part only says nothing of the rest.
        blended: whether the planes of pairs that begin at a vertex are the scan's, as far as it has any.
    """

    def __init__(self, scan: Scan, count: int, vertices: IntArray, *, both: bool, blended: bool) -> None:
        self.scan, self.some = scan, scan.some(count)
        self._vertices, self._both, self._blended = vertices, both, blended

    def closest(self, surface: MeshProximity, placement: Placement) -> Pairs:
        """Points of both sides and the closest ones of the other, where a placement takes the surface to the scan."""
        some = self.some
        points, normals = placement.back(some.points), some.normals @ placement.rotation
        found = surface.closest(points)
        corners = surface.fans.faces[found.faces]
        own = unit(np.einsum("nk,nkx->nx", found.shares, surface.vertex_normals[corners]))
        n, k = len(points), len(self._vertices) if self._both else 0
        rows = [(found.shares.ravel(), np.repeat(np.arange(n), 3), corners.ravel())]
        agree = self._alike(normals, own, some.trust)
        parts = [(points - found.places, own, found.distances, found.places, agree, np.full(n, 1 / n))]
        if k:
            places, across = surface.vertices[self._vertices], surface.vertex_normals[self._vertices]
            _, nearest = nearest_points(self.scan.tree, placement(places))
            gaps = placement.back(self.scan.points[nearest]) - places
            # Points of a scan are some way apart, which says nothing of how far the surface is.
            distances = self.scan.distances(placement(places)) / placement.scale
            there, trust = self.scan.normals[nearest] @ placement.rotation, self.scan.trust[nearest]
            agree = self._alike(there, across, trust)
            if self._blended:
                across = _blended(across, there, trust)
            rows.append((np.ones(k), n + np.arange(k), self._vertices))
            parts.append((gaps, across, distances, places, agree, np.full(k, 1 / k)))
        columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        gaps, across, distances, places, agree, mass = columns
        values, row, column = (np.concatenate(each) for each in zip(*rows, strict=True))
        matrix = sparse.csr_array((values, (row, column)), shape=(n + k, len(surface.vertices)))
        return Pairs(gaps, across, distances, matrix, places, agree, mass, n, np.zeros(n + k, bool))

    def drawn(self, pairs: Pairs, surface: MeshProximity, placement: Placement, most: float) -> Pairs:
        """The same pairs, but what is further away than ``most`` is paired with what of the model nothing shows.

        A limb that is folded the wrong way has both, and its own nearest points are those of other limbs.
        """
        points, vertices = placement.back(self.some.points), surface.vertices[self._vertices]
        far = np.flatnonzero(pairs.distances[: pairs.of_scan] > most)
        unseen = np.flatnonzero(self.scan.distances(placement(vertices)) / placement.scale > most)
        if not len(far) or not len(unseen):
            return pairs
        _, there = nearest_points(cKDTree(vertices[unseen]), points[far])
        replaced = [(far, self._vertices[unseen[there]], points[far])]
        if self._both:
            _, back = nearest_points(cKDTree(points[far]), vertices[unseen])
            replaced.append((pairs.of_scan + unseen, self._vertices[unseen], points[far[back]]))
        index, own, goal = (np.concatenate(each) for each in zip(*replaced, strict=True))
        rows, found = pairs.rows.tolil(), deepcopy(pairs)
        rows[index] = 0
        rows[index, own] = 1
        found.places[index], found.normals[index] = surface.vertices[own], surface.vertex_normals[own]
        found.gaps[index] = goal - found.places[index]
        found.distances[index], found.agree[index], found.drawn[index] = 0, 1, True
        return replace(found, rows=rows.tocsr())

    def _alike(self, normals: FloatArray, others: FloatArray, trust: FloatArray) -> FloatArray:
        """(n,) from 0 to 1, whether normals (n, 3) agree with those of the scan, as far as these are trusted (n,)."""
        cosines = (normals * others).sum(axis=1)
        if not self.scan.oriented:
            cosines = np.abs(cosines)
        elif cosines.sum() < 0:  # the scan's faces are turned inside out
            cosines = -cosines
        agree: FloatArray = 1 - trust * (1 - np.clip((cosines - APART) / (ALIKE - APART), 0, 1))
        return agree


def _blended(normals: FloatArray, others: FloatArray, trust: FloatArray) -> FloatArray:
    """(n, 3) normals of pairs that begin at vertices: those of the scan (n, 3) as far as these are trusted (n,).

    A vertex of a convex surface lies outside of its neighbourhood. Over the plane at the vertex its nearest scan point,
    which lies beside it, would have a negative height, and the model would shrink; over the plane at the scan point the
    vertex has none.
    """
    sides = np.sign((normals * others).sum(axis=1))
    return unit((1 - trust)[:, None] * normals + (sides * trust)[:, None] * others)
