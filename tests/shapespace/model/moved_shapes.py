"""Shapes of known codes somewhere in space, and scans of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.model.fit_result import Fitted
from shapespace.model.shape_model import ShapeModel


@dataclass(frozen=True)
class Moved:
    """A shape of a known code after a known similarity transformation."""

    code: FloatArray
    shape: FloatArray
    faces: IntArray
    size: float

    @classmethod
    def of(cls, model: ShapeModel, seed: int, scale: float = 1.0, code: FloatArray | None = None) -> Moved:
        drawn = np.clip(model.population.sample(1, seed)[0], model.lower, model.upper) if code is None else code
        shape = model.decode(drawn)
        turn = Rotation.random(random_state=seed).as_matrix()
        there = scale * (shape @ turn.T + [3.0, -1.0, 2.0])
        return cls(drawn, there, model.faces, float(diagonal(there)))

    def points(self, count: int = 4000, seed: int = 0) -> FloatArray:
        """Random points of the whole surface."""
        rng = np.random.default_rng(seed)
        a, b, c = (self.shape[self.faces[:, k]] for k in range(3))
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        chosen = rng.choice(len(areas), count, p=areas / areas.sum())
        shares = rng.dirichlet(np.ones(3), count)
        return np.einsum("nk,nkx->nx", shares, self.shape[self.faces[chosen]])

    def seen_from(self, axis: int) -> FloatArray:
        """Points that are not occluded from a camera far away on an axis."""
        points = self.points(30_000)
        cells = np.floor(np.delete(points, axis, 1) / (self.size / 120)).astype(np.int64)
        _, cell = np.unique(cells, axis=0, return_inverse=True)
        front = np.full(cell.max() + 1, -np.inf)
        np.maximum.at(front, cell, points[:, axis])
        return points[points[:, axis] > front[cell] - 0.02 * self.size][::4]

    def error(self, found: Fitted) -> float:
        """Mean distance of the vertices found from the true ones, as a fraction of the diagonal."""
        away = found.placement(found.shape.vertices) - self.shape
        return float(np.linalg.norm(away, axis=1).mean() / self.size)


#: From a seed to a moved shape of the figure and the fit to its points.
Plain = Callable[[int], tuple[Moved, Fitted]]
