"""What kind of space a collection's modes span: compactness, generalisation and specificity (Davies et al. 2002).

Beside principal component analysis of the aligned vertices, which is what a user would otherwise take. Distances of
shapes are means over vertices after rigid alignment, as shares of the reference's bounding-box diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.exponential import exponential
from shapespace.shell.mean import elastic_mean
from shapespace.shell.space import ShellSpace
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import read
from shapespace.training.runs.workers import run as on_each
from shapespace.training.space import modes
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.stages import material

FOLDS = 5
#: Random codes whose shapes are compared with the collection.
CODES = 200


@dataclass(frozen=True)
class PrincipalComponents:
    """Of shapes aligned to their mean.

    Attributes:
        mean: (V, 3).
        axes: (n, 3V) orthonormal, strongest first.
        coefficients: (n, n) of the shapes.
    """

    mean: FloatArray
    axes: FloatArray
    coefficients: FloatArray

    @classmethod
    def of(cls, shapes: FloatArray, reference: FloatArray) -> PrincipalComponents:
        """Of shapes (n, V, 3), aligned to the reference and then to their mean."""
        mean = align(shapes, reference).mean(axis=0)
        shapes = align(shapes, mean)
        mean = shapes.mean(axis=0)
        u, s, axes = np.linalg.svd((shapes - mean).reshape(len(shapes), -1), full_matrices=False)
        return cls(mean, axes, u * s)

    def nearest(self, shapes: FloatArray, count: int) -> FloatArray:
        """What the first components make of shapes (n, V, 3)."""
        some = self.axes[:count]
        rows = (align(shapes, self.mean) - self.mean).reshape(len(shapes), -1)
        return self.mean + (rows @ some.T @ some).reshape(shapes.shape)

    def random(self, count: int, codes: int, rng: np.random.Generator) -> FloatArray:
        """Shapes uniform in the box of the first components' coefficients."""
        some = self.coefficients[:, :count]
        drawn = rng.uniform(some.min(axis=0), some.max(axis=0), (codes, count))
        return self.mean + (drawn @ self.axes[:count]).reshape(codes, *self.mean.shape)


def measure(run: RunDirectory, config: Config) -> dict[str, Any]:
    """The three of a run whose samples are drawn, by the number of modes where that is a choice."""
    shapes, reference, mean = run.shapes.read()["vertices"], run.reference_mesh(), run.mean.read()["vertices"]
    found = run.modes_by_strength.read()
    sparse, principal = found["vertices"], found["pga_vertices"]
    m = len(sparse)
    counts = sorted({2**k for k in range(m.bit_length()) if 2**k < m} | {m})
    drawn = read(run.samples).vertices[:CODES].astype(np.float64)
    linear = PrincipalComponents.of(shapes, reference.vertices)
    others = linear.random(min(m, len(shapes) - 1), CODES, np.random.default_rng(0))
    energy = (linear.coefficients**2).sum(axis=0)
    space = ShellSpace(reference.with_vertices(mean), material(config))
    fields = logarithms(space, mean, shapes, config.modes.log_steps).fields

    def explained(span: FloatArray) -> list[float]:
        return [modes.projected(space, mean, fields, span[:k])[1] for k in counts]

    return {
        "modes": counts,
        "compactness": {
            "modes": explained(sparse),
            "principal geodesics": explained(principal),
            "components": [float(energy[:k].sum() / energy.sum()) for k in counts],
        },
        "generalisation": generalisation(reference, shapes, config, counts),
        "specificity": {
            "modes": to_nearest(drawn, shapes, reference.diagonal),
            "components": to_nearest(others, shapes, reference.diagonal),
        },
    }


def distances(shapes: FloatArray, others: FloatArray, diagonal: float) -> FloatArray:
    """(n,) between shapes (n, V, 3) and others (n, V, 3) or one (V, 3)."""
    result: FloatArray = np.linalg.norm(align(shapes, others) - others, axis=2).mean(axis=1) / diagonal
    return result


def to_nearest(shapes: FloatArray, collection: FloatArray, diagonal: float) -> float:
    """Mean distance of shapes (k, V, 3) from the nearest of a collection (n, V, 3)."""
    return float(np.min([distances(shapes, other, diagonal) for other in collection], axis=0).mean())


def _shot(space: ShellSpace, start: FloatArray, steps: int, velocity: FloatArray) -> tuple[FloatArray, bool]:
    """Where an exponential ends, and whether it converged."""
    path = exponential(space, start, velocity, steps)
    return path.vertices[-1], path.converged


def generalisation(reference: TriangleMesh, shapes: FloatArray, config: Config, counts: list[int]) -> dict[str, Any]:
    """Mean distance of each shape from what the modes of the other folds' shapes make of it.

    Everything is found anew without the fold: mean, logarithms, modes. The held-out shape's logarithm is projected to
    the strongest modes and shot by the exponential.
    """
    errors: dict[str, list[list[FloatArray]]] = {name: [[] for _ in counts] for name in ("modes", "components")}
    failed = 0
    for fold in range(FOLDS):
        held_out = np.arange(fold, len(shapes), FOLDS)
        kept = np.setdiff1d(np.arange(len(shapes)), held_out)
        mean = elastic_mean(ShellSpace(reference, material(config)), shapes[kept]).vertices
        space = ShellSpace(reference.with_vertices(mean), material(config))
        fields = logarithms(space, mean, shapes, config.modes.log_steps).fields
        most = min(counts[-1], len(kept) - 1)
        sparse = modes.spga(space, mean, fields[kept], most, config.modes.sparsity).vertices
        linear = PrincipalComponents.of(shapes[kept], reference.vertices)
        for row, k in enumerate(counts):
            velocities, _ = modes.projected(space, mean, fields[held_out], sparse[:k])
            shot = dict(on_each(partial(_shot, space, mean, config.samples.steps), velocities))
            ends, converged = map(np.array, zip(*(shot[row] for row in range(len(velocities))), strict=True))
            failed += int((~converged).sum())
            near = {"modes": ends}
            near["components"] = linear.nearest(shapes[held_out], min(k, most))
            for name, found in near.items():
                errors[name][row].append(distances(found, shapes[held_out], reference.diagonal))
    means = {name: [float(np.concatenate(row).mean()) for row in rows] for name, rows in errors.items()}
    return means | {"failed": failed}
