"""The map from a coarse shape to the fine one: fixed sparse weights for vertices and normals."""

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
from shapespace.mesh.closest_points import closest_barycentric
from shapespace.mesh.fine_detail import FineDetail
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import (
    Connectivity,
    MeshError,
    TriangleMesh,
    diagonal,
    face_normals,
)

#: Weight of a vertex normal relative to the weight of an edge, in the fit of a vertex' local affine map.
NORMAL_WEIGHT = 0.1
#: Start of the names of the arrays in a file.
PREFIX = "prolongation_"
#: Ridge of `Prolongation.fitted`, relative to the mean square of its regressors.
RIDGE = 1e-3
#: Vectors that `Prolongation.fitted` holds in memory at a time.
FITTED_VECTORS = 2**20
#: Barycentric coordinates below this are rounding errors.
ROUNDING = 1e-15
#: Fine vertices that are bound to faces at a time: each is compared with dozens of faces, which takes memory.
BOUND_VERTICES = 10_000


def faces_at_vertices(faces: IntArray, count: int) -> sp.csr_array:
    """Return the matrix (V, F) with 1 where a vertex belongs to a face, for `count` vertices."""
    columns = np.repeat(np.arange(len(faces)), 3)
    return sp.csr_array((np.ones(faces.size), (faces.ravel(), columns)), shape=(count, len(faces)))


def nearest_counts(fine: FloatArray, own: IntArray) -> FloatArray:
    """Return the number (V,) of fine vertices (Vf, 3) nearest to each coarse vertex, at least 1.

    Coarse vertices are the fine vertices with the indices ``own`` (V,).
    """
    nearest = cKDTree(fine[own]).query(fine)[1]
    return np.maximum(np.bincount(nearest, minlength=len(own)), 1).astype(float)


class ProlongationError(ValueError):
    """The arrays are not a valid prolongation; the message says why."""


class AttachedPart(NamedTuple):
    """A part of the fine mesh beside the surface of the coarse mesh, such as an eye or a nail, and its anchors."""

    vertices: IntArray  # (k,) vertices of the fine mesh
    anchors: IntArray  # (K,) coarse vertices that move the part as a whole
    weights: FloatArray  # (K,) weights of the anchors, with sum 1
    rigid: bool  # whether the part moves rigidly


class RigidPart(NamedTuple):
    """Vertices (k,) of the fine mesh that move rigidly together, and their positions at rest (k, 3)."""

    vertices: IntArray
    rest: FloatArray


