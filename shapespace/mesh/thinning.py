"""Thinning a large mesh before it is coarsened with care: many half-edge collapses at once, in arrays.

One collapse after the other, each checked in every shape, takes as long as it has to for the last few thousand vertices
and far too long for the first hundred thousand, which lie so close together that hardly any choice among them matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.quadrics import monomials, quadrics_of
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.mesh.triangle_quality import FOLD_LIMIT, normals_and_sides, squared_sines
from shapespace.mesh.vectors import dots, unit

#: Smallest angles (degrees) that a collapse may leave, unless there was a smaller one around: the first limit holds
#: until a round removes less than this share of the vertices, then the next.
ANGLE_LIMITS, SLOW = (10.0, 5.0, 2.5), 0.01
#: Largest turn of a face's normal.
TURN = np.cos(np.deg2rad(45))
#: Weight of a vertex's motion relative to the plane errors of its faces: it keeps triangles uniform.
MOTION_WEIGHT = 0.1
#: In each round the cheapest of the candidate collapses are made: this share of them.
CHEAPEST = 0.5
#: How often further vertices are chosen, far from those already chosen.
SWEEPS = 3
#: Faces, or collapses, looked at together.
CHUNK = 50_000
#: Thinning ends after VAIN rounds that each remove less than the share FEWEST of the vertices.
FEWEST, VAIN = 0.001, 5


def thin(connectivity: Connectivity, shapes: FloatArray, target: int) -> tuple[IntArray, IntArray]:
    """Collapse edges until about ``target`` vertices are left, or until hardly any edge can be collapsed.

    In each round vertices far enough from each other are drawn at random, so that no collapse changes the faces that
    another looks at; those are collapsed whose quadrics, of all shapes, say that it costs least (Garland and Heckbert
    1997). To take the vertices that cost less than all around them instead would give too few of them.

    Args:
        connectivity: F faces on V vertices.
        shapes: (n, V, 3) a few shapes of similar size, which a collapse must neither fold nor flatten.
        target: number of vertices.

    Returns:
        Which vertices are left (V'), increasing, and the faces (F', 3) between them.
    """
    points = np.ascontiguousarray(np.moveaxis(shapes - shapes.mean(axis=1, keepdims=True), 0, 1))
    quadrics, areas = quadrics_of(connectivity, np.moveaxis(points, 1, 0))
    faces, kept, vain = connectivity.faces, np.arange(connectivity.vertex_count), 0
    rng, sines = np.random.default_rng(0), np.sin(np.deg2rad(ANGLE_LIMITS)).tolist()
    while len(kept) > target and vain < VAIN:
        collapses = _collapses(_Round(faces, points), quadrics, areas, len(kept) - target, sines[0], rng)
        vain += len(collapses) < FEWEST * len(kept)
        if len(collapses) < SLOW * len(kept) and len(sines) > 1:
            sines, vain = sines[1:], 0
        u, v = collapses.T
        goes = np.arange(len(kept))
        goes[u] = v
        faces = goes[faces]
        faces = faces[_proper(faces)]
        np.add.at(quadrics, v, quadrics[u])
        np.add.at(areas, v, areas[u])
        some = np.ones(len(kept), dtype=bool)
        some[u] = False
        faces, kept = (np.cumsum(some) - 1)[faces], kept[some]
        points, quadrics, areas = points[some], quadrics[some], areas[some]
    return kept, faces


class _Round:
    """The mesh at the beginning of a round: its faces, and who is next to whom.

    Attributes:
        sides: (V, V) of each half-edge the number of its face, from 1.
        neighbours: (V, V) number of faces at each edge.
    """

    def __init__(self, faces: IntArray, points: FloatArray) -> None:
        self.faces, self.points, self.count = faces, points, len(points)
        tails, heads = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
        numbers = np.tile(np.arange(1, len(faces) + 1), 3)
        shape = (self.count, self.count)
        self.sides = sparse.csr_array((numbers, (tails, heads)), shape=shape)
        half = sparse.csr_array((np.ones(len(tails), np.int32), (tails, heads)), shape=shape)
        self.neighbours = sparse.csr_array(half + half.T)
        degree = np.diff(self.neighbours.indptr)
        self.valence = np.bincount(faces.ravel(), minlength=self.count)
        self.rim = np.zeros(self.count, dtype=bool)
        self.rim[np.repeat(np.arange(self.count), degree)[self.neighbours.data == 1]] = True
        # Where sheets touch, a vertex has more edges than its one fan of faces needs.
        self.touching = degree != self.valence + self.rim
        corners = (np.ones(3 * len(faces), bool), faces.ravel(), np.arange(3 * len(faces) + 1))
        # The faces around each vertex, one vertex after the other: a counting sort.
        self._around = sparse.csr_array(corners, shape=(3 * len(faces), self.count)).tocsc().indices // 3
        self._starts = np.cumsum(self.valence) - self.valence

    def apart(self, rng: np.random.Generator) -> IntArray:
        """Vertices (k,) that may go, more than two edges from each other."""
        rank = rng.permutation(self.count)
        rank[self.touching] = self.count
        chosen = np.zeros(self.count, dtype=bool)
        for _ in range(SWEEPS):
            lowest = rank
            for _ in range(2):
                # Every vertex has a face.
                of_face = np.minimum.reduce([lowest[corner] for corner in self.faces.T])
                lowest = np.minimum.reduceat(of_face[self._around], self._starts)
            wins = (lowest == rank) & (rank >= 0) & ~self.touching
            chosen |= wins
            rank[wins] = -1  # nothing near these can win any more
        return np.flatnonzero(chosen)

    def half_edges(self, tails: IntArray) -> IntArray:
        """Half-edges (k, 2) from some vertices whose collapse keeps the topology (link condition, Dey et al. 1999)."""
        rows = self.neighbours[tails]
        u, v = np.repeat(tails, np.diff(rows.indptr)), rows.indices
        others = sparse.csr_array(self.neighbours[u].multiply(self.neighbours[v]))
        inner = rows.data == 2
        common = np.diff(others.indptr)
        few = self.valence <= np.where(self.rim, 1, 3)
        allowed = (common == np.where(inner, 2, 1)) & (others @ few == 0) & ~(self.rim[u] & inner)
        pairs: IntArray = np.stack([u, v], axis=1)[allowed].astype(np.int64)
        return pairs

    def stars(self, vertices: IntArray) -> tuple[IntArray, IntArray]:
        """The faces around some vertices, and for each face which of these it is around."""
        counts = self.valence[vertices]
        which = np.repeat(np.arange(len(vertices)), counts)
        offset = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        return self._around[self._starts[vertices][which] + offset], which


def _proper(faces: IntArray) -> NDArray[np.bool_]:
    """Which faces have three different corners."""
    a, b, c = faces.T
    proper: NDArray[np.bool_] = (a != b) & (b != c) & (c != a)
    return proper


def _collapses(
    mesh: _Round, quadrics: FloatArray, areas: FloatArray, most: int, sine: float, rng: np.random.Generator
) -> IntArray:
    """Half-edges (k, 2), u → v, that can be collapsed all at once, ``most`` at most."""
    pairs = mesh.half_edges(mesh.apart(rng))
    if not len(pairs):
        return pairs
    u, v = pairs.T
    costs = np.concatenate([_costs(mesh.points, quadrics, areas, some) for some in _chunks(pairs)])
    # The cheapest half-edge of each vertex, and of these the cheaper ones.
    order = np.lexsort((costs, u))
    first = order[np.flatnonzero(np.diff(u[order], prepend=-1))]
    first = first[np.argsort(costs[first], kind="stable")][: max(1, int(CHEAPEST * len(first)))]
    pairs = np.stack([u[first], v[first]], axis=1)
    pairs = pairs[_keep_shape(mesh, pairs, sine)][:most]
    return _without_folds(mesh, pairs)


def _costs(points: FloatArray, quadrics: FloatArray, areas: FloatArray, pairs: IntArray) -> FloatArray:
    """What collapses (k, 2) cost."""
    u, v = pairs.T
    costs: FloatArray = dots(quadrics[u] + quadrics[v], monomials(points[v]))
    costs += MOTION_WEIGHT * areas[u] * ((points[u] - points[v]) ** 2).sum(axis=(1, 2))
    return costs


def _chunks(pairs: IntArray) -> list[IntArray]:
    """Some at a time: what is computed of all of them in all shapes takes much memory."""
    return np.array_split(pairs, -(-len(pairs) // CHUNK))


def _keep_shape(mesh: _Round, pairs: IntArray, sine: float) -> NDArray[np.bool_]:
    """Which collapses (k, 2) leave no angle below ``sine`` and turn no face much, in any shape."""
    u, v = pairs.T
    star, which = mesh.stars(u)
    old = mesh.faces[star]
    new = np.where(old == u[which][:, None], v[which][:, None], old)
    stays = _proper(new)
    which, old, new = which[stays], old[stays], new[stays]
    good = np.ones(len(pairs), dtype=bool)
    # Some at a time: corners of all faces in all shapes take much memory.
    for start in range(0, len(which), CHUNK):
        part = slice(start, start + CHUNK)
        before, was = normals_and_sides(mesh.points[old[part].T])
        after, becomes = normals_and_sides(mesh.points[new[part].T])
        floor = np.minimum(sine**2, squared_sines(before, was))
        bad = (squared_sines(after, becomes) < floor) | (dots(unit(before), unit(after)) < TURN)
        good[which[part][bad.any(axis=1)]] = False
    return good


def _without_folds(mesh: _Round, pairs: IntArray) -> IntArray:
    """Leave out collapses that would fold neighbouring faces onto each other, in any shape."""
    while len(pairs):
        star, _ = mesh.stars(pairs[:, 0])
        corners = mesh.faces[star]
        across = mesh.sides[np.roll(corners, -1, axis=1).ravel(), corners.ravel()]
        near = np.union1d(star, np.asarray(across).ravel() - 1)
        near = near[near >= 0]
        goes, by = np.arange(mesh.count), np.full(mesh.count, -1)
        goes[pairs[:, 0]], by[pairs[:, 0]] = pairs[:, 1], np.arange(len(pairs))
        # A face has one corner that goes, at most.
        cause, faces = by[mesh.faces[near]].max(axis=1), goes[mesh.faces[near]]
        proper = _proper(faces)
        cause, faces = cause[proper], faces[proper]
        used, local = np.unique(faces, return_inverse=True)
        after = Connectivity(local.reshape(-1, 3), len(used))
        left, right = after.edge_faces[after.interior].T
        normals = unit(normals_and_sides(mesh.points[faces.T])[0])
        folded = (dots(normals[left], normals[right]) < FOLD_LIMIT).any(axis=1)
        out = np.unique(np.concatenate([cause[left[folded]], cause[right[folded]]]))
        out = out[out >= 0]
        if not len(out):
            break
        pairs = np.delete(pairs, out, axis=0)
    return pairs
