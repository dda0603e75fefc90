"""How good the triangles of all shapes of a collection are: slivers, and folds between neighbours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.mesh import Connectivity, FloatArray, IntArray, cross

#: Largest angle between the normals of two neighbours, as a cosine.
FOLD_LIMIT = np.cos(np.deg2rad(140))
#: Numbers of neighbouring faces.
Pairs = list[tuple[int, int]]


@dataclass(frozen=True)
class Quality:
    """Of a few faces: smallest sin² of an angle, smallest cosine between neighbours, and how many are beyond limits."""

    sine: float
    fold: float
    slivers: int
    folds: int

    @property
    def faults(self) -> int:
        """Slivers and folds."""
        return self.slivers + self.folds


def quality(sines: FloatArray, normals: FloatArray, faces: list[int], pairs: Pairs, sine: float) -> Quality:
    """Quality of some faces and neighbours, numbered in arrays (k, n) of sin² and (k, n, 3) of unit normals."""
    angles = sines[faces]
    folds = dots(normals[[i for i, _ in pairs]], normals[[j for _, j in pairs]])
    return Quality(
        float(angles.min(initial=1)),
        float(folds.min(initial=1)),
        int(np.count_nonzero(angles < sine**2)),
        int(np.count_nonzero(folds < FOLD_LIMIT)),
    )


def unit(normals: FloatArray) -> FloatArray:
    """Vectors (…, 3) of length 1; what has no length stays as it is."""
    result: FloatArray = normals / np.maximum(np.sqrt(dots(normals, normals)), 1e-300)[..., None]
    return result


def folded_pairs(connectivity: Connectivity, normals: FloatArray) -> IntArray:
    """(k, 2) neighbouring faces that are folded onto one another in some shape; normals (F, n, 3) of any length."""
    normals = unit(normals)
    pairs = connectivity.edge_faces[connectivity.interior]
    folded: IntArray = pairs[(dots(normals[pairs[:, 0]], normals[pairs[:, 1]]) < FOLD_LIMIT).any(axis=1)]
    return folded


def normals_and_sides(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals (…, 3), as long as twice the area, and squared sides (3, …) of triangles with corners (3, …, 3)."""
    p, q = corners[1] - corners[0], corners[2] - corners[0]
    return cross(p, q), np.stack([dots(side, side) for side in (p, q, q - p)])


def squared_sines(normals: FloatArray, squares: FloatArray) -> FloatArray:
    """sin² of the smallest angle: twice the area over the product of the two longer sides."""
    product = squares.prod(axis=0)
    return dots(normals, normals) * squares.min(axis=0) / np.maximum(product, 1e-300)


def dots(a: FloatArray, b: FloatArray) -> FloatArray:
    """Scalar products (…) of vectors (…, n)."""
    result: FloatArray = np.einsum("...i,...i->...", a, b)
    return result
