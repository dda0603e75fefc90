"""Warnings about single shapes: another unit, another order of vertices, a mirror image, a vertex far off.

Each such shape is a valid mesh, but a model trained on it is rarely wanted. All checks compare shapes with each other
and know nothing about the objects, so a warning can be wrong: the user reads it and decides.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from shapespace.arrays import FloatArray, IntArray, evenly_spaced
from shapespace.mesh.triangle_mesh import Connectivity, face_areas
from shapespace.mesh.vertex_order import ORDER, VertexEdges, extent, times_longer
from shapespace.training.collection.large_arrays import TOGETHER, columns, room


@dataclass(frozen=True)
class WarningThresholds:
    """Differences between shapes that cause a warning."""

    area_factor: float = 3.0  # an area that differs from the median by more than this factor suggests another unit
    # A reflection, or a rotation, explains why a shape differs from another if it reduces the squared distance to less
    # than this share.
    mirrored: float = 0.5
    turned: float = 0.1
    quarter_turn: float = 25.0  # largest angle in degrees between a rotation and an exchange of coordinate axes
    alike: float = 30.0  # largest angle, in degrees, between shapes that count as having the same orientation


THRESHOLDS = WarningThresholds()
#: Number of vertices, spread evenly, that rigid motions between shapes are computed from.
SAMPLE = 2000


@dataclass(frozen=True)
class CollectionWarning:
    """A warning about one shape of a collection."""

    shape: int  # index of the shape
    # What seems wrong. From `find_warnings` it follows the file's name and may have a field ``{vertex}``.
    sentence: str
    grave: bool = False  # whether a model of such a shape is useless, so that the user must accept the shape by name
    vertex: int = 0  # index of the vertex that the sentence names


class Placements:
    """Distances, reflections and rotations between the shapes of a collection, from a sample of their vertices.

    Args:
        vertices: (n, V, 3).
    """

    def __init__(self, vertices: FloatArray) -> None:
        chosen = evenly_spaced(vertices.shape[1], SAMPLE)
        points = np.stack([shape[chosen] for shape in vertices])
        points -= points.mean(axis=1, keepdims=True)
        # Scaled, as the squares of very small coordinates (1e-200) would underflow to 0.
        self.points = points / np.abs(points).max()
        self.squares = (self.points**2).sum(axis=(1, 2))

    def _distances(self, sign: int) -> FloatArray:
        """Squared distances (n, n) after the best rotation, or for −1 the best reflection (Kabsch 1976)."""
        count = len(self.points)
        columns = np.moveaxis(self.points, 1, 0).reshape(-1, 3 * count)
        products = (columns.T @ columns).reshape(count, 3, count, 3).swapaxes(1, 2)
        values = np.linalg.svd(products, compute_uv=False)
        values[..., 2] *= sign * np.sign(np.linalg.det(products))
        return np.maximum(self.squares[:, None] + self.squares - 2 * values.sum(axis=-1), 0)

    @cached_property
    def distances(self) -> FloatArray:
        """Squared distances (n, n) after the best rigid motion."""
        return self._distances(1)

    @cached_property
    def central(self) -> int:
        """The shape with the least mean square distance from the others."""
        return int(self.distances.mean(axis=1).argmin())

    def mirrored(self) -> list[int]:
        """Find shapes that a reflection brings closer to most others than any rigid motion does."""
        # Equal shapes have a distance of zero. Between infinite ratios the quantile is not a number: not mirrored.
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self._distances(-1) / self.distances
            np.fill_diagonal(ratio, np.inf)
            return np.flatnonzero(np.quantile(ratio, 0.6, axis=1) < THRESHOLDS.mirrored).tolist()

    def turned(self) -> dict[int, FloatArray]:
        """Find shapes whose axes are exchanged, if most shapes have the same orientation.

        Returns:
            For each such shape the exchange, a signed permutation matrix (3, 3).
        """
        centre = self.points[self.central]
        products = np.swapaxes(self.points, 1, 2) @ centre
        u, _, vt = np.linalg.svd(products)
        u[..., -1] *= np.sign(np.linalg.det(u @ vt))[:, None]
        rotations = u @ vt  # x @ rotation is closest to the centre
        if np.median(_angles(rotations, np.eye(3))) > THRESHOLDS.alike:
            return {}
        exchanges = np.stack([m for m in _exchanges() if np.linalg.det(m) > 0 and not np.array_equal(m, np.eye(3))])
        found = {}
        standing = ((self.points - centre) ** 2).sum(axis=(1, 2))
        for k in np.flatnonzero(self.distances[self.central] < THRESHOLDS.turned * standing):
            angles = _angles(exchanges, rotations[k])
            if angles.min() < THRESHOLDS.quarter_turn:
                found[int(k)] = exchanges[angles.argmin()]
        return found


def _angles(rotations: FloatArray, other: FloatArray) -> FloatArray:
    """Angles (n,) in degrees between rotations (n, 3, 3) and another rotation."""
    cosine = (np.einsum("nij,ij->n", rotations, other) - 1) / 2
    return np.rad2deg(np.arccos(cosine.clip(-1, 1)))


def _exchanges() -> list[FloatArray]:
    """Return all matrices that exchange axes and reverse their directions."""
    signs = itertools.product((1.0, -1.0), repeat=3)
    return [np.eye(3)[list(order)] * sign for sign in signs for order in itertools.permutations(range(3))]


def find_warnings(
    vertices: FloatArray, connectivity: Connectivity, names: Sequence[str], placements: Placements
) -> list[CollectionWarning]:
    """Find shapes (n, V, 3) that look wrong beside the others, in the order of the shapes, grave warnings first.

    Sentences that refer to another shape use its name.
    """
    edges = _EdgeLengths(vertices, connectivity)
    found = edges.warnings()
    # The other checks say nothing about a shape in another order.
    scrambled = {warning.shape for warning in found if warning.grave}
    found += _size_warnings(vertices, connectivity, edges.misplaced, scrambled)
    found += _duplicate_warnings(vertices, names)
    mirrored = [k for k in placements.mirrored() if k not in scrambled]
    found += [CollectionWarning(k, "is a mirror image of the other shapes; mirror it back") for k in mirrored]
    for k, exchange in placements.turned().items():
        if k not in scrambled and k not in mirrored:
            axes = ", ".join(f"{'−' if row.min() < 0 else ''}{'xyz'[np.abs(row).argmax()]}" for row in exchange)
            sentence = (
                f"is rotated: its axes x, y, z are the axes {axes} of the others; check which axis is up in that file"
            )
            found.append(CollectionWarning(k, sentence))
    return sorted(found, key=lambda warning: (warning.shape, not warning.grave))


def _size_warnings(
    vertices: FloatArray, connectivity: Connectivity, misplaced: dict[int, IntArray], scrambled: set[int]
) -> list[CollectionWarning]:
    """Warn of shapes whose area is far from the median; faces at misplaced vertices don't count."""
    wrong = np.zeros(connectivity.vertex_count, dtype=bool)
    for shape, indices in misplaced.items():
        if shape not in scrambled:
            wrong[indices] = True
    faces = connectivity.faces[~wrong[connectivity.faces].any(axis=1)]
    areas = np.array([face_areas(shape, faces).sum() for shape in vertices])
    ordered = [k for k in range(len(vertices)) if k not in scrambled]
    found = []
    for k in ordered:
        ratio = areas[k] / np.median(areas[ordered])
        if not 1 / THRESHOLDS.area_factor < ratio < THRESHOLDS.area_factor:
            length = float(f"{ratio**0.5:.3g}")
            sentence = f"has another size: its lengths are {length:,g} times the median of all shapes; check its unit"
            found.append(CollectionWarning(k, sentence, grave=True))
    return found


