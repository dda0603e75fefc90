"""Share of a collection that a space explains, by the number of modes: compactness (Davies et al. 2002).

Principal component analysis of the aligned vertices, the usual alternative, stands next to it. Generalisation is in
`benchmarks.generalisation`, specificity in `benchmarks.served`.
"""

from __future__ import annotations

from typing import Any

from shapespace.arrays import FloatArray
from shapespace.shell.space import ShellSpace
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.space import modes
from shapespace.training.space.generalisation import PrincipalComponents
from shapespace.training.space.logarithms import logarithms


def measure(run: RunDirectory, config: Config) -> dict[str, Any]:
    """Measure a run whose modes are found, with half of the modes and with all."""
    shapes, reference, mean = run.own_shapes(), run.reference_mesh(), run.mean.read()["vertices"]
    found = run.modes_by_strength.read()
    sparse, principal = found["vertices"], found["pga_vertices"]
    m = len(sparse)
    counts = [-(-m // 2), m]
    linear = PrincipalComponents.of(shapes, reference.vertices)
    space = ShellSpace(reference.with_vertices(mean), config.shell_material)
    fields = logarithms(space, mean, shapes, run.decomposition.read()["log_steps"]).fields

    def explained(span: FloatArray) -> list[float]:
        return [modes.coefficients(space, mean, fields, span[:k], config.modes.norm)[1] for k in counts]

    return {
        "modes": counts,
        "compactness": {
            "modes": explained(sparse),
            "principal geodesics": explained(principal),
            "components": [linear.explained(k) for k in counts],
        },
    }
