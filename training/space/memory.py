"""Memory of training shapes: corrections that vanish away from the codes of these shapes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.distance import cdist

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.training.runs.progress import progress
from shapespace.training.runs.workers import run
from shapespace.training.space.codes import Codes, NearestCode, ShapeMap, gathered, nearest_code


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


class RememberingMap:
    """A map from codes to shapes that remembers some shapes, with the Gaussians of a bundle.

    This is what our bundles do to lengths and angles, done to vertices. So all maps can be compared as they are served,
    and with principal components that remember too.
    """

    def __init__(
        self, plain: ShapeMap, codes: FloatArray, shapes: FloatArray, units: FloatArray, workers: int = 1
    ) -> None:
        """Remember shapes (n, V, 3), which have the codes (n, m). ``units`` (m,) are the lengths of the modes.

        With other ``workers`` than 1, ``plain`` has to be a map that can be pickled.
        """
        self._workers = workers
        results = run(partial(_vertices, plain), list(codes), workers=workers)
        found = dict(progress(results, "computing the remembered shapes", "shape", len(codes)))
        there = {k: vertices for k, vertices in sorted(found.items()) if vertices is not None}
        known = list(there)
        missed = np.stack([align(shapes[k], near) - near for k, near in there.items()]).reshape(len(known), -1)
        self._codes = codes[known]
        kept = np.argsort(-(missed**2).sum(axis=1), kind="stable")[: GAUSSIANS.examples]
        self._plain, self._units = plain, units
        self._places = self._codes[kept] * self._units
        apart = cdist(self._places, self._places)
        widest = float(apart.max())
        nearest = np.where(apart > GAUSSIANS.same * widest, apart, widest).min(axis=1)
        self._sharpness = 0.5 / (GAUSSIANS.width * nearest.clip(1e-15)) ** 2
        gaussians = np.exp(-self._sharpness * cdist(self._places, self._places, "sqeuclidean"))
        inverse = np.linalg.pinv(gaussians, rcond=GAUSSIANS.distinct / np.linalg.norm(gaussians, 2))
        self._weights = inverse @ missed[kept]

    def shape(self, code: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]] | None:
        """Return the shape (V, 3) of a code (m,), and the function that computes its derivative (m, V, 3)."""
        found = self._plain(code)
        if found is None:
            return None
        away = code * self._units - self._places
        near = np.exp(-self._sharpness * (away**2).sum(axis=1))
        vertices, plain = found

        def derivative() -> FloatArray:
            slopes = -2 * (self._sharpness * near)[:, None] * away * self._units
            return plain() + (slopes.T @ self._weights).reshape(len(code), -1, 3)

        return vertices + (near @ self._weights).reshape(-1, 3), derivative

    def nearest(self, shapes: FloatArray, plain: Codes) -> Codes:
        """Return the codes of the nearest shapes to shapes (n, V, 3), from their codes in the plain map.

        The search starts twice: from this code, and from the nearest code of a remembered shape.
        """
        items = list(zip(shapes, plain.codes, strict=True))
        return gathered(run(self._nearest, items, workers=self._workers), len(items))

    def _nearest(self, item: tuple[FloatArray, FloatArray]) -> NearestCode:
        shape, start = item
        known = self._codes[((self._codes - start) ** 2 @ self._units**2).argmin()]
        found = [nearest_code(self.shape, shape, each) for each in (start, known)]

        def distance(each: NearestCode) -> float:
            return float(((each.vertices - shape) ** 2).sum())

        return min(found, key=distance)


def _vertices(plain: ShapeMap, code: FloatArray) -> FloatArray | None:
    found = plain(code)
    return None if found is None else found[0]