def _duplicate_warnings(vertices: FloatArray, names: Sequence[str]) -> list[CollectionWarning]:
    first: dict[bytes, int] = {}
    found = []
    for k, shape in enumerate(vertices):
        same = first.setdefault(hashlib.sha256(shape.tobytes()).digest(), k)
        if same != k:
            found.append(CollectionWarning(k, f"is the same shape as {names[same]}; remove one of them"))
    return found


class _EdgeLengths:
    """Lengths of the edges of all shapes, each compared with the same edge of the other shapes."""

    def __init__(self, vertices: FloatArray, connectivity: Connectivity) -> None:
        self.vertices = vertices
        edges, count = VertexEdges(connectivity), connectivity.vertex_count
        shortest, longest = (room((len(vertices), count), np.float32) for _ in range(2))
        extents, self._middle = np.empty((2, len(vertices)))
        most = min(20 * SAMPLE, TOGETHER // len(vertices))
        some = evenly_spaced(connectivity.edge_count, most)
        i, j = connectivity.edges[some].T
        sample = np.empty((len(vertices), len(some)))
        for k, shape in enumerate(vertices):
            lengths = edges.lengths(shape)
            (shortest[k], longest[k]), self._middle[k] = edges.range(lengths), np.median(lengths)
            extents[k] = extent(shape)
            sample[k] = np.linalg.norm(shape[i] - shape[j], axis=1)
        # Indices of shapes whose vertices have another order.
        times = times_longer(sample, extents, sample, extents)
        self.scrambled = np.flatnonzero(np.median(times, axis=1) > ORDER.scrambled)
        places = []
        for part in columns(*shortest.shape):
            short, long = shortest[:, part], longest[:, part]
            stretched = times_longer(short, extents, long, extents) > ORDER.stretch
            stretched &= short > ORDER.long * self._middle[:, None]
            places.append(np.argwhere(stretched) + np.array([0, part.start]))
        shape_of, vertex_of = np.concatenate(places).T
        # By the index of a shape, its vertices that are far from their neighbours.
        self.misplaced = {int(k): vertex_of[shape_of == k] for k in np.unique(shape_of)}

    def warnings(self) -> list[CollectionWarning]:
        """Warn of vertices in another order, wholly or in part, and of vertices far off."""
        sentence = (
            "has its vertices in another order than the others, with the same faces; export it again like the others"
        )
        found = [CollectionWarning(k, sentence, grave=True) for k in self.scrambled.tolist()]
        for k, indices in self.misplaced.items():
            if k in self.scrambled:
                continue
            vertex, more = int(indices[0]), f" and {len(indices) - 1} more" if len(indices) > 1 else ""
            if self._exchanged(k, indices):
                sentence = (
                    f"has some vertices in another order than the others, with the same faces: vertex "
                    f"{{vertex}}{more} are at the positions of other vertices; export it again like the others"
                )
                found.append(CollectionWarning(k, sentence, grave=True, vertex=vertex))
            else:
                found.append(
                    CollectionWarning(k, f"has a vertex far off the surface: {{vertex}}{more}; check it", vertex=vertex)
                )
        return found

    def _exchanged(self, k: int, misplaced: IntArray) -> bool:
        """Whether most misplaced vertices lie on the surface: then they are exchanged, not moved away."""
        near = np.asarray(KDTree(self.vertices[k]).query(self.vertices[k][misplaced], 2)[0])[:, 1]
        return len(misplaced) > 1 and bool((near < ORDER.long * self._middle[k]).mean() > 0.5)
