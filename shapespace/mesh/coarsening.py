"""A coarse connectivity that serves every shape of a collection: half-edge collapses by quadric error."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.quadrics import monomials, quadrics_of
from shapespace.mesh.thinning import thin
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, TriangleMesh, face_areas
from shapespace.mesh.triangle_quality import FOLD_LIMIT, Pairs, Triangles, dots, folded_pairs

#: Smallest angle (degrees) that a collapse may leave in any shape: the first limit until no collapse is left,
#: then the next. Stricter ones cost accuracy: the cheap collapses wait while dear ones are made.
ANGLE_LIMITS = (10.0, 6.0, 3.0, 1.5)
#: Largest turn of a face's normal in one collapse.
TURN_LIMIT = np.cos(np.deg2rad(60))
#: Where the fine mesh is crumpled already and no side of a face at a vertex is longer than this share of the coarse
#: mesh's edges, anything goes that makes neither slivers nor folds more: the place is about to become a point.
SMALL = 1.0
#: Share of the vertices kept back to heal slivers and folds that the fine mesh has already.
HEALING_SHARE = 0.1
#: Share of the vertices that remain, whatever thin parts lose that can't be had without slivers.
LEAST_SHARE = 0.5
#: Shapes, spread evenly over the collection, whose quadrics are summed; every shape is checked.
QUADRIC_SHAPES = 16
#: Weight of the squared distance that a vertex moves against that of the planes of the faces. A large one makes faces
#: even, which networks learn better, but a geodesic ends where a face collapses: of the meshes with the fewest folds
#: the first is taken whose worst face keeps nearly as much of its area, as a share of the most that one of them keeps.
MOTION_WEIGHTS, NEARLY = (1.0, 0.1, 0.01), 0.9

#: A mesh of more vertices than that, and than so many times the target's, is thinned first; and to how many.
LARGE, PLENTY = 20_000, 20
THINNED, ENOUGH = 5000, 8
#: Shapes, spread evenly, that thinning looks at.
THINNED_SHAPES = 4

_Face = tuple[int, int, int]


@dataclass(frozen=True)
class Coarsening:
    """A coarse connectivity on some of the fine vertices.

    Attributes:
        fine_index: (V,) which fine vertex each coarse one is, increasing.
        faces: (F, 3) in coarse indices.
        smallest_angle: over all faces of all shapes, radians.
        folds: pairs of neighbouring faces that are folded onto one another in some shape.
        shrinkage: smallest area of a face in a shape, as a share of the face's geometric mean over all shapes.
        smallest_area: of a face in a shape, as a share of the mean over the faces of that shape.
        specks: faces that in some shape are below the least area or angle (``triangle_quality``).
        reason: why there are more or fewer vertices than asked for, or specks, in words; empty if there are none.
    """

    fine_index: IntArray
    faces: IntArray
    smallest_angle: float
    folds: int
    shrinkage: float
    smallest_area: float = 1.0
    specks: int = 0
    reason: str = ""


def coarsen(fine: TriangleMesh, target: int, shapes: FloatArray) -> Coarsening:
    """Take vertices away until ``target`` are left, the same for all shapes.

    Half-edge collapses u → v (Garland and Heckbert 1997, Hoppe 1996): u's faces are handed to v, so that every
    coarse vertex is a fine one and the coarse faces are faces of any shape. The cheapest goes first, by the
    quadrics of several shapes together, so that bent poses count too. Refused is what changes the topology
    (link condition, boundary loops stay) and what would leave, in the reference or any shape, a sliver, a
    face turned over, two neighbours folded onto one another, or a speck: a face whose area is next to nothing beside
    the others', or next to nothing in one shape of what it is in the others; unless it was worse there before. The
    limit on slivers is relaxed only once nothing else is left. Slivers, folds and specks of the fine mesh itself are
    healed where a collapse or an edge flip makes them fewer, over all shapes. In the end thin parts that can't be had
    without slivers or specks lose vertices, and are left to the fine mesh; the result says what remains.

    Each collapse costs a part of a millisecond, so a large mesh is thinned by many at once first, with an eye on a few
    shapes; in time about linear in its vertices.

    Args:
        fine: the reference.
        target: number of vertices.
        shapes: (n, Vf, 3) all shapes of the collection, n ≥ 0.

    Raises:
        MeshError: shapes of another form, or with coordinates that aren't finite.
    """
    shapes = np.asarray(shapes, dtype=np.float64)
    if shapes.ndim != 3 or shapes.shape[1:] != fine.vertices.shape:
        raise MeshError(f"shapes must be (n, {len(fine.vertices)}, 3), not {shapes.shape}")
    bad = [k for k, shape in enumerate(shapes) if not np.isfinite(shape).all()]
    if bad:
        raise MeshError(f"shape {bad[0]} has a coordinate that is not finite")
    if len(fine.vertices) <= max(LARGE, PLENTY * target):
        return _best(fine, target, shapes)
    some = np.unique(np.linspace(0, len(shapes) - 1, THINNED_SHAPES).astype(int)) if len(shapes) else ()
    few = np.stack([fine.vertices, *(shapes[k] for k in some)])
    kept, faces = thin(fine.connectivity, few, max(THINNED, ENOUGH * target))
    found = _best(TriangleMesh.from_arrays(fine.vertices[kept], faces), target, shapes[:, kept])
    return replace(found, fine_index=kept[found.fine_index])


def _best(fine: TriangleMesh, target: int, shapes: FloatArray) -> Coarsening:
    """The best that one of the weights of motion leads to."""
    shapes = np.concatenate([fine.vertices[None], shapes])
    found = [_coarsen(fine, target, shapes, weight) for weight in MOTION_WEIGHTS]
    fewest = min((coarsening.specks, coarsening.folds) for coarsening in found)
    found = [coarsening for coarsening in found if (coarsening.specks, coarsening.folds) == fewest]
    most = max(coarsening.shrinkage for coarsening in found)
    return next(coarsening for coarsening in found if coarsening.shrinkage >= NEARLY * most)


def _coarsen(fine: TriangleMesh, target: int, shapes: FloatArray, motion_weight: float) -> Coarsening:
    first = _decimated(fine, target, target, shapes, motion_weight)
    lost = target - first.count
    # What thin parts have lost goes to the others.
    return (_decimated(fine, target, target + lost, shapes, motion_weight) if lost > 0 else first).result(target)


def _decimated(fine: TriangleMesh, target: int, wanted: int, shapes: FloatArray, motion_weight: float) -> _Decimation:
    """The mesh with ``target`` vertices left, or fewer, of which thin parts lose some once there are ``wanted``."""
    edge = np.sqrt(2 / np.sqrt(3) * fine.area / target)
    # A closed surface has twice as many faces as vertices, and the others hardly fewer.
    areas = face_areas(shapes, fine.faces).sum(axis=1) / (2 * target)
    decimation = _Decimation(fine.connectivity, shapes, areas, SMALL * edge, motion_weight)
    sines = np.sin(np.deg2rad(ANGLE_LIMITS))
    spare = int((1 + HEALING_SHARE) * wanted)
    if any(decimation.run(spare, sine) for sine in sines):
        for sine in sines[:0:-1]:  # the worst first
            decimation.heal(wanted, sine)
        any(decimation.run(wanted, sine) for sine in sines)
        decimation.heal(wanted, sines[-1])
        decimation.heal(int(LEAST_SHARE * target), sines[-1], folds=False)
        any(decimation.run(target, sine) for sine in sines)
    return decimation


def _reason(count: int, target: int, specks: int) -> str:
    """What isn't as it was asked for, and why."""
    parts = []
    if count > target:
        parts.append(
            f"{count} vertices instead of {target}: any other collapse would change the topology, or leave a sliver or "
            "a fold in some shape"
        )
    elif count < target:
        parts.append(
            f"{count} vertices instead of {target}: thin parts that could only be had with slivers are left to the "
            "fine mesh"
        )
    if specks:
        parts.append(f"{specks} faces have next to no area or height in some shape, and no collapse or flip mends that")
    return "; ".join(parts)


