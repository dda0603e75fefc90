"""Pairs of corresponding points of a scan and a model's surface, for the steps of a fit."""

from copy import deepcopy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.closest_points import MeshProximity
from shapespace.mesh.rigid_motion import Placement
from shapespace.mesh.vectors import unit
from shapespace.model.scan import Scan, nearest_points

#: Cosines of the angle between the normals of a pair: its weight is 0 below the first value and 1 above the second.
APART, ALIKE = 0.2, 0.6


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs of points of the scan and of the model, in the model's frame."""

    gaps: FloatArray  # (n, 3) vectors from the model's points to the scan's points
    normals: FloatArray  # (n, 3) normals of the model
    distances: FloatArray  # (n,) distances of the points
    corners: IntArray  # (n, 3) vertices of the model
    barycentric: FloatArray  # (n, 3) weights of these vertices in the model's points
    places: FloatArray  # (n, 3) points of the model
    agree: FloatArray  # (n,) agreement of the normals, from 0 to 1
    mass: FloatArray  # (n,) share of the surface that each pair represents; pairs from the scan sum to 1
    of_scan: int  # number of pairs that begin at points of the scan; they come first
    drawn: NDArray[np.bool_]  # (n,) whether a pair joins unmatched parts of both sides

    @property
    def heights(self) -> FloatArray:
        """Signed distance (n,) of the scan's points from the model's tangent planes."""
        return (self.gaps * self.normals).sum(axis=1)

    def carried(self, fields: FloatArray) -> FloatArray:
        """Return the model's points (n, 3, f) in vertex fields (V, 3, f)."""
        flat, count = fields.reshape(len(fields), -1), len(self.corners)
        starts = np.arange(0, 3 * count + 1, 3)
        rows = sparse.csr_array((self.barycentric.ravel(), self.corners.ravel(), starts), (count, len(flat)))
        return np.asarray(rows @ flat).reshape(count, *fields.shape[1:])


class Pairing:
    """Finds pairs of a scan and a surface.

    Some points of the scan, ``count``, look for the surface. If ``both``, the vertices given look for the scan too.
    If the scan shows only a part, the other vertices have no partner. If ``blended``, pairs that begin at a
    vertex use the scan's planes where the scan has planes.
    """

    def __init__(self, scan: Scan, count: int, vertices: IntArray, *, both: bool, blended: bool) -> None:
        self.scan, self.some = scan, scan.some(count)
        self._vertices, self._both, self._blended = vertices, both, blended

    def closest(self, surface: MeshProximity, placement: Placement) -> Pairs:
        """Pair the points of each side with the closest points of the other side, at a placement of the surface."""
        some = self.some
        points, normals = placement.back(some.points), some.normals @ placement.rotation
        found = surface.closest(points)
        corners = surface.vertex_faces.faces[found.faces]
        own = unit(np.einsum("nk,nkx->nx", found.barycentric, surface.vertex_normals[corners]))
        n, k = len(points), len(self._vertices) if self._both else 0
        agree, mass = self._alike(normals, own, some.trust), np.full(n, 1 / n)
        gaps = points - found.places
        parts = [(gaps, own, found.distances, corners, found.barycentric, found.places, agree, mass)]
        if k:
            places, across = surface.vertices[self._vertices], surface.vertex_normals[self._vertices]
            # Gaps to the nearest scan point include the points' spacing, so distances are measured from the planes.
            distances, nearest = self.scan.nearest(placement(places))
            gaps = placement.back(self.scan.points[nearest]) - places
            there, trust = self.scan.normals[nearest] @ placement.rotation, self.scan.trust[nearest]
            agree = self._alike(there, across, trust)
            if self._blended:
                across = _blended(across, there, trust)
            corners, weights = np.repeat(self._vertices[:, None], 3, axis=1), np.tile([1.0, 0.0, 0.0], (k, 1))
            distances, mass = distances / placement.scale, np.full(k, 1 / k)
            parts.append((gaps, across, distances, corners, weights, places, agree, mass))
        columns = (np.concatenate(column) for column in zip(*parts, strict=True))
        gaps, across, distances, corners, weights, places, agree, mass = columns
        return Pairs(
            gaps, across, distances, corners, weights, places, agree, mass, of_scan=n, drawn=np.zeros(n + k, bool)
        )

    def drawn(self, pairs: Pairs, surface: MeshProximity, placement: Placement, most: float) -> Pairs:
        """Pair scan points farther away than ``most`` with parts of the model that the scan does not show.

        A limb in the wrong pose causes both, and its nearest points belong to other limbs.
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
        found = deepcopy(pairs)
        found.corners[index], found.barycentric[index] = own[:, None], [1.0, 0.0, 0.0]
        found.places[index], found.normals[index] = surface.vertices[own], surface.vertex_normals[own]
        found.gaps[index] = goal - found.places[index]
        found.distances[index], found.agree[index], found.drawn[index] = 0, 1, True
        return found

    def _alike(self, normals: FloatArray, others: FloatArray, trust: FloatArray) -> FloatArray:
        """Return the agreement (n,) of model and scan normals (n, 3), from 0 to 1, weighted by the scan's ``trust``."""
        cosines = (normals * others).sum(axis=1)
        if not self.scan.oriented:
            cosines = np.abs(cosines)
        elif cosines.sum() < 0:  # the scan's faces point inwards
            cosines = -cosines
        return 1 - trust * (1 - np.clip((cosines - APART) / (ALIKE - APART), 0, 1))


def _blended(normals: FloatArray, others: FloatArray, trust: FloatArray) -> FloatArray:
    """Return normals (n, 3) of pairs that begin at vertices: the scan's normals, weighted by ``trust`` (n,).

    On a convex surface, the nearest scan point lies beside the vertex and below its tangent plane. The negative height
    would shrink the model. Above the plane at the scan point, the vertex has no height.
    """
    sides = np.sign((normals * others).sum(axis=1))
    return unit((1 - trust)[:, None] * normals + (sides * trust)[:, None] * others)
