"""Quality of triangles in all shapes of a collection: slivers, specks, and folds between neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.mesh.vectors import cross, dots, unit

#: Cosine of the largest angle between the normals of two neighbours; a larger angle is a fold.
FOLD_LIMIT = np.cos(np.deg2rad(140))
#: Indices of pairs of neighbouring faces.
Pairs = list[tuple[int, int]]
#: Smallest area of a face, as a share of the mean area of the coarse faces in the same shape.
SMALLEST_AREA = 0.01
#: Smallest area and sine of a face in a shape, as shares of their means over all shapes.
SMALLEST_SHARE = 0.1


@dataclass(frozen=True)
class TriangleQuality:
    """Quality of a few faces: the worst values, and the numbers of faults."""

    sine: float  # smallest sin² of an angle
    fold: float  # smallest cosine between the normals of neighbours
    size: float  # smallest size, see `Triangles.sizes`
    slivers: int
    folds: int
    specks: int

    @property
    def faults(self) -> int:
        """Total number of faults."""
        return self.slivers + self.folds + self.specks


@dataclass(frozen=True)
class Triangles:
    """Measures of k faces in n shapes."""

    sines: FloatArray  # (k, n) sin² of the smallest angle
    normals: FloatArray  # (k, n, 3) unit normals
    squares: FloatArray  # (3, k, n) squared sides
    areas: FloatArray  # (k, n) areas, as shares of the mean area of a coarse face
    # (k, n) the smaller of area and smallest sine, each as a multiple of its limit. A face below 1 is a speck:
    # geodesics between the shapes fail there.
    sizes: FloatArray

    @classmethod
    def of(cls, corners: FloatArray, mean_areas: FloatArray) -> Triangles:
        """Measure faces with corners (3, k, n, 3), given the expected mean areas (n,) of the coarse faces."""
        normals, squares = normals_and_sides(corners)
        sines = squared_sines(normals, squares)
        doubled = np.sqrt(dots(normals, normals))
        areas, angles = doubled / (2 * mean_areas), np.sqrt(sines)
        least = np.maximum(SMALLEST_AREA, SMALLEST_SHARE * areas.mean(axis=1, keepdims=True))
        least_angles = np.maximum(SMALLEST_SHARE * angles.mean(axis=1, keepdims=True), 1e-300)
        sizes = np.minimum(areas / least, angles / least_angles)
        return cls(sines, normals / np.maximum(doubled, 1e-300)[..., None], squares, areas, sizes)

    def quality(self, faces: list[int], pairs: Pairs, sine: float) -> TriangleQuality:
        """Summarise some of the faces and some pairs of neighbours, given by index."""
        angles, sizes = self.sines[faces], self.sizes[faces]
        folds = dots(self.normals[[i for i, _ in pairs]], self.normals[[j for _, j in pairs]])
        return TriangleQuality(
            float(angles.min(initial=1)),
            float(folds.min(initial=1)),
            float(sizes.min(initial=1)),
            int(np.count_nonzero(angles < sine**2)),
            int(np.count_nonzero(folds < FOLD_LIMIT)),
            int(np.count_nonzero(sizes < 1)),
        )


def folded_pairs(connectivity: Connectivity, normals: FloatArray) -> IntArray:
    """List pairs (k, 2) of neighbouring faces with normals (F, n, 3) that are folded together in some shape."""
    normals = unit(normals)
    pairs: IntArray = connectivity.edge_faces[connectivity.interior]
    return pairs[(dots(normals[pairs[:, 0]], normals[pairs[:, 1]]) < FOLD_LIMIT).any(axis=1)]


def folded_anew(angles: FloatArray, others: FloatArray) -> NDArray[np.bool_]:
    """Return a mask (n,) of the shapes with two faces folded onto one another at an edge that is smooth in the others.

    Angles are (n, E) and (k, E). An edge is smooth where all are below 90°.
    """
    smooth = (np.abs(others) < np.pi / 2).all(axis=0)
    return np.asarray(((np.cos(angles) < FOLD_LIMIT) & smooth).any(axis=1))


def normals_and_sides(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute normals (…, 3) of twice the area, and squared sides (3, …), of triangles with corners (3, …, 3)."""
    p, q = corners[1] - corners[0], corners[2] - corners[0]
    return cross(p.T, q.T).T, np.stack([dots(side, side) for side in (p, q, q - p)])


def squared_sines(normals: FloatArray, squares: FloatArray) -> FloatArray:
    """Compute sin² of the smallest angle: (twice the area / product of the two longer sides)²."""
    product = squares.prod(axis=0)
    return dots(normals, normals) * squares.min(axis=0) / np.maximum(product, 1e-300)
