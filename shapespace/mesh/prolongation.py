"""From a coarse shape to the fine one: fixed sparse weights on vertices and normals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, TriangleMesh, diagonal, face_normals

#: Weight of a vertex normal against that of an edge in the fit of a vertex' local affine map.
NORMAL_WEIGHT = 0.1
PREFIX = "prolongation_"
#: Ridge of `fitted`, relative to the mean square of its regressors, and how many vectors it holds in memory at a time.
RIDGE, FITTED = 1e-3, 2**20
#: How many fine vertices are bound to faces at a time: each is compared with dozens of faces, which takes memory.
CHUNK = 10_000


class ProlongationError(ValueError):
    """Arrays that are no prolongation, with a sentence that says why."""


class AttachedPart(NamedTuple):
    """A part of the fine mesh that no coarse face lies under, and what carries it as a whole.

    Attributes:
        vertices: (k,) of the fine mesh.
        anchors: (K,) coarse vertices.
        weights: (K,) of these, with sum 1.
        rigid: whether it keeps its form.
    """

    vertices: IntArray
    anchors: IntArray
    weights: FloatArray
    rigid: bool


class RigidPart(NamedTuple):
    """Vertices (k,) of the fine mesh that move rigidly, and where they are at rest, (k, 3)."""

    vertices: IntArray
    rest: FloatArray


@dataclass(frozen=True, eq=False)
class Prolongation:
    """Carries the fine surface along with a coarse one, around bends too.

    A fine vertex X_i hangs on the corners j of the coarse triangle that it lies over, with barycentric
    weights b_ij: ``x_i = Σ_j b_ij (y_j + A_j (X_i − Y_j))``. A_j is the affine map that takes the edges at
    vertex j, and its normal, closest to what they have become. It turns with the surface and stretches with
    it, and being a least-squares fit is linear in vertices and normals: ``x = B y + C n(y)`` with fixed
    sparse B and C. Normals are scaled by the root of the area around the vertex, so that x moves with y under
    rigid motion and scaling. Exact at the shapes it was made of, and at coarse vertices that are fine ones.

    Rotations alone, by polar decomposition of A_j (Sumner, Schmid and Pauly 2007), cost ten times as much and
    are less accurate, because skin stretches where it bends.

    Weights of a few dozen numbers for each fine vertex leave much to be learned: `fitted` takes those, on the same
    vertices and normals, that come closest to shapes whose fine vertices are known.

    A part that rides along hangs as a whole on its anchors, so that its map is affine; one that is rigid is then
    replaced by its rest shape in the place that comes closest.

    Args:
        faces: (F, 3) of the coarse mesh.
        weights: (Vf, 2V) B beside C.
        rigid: parts that move rigidly.
    """

    faces: IntArray
    weights: sp.csr_array
    rigid: tuple[RigidPart, ...] = ()

    @classmethod
    def of(cls, coarse: TriangleMesh, fine: TriangleMesh, riders: Sequence[AttachedPart] = ()) -> Prolongation:
        """Bind a fine mesh to a coarse one at rest; both lie on the same surface, but for parts that ride along."""
        whole = np.arange(len(fine.vertices))
        bound = np.setdiff1d(whole, np.concatenate([rider.vertices for rider in riders])) if riders else whole
        corners, barycentric = _bind(coarse, submesh(fine, bound) if riders else fine)
        rows, columns, b = [np.repeat(bound, 3)], [corners.ravel()], [barycentric.ravel()]
        for rider in riders:
            rows.append(np.repeat(rider.vertices, len(rider.anchors)))
            columns.append(np.tile(rider.anchors, len(rider.vertices)))
            b.append(np.tile(rider.weights, len(rider.vertices)))
        weights = bind_points(coarse, fine.vertices, *map(np.concatenate, (rows, columns, b)))
        rigid = (RigidPart(rider.vertices, fine.vertices[rider.vertices]) for rider in riders if rider.rigid)
        return cls(coarse.faces, weights, tuple(rigid))

    def __call__(self, vertices: FloatArray) -> FloatArray:
        """Fine vertices (…, Vf, 3) of coarse ones (…, V, 3)."""
        if vertices.ndim > 2:
            return np.stack([self(shape) for shape in vertices]).reshape(*vertices.shape[:-2], -1, 3)
        fine = self.affine(vertices)
        for part in self.rigid:
            fine[part.vertices] = align(part.rest, fine[part.vertices])
        return fine

    def affine(self, vertices: FloatArray) -> FloatArray:
        """Fine vertices (Vf, 3) of coarse ones (V, 3), rigid parts affinely too."""
        fine: FloatArray = self.weights @ np.concatenate(
            [vertices, _scaled_normals(vertices, self.faces, self._around)]
        )
        return fine

    def fitted(self, coarse: FloatArray, fine: FloatArray, rows: IntArray, shapes: IntArray) -> Prolongation:
        """The same with weights that bring fine vertices closest to where they are in some shapes.

        Ridge regression of each vertex on the vertices and normals that it hangs on already, towards the weights that
        it has. Lengths of the changes count in all directions alike, and they sum up to 0, so that fine vertices still
        move as the shape does. Vertices that are coarse ones stay so.

        Args:
            coarse: (n, V, 3) shapes.
            fine: (n, Vf, 3) what they should become, each in the place of the coarse one.
            rows: (k,) fine vertices whose weights may change.
            shapes: (l,) which of the shapes to learn from.
        """
        count, weights = coarse.shape[1], self.weights
        given = np.stack([np.concatenate([y, _scaled_normals(y, self.faces, self._around)]) for y in coarse[shapes]])
        data, sizes = weights.data.copy(), np.diff(weights.indptr)
        for size in np.unique(sizes[rows])[1 if sizes[rows].min() == 1 else 0 :]:
            those = rows[sizes[rows] == size]
            for some in np.array_split(those, -(-len(those) * size * len(shapes) // FITTED)):
                places = weights.indptr[some][:, None] + np.arange(size)
                columns = weights.indices[places]
                x = given[:, columns]
                misfit = fine[np.ix_(shapes, some)] - np.einsum("rk,nrki->nri", data[places], x)
                # Changes that sum up to 0 are made of differences from the middle of the vertices.
                on_vertices = (columns < count).astype(float)
                share = on_vertices / on_vertices.sum(axis=1, keepdims=True)
                x -= on_vertices[..., None] * np.einsum("rk,nrki->nri", share, x)[:, :, None]
                moments = np.einsum("nrki,nrli->rkl", x, x)
                ridge = RIDGE * np.trace(moments, axis1=1, axis2=2) / size
                moments += ridge[:, None, None] * np.eye(size)
                change = np.linalg.solve(moments, np.einsum("nrki,nri->rk", x, misfit)[..., None])[..., 0]
                data[places] += change - on_vertices * (share * change).sum(axis=1, keepdims=True)
        return replace(self, weights=sp.csr_array((data, weights.indices, weights.indptr), shape=weights.shape))

    @property
    def vertex_count(self) -> int:
        """Vf."""
        return int(self.weights.shape[0])

    @cached_property
    def coarse_vertices(self) -> IntArray:
        """(V,) the fine vertex that is always where a coarse one is, −1 where there is none."""
        alone = np.flatnonzero(np.diff(self.weights.indptr) == 1)[::-1]
        column = self.weights.indices[self.weights.indptr[alone]]
        found = np.full(self.weights.shape[1] // 2, -1)
        vertices = (column < len(found)) & (self.weights.data[self.weights.indptr[alone]] == 1)
        found[column[vertices]] = alone[vertices]
        return found

    @cached_property
    def _around(self) -> sp.csr_array:
        return _around(self.faces, self.weights.shape[1] // 2)

    def errors(self, coarse: FloatArray, fine: Iterable[FloatArray]) -> dict[str, float]:
        """``mean`` and ``max`` distance to the true fine shapes, after rigid alignment.

        Args:
            coarse: (n, V, 3) shapes.
            fine: n times (Vf, 3), what they should become.

        Returns:
            Distances as fractions of the diagonal of each shape's bounding box, over all vertices and shapes.
        """
        found = [(away.mean(), away.max()) for away in self.distances(coarse, fine)]
        means, largest = zip(*found, strict=True)
        return {"mean": float(np.mean(means)), "max": float(np.max(largest))}

    def distances(self, coarse: FloatArray, fine: Iterable[FloatArray]) -> Iterator[FloatArray]:
        """For each shape how far its fine vertices are (Vf,), as `errors` counts."""
        for y, x in zip(coarse, fine, strict=True):
            yield np.linalg.norm(align(self(y), x) - x, axis=1) / diagonal(x)

    def arrays(self) -> dict[str, NDArray]:
        """What a file holds; names begin with ``prolongation_``."""
        return {
            PREFIX + "faces": self.faces.astype(np.int32),
            PREFIX + "indptr": self.weights.indptr.astype(np.int32),
            PREFIX + "indices": self.weights.indices.astype(np.int32),
            PREFIX + "weights": self.weights.data,
        } | self._rigid_arrays()

    def _rigid_arrays(self) -> dict[str, NDArray]:
        if not self.rigid:
            return {}
        part = np.full(self.vertex_count, -1, np.int32)
        rest = np.zeros((self.vertex_count, 3))
        for k, (vertices, places) in enumerate(self.rigid):
            part[vertices], rest[vertices] = k, places
        return {PREFIX + "rigid": part, PREFIX + "rest": rest[part >= 0]}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray]) -> Prolongation:
        """Read ``arrays()`` back from any mapping that holds them, such as an opened NPZ file.

        Raises:
            ProlongationError: an array is missing, of another form, out of range, not finite, or a fine
                vertex would not follow when the shape moves.
        """
        faces, indptr, indices, weights = (
            _flat(arrays, name, kind, dimensions)
            for name, kind, dimensions in (
                ("faces", "i", 2),
                ("indptr", "i", 1),
                ("indices", "i", 1),
                ("weights", "f", 1),
            )
        )
        try:
            connectivity = Connectivity(faces, int(faces.max(initial=-1)) + 1)
        except MeshError as error:
            raise ProlongationError(f"{PREFIX}faces: {error}") from None
        columns = 2 * connectivity.vertex_count
        if len(indices) != len(weights):
            raise ProlongationError(f"there are {len(indices)} {PREFIX}indices for {len(weights)} {PREFIX}weights")
        if len(indptr) < 2 or indptr[0] != 0 or indptr[-1] != len(indices) or (np.diff(indptr) < 0).any():
            raise ProlongationError(f"{PREFIX}indptr must rise from 0 to {len(indices)}, the number of weights")
        if len(indices) and (indices.min() < 0 or indices.max() >= columns):
            raise ProlongationError(
                f"{PREFIX}indices must lie in [0, {columns}), but reach {indices.min()} to {indices.max()}"
            )
        if not np.isfinite(weights).all():
            raise ProlongationError(f"{PREFIX}weights has an entry that is not finite")
        matrix = sp.csr_array((weights, indices, indptr), shape=(len(indptr) - 1, columns))
        sums = matrix[:, : connectivity.vertex_count].sum(axis=1)
        astray = np.flatnonzero(np.abs(sums - 1) > 1e-5)
        if len(astray):
            raise ProlongationError(
                f"the weights of fine vertex {astray[0]} sum up to {sums[astray[0]]:.6g}, not 1; it would not "
                "move with the shape"
            )
        return cls(connectivity.faces, matrix, _rigid_parts(arrays, len(indptr) - 1))


def submesh(mesh: TriangleMesh, vertices: IntArray) -> TriangleMesh:
    """The faces of a mesh that join some of its vertices (k,), increasing, as a mesh of these alone."""
    inside = np.isin(mesh.faces, vertices).all(axis=1)
    return TriangleMesh.from_arrays(mesh.vertices[vertices], np.searchsorted(vertices, mesh.faces[inside]))


def bind_points(
    coarse: TriangleMesh, points: FloatArray, rows: IntArray, columns: IntArray, b: FloatArray
) -> sp.csr_array:
    """Weights (k, 2V) that carry points (k, 3) with the vertices they hang on: B beside C of `Prolongation`.

    Args:
        coarse: at rest.
        points: at rest.
        rows: (n,) numbers of points.
        columns: (n,) coarse vertices that these hang on.
        b: (n,) with which weight; those of a point have the sum 1.
    """
    count, tail, head = len(coarse.vertices), *np.concatenate([coarse.edges, coarse.edges[:, ::-1]]).T
    around = _around(coarse.faces, count)
    normals = _scaled_normals(coarse.vertices, coarse.faces, around)

    # A_j = Σ_k (y_k − y_j) g_jkᵀ + n_j h_jᵀ, the normal equations being the same for all three coordinates.
    edges = coarse.vertices[head] - coarse.vertices[tail]
    weight = 1 / (edges**2).sum(axis=1)
    normal_weight = NORMAL_WEIGHT * np.bincount(tail) / (normals**2).sum(axis=1)
    moments = normal_weight[:, None, None] * normals[:, :, None] * normals[:, None, :]
    np.add.at(moments, tail, weight[:, None, None] * edges[:, :, None] * edges[:, None, :])
    inverse = np.linalg.inv(moments)
    g = weight[:, None] * np.einsum("eij,ej->ei", inverse[tail], edges)
    h = normal_weight[:, None] * np.einsum("vij,vj->vi", inverse, normals)

    offsets = b[:, None] * (points[rows] - coarse.vertices[columns])
    on_vertices = sp.csr_array((b, (rows, columns)), shape=(len(points), count))
    on_normals = sp.csr_array(on_vertices.shape)
    for axis in range(3):
        difference = sp.csr_array((g[:, axis], (tail, head)), shape=(count, count))
        difference = difference - sp.diags_array(difference.sum(axis=1))
        offset = sp.csr_array((offsets[:, axis], (rows, columns)), shape=on_vertices.shape)
        on_vertices = on_vertices + offset @ difference
        on_normals = on_normals + offset @ sp.diags_array(h[:, axis])
    weights = sp.csr_array(sp.hstack([on_vertices, on_normals]))
    weights.eliminate_zeros()
    weights.sort_indices()
    return weights


def _rigid_parts(arrays: Mapping[str, NDArray], count: int) -> tuple[RigidPart, ...]:
    """Of a mesh with so many fine vertices."""
    if PREFIX + "rigid" not in arrays and PREFIX + "rest" not in arrays:
        return ()
    of, rest = _flat(arrays, "rigid", "i", 1), _flat(arrays, "rest", "f", 2)
    there = np.flatnonzero(of >= 0)
    if len(of) != count or rest.shape != (len(there), 3) or not np.isfinite(rest).all():
        raise ProlongationError(
            f"{PREFIX}rigid must have {count} entries, and {PREFIX}rest a place for each that is not negative"
        )
    order = np.argsort(of[there], kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(of[there][order])) + 1) if len(order) else []
    return tuple(RigidPart(there[part], rest[part]) for part in parts)


def _flat(arrays: Mapping[str, NDArray], name: str, kind: str, dimensions: int) -> NDArray:
    try:
        array = np.asarray(arrays[PREFIX + name])
    except KeyError:
        raise ProlongationError(f"there is no array {PREFIX}{name}") from None
    if array.ndim != dimensions or not np.issubdtype(array.dtype, np.integer if kind == "i" else np.floating):
        wanted = "integers" if kind == "i" else "real numbers"
        raise ProlongationError(
            f"{PREFIX}{name} must be a {dimensions}-dimensional array of {wanted}, "
            f"not {array.dtype} of shape {array.shape}"
        )
    return array.astype(np.int64 if kind == "i" else np.float64)


def _around(faces: IntArray, count: int) -> sp.csr_array:
    """(V, F) ones where a vertex belongs to a face."""
    columns = np.repeat(np.arange(len(faces)), 3)
    return sp.csr_array((np.ones(faces.size), (faces.ravel(), columns)), shape=(count, len(faces)))


def _scaled_normals(vertices: FloatArray, faces: IntArray, around: sp.csr_array) -> FloatArray:
    """(V, 3) normals at the vertices, as long as the root of twice the area around them; 0 where there is none."""
    by_face = face_normals(vertices, faces, normalised=False)
    summed = around @ by_face
    length = np.linalg.norm(summed, axis=1)
    area = around @ np.linalg.norm(by_face, axis=1)
    scaled: FloatArray = summed * (np.sqrt(area) / np.where(length > 0, length, 1))[:, None]
    return scaled


def _bind(coarse: TriangleMesh, fine: TriangleMesh) -> tuple[IntArray, FloatArray]:
    """Corners (Vf, 3) of the coarse face that each fine vertex lies over, and its barycentric coordinates there.

    Only faces near the coarse vertex that is closest along the fine surface come into question: through the
    air, fingers and lips are close to what they don't belong to.
    """
    near = _closest_along_surface(coarse, fine)
    around = _around(coarse.faces, len(coarse.vertices))
    two_rings = sp.csr_array((around @ around.T) @ around)
    found = [
        _over(coarse, fine.vertices[k : k + CHUNK], near[k : k + CHUNK], two_rings) for k in range(0, len(near), CHUNK)
    ]
    corners, barycentric = zip(*found, strict=True)
    return np.concatenate(corners), np.concatenate(barycentric)


def _over(
    coarse: TriangleMesh, points: FloatArray, near: IntArray, two_rings: sp.csr_array
) -> tuple[IntArray, FloatArray]:
    """The same for points (k, 3), whose closest coarse vertices (k,) have faces around them, as rows of (V, F)."""
    counts = np.diff(two_rings.indptr)[near]
    rows = np.repeat(np.arange(len(near)), counts)
    starts = np.cumsum(counts) - counts
    candidates = two_rings.indices[np.arange(len(rows)) - (starts - two_rings.indptr[near])[rows]]
    corners = coarse.faces[candidates]
    barycentric, squared = _closest_in_triangle(points[rows], coarse.vertices[corners])
    # Ties, at corners and edges, go to the first face.
    chosen = np.lexsort((candidates, squared, rows))[starts]
    return corners[chosen], barycentric[chosen]


def _closest_along_surface(coarse: TriangleMesh, fine: TriangleMesh) -> IntArray:
    """(Vf,) coarse vertex with the shortest way along fine edges."""
    tail, head = fine.edges.T
    lengths = np.linalg.norm(fine.vertices[tail] - fine.vertices[head], axis=1)
    graph = sp.csr_array((lengths, (tail, head)), shape=(len(fine.vertices),) * 2)
    seeds: IntArray = np.asarray(cKDTree(fine.vertices).query(coarse.vertices)[1])
    owner = np.zeros(len(fine.vertices), np.int64)
    owner[seeds] = np.arange(len(seeds))
    _, _, source = dijkstra(graph, directed=False, indices=np.unique(seeds), min_only=True, return_predecessors=True)
    # A part of the fine mesh that has no coarse vertex can only go by distance through the air.
    through_air = cKDTree(coarse.vertices).query(fine.vertices)[1]
    closest: IntArray = np.where(source >= 0, owner[source], through_air)
    return closest


def _closest_in_triangle(points: FloatArray, corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Barycentric coordinates (k, 3) of the points of triangles (k, 3, 3) closest to points (k, 3), and distances²."""
    a, p, q = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    r = points - a
    pp, pq, qq, pr, qr = ((x * y).sum(axis=1) for x, y in ((p, p), (p, q), (q, q), (p, r), (q, r)))
    determinant = pp * qq - pq**2
    s, t = (qq * pr - pq * qr) / determinant, (pp * qr - pq * pr) / determinant
    tries = [np.stack([1 - s - t, s, t], axis=1)]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        side = corners[:, j] - corners[:, i]
        along = np.clip(((points - corners[:, i]) * side).sum(axis=1) / (side**2).sum(axis=1), 0, 1)
        on_side = np.zeros_like(tries[0])
        on_side[:, i], on_side[:, j] = 1 - along, along
        tries.append(on_side)
    coordinates = np.stack(tries)
    squared = ((np.einsum("tki,kix->tkx", coordinates, corners) - points) ** 2).sum(axis=-1)
    squared[0, (tries[0] < 0).any(axis=1)] = np.inf
    best = squared.argmin(axis=0)
    index = np.arange(len(points))
    return coordinates[best, index], squared[best, index]