@dataclass(frozen=True, eq=False)
class Prolongation:
    """The map from coarse vertices y to fine vertices x; it follows bends of the surface.

    A fine vertex X_i is bound to the corners j of the closest coarse triangle, with barycentric weights b_ij:
    ``x_i = Σ_j b_ij (y_j + A_j (X_i − Y_j))``. The affine map A_j is the least-squares fit between the rest position
    and the new position of the edges and the normal at vertex j. So it rotates and stretches with the surface. A
    least-squares fit is linear in vertices and normals: ``x = B y + C n(y)`` with fixed sparse B and C. Normals are
    scaled by the root of the area around the vertex, so that x moves with y under rigid motion and scaling. The map is
    exact at rest, and at fine vertices that coincide with coarse ones.

    Rotations alone, by polar decomposition of A_j (Sumner, Schmid and Pauly 2007), cost ten times as much. They are
    also less accurate, because skin stretches where it bends.

    Each fine vertex has a few dozen weights. `fitted` learns them from shapes whose fine vertices are known.

    `detailed` adds displacements that depend on the whole coarse shape.

    An attached part is bound to its anchors as a whole, so its map is affine. If it is rigid, its rest shape then
    replaces the mapped one, aligned to it.
    """

    faces: IntArray  # (F, 3) faces of the coarse mesh
    weights: sp.csr_array  # (Vf, 2V) B beside C
    rigid: tuple[RigidPart, ...] = ()  # parts that move rigidly
    detail: FineDetail | None = None  # displacements that depend on the whole shape

    @classmethod
    def of(cls, coarse: TriangleMesh, fine: TriangleMesh, parts: Sequence[AttachedPart] = ()) -> Prolongation:
        """Bind a fine mesh to a coarse one at rest. Both lie on the same surface, except for attached parts."""
        whole = np.arange(len(fine.vertices))
        bound = np.setdiff1d(whole, np.concatenate([part.vertices for part in parts])) if parts else whole
        corners, barycentric = _bind(coarse, submesh(fine, bound) if parts else fine)
        rows, columns, b = [np.repeat(bound, 3)], [corners.ravel()], [barycentric.ravel()]
        for part in parts:
            rows.append(np.repeat(part.vertices, len(part.anchors)))
            columns.append(np.tile(part.anchors, len(part.vertices)))
            b.append(np.tile(part.weights, len(part.vertices)))
        weights = bind_points(coarse, fine.vertices, *map(np.concatenate, (rows, columns, b)))
        rigid = (RigidPart(part.vertices, fine.vertices[part.vertices]) for part in parts if part.rigid)
        return cls(coarse.faces, weights, tuple(rigid))

    def __call__(self, vertices: FloatArray) -> FloatArray:
        """Map coarse vertices (…, V, 3) to fine ones (…, Vf, 3)."""
        if vertices.ndim > 2:
            return np.stack([self(shape) for shape in vertices]).reshape(*vertices.shape[:-2], -1, 3)
        fine: FloatArray = self.weights @ self._regressors(vertices)
        if self.detail:
            fine += self.detail(vertices)
        for part in self.rigid:
            fine[part.vertices] = align(part.rest, fine[part.vertices])
        return fine

    def _regressors(self, vertices: FloatArray) -> FloatArray:
        """(2V, 3) coarse vertices, then the scaled normals at them."""
        return np.concatenate([vertices, _scaled_normals(vertices, self.faces, self._around)])

    def fitted(self, coarse: FloatArray, fine: FloatArray, rows: IntArray, shapes: IntArray) -> Prolongation:
        """Return a prolongation whose weights are fitted to shapes with known fine vertices.

        Ridge regression for each fine vertex, on the vertices and normals to which it is already bound, towards its
        present weights. The ridge is isotropic. Changes of the weights on vertices sum to 0, so that fine vertices
        still follow translations. Fine vertices that coincide with coarse ones keep their weights.

        The coarse shapes are (n, V, 3), and the true fine shapes (n, Vf, 3) are aligned to them. Only the weights of
        the fine vertices ``rows`` (k,) change. They are learned from the shapes with indices ``shapes`` (l,).
        """
        count, weights = coarse.shape[1], self.weights
        given = np.stack([self._regressors(y) for y in coarse[shapes]])
        data, sizes = weights.data.copy(), np.diff(weights.indptr)
        for size in np.unique(sizes[rows])[1 if sizes[rows].min() == 1 else 0 :]:
            alike = rows[sizes[rows] == size]
            for some in np.array_split(alike, -(-len(alike) * size * len(shapes) // FITTED_VECTORS)):
                places = weights.indptr[some][:, None] + np.arange(size)
                columns = weights.indices[places]
                x = given[:, columns]
                misfit = fine[np.ix_(shapes, some)] - np.einsum("rk,nrki->nri", data[places], x)
                # Subtract the mean over the vertices, so that the changes sum to 0.
                on_vertices = (columns < count).astype(float)
                share = on_vertices / on_vertices.sum(axis=1, keepdims=True)
                x -= on_vertices[..., None] * np.einsum("rk,nrki->nri", share, x)[:, :, None]
                moments = np.einsum("nrki,nrli->rkl", x, x)
                ridge = RIDGE * np.trace(moments, axis1=1, axis2=2) / size
                moments += ridge[:, None, None] * np.eye(size)
                change = np.linalg.solve(moments, np.einsum("nrki,nri->rk", x, misfit)[..., None])[..., 0]
                data[places] += change - on_vertices * (share * change).sum(axis=1, keepdims=True)
        return replace(self, weights=sp.csr_array((data, weights.indices, weights.indptr), shape=weights.shape))

    def detailed(
        self, rest: FloatArray, coarse: FloatArray, fine: FloatArray, rows: IntArray, shapes: IntArray, ridge: float
    ) -> Prolongation:
        """Return a prolongation that also has the detail learned from some shapes; see `fitted` for the arguments."""
        missing = np.zeros((len(shapes), *fine.shape[1:]))
        for k, shape in enumerate(shapes):
            missing[k, rows] = fine[shape][rows] - self(coarse[shape])[rows]
        return replace(self, detail=FineDetail.fitted(rest, coarse[shapes], missing, ridge))

    @property
    def vertex_count(self) -> int:
        """Number of fine vertices, Vf."""
        return int(self.weights.shape[0])

    @cached_property
    def coarse_vertices(self) -> IntArray:
        """(V,) the fine vertex that coincides with each coarse vertex in every shape, −1 where there is none."""
        alone = np.flatnonzero(np.diff(self.weights.indptr) == 1)[::-1]
        column = self.weights.indices[self.weights.indptr[alone]]
        found = np.full(self.weights.shape[1] // 2, -1)
        vertices = (column < len(found)) & (self.weights.data[self.weights.indptr[alone]] == 1)
        found[column[vertices]] = alone[vertices]
        return found

    @cached_property
    def _around(self) -> sp.csr_array:
        return faces_at_vertices(self.faces, self.weights.shape[1] // 2)

    def errors(self, coarse: FloatArray, fine: Iterable[FloatArray]) -> dict[str, float]:
        """Compute the ``mean`` and ``max`` distance to the true fine shapes, over all vertices and shapes.

        Distances between n coarse shapes (V, 3), mapped and rigidly aligned, and n true fine shapes (Vf, 3) are
        fractions of the diagonal of each fine shape's bounding box.
        """
        found = [(distance.mean(), distance.max()) for distance in self.distances(coarse, fine)]
        means, largest = zip(*found, strict=True)
        return {"mean": float(np.mean(means)), "max": float(np.max(largest))}

    def distances(self, coarse: FloatArray, fine: Iterable[FloatArray]) -> Iterator[FloatArray]:
        """Yield the distances (Vf,) of the fine vertices for each shape, in the unit of `errors`."""
        for y, x in zip(coarse, fine, strict=True):
            yield np.linalg.norm(align(self(y), x) - x, axis=1) / diagonal(x)

    def arrays(self) -> dict[str, NDArray]:
        """Arrays for a file; their names begin with ``prolongation_``."""
        found: dict[str, NDArray] = {
            "faces": self.faces.astype(np.int32),
            "indptr": self.weights.indptr.astype(np.int32),
            "indices": self.weights.indices.astype(np.int32),
            "weights": self.weights.data,
        }
        if self.rigid:
            part, rest = np.full(self.vertex_count, -1, np.int32), np.zeros((self.vertex_count, 3))
            for k, (vertices, places) in enumerate(self.rigid):
                part[vertices], rest[vertices] = k, places
            found |= {"rigid": part, "rest": rest[part >= 0]}
        if self.detail:
            found |= {
                "detail_rest": self.detail.rest,
                "detail_axes": self.detail.axes.astype(np.float32),
                "detail_fields": self.detail.fields,
            }
        return {PREFIX + name: array for name, array in found.items()}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray]) -> Prolongation:
        """Read ``arrays()`` back from a mapping, such as an opened NPZ file. Raises ProlongationError if an array is
        missing, has another shape or type, is out of range or not finite, or the weights of a fine vertex don't sum to
        1.
        """
        faces, weights = _flat(arrays, "faces", np.int64, 2), _flat(arrays, "weights", np.float64, 1)
        indptr, indices = (_flat(arrays, name, np.int64, 1) for name in ("indptr", "indices"))
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
            reach = f"{indices.min()} to {indices.max()}"
            raise ProlongationError(f"{PREFIX}indices must lie in [0, {columns}), but reach {reach}")
        if not np.isfinite(weights).all():
            raise ProlongationError(f"{PREFIX}weights has an entry that is not finite")
        matrix = sp.csr_array((weights, indices, indptr), shape=(len(indptr) - 1, columns))
        sums = matrix[:, : connectivity.vertex_count].sum(axis=1)
        wrong = np.flatnonzero(np.abs(sums - 1) > 1e-5)
        if len(wrong):
            found = f"the weights of fine vertex {wrong[0]} sum up to {sums[wrong[0]]:.6g}, not 1"
            raise ProlongationError(f"{found}; it would not move with the shape")
        detail = _detail(arrays, connectivity.vertex_count, len(indptr) - 1)
        return cls(connectivity.faces, matrix, _rigid_parts(arrays, len(indptr) - 1), detail)


def submesh(mesh: TriangleMesh, vertices: IntArray) -> TriangleMesh:
    """Return the mesh of the faces whose corners are all among some vertices (k,), given in increasing order."""
    inside = np.isin(mesh.faces, vertices).all(axis=1)
    return TriangleMesh.from_arrays(mesh.vertices[vertices], np.searchsorted(vertices, mesh.faces[inside]))


def bind_points(
    coarse: TriangleMesh, points: FloatArray, rows: IntArray, columns: IntArray, b: FloatArray
) -> sp.csr_array:
    """Weights (k, 2V) that move points (k, 3) with the coarse vertices they are bound to: B beside C of `Prolongation`.

    Each of n bonds has the index of a point in ``rows``, a coarse vertex in ``columns``, and a weight in ``b``. The
    weights of one point sum to 1.
    """
    count, tail, head = len(coarse.vertices), *np.concatenate([coarse.edges, coarse.edges[:, ::-1]]).T
    around = faces_at_vertices(coarse.faces, count)
    normals = _scaled_normals(coarse.vertices, coarse.faces, around)

    # A_j = Σ_k (y_k − y_j) g_jkᵀ + n_j h_jᵀ, the normal equations which are the same for all three coordinates.
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
    """Read the rigid parts of a mesh with `count` fine vertices."""
    if PREFIX + "rigid" not in arrays and PREFIX + "rest" not in arrays:
        return ()
    part_of, rest = _flat(arrays, "rigid", np.int64, 1), _flat(arrays, "rest", np.float64, 2)
    there = np.flatnonzero(part_of >= 0)
    if len(part_of) != count or rest.shape != (len(there), 3) or not np.isfinite(rest).all():
        raise ProlongationError(
            f"{PREFIX}rigid must have {count} entries, and {PREFIX}rest a place for each that is not negative"
        )
    order = np.argsort(part_of[there], kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(part_of[there][order])) + 1) if len(order) else []
    return tuple(RigidPart(there[part], rest[part]) for part in parts)


def _detail(arrays: Mapping[str, NDArray], count: int, fine: int) -> FineDetail | None:
    """Read the detail of a map from `count` vertices to `fine` vertices."""
    names = ("detail_rest", "detail_axes", "detail_fields")
    if not any(PREFIX + name in arrays for name in names):
        return None
    rest, axes, fields = (_flat(arrays, name, np.float64, 3 if name != names[0] else 2) for name in names)
    if rest.shape != (count, 3) or axes.shape[1:] != (count, 3) or fields.shape != (len(axes), fine, 3):
        raise ProlongationError(
            f"{PREFIX}detail_rest must be ({count}, 3), {PREFIX}detail_axes (r, {count}, 3), and "
            f"{PREFIX}detail_fields (r, {fine}, 3)"
        )
    if not all(np.isfinite(each).all() for each in (rest, axes, fields)):
        raise ProlongationError(f"{PREFIX}detail_rest, _axes or _fields has an entry that is not finite")
    return FineDetail(rest, axes, fields.astype(np.float32))


def _flat(arrays: Mapping[str, NDArray], name: str, kind: type[np.number], dimensions: int) -> NDArray:
    if PREFIX + name not in arrays:
        raise ProlongationError(f"there is no array {PREFIX}{name}")
    array = np.asarray(arrays[PREFIX + name])
    whole = issubclass(kind, np.integer)
    if array.ndim != dimensions or not np.issubdtype(array.dtype, np.integer if whole else np.floating):
        wanted = f"a {dimensions}-dimensional array of {'integers' if whole else 'real numbers'}"
        raise ProlongationError(f"{PREFIX}{name} must be {wanted}, not {array.dtype} of shape {array.shape}")
    return array.astype(kind)


def _scaled_normals(vertices: FloatArray, faces: IntArray, around: sp.csr_array) -> FloatArray:
    """(V, 3) vertex normals, as long as the root of twice the area around; 0 where the faces cancel."""
    by_face = face_normals(vertices, faces, normalised=False)
    summed = around @ by_face
    length = np.linalg.norm(summed, axis=1)
    area = around @ np.linalg.norm(by_face, axis=1)
    return summed * (np.sqrt(area) / np.where(length > 0, length, 1))[:, None]


def _bind(coarse: TriangleMesh, fine: TriangleMesh) -> tuple[IntArray, FloatArray]:
    """Corners (Vf, 3) of the closest coarse face to each fine vertex, and barycentric coordinates (Vf, 3) there.

    Candidates are the faces near the coarse vertex that is closest along the fine surface. Distances in space would
    bind fingers and lips to their neighbours.
    """
    near = _closest_along_surface(coarse, fine)
    around = faces_at_vertices(coarse.faces, len(coarse.vertices))
    two_rings = sp.csr_array((around @ around.T) @ around)
    found = [
        _bind_some(coarse, fine.vertices[k : k + BOUND_VERTICES], near[k : k + BOUND_VERTICES], two_rings)
        for k in range(0, len(near), BOUND_VERTICES)
    ]
    corners, barycentric = map(np.concatenate, zip(*found, strict=True))
    return corners, barycentric


def _bind_some(
    coarse: TriangleMesh, points: FloatArray, near: IntArray, two_rings: sp.csr_array
) -> tuple[IntArray, FloatArray]:
    """Do the same for points (k, 3), given their closest coarse vertices (k,) and the faces near each (V, F)."""
    counts = np.diff(two_rings.indptr)[near]
    rows = np.repeat(np.arange(len(near)), counts)
    starts = np.cumsum(counts) - counts
    candidates = two_rings.indices[np.arange(len(rows)) - (starts - two_rings.indptr[near])[rows]]
    corners = coarse.faces[candidates]
    barycentric = closest_barycentric(points[rows], coarse.vertices[corners])
    # On a side, rounding may leave a weight for the opposite corner, which would bind the point to it.
    barycentric[barycentric < ROUNDING] = 0
    places = np.einsum("ki,kix->kx", barycentric, coarse.vertices[corners])
    squared = ((places - points[rows]) ** 2).sum(axis=1)
    # Ties, at corners and edges, go to the first face.
    chosen = np.lexsort((candidates, squared, rows))[starts]
    return corners[chosen], barycentric[chosen]


def _closest_along_surface(coarse: TriangleMesh, fine: TriangleMesh) -> IntArray:
    """(Vf,) coarse vertex with the shortest path along fine edges."""
    tail, head = fine.edges.T
    lengths = np.linalg.norm(fine.vertices[tail] - fine.vertices[head], axis=1)
    graph = sp.csr_array((lengths, (tail, head)), shape=(len(fine.vertices),) * 2)
    seeds: IntArray = np.asarray(cKDTree(fine.vertices).query(coarse.vertices)[1])
    owner = np.zeros(len(fine.vertices), np.int64)
    owner[seeds] = np.arange(len(seeds))
    _, _, source = dijkstra(graph, directed=False, indices=np.unique(seeds), min_only=True, return_predecessors=True)
    # For a component of the fine mesh without a coarse vertex only the distance in space is left.
    in_space = cKDTree(coarse.vertices).query(fine.vertices)[1]
    return np.where(source >= 0, owner[source], in_space)
