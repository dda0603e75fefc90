"""The table "Time of a fit" of docs/measurements/fit.md: ``python -m benchmarks.fit_time`` prints it.

The unit is a solved shape, timed beside each fit, so that the figures depend little on the machine.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from benchmarks.fit import POINTS, sampled, scan
from benchmarks.pages import ROOT, table
from shapespace.arrays import FloatArray
from shapespace.mesh.closest_points import MeshProximity, VertexFaces
from shapespace.model.shape_model import ShapeModel, load

#: Number of points by which the distance of a surface is measured; number of solved shapes timed beside a fit.
MEASURED, TIMED = 3000, 5
#: A fit is wrong if its error exceeds this share of the diagonal.
WRONG = 0.01


def seconds(work: Callable[[], object]) -> float:
    """Return the CPU time of a call."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def drawn(model: ShapeModel, count: int, seed: int) -> FloatArray:
    """Return codes (count, m) of the population, inside the bounds."""
    return np.clip(model.population.sample(count, seed), model.lower, model.upper)


def measured(model: ShapeModel, variant: str, seed: int, *, by_surface: bool) -> tuple[float, float, str]:
    """Fit one scan. Return its time in solved shapes, its error as a share of the diagonal, and its status."""
    rng = np.random.default_rng(seed)
    truth = model.decode(drawn(model, 1, seed)[0], quality="full")
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
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=10, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=500, help="seed of the first scan")
    given = parser.parse_args()
    rows = []
    with threadpool_limits(1):
        for name in ("figure", "freaky-torus"):
            model = load(ROOT / "models" / name)
            model.fit_scan(model.vertices)  # what a model prepares at its first scan is not timed
            for variant in ("whole", "noisy", "camera"):
                seeds = range(given.seed, given.seed + given.scans)
                found = [measured(model, variant, seed, by_surface=name != "figure") for seed in seeds]
                times, errors = (np.array([each[k] for each in found]) for k in (0, 1))
                spread = f"{100 * np.median(errors):.3f} ({100 * np.quantile(errors, 0.9):.3f})"
                settled = sum(each[2] == "converged" for each in found)
                wrong = int((errors > WRONG).sum())
                rows.append([f"{name}, {variant}", f"{np.median(times):.0f}", spread, str(wrong), str(settled)])
    print(table(("scan", "time", "median error (90th percentile)", "wrong", "converged"), rows))


if __name__ == "__main__":
    main()
