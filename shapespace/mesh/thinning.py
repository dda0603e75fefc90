"""Thinning of a large mesh before its decimation: many half-edge collapses at once, in arrays.

Decimation makes one collapse after the other, each checked in every shape. For the first hundred thousand vertices this
takes far too long. They are so close together that the choice among them matters little.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.quadrics import monomials, quadrics_of
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.mesh.triangle_quality import FOLD_LIMIT, normals_and_sides, squared_sines
from shapespace.mesh.vectors import dots, unit

#: Smallest angles (degrees) that a collapse may leave, unless there was a smaller one around. The next limit replaces
#: the present one after a round that removes less than the share SLOW of the vertices.
ANGLE_LIMITS, SLOW = (10.0, 5.0, 2.5), 0.01
#: Cosine of the largest rotation of a face's normal in one collapse.
TURN_LIMIT = np.cos(np.deg2rad(45))
#: Weight of a vertex's motion relative to the plane errors of its faces. It keeps triangles uniform.
MOTION_WEIGHT = 0.1
#: Share of the candidate collapses that is made in each round, the cheapest first.
CHEAPEST = 0.5
#: Number of times that further candidates are chosen at a distance from the chosen ones.
SWEEPS = 3
#: Number of faces, or collapses, that are checked together.
CHUNK = 50_000
#: Thinning ends after VAIN rounds that each remove less than the share FEWEST of the vertices.
FEWEST, VAIN = 0.001, 5


def thin(connectivity: Connectivity, shapes: FloatArray, target: int) -> tuple[IntArray, IntArray]:
    """Collapse edges until about ``target`` vertices are left, or until few edges can be collapsed.

    Each round draws random vertices far enough from each other: no collapse changes the faces that another collapse
    checks. The cheapest collapses are made, by the quadrics of all shapes (Garland and Heckbert 1997). Choosing
    vertices that cost less than all their neighbours instead would find too few.

    A collapse may neither fold nor flatten any of the shapes (n, V, 3), which are a few of similar size. Returns the
    remaining vertices (V'), increasing, and the faces (F', 3) between them.
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
    """The mesh at the beginning of a round: its faces and adjacency."""

    def __init__(self, faces: IntArray, points: FloatArray) -> None:
        self.faces, self.points, self.count = faces, points, len(points)
        tails, heads = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
        numbers = np.tile(np.arange(1, len(faces) + 1), 3)
        shape = (self.count, self.count)
        # (V, V) matrices: the index of the face of each half-edge, from 1, and the number of faces at each edge.
        self.sides = sparse.csr_array((numbers, (tails, heads)), shape=shape)
        half = sparse.csr_array((np.ones(len(tails), np.int32), (tails, heads)), shape=shape)
        self.neighbours = sparse.csr_array(half + half.T)
        degree = np.diff(self.neighbours.indptr)
        self.valence = np.bincount(faces.ravel(), minlength=self.count)
        self.rim = np.zeros(self.count, dtype=bool)
        self.rim[np.repeat(np.arange(self.count), degree)[self.neighbours.data == 1]] = True
        # Where two sheets touch, a vertex has more edges than a single fan of faces needs.
        self.touching = degree != self.valence + self.rim
        corners = (np.ones(3 * len(faces), bool), faces.ravel(), np.arange(3 * len(faces) + 1))
        # Faces around each vertex, sorted by vertex: a counting sort.
        self._around = sparse.csr_array(corners, shape=(3 * len(faces), self.count)).tocsc().indices // 3
        self._starts = np.cumsum(self.valence) - self.valence

    def apart(self, rng: np.random.Generator) -> IntArray:
        """Choose vertices (k,) to remove, more than two edges from each other."""
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
            rank[wins] = -1  # no vertex near these is chosen any more
        return np.flatnonzero(chosen)

    def half_edges(self, tails: IntArray) -> IntArray:
        """List the half-edges (k, 2) from some vertices that meet the link condition (Dey et al. 1999)."""
        rows = self.neighbours[tails]
        u, v = np.repeat(tails, np.diff(rows.indptr)), rows.indices
        others = sparse.csr_array(self.neighbours[u].multiply(self.neighbours[v]))
        inner = rows.data == 2
        common = np.diff(others.indptr)
        few = self.valence <= np.where(self.rim, 1, 3)
        allowed = (common == np.where(inner, 2, 1)) & (others @ few == 0) & ~(self.rim[u] & inner)
        return np.stack([u, v], axis=1)[allowed].astype(np.int64)

    def stars(self, vertices: IntArray) -> tuple[IntArray, IntArray]:
        """List the faces around some vertices, with the index of the vertex for each face."""
        counts = self.valence[vertices]
        which = np.repeat(np.arange(len(vertices)), counts)
        offset = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        return self._around[self._starts[vertices][which] + offset], which


