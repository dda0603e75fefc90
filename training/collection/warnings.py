"""Shapes that differ suspiciously from the others of their collection: another unit, another order, a mirror image.

Each such shape is a mesh that can be used, and that leads to a model nobody wants. All checks compare, none knows what
the shapes are of, so each can be wrong: people are told, and decide.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import Connectivity, face_areas
from shapespace.training.collection.large_arrays import TOGETHER, columns, room

#: Areas that differ from the median by more than this factor suggest another unit.
AREA_FACTOR = 3.0
#: A vertex is misplaced in a shape if its shortest edge there is longer than STRETCH times its longest in other shapes,
STRETCH = 2.0
#: and longer than LONG times the shape's mean edge.
LONG = 3.0
#: If half of all edges are longer than this many times those of other shapes, the vertices have another order.
SCRAMBLED = 2.5
#: "In other shapes" means this quantile over all shapes, so that faults are found even if only a quarter of the shapes
#: are right.
QUANTILE = 0.25
#: A reflection, or a rotation, explains why a shape differs from the others if it reduces the squared distance to less
#: than this share.
MIRRORED, TURNED = 0.5, 0.1
#: Largest angles, in degrees: between a rotation and one that exchanges coordinate axes, to count as it; and between
#: shapes that count as having the same orientation.
QUARTER_TURN, ALIKE = 25.0, 30.0
#: Number of vertices, spread evenly, that rigid motions between shapes are computed from.
SAMPLE = 2000


@dataclass(frozen=True)
class CollectionWarning:
    """One oddity of one shape.

    Attributes:
        shape: its index.
        sentence: what is odd, to follow the file's name; with ``{vertex}`` where it names one.
        grave: whether a model of such a shape is worthless, so that somebody has to accept it by name.
        vertex: that is named.
    """

    shape: int
    sentence: str
    grave: bool = False
    vertex: int = 0


class Placements:
    """How the shapes of a collection stand to each other, from a sample of their vertices.

    Args:
        vertices: (n, V, 3).
    """

    def __init__(self, vertices: FloatArray) -> None:
        chosen = np.unique(np.linspace(0, vertices.shape[1] - 1, SAMPLE).astype(int))
        points = np.stack([shape[chosen] for shape in vertices])
        points -= points.mean(axis=1, keepdims=True)
        # Scaled, as the squares of very small coordinates (1e-200) would underflow to 0.
        self.points = points / np.abs(points).max()
        self.squares = (self.points**2).sum(axis=(1, 2))

    def _distances(self, sign: int) -> FloatArray:
        """(n, n) squared distances after the best rotation, or for −1 the best reflection (Kabsch 1976)."""
        count = len(self.points)
        columns = np.moveaxis(self.points, 1, 0).reshape(-1, 3 * count)
        products = (columns.T @ columns).reshape(count, 3, count, 3).swapaxes(1, 2)
        values = np.linalg.svd(products, compute_uv=False)
        values[..., 2] *= sign * np.sign(np.linalg.det(products))
        return np.maximum(self.squares[:, None] + self.squares - 2 * values.sum(axis=-1), 0)

    @cached_property
    def distances(self) -> FloatArray:
        """(n, n) squared distances after the best rigid motion."""
        return self._distances(1)

    @cached_property
    def central(self) -> int:
        """The shape with the least mean square distance from the others."""
        return int(self.distances.mean(axis=1).argmin())

    def mirrored(self) -> list[int]:
        """Shapes that a reflection brings closer to most others than any motion does."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self._distances(-1) / self.distances
        np.fill_diagonal(ratio, np.inf)
        return np.flatnonzero(np.quantile(ratio, 0.6, axis=1) < MIRRORED).tolist()

    def turned(self) -> dict[int, FloatArray]:
        """Shapes that stand as if axes were exchanged, where most stand alike, with that exchange (3, 3)."""
        centre = self.points[self.central]
        products = np.swapaxes(self.points, 1, 2) @ centre
        u, _, vt = np.linalg.svd(products)
        u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotations = u @ vt  # x @ rotation is closest to the centre
        if np.median(_angles(rotations, np.eye(3))) > ALIKE:
            return {}
        exchanges = np.stack([m for m in _exchanges() if np.linalg.det(m) > 0 and not np.array_equal(m, np.eye(3))])
        found = {}
        standing = ((self.points - centre) ** 2).sum(axis=(1, 2))
        for k in np.flatnonzero(self.distances[self.central] < TURNED * standing):
            angles = _angles(exchanges, rotations[k])
            if angles.min() < QUARTER_TURN:
                found[int(k)] = exchanges[angles.argmin()]
        return found


