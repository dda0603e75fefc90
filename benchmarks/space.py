"""What kind of space a collection's modes span: compactness and specificity (Davies et al. 2002).

Beside principal component analysis of the aligned vertices, which is what a user would otherwise take. Distances of
shapes are means over vertices after rigid alignment, as shares of the reference's bounding-box diagonal.
Generalisation, the third, is `benchmarks.generalisation`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.shell.space import ShellSpace
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import read
from shapespace.training.space import modes
from shapespace.training.space.generalisation import PrincipalComponents, vertex_distances
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.stages import material

#: Random codes whose shapes are compared with the collection.
CODES = 200


def measure(run: RunDirectory, config: Config) -> dict[str, Any]:
    """Both of a run whose samples are drawn; compactness by the number of modes."""
    shapes, reference, mean = run.own_shapes(), run.reference_mesh(), run.mean.read()["vertices"]
    found = run.modes_by_strength.read()
    sparse, principal = found["vertices"], found["pga_vertices"]
    m = len(sparse)
    counts = [-(-m // 2), m]
    drawn = read(run.samples).vertices[:CODES].astype(np.float64)
    linear = PrincipalComponents.of(shapes, reference.vertices)
    others = linear.random(min(m, len(shapes) - 1), CODES, np.random.default_rng(0))
    energy = (linear.coefficients**2).sum(axis=0)
    space = ShellSpace(reference.with_vertices(mean), material(config))
    fields = logarithms(space, mean, shapes, run.decomposition.read()["log_steps"]).fields

    def explained(span: FloatArray) -> list[float]:
        return [modes.coefficients(space, mean, fields, span[:k], config.modes.norm)[1] for k in counts]

    return {
        "modes": counts,
        "compactness": {
            "modes": explained(sparse),
            "principal geodesics": explained(principal),
            "components": [float(energy[:k].sum() / energy.sum()) for k in counts],
        },
        "specificity": {
            "modes": to_nearest(drawn, shapes, reference.diagonal),
            "components": to_nearest(others, shapes, reference.diagonal),
        },
    }


def to_nearest(shapes: FloatArray, collection: FloatArray, diagonal: float) -> float:
    """Mean distance of shapes (k, V, 3) from the nearest of a collection (n, V, 3)."""
    distances = [vertex_distances(shapes, other, diagonal).mean(axis=1) for other in collection]
    return float(np.min(distances, axis=0).mean())
