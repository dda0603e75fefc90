"""The table "Time of a fit" of docs/measurements/fit.md: ``python -m benchmarks.fit_time`` measures it.

The unit is a solved shape, timed beside each fit, so that the figures depend little on the machine.
"""

import argparse
import itertools
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from benchmarks import pages
from benchmarks.fit import FIT_TIMES, POINTS, sampled, scan, write_page
from benchmarks.pages import ROOT
from shapespace.arrays import FloatArray
from shapespace.mesh.closest_points import MeshProximity, VertexFaces
from shapespace.model.shape_model import ShapeModel, load

#: Number of points by which the distance of a surface is measured; number of solved shapes timed beside a fit.
MEASURED, TIMED = 3000, 5
#: A fit is wrong if its error exceeds this share of the diagonal.
WRONG = 0.01
#: Kinds of codes, by model.
MODELS = {"figure": ("population", "uniform", "training"), "freaky-torus": ("population",)}


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of a call."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def drawn(model: ShapeModel, count: int, seed: int, codes: str = "population") -> FloatArray:
    """Return codes (count, m) inside the bounds: of the population, uniform, or of training shapes."""
    rng, known = np.random.default_rng(seed), model.decoder.training_codes
    if codes == "uniform":
        return rng.uniform(model.lower, model.upper, (count, model.dimension))
    if codes == "training" and known is not None:
        return known[rng.choice(len(known), count)]
    return np.clip(model.population.sample(count, seed), model.lower, model.upper)


def measured(
    model: ShapeModel, variant: str, seed: int, *, by_surface: bool, kind: str = "population"
) -> tuple[float, float, str]:
    """Fit one scan. Return its time in solved shapes, its error as a share of the diagonal, and its status."""
    rng = np.random.default_rng(seed)
    truth = model.decode(drawn(model, 1, seed, kind)[0], quality="full")
    size = model.manifest.scale * model.mesh().diagonal
    points: FloatArray = sampled(truth, model.faces, POINTS, rng)
    if variant != "whole":
        points, _ = scan(truth, model.faces, variant, 0, rng)
    turn, shift = Rotation.random(random_state=rng), rng.normal(size=3) * size
    found = []
    codes = drawn(model, TIMED, seed + 1000)
    unit = float(np.median([seconds(partial(model.decode, code, quality="full")) for code in codes]))
    spent = seconds(lambda: found.append(model.fit_scan(turn.apply(points) + shift, partial=variant == "camera")))
    back = turn.inv().apply(found[0].placement(found[0].shape.vertices) - shift)
    away = np.linalg.norm(back - truth, axis=1)
    if by_surface:
        surface = MeshProximity(back, VertexFaces(model.faces, len(back)))
        away = surface.closest(sampled(truth, model.faces, MEASURED, rng)).distances
    return spent / unit, float(away.mean()) / size, str(found[0].status)


def main() -> None:
    """Measure, store the figures, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=10, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=500, help="seed of the first scan")
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with threadpool_limits(1):
        for name, kinds in MODELS.items():
            model = load(ROOT / "models" / name)
            model.fit_scan(model.vertices)  # what a model prepares at its first scan is not timed
            for kind, variant in itertools.product(kinds, ("whole", "noisy", "camera")):
                seeds = range(given.seed, given.seed + given.scans)
                found = [measured(model, variant, seed, by_surface=name != "figure", kind=kind) for seed in seeds]
                times, errors = (np.array([each[k] for each in found]) for k in (0, 1))
                settled = np.array([each[2] == "converged" for each in found])
                wrong = errors > WRONG
                rows.append(
                    {
                        "model": name,
                        "scan": variant,
                        "codes": kind,
                        "scans": len(found),
                        "time": float(np.median(times)),
                        "error": [float(np.quantile(errors, share)) for share in (0.5, 0.9)],
                        "wrong": int(wrong.sum()),
                        "unnoticed": int((wrong & settled).sum()),
                        "converged": int(settled.sum()),
                    }
                )
                print(rows[-1], flush=True)
    pages.write_figures(FIT_TIMES, rows)
    write_page()


if __name__ == "__main__":
    main()