@dataclass(frozen=True)
class _Neighbourhood:
    """What a collapse changes.

    Attributes:
        rows: faces as triples of vertices, to which the other lists refer by number.
        old: faces at the vertex that is collapsed.
        staying: those of them that don't vanish.
        new: what these become, in the same order.
        pairs_before: neighbours among the old faces and those across from them.
        pairs_after: the same among the new ones.
    """

    rows: list[_Face]
    old: list[int]
    staying: list[int]
    new: list[int]
    pairs_before: Pairs
    pairs_after: Pairs


class _Decimation:
    """The mesh while it is being decimated.

    Args:
        connectivity: fine.
        shapes: (n, Vf, 3).
        areas: (n,) what a coarse face will have on average.
        small: see SMALL, as a length.
        motion_weight: one of MOTION_WEIGHTS.
    """

    def __init__(
        self, connectivity: Connectivity, shapes: FloatArray, areas: FloatArray, small: float, motion_weight: float
    ) -> None:
        self.small, self.motion_weight, self.mean_areas = small, motion_weight, areas
        centred = shapes - shapes.mean(axis=1, keepdims=True)
        # Vertex first: a check gathers a few vertices of every shape.
        self.points = np.ascontiguousarray(np.moveaxis(centred, 0, 1))
        chosen = np.unique(np.linspace(0, len(shapes) - 1, QUADRIC_SHAPES).astype(int))
        self.sample = np.ascontiguousarray(self.points[:, chosen])
        self.monomials = monomials(self.sample)
        self.quadrics, self.areas = quadrics_of(connectivity, centred[chosen])
        self.faces: dict[int, _Face] = {f: (a, b, c) for f, (a, b, c) in enumerate(connectivity.faces.tolist())}
        self.count = connectivity.vertex_count
        self.star: list[set[int]] = [set() for _ in range(self.count)]
        for f, face in self.faces.items():
            for v in face:
                self.star[v].add(f)
        rim = set(connectivity.edges[~connectivity.interior].ravel().tolist())
        self.boundary = [v in rim for v in range(self.count)]
        # A vertex where sheets touch stays, because removing it would tear them apart.
        self.locked = [len(self._fan(self._link(v))) < len(self.star[v]) for v in range(self.count)]
        self.version = [0] * self.count
        """Grows whenever the offers of a vertex are renewed."""
        self.heap: list[tuple[float, int, int, int, int]] = []
        self.refused: dict[int, list[tuple[float, int, int, int, int]]] = {}
        self._offer(np.concatenate([connectivity.edges, connectivity.edges[:, ::-1]]))

    def run(self, target: int, sine: float) -> bool:
        """Collapse until ``target`` vertices are left or nothing can be; whether the target is reached."""
        for entries in self.refused.values():
            self.heap += entries
        self.refused.clear()
        heapq.heapify(self.heap)
        while self.count > target and self.heap:
            entry = heapq.heappop(self.heap)
            _, u, v, version_u, version_v = entry
            if self.version[u] != version_u or self.version[v] != version_v:
                continue
            if self._keeps_topology(u, v) and self._keeps_shape(u, v, sine):
                self._collapse(u, v)
            else:
                self.refused.setdefault(u, []).append(entry)
        return self.count <= target

    def heal(self, target: int, sine: float, *, folds: bool = True) -> None:
        """Make slivers, specks and folds fewer by flips, and by collapses while there are over ``target`` vertices."""
        while vertices := self._faulty(sine, folds=folds):
            changed = [self._flip_one(u, sine) or self._collapse_one([u], target, sine, heal=True) for u in vertices]
            if any(changed):
                continue
            # Where nothing heals, thinning the neighbourhood makes room for it.
            thinned = [self._collapse_one([u, *self._ring(u)], target, sine, heal=False) for u in vertices]
            if not any(thinned):
                break

    def result(self, target: int) -> Coarsening:
        """The mesh as it is now."""
        fine_index, local = np.unique(list(self.faces.values()), return_inverse=True)
        connectivity = Connectivity(local.reshape(-1, 3), len(fine_index))
        faces = connectivity.faces
        triangles = self._triangles(fine_index[faces])
        areas = (triangles.areas * self.mean_areas).clip(1e-300)
        shrinkage = float(np.exp((np.log(areas) - np.log(areas).mean(axis=1, keepdims=True)).min()))
        specks = int((triangles.sizes < 1).any(axis=1).sum())
        return Coarsening(
            fine_index,
            faces,
            float(np.arcsin(min(np.sqrt(triangles.sines.min()), 1.0))),
            len(folded_pairs(connectivity, triangles.normals)),
            shrinkage,
            float((areas / areas.mean(axis=0)).min()),
            specks,
            _reason(len(fine_index), target, specks),
        )

    def _triangles(self, faces: IntArray) -> Triangles:
        return Triangles.of(self.points[faces.T], self.mean_areas)

    def _faulty(self, sine: float, *, folds: bool) -> list[int]:
        """Vertices of slivers, specks and, where asked for, folds in any shape."""
        faces = np.array(list(self.faces.values()))
        used, local = np.unique(faces, return_inverse=True)
        connectivity = Connectivity(local.reshape(-1, 3), len(used))
        triangles = self._triangles(faces)
        bad = np.asarray(((triangles.sines < sine**2) | (triangles.sizes < 1)).any(axis=1))
        if folds:
            bad[folded_pairs(connectivity, triangles.normals).ravel()] = True
        vertices: list[int] = np.unique(faces[bad]).tolist()
        return vertices

    # ------------------------------------------------------------ offers

    def _costs(self, pairs: IntArray) -> FloatArray:
        u, v = pairs.T
        costs: FloatArray = dots(self.quadrics[u] + self.quadrics[v], self.monomials[v])
        return costs + self.motion_weight * self.areas[u] * ((self.sample[u] - self.sample[v]) ** 2).sum(axis=(1, 2))

    def _offer(self, pairs: IntArray) -> None:
        """Put half-edges (k, 2), u → v, on the heap."""
        for cost, (u, v) in zip(self._costs(pairs).tolist(), pairs.tolist(), strict=True):
            if not self.locked[u]:
                heapq.heappush(self.heap, (cost, u, v, self.version[u], self.version[v]))

    def _offer_again(self, vertices: Sequence[int]) -> None:
        """Renew the offers of vertices whose star has changed, and those refused before at their neighbours."""
        pairs = set()
        for v in vertices:
            self.version[v] += 1
            self.refused.pop(v, None)
            for w in self._ring(v):
                pairs |= {(v, w), (w, v)}
                for entry in self.refused.pop(w, ()):
                    heapq.heappush(self.heap, entry)
        self._offer(np.array(sorted(pairs)))

    # ------------------------------------------------------------ neighbourhoods

    def _ring(self, v: int) -> list[int]:
        return sorted({w for f in self.star[v] for w in self.faces[f]} - {v})

    def _link(self, v: int) -> dict[int, tuple[int, int]]:
        """The faces around a vertex, ``(v, a, b)`` as ``a: (b, number of the face)``."""
        link = {}
        for f in self.star[v]:
            a, b, c = self.faces[f]
            a, b = (b, c) if a == v else (c, a) if b == v else (a, b)
            link[a] = b, f
        return link

    @staticmethod
    def _fan(link: dict[int, tuple[int, int]]) -> list[_Face]:
        """``(a, b, face)`` in order around the vertex, from its boundary or from the smallest neighbour."""
        a = min(link.keys() - {b for b, _ in link.values()} or link)
        fan: list[_Face] = []
        while a in link and not (fan and a == fan[0][0]):
            fan.append((a, *link[a]))
            a = fan[-1][1]
        return fan

    def _across(self, a: int, b: int, f: int) -> list[int]:
        """The face on the other side of an edge of face f, if there is one."""
        return list((self.star[a] & self.star[b]) - {f})

    # ------------------------------------------------------------ checks

    def _keeps_topology(self, u: int, v: int) -> bool:
        """The link condition (Dey, Edelsbrunner, Guha and Nekhayev 1999): lk u ∩ lk v = lk uv, with boundary."""
        shared = self.star[u] & self.star[v]
        opposite = {w for f in shared for w in self.faces[f]} - {u, v}
        link_u, link_v = self._link(u), self._link(v)
        return (
            {*self._ring(u)} & {*self._ring(v)} == opposite
            and not (self.boundary[u] and len(shared) == 2)
            # The face (u, a, b) must not come to lie on a face (v, b, a), as it would on a tetrahedron.
            and not any(link_v.get(b, (None,))[0] == a for a, (b, _) in link_u.items())
            and all(self.star[w] - shared for w in opposite)
            and (self.star[u] | self.star[v]) != shared
        )

    def _keeps_shape(self, u: int, v: int, sine: float, *, heal: bool = False) -> bool:
        """Whether u → v leaves nothing bad that was not worse before, in any shape; or, to ``heal``, less that is."""
        around = self._around(u, v)
        triangles = self._triangles(np.array(around.rows))
        was = triangles.quality(around.old, around.pairs_before, sine)
        becomes = triangles.quality(around.new, around.pairs_after, sine)
        if becomes.size < min(1, was.size):
            return False
        if heal:
            return becomes.faults < was.faults
        no_more = becomes.slivers <= was.slivers and becomes.folds <= was.folds
        if was.slivers + was.folds and no_more and triangles.squares[:, around.old].max() <= self.small**2:
            return True
        turns = dots(triangles.normals[around.staying], triangles.normals[around.new])
        return (
            becomes.sine >= min(sine**2, was.sine)
            and becomes.fold >= min(FOLD_LIMIT, was.fold)
            and bool((turns >= TURN_LIMIT).all())
        )

    def _around(self, u: int, v: int) -> _Neighbourhood:
        """The faces that u → v changes, before and after, and those across their outer sides."""
        fan = self._fan(self._link(u))
        k = len(fan)
        gone = [v in (a, b) for a, b, _ in fan]
        staying = [i for i in range(k) if not gone[i]]
        rows = [(u, a, b) for a, b, _ in fan] + [(v, a, b) for a, b, _ in fan]
        # A face of u that vanishes has no image: put another in its place rather than one without area.
        for i in range(k):
            if gone[i]:
                rows[k + i] = rows[i]
        across: list[int | None] = []
        for a, b, f in fan:
            found = self._across(a, b, f)
            across.append(len(rows) if found else None)
            rows += [self.faces[g] for g in found]
        consecutive = [(i, (i + 1) % k) for i in range(k if fan[-1][1] == fan[0][0] else k - 1)]
        # Faces that vanish leave the ones behind them as neighbours.
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

    # ------------------------------------------------------------ changes

    def _collapse(self, u: int, v: int) -> None:
        shared = self.star[u] & self.star[v]
        for f in shared:
            for w in self.faces.pop(f):
                self.star[w].discard(f)
        for f in self.star[u]:
            a, b, c = self.faces[f]
            self.faces[f] = (v if a == u else a, v if b == u else b, v if c == u else c)
        self.star[v] |= self.star[u]
        self.star[u] = set()
        self.quadrics[v] += self.quadrics[u]
        self.areas[v] += self.areas[u]
        self.count -= 1
        self.version[u] += 1
        self.refused.pop(u, None)
        self._offer_again([v])

    def _collapse_one(self, vertices: list[int], target: int, sine: float, *, heal: bool) -> bool:
        """Do the cheapest possible collapse of one of some vertices; whether there was one."""
        pairs = [(u, v) for u in vertices if not self.locked[u] for v in self._ring(u)]
        if self.count <= target or not pairs:
            return False
        for i in np.argsort(self._costs(np.array(pairs)), kind="stable"):
            u, v = pairs[i]
            if self._keeps_topology(u, v) and self._keeps_shape(u, v, sine, heal=heal):
                self._collapse(u, v)
                return True
        return False

    def _flip_one(self, u: int, sine: float) -> bool:
        """Flip an edge at u if that makes slivers and folds fewer; whether there was one."""
        link = self._link(u)
        for w, (c, f) in sorted(link.items()):
            d, g = next(((a, g) for a, (b, g) in link.items() if b == w), (None, None))
            if d is None or g is None or c == d or c in self._ring(d):
                continue
            # An inner vertex keeps three faces, one on the boundary one.
            if any(len(self.star[x]) < (2 if self.boundary[x] else 4) for x in (u, w)):
                continue
            old, new = [(u, w, c), (w, u, d)], [(u, d, c), (d, w, c)]
            rows = old + new
            before, after = [(0, 1)], [(2, 3)]
            for a, b, face, i, j in ((w, c, f, 0, 3), (c, u, f, 0, 2), (u, d, g, 1, 2), (d, w, g, 1, 3)):
                for h in self._across(a, b, face):
                    before.append((i, len(rows)))
                    after.append((j, len(rows)))
                    rows.append(self.faces[h])
            triangles = self._triangles(np.array(rows))
            was = triangles.quality([0, 1], before, sine)
            if triangles.quality([2, 3], after, sine).faults < was.faults:
                self.faces[f], self.faces[g] = new
                self.star[u].discard(g)
                self.star[w].discard(f)
                self.star[c].add(g)
                self.star[d].add(f)
                self._offer_again([u, w, c, d])
                return True
        return False