def _proper(faces: IntArray) -> NDArray[np.bool_]:
    """Return a mask of the faces with three different corners."""
    a, b, c = faces.T
    return np.asarray((a != b) & (b != c) & (c != a))


def _collapses(
    mesh: _Round, quadrics: FloatArray, areas: FloatArray, most: int, sine: float, rng: np.random.Generator
) -> IntArray:
    """Choose at most ``most`` half-edges (k, 2), u → v, that can be collapsed at once."""
    pairs = mesh.half_edges(mesh.apart(rng))
    if not len(pairs):
        return pairs
    u, v = pairs.T
    # In chunks: the monomials of all vertices in all shapes take much memory.
    chunks = np.array_split(pairs, -(-len(pairs) // CHUNK))
    costs = np.concatenate([_costs(mesh.points, quadrics, areas, some) for some in chunks])
    # The cheapest half-edge of each vertex, and the cheaper part of these.
    order = np.lexsort((costs, u))
    first = order[np.flatnonzero(np.diff(u[order], prepend=-1))]
    first = first[np.argsort(costs[first], kind="stable")][: max(1, int(CHEAPEST * len(first)))]
    pairs = np.stack([u[first], v[first]], axis=1)
    pairs = pairs[_keep_shape(mesh, pairs, sine)][:most]
    return _without_folds(mesh, pairs)


def _costs(points: FloatArray, quadrics: FloatArray, areas: FloatArray, pairs: IntArray) -> FloatArray:
    u, v = pairs.T
    costs: FloatArray = dots(quadrics[u] + quadrics[v], monomials(points[v]))
    costs += MOTION_WEIGHT * areas[u] * ((points[u] - points[v]) ** 2).sum(axis=(1, 2))
    return costs


def _keep_shape(mesh: _Round, pairs: IntArray, sine: float) -> NDArray[np.bool_]:
    """Return a mask of the collapses (k, 2) that leave no small angle and rotate no face much, in any shape."""
    u, v = pairs.T
    star, which = mesh.stars(u)
    old = mesh.faces[star]
    new = np.where(old == u[which][:, None], v[which][:, None], old)
    stays = _proper(new)
    which, old, new = which[stays], old[stays], new[stays]
    good = np.ones(len(pairs), dtype=bool)
    # In chunks: the corners of all faces in all shapes take much memory.
    for start in range(0, len(which), CHUNK):
        part = slice(start, start + CHUNK)
        before, was = normals_and_sides(mesh.points[old[part].T])
        after, becomes = normals_and_sides(mesh.points[new[part].T])
        floor = np.minimum(sine**2, squared_sines(before, was))
        bad = (squared_sines(after, becomes) < floor) | (dots(unit(before), unit(after)) < TURN_LIMIT)
        good[which[part][bad.any(axis=1)]] = False
    return good


def _without_folds(mesh: _Round, pairs: IntArray) -> IntArray:
    """Drop collapses that would fold neighbouring faces onto each other in any shape."""
    while len(pairs):
        star, _ = mesh.stars(pairs[:, 0])
        corners = mesh.faces[star]
        across = mesh.sides[np.roll(corners, -1, axis=1).ravel(), corners.ravel()]
        near = np.union1d(star, np.asarray(across).ravel() - 1)
        near = near[near >= 0]
        goes, by = np.arange(mesh.count), np.full(mesh.count, -1)
        goes[pairs[:, 0]], by[pairs[:, 0]] = pairs[:, 1], np.arange(len(pairs))
        # At most one corner of a face is removed.
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