def _angles(rotations: FloatArray, other: FloatArray) -> FloatArray:
    """Degrees (n,) between rotations (n, 3, 3) and another."""
    cosine = (np.einsum("nij,ij->n", rotations, other) - 1) / 2
    return np.rad2deg(np.arccos(cosine.clip(-1, 1)))


def _exchanges() -> list[FloatArray]:
    """All matrices that exchange axes and their directions."""
    signs = itertools.product((1.0, -1.0), repeat=3)
    return [np.eye(3)[list(order)] * sign for sign in signs for order in itertools.permutations(range(3))]


def suspicions(
    vertices: FloatArray, connectivity: Connectivity, names: Sequence[str], placements: Placements
) -> list[CollectionWarning]:
    """Everything odd about shapes (n, V, 3), by shape; names (n) are for sentences that name another one."""
    edges = _Edges(vertices, connectivity)
    found = edges.suspicions()
    # Of a shape in another order the other checks say nothing.
    scrambled = {s.shape for s in found if s.grave}
    found += _sizes(vertices, connectivity, edges.out_of_place, scrambled)
    found += _duplicates(vertices, names)
    mirrored = [k for k in placements.mirrored() if k not in scrambled]
    found += [CollectionWarning(k, "is a mirror image of what the others show; mirror it back") for k in mirrored]
    for k, exchange in placements.turned().items():
        if k not in scrambled and k not in mirrored:
            axes = ", ".join(f"{'−' if row.min() < 0 else ''}{'xyz'[np.abs(row).argmax()]}" for row in exchange)
            sentence = f"is turned against the others: its x, y, z are their {axes}; is another axis up in that file?"
            found.append(CollectionWarning(k, sentence))
    return sorted(found, key=lambda s: (s.shape, not s.grave))


def _sizes(
    vertices: FloatArray, connectivity: Connectivity, out_of_place: dict[int, IntArray], scrambled: set[int]
) -> list[CollectionWarning]:
    """Shapes whose area, without the faces at vertices that are out of place, is far from the median."""
    wrong = np.zeros(connectivity.vertex_count, dtype=bool)
    for shape, those in out_of_place.items():
        if shape not in scrambled:
            wrong[those] = True
    faces = connectivity.faces[~wrong[connectivity.faces].any(axis=1)]
    areas = np.array([face_areas(shape, faces).sum() for shape in vertices])
    there = [k for k in range(len(vertices)) if k not in scrambled]
    found = []
    for k in there:
        ratio = areas[k] / np.median(areas[there])
        if not 1 / AREA_FACTOR < ratio < AREA_FACTOR:
            length = float(f"{ratio**0.5:.3g}")
            sentence = f"is of another size: its lengths are {length:,g} times the median's; is it in another unit?"
            found.append(CollectionWarning(k, sentence, grave=True))
    return found


def _duplicates(vertices: FloatArray, names: Sequence[str]) -> list[CollectionWarning]:
    first: dict[bytes, int] = {}
    found = []
    for k, shape in enumerate(vertices):
        same = first.setdefault(hashlib.sha256(shape.tobytes()).digest(), k)
        if same != k:
            found.append(CollectionWarning(k, f"has every vertex where {names[same]} has it: the same shape twice"))
    return found


