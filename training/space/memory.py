"""Memory of training shapes: corrections that vanish away from the codes of these shapes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from shapespace.arrays import FloatArray
from shapespace.training.space.codes import NearestCode, nearest_code
from shapespace.training.space.straight_lines import StraightLines


@dataclass(frozen=True)
class ExampleGaussians:
    """Settings of the Gaussians around examples."""

    examples: int = 512  # largest number of examples; the examples with the largest errors are kept
    coordinates: int = 64  # largest number of coordinates that distinguish shapes
    # Standard deviation of a Gaussian, as a share of the distance to the nearest other example, where it has fallen to
    # 0.4 %. Larger Gaussians change random codes more (benchmarks/NOTES.md, Examples).
    width: float = 0.3
    same: float = 1e-3  # examples nearer to each other than this share of the largest distance count as one
    distinct: float = 0.3  # smallest singular value of the Gaussians' matrix that is used; a single example has 1


GAUSSIANS = ExampleGaussians()


class RememberingLines:
    """Straight lines of vertices that remember the shapes they were found from, with the Gaussians of a bundle.

    This is what our models do to networks, done to principal components. So a comparison with these is fair.
    """

    def __init__(self, lines: StraightLines, shapes: FloatArray) -> None:
        """Remember shapes (n, V, 3)."""
        offsets, self._codes = lines.offsets(shapes), lines.project(shapes)
        missed = offsets - self._codes @ lines.modes
        kept = np.argsort(-(missed**2).sum(axis=1), kind="stable")[: GAUSSIANS.examples]
        self._lines, self._units = lines, np.sqrt(lines.squares)
        self._places = self._codes[kept] * self._units
        apart = cdist(self._places, self._places)
        widest = float(apart.max())
        nearest = np.where(apart > GAUSSIANS.same * widest, apart, widest).min(axis=1)
        self._sharpness = 0.5 / (GAUSSIANS.width * nearest.clip(1e-15)) ** 2
        gaussians = np.exp(-self._sharpness * cdist(self._places, self._places, "sqeuclidean"))
        inverse = np.linalg.pinv(gaussians, rcond=GAUSSIANS.distinct / np.linalg.norm(gaussians, 2))
        self._weights = inverse @ missed[kept]

    def shape(self, code: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]]:
        """Return the shape (V, 3) of a code (m,), and the function that computes its derivative (m, V, 3)."""
        away = code * self._units - self._places
        near = np.exp(-self._sharpness * (away**2).sum(axis=1))
        lines = self._lines

        def derivative() -> FloatArray:
            slopes = -2 * (self._sharpness * near)[:, None] * away * self._units
            return (lines.modes + slopes.T @ self._weights).reshape(len(lines), -1, 3)

        return (lines.mean + code @ lines.modes + near @ self._weights).reshape(-1, 3), derivative

    def nearest(self, shapes: FloatArray) -> FloatArray:
        """Return the nearest shape (V, 3) to each shape (n, V, 3). The search starts twice: from the projection, and
        from the nearest code of a remembered shape.
        """
        starts = self._lines.project(shapes)
        return np.stack([self._nearest(shape, start) for shape, start in zip(shapes, starts, strict=True)])

    def _nearest(self, shape: FloatArray, projected: FloatArray) -> FloatArray:
        known = self._codes[((self._codes - projected) ** 2 @ self._units**2).argmin()]
        found = [nearest_code(self.shape, shape, start) for start in (projected, known)]

        def distance(each: NearestCode) -> float:
            return float(((each.vertices - shape) ** 2).sum())

        return min(found, key=distance).vertices
