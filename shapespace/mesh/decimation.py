"""Decimation of one mesh in all its shapes: half-edge collapses by quadric error, one by one, and edge flips."""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray, IntArray, evenly_spaced
from shapespace.mesh.quadrics import monomials, quadrics_of
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.mesh.triangle_quality import FOLD_LIMIT, Pairs, Triangles, folded_pairs
from shapespace.mesh.vectors import dots

#: Cosine of the largest rotation of a face's normal in one collapse.
TURN_LIMIT = np.cos(np.deg2rad(60))
#: Number of shapes, evenly spaced in the collection, whose quadrics are summed. Every shape is checked.
QUADRIC_SHAPES = 16

_Face = tuple[int, int, int]


@dataclass(frozen=True)
class _Neighbourhood:
    """Faces that a collapse changes, as triples of vertices in ``rows``. All other lists have indices of rows."""

    rows: list[_Face]
    old: list[int]
    # staying, new: faces at the collapsed vertex that don't vanish, and these faces after the collapse
    staying: list[int]
    new: list[int]
    # pairs_before, pairs_after: neighbours among the old or the new faces and the faces around them
    pairs_before: Pairs
    pairs_after: Pairs


class Decimation:
    """A mesh during its decimation. See ``coarsening.coarsen`` for the collapses that are refused.

    The shapes are (n, Vf, 3), and the coarse faces in each have an expected mean area (n,). In a crumpled place, a
    vertex whose faces have no side longer than ``small`` may collapse freely as long as slivers and folds don't become
    more: the place is about to become a point. The squared distance that a vertex moves has the weight
    ``motion_weight``, relative to the planes of the faces.
    """

    def __init__(
        self, connectivity: Connectivity, shapes: FloatArray, mean_areas: FloatArray, small: float, motion_weight: float
    ) -> None:
        self.mean_areas, self._small, self._motion_weight = mean_areas, small, motion_weight
        centred = shapes - shapes.mean(axis=1, keepdims=True)
        # Vertex first: a check gathers a few vertices of every shape.
        self._points = np.ascontiguousarray(np.moveaxis(centred, 0, 1))
        chosen = evenly_spaced(len(shapes), QUADRIC_SHAPES)
        self._sample = np.ascontiguousarray(self._points[:, chosen])
        self._monomials = monomials(self._sample)
        self._quadrics, self._areas = quadrics_of(connectivity, centred[chosen])
        # Remaining faces as triples of fine vertices, by their index in the fine mesh, and number of vertices left.
        self.faces: dict[int, _Face] = {f: (a, b, c) for f, (a, b, c) in enumerate(connectivity.faces.tolist())}
        self.count = connectivity.vertex_count
        self._star: list[set[int]] = [set() for _ in range(self.count)]
        for f, face in self.faces.items():
            for v in face:
                self._star[v].add(f)
        rim = set(connectivity.edges[~connectivity.interior].ravel().tolist())
        self._boundary = [v in rim for v in range(self.count)]
        # A vertex where two sheets touch stays: removing it would separate them.
        self._locked = [len(self._fan(self._link(v))) < len(self._star[v]) for v in range(self.count)]
        #: Increases whenever the candidate collapses of a vertex are renewed.
        self._version = [0] * self.count
        self._heap: list[tuple[float, int, int, int, int]] = []
        self._refused: dict[int, list[tuple[float, int, int, int, int]]] = {}
        self._offer(np.concatenate([connectivity.edges, connectivity.edges[:, ::-1]]))

    def run(self, target: int, sine: float) -> bool:
        """Collapse until ``target`` vertices are left or none can go. Returns whether the target is reached."""
        for entries in self._refused.values():
            self._heap += entries
        self._refused.clear()
        heapq.heapify(self._heap)
        while self.count > target and self._heap:
            entry = heapq.heappop(self._heap)
            _, u, v, version_u, version_v = entry
            if self._version[u] != version_u or self._version[v] != version_v:
                continue
            if self._keeps_topology(u, v) and self._keeps_shape(u, v, sine):
                self._collapse(u, v)
            else:
                self._refused.setdefault(u, []).append(entry)
        return self.count <= target

    def heal(self, target: int, sine: float, *, folds: bool = True) -> None:
        """Remove slivers, specks and folds by flips, and by collapses while more than ``target`` vertices are left."""
        while vertices := self._faulty(sine, folds=folds):
            changed = [self._flip_one(u, sine) or self._collapse_one([u], target, sine, heal=True) for u in vertices]
            if any(changed):
                continue
            # If nothing helps, remove vertices of the neighbourhood to make room.
            thinned = [self._collapse_one([u, *self._ring(u)], target, sine, heal=False) for u in vertices]
            if not any(thinned):
                break

    def triangles(self, faces: IntArray) -> Triangles:
        """Measure faces (k, 3) of fine vertices in all shapes."""
        return Triangles.of(self._points[faces.T], self.mean_areas)

    def _faulty(self, sine: float, *, folds: bool) -> list[int]:
        """List the vertices at slivers, at specks and, if ``folds``, at folds in any shape."""
        faces = np.array(list(self.faces.values()))
        used, local = np.unique(faces, return_inverse=True)
        connectivity = Connectivity(local.reshape(-1, 3), len(used))
        triangles = self.triangles(faces)
        bad = np.asarray(((triangles.sines < sine**2) | (triangles.sizes < 1)).any(axis=1))
        if folds:
            bad[folded_pairs(connectivity, triangles.normals).ravel()] = True
        return np.unique(faces[bad]).tolist()

    def _costs(self, pairs: IntArray) -> FloatArray:
        u, v = pairs.T
        costs: FloatArray = dots(self._quadrics[u] + self._quadrics[v], self._monomials[v])
        motion = ((self._sample[u] - self._sample[v]) ** 2).sum(axis=(1, 2))
        return costs + self._motion_weight * self._areas[u] * motion

    def _offer(self, pairs: IntArray) -> None:
        """Put half-edges (k, 2), u → v, on the heap as candidates."""
        for cost, (u, v) in zip(self._costs(pairs).tolist(), pairs.tolist(), strict=True):
            if not self._locked[u]:
                heapq.heappush(self._heap, (cost, u, v, self._version[u], self._version[v]))

    def _offer_again(self, vertices: Sequence[int]) -> None:
        """Renew the candidates at vertices whose star has changed, and the refused candidates of their neighbours."""
        pairs = set()
        for v in vertices:
            self._version[v] += 1
            self._refused.pop(v, None)
            for w in self._ring(v):
                pairs |= {(v, w), (w, v)}
                for entry in self._refused.pop(w, ()):
                    heapq.heappush(self._heap, entry)
        self._offer(np.array(sorted(pairs)))

    def _ring(self, v: int) -> list[int]:
        return sorted({w for f in self._star[v] for w in self.faces[f]} - {v})

    def _link(self, v: int) -> dict[int, tuple[int, int]]:
        """Map a to (b, index of the face) for each face ``(v, a, b)`` around a vertex v."""
        link = {}
        for f in self._star[v]:
            a, b, c = self.faces[f]
            a, b = (b, c) if a == v else (c, a) if b == v else (a, b)
            link[a] = b, f
        return link

    @staticmethod
    def _fan(link: dict[int, tuple[int, int]]) -> list[_Face]:
        """List ``(a, b, face)`` in order around the vertex, from its boundary or from the smallest neighbour."""
        a = min(link.keys() - {b for b, _ in link.values()} or link)
        fan: list[_Face] = []
        while a in link and not (fan and a == fan[0][0]):
            fan.append((a, *link[a]))
            a = fan[-1][1]
        return fan

    def _across(self, a: int, b: int, f: int) -> list[int]:
        """List the face beside face f at an edge, if there is one."""
        return list((self._star[a] & self._star[b]) - {f})

    def _keeps_topology(self, u: int, v: int) -> bool:
        """Check the link condition with boundary, lk u ∩ lk v = lk uv (Dey, Edelsbrunner, Guha and Nekhayev 1999)."""
        shared = self._star[u] & self._star[v]
        opposite = {w for f in shared for w in self.faces[f]} - {u, v}
        link_u, link_v = self._link(u), self._link(v)
        return (
            {*self._ring(u)} & {*self._ring(v)} == opposite
            and not (self._boundary[u] and len(shared) == 2)
            # The face (u, a, b) must not come to lie on a face (v, b, a), as it would on a tetrahedron.
            and not any(link_v.get(b, (None,))[0] == a for a, (b, _) in link_u.items())
            and all(self._star[w] - shared for w in opposite)
            and (self._star[u] | self._star[v]) != shared
        )

    def _keeps_shape(self, u: int, v: int, sine: float, *, heal: bool = False) -> bool:
        """Whether u → v makes no shape worse than before; with ``heal``, whether it reduces the number of faults."""
        around = self._around(u, v)
        triangles = self.triangles(np.array(around.rows))
        was = triangles.quality(around.old, around.pairs_before, sine)
        becomes = triangles.quality(around.new, around.pairs_after, sine)
        if becomes.size < min(1, was.size):
            return False
        if heal:
            return becomes.faults < was.faults
        no_more = becomes.slivers <= was.slivers and becomes.folds <= was.folds
        if was.slivers + was.folds and no_more and triangles.squares[:, around.old].max() <= self._small**2:
            return True
        turns = dots(triangles.normals[around.staying], triangles.normals[around.new])
        return (
            becomes.sine >= min(sine**2, was.sine)
            and becomes.fold >= min(FOLD_LIMIT, was.fold)
            and bool((turns >= TURN_LIMIT).all())
        )

    def _around(self, u: int, v: int) -> _Neighbourhood:
        """Collect the faces that u → v changes, before and after, and the faces across their outer sides."""
        fan = self._fan(self._link(u))
        k = len(fan)
        gone = [v in (a, b) for a, b, _ in fan]
        staying = [i for i in range(k) if not gone[i]]
        rows = [(u, a, b) for a, b, _ in fan] + [(v, a, b) for a, b, _ in fan]
        # A face of u that vanishes has no image. Put another face in its place, so that no row lacks area.
        for i in range(k):
            if gone[i]:
                rows[k + i] = rows[i]
        across: list[int | None] = []
        for a, b, f in fan:
            found = self._across(a, b, f)
            across.append(len(rows) if found else None)
            rows += [self.faces[g] for g in found]
        consecutive = [(i, (i + 1) % k) for i in range(k if fan[-1][1] == fan[0][0] else k - 1)]
        # Where a face vanishes, its two outer neighbours become neighbours.
        image = [across[i] if gone[i] else k + i for i in range(k)]
        before = consecutive + [(i, o) for i, o in enumerate(across) if o is not None]
        after = [(image[i], image[j]) for i, j in consecutive if not (gone[i] and gone[j])]
        after += [(image[i], across[i]) for i in staying]
        return _Neighbourhood(
            rows=rows,
            old=list(range(k)),
            staying=staying,
            new=[k + i for i in staying],
            pairs_before=before,
            pairs_after=[(i, j) for i, j in after if i is not None and j is not None],
        )

    def _collapse(self, u: int, v: int) -> None:
        shared = self._star[u] & self._star[v]
        for f in shared:
            for w in self.faces.pop(f):
                self._star[w].discard(f)
        for f in self._star[u]:
            a, b, c = self.faces[f]
            self.faces[f] = (v if a == u else a, v if b == u else b, v if c == u else c)
        self._star[v] |= self._star[u]
        self._star[u] = set()
        self._quadrics[v] += self._quadrics[u]
        self._areas[v] += self._areas[u]
        self.count -= 1
        self._version[u] += 1
        self._refused.pop(u, None)
        self._offer_again([v])

    def _collapse_one(self, vertices: list[int], target: int, sine: float, *, heal: bool) -> bool:
        """Make the cheapest possible collapse of one of some vertices. Returns whether there was one."""
        pairs = [(u, v) for u in vertices if not self._locked[u] for v in self._ring(u)]
        if self.count <= target or not pairs:
            return False
        for i in np.argsort(self._costs(np.array(pairs)), kind="stable"):
            u, v = pairs[i]
            if self._keeps_topology(u, v) and self._keeps_shape(u, v, sine, heal=heal):
                self._collapse(u, v)
                return True
        return False

    def _flip_one(self, u: int, sine: float) -> bool:
        """Flip an edge at u if this reduces slivers and folds. Returns whether there was one."""
        link = self._link(u)
        for w, (c, f) in sorted(link.items()):
            d, g = next(((a, g) for a, (b, g) in link.items() if b == w), (None, None))
            if d is None or g is None or c == d or c in self._ring(d):
                continue
            # An inner vertex keeps at least three faces, a boundary vertex at least one.
            if any(len(self._star[x]) < (2 if self._boundary[x] else 4) for x in (u, w)):
                continue
            old, new = [(u, w, c), (w, u, d)], [(u, d, c), (d, w, c)]
            rows = old + new
            before, after = [(0, 1)], [(2, 3)]
            for a, b, face, i, j in ((w, c, f, 0, 3), (c, u, f, 0, 2), (u, d, g, 1, 2), (d, w, g, 1, 3)):
                for h in self._across(a, b, face):
                    before.append((i, len(rows)))
                    after.append((j, len(rows)))
                    rows.append(self.faces[h])
            triangles = self.triangles(np.array(rows))
            was = triangles.quality([0, 1], before, sine)
            if triangles.quality([2, 3], after, sine).faults < was.faults:
                self.faces[f], self.faces[g] = new
                self._star[u].discard(g)
                self._star[w].discard(f)
                self._star[c].add(g)
                self._star[d].add(f)
                self._offer_again([u, w, c, d])
                return True
        return False