class _Edges:
    """Lengths of the edges of all shapes, each compared with the same edge of the other shapes.

    A shape may be in another unit, or rolled up: an edge counts as long only if it is so both in the units of the
    file and as a share of the shape's extent.
    """

    def __init__(self, vertices: FloatArray, connectivity: Connectivity) -> None:
        self.vertices = vertices
        tail, head = np.concatenate([connectivity.edges, connectivity.edges[:, ::-1]]).T
        order = np.argsort(tail, kind="stable")
        tail, head = tail[order], head[order]
        starts = np.flatnonzero(np.diff(tail, prepend=-1))
        count = connectivity.vertex_count
        shortest, longest = (room((len(vertices), count), np.float32) for _ in range(2))
        extent, self._middle = np.empty((2, len(vertices)))
        most = min(20 * SAMPLE, TOGETHER // len(vertices))
        some = np.unique(np.linspace(0, connectivity.edge_count - 1, most).astype(int))
        i, j = connectivity.edges[some].T
        sample = np.empty((len(vertices), len(some)))
        for k, shape in enumerate(vertices):
            lengths = np.linalg.norm(shape[tail] - shape[head], axis=1)
            shortest[k] = np.minimum.reduceat(lengths, starts)
            longest[k] = np.maximum.reduceat(lengths, starts)
            self._middle[k] = np.median(lengths)
            # Medians, since a vertex far off would hide itself in a mean.
            extent[k] = np.median(np.linalg.norm(shape - np.median(shape, axis=0), axis=1))
            sample[k] = np.linalg.norm(shape[i] - shape[j], axis=1)
        relative = extent[:, None]

        def beside(values: NDArray, usual: NDArray) -> NDArray:
            """Values (n, …) as multiples of the usual ones; the smaller of the two ways of counting."""
            raw = values / np.quantile(usual, QUANTILE, axis=0)
            return np.minimum(raw, (values / relative) / np.quantile(usual / relative, QUANTILE, axis=0))

        self.scrambled = np.flatnonzero(np.median(beside(sample, sample), axis=1) > SCRAMBLED)
        places = []
        for part in columns(*shortest.shape):
            short, long = shortest[:, part], longest[:, part]
            stretched = (beside(short, long) > STRETCH) & (short > LONG * self._middle[:, None])
            places.append(np.argwhere(stretched) + np.array([0, part.start]))
        shape_of, vertex_of = np.concatenate(places).T
        self.out_of_place = {int(k): vertex_of[shape_of == k] for k in np.unique(shape_of)}

    def suspicions(self) -> list[CollectionWarning]:
        """Vertices in another order, wholly or in part, and vertices far off."""
        found = []
        for k in self.scrambled.tolist():
            sentence = (
                "has its vertices in another order than the others, with the same faces; export it again like them"
            )
            found.append(CollectionWarning(k, sentence, grave=True))
        for k, those in self.out_of_place.items():
            if k in self.scrambled:
                continue
            vertex, more = int(those[0]), f" and {len(those) - 1} more" if len(those) > 1 else ""
            if self._exchanged(k, those):
                sentence = (
                    f"has some vertices in another order than the others, with the same faces: vertex {{vertex}}{more} "
                    "stand where others should; export it like the others"
                )
                found.append(CollectionWarning(k, sentence, grave=True, vertex=vertex))
            else:
                found.append(CollectionWarning(k, f"has a vertex far off: {{vertex}}{more}", vertex=vertex))
        return found

    def _exchanged(self, k: int, those: IntArray) -> bool:
        """Whether most vertices that are out of place lie on the surface: then they are exchanged, not moved away."""
        near = np.asarray(KDTree(self.vertices[k]).query(self.vertices[k][those], 2)[0])[:, 1]
        return len(those) > 1 and bool((near < LONG * self._middle[k]).mean() > 0.5)
