"""Accuracy and time of finding codes: ``python -m benchmarks.codes``.

Prints a Markdown row for each bundled model and task, measured in this process, on one thread, in processor time.
``encode`` takes shapes of random codes, moved rigidly, back to codes. ``edit`` goes from a random code to the shape of
another code, by one to ten of its vertices.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from benchmarks.bundles import bundles
from shapespace.bundle.reader import read_bundle
from shapespace.model.correspondence import Matched
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Codes, Distribution
from shapespace.model.options import Target
from shapespace.model.shape_model import ShapeModel

T = TypeVar("T")


def timed(times: list[float], work: Callable[[], T]) -> T:
    """Call a function and append its processor time in seconds."""
    began = time.process_time()
    result = work()
    times.append(time.process_time() - began)
    return result


def codes(model: ShapeModel, count: int, seed: int) -> Codes:
    """Return random codes (count, m) inside the bounds."""
    return model.latents.sample(count, seed, Distribution.UNIFORM)


def encode(model: ShapeModel, count: int) -> str:
    """Return cells: errors of coordinates as fractions of their range, and the relative time."""
    shape_times: list[float] = []
    times: list[float] = []
    rng, errors = np.random.default_rng(0), []
    for code in codes(model, count, 0):
        shape = timed(shape_times, partial(model.shape, code))
        turn = Rotation.random(rng=rng).as_matrix()
        moved = (shape.vertices @ turn + rng.normal(size=3)).astype(np.float32).astype(np.float64)
        found = timed(times, partial(model.encode, Matched(moved, MeshChoice.FINE)))
        errors.append(np.abs(model.latents.shorter(found.code.astype(np.float64) - code)) / model.latents.width)
    worst = np.median(errors, axis=0).max()
    return (
        f"median {np.median(errors):.4%}, of the worst coordinate {worst:.4%}; over 1 % in "
        f"{(np.max(errors, axis=1) > 0.01).sum()} of {count} | {np.median(times) / np.median(shape_times):.1f}"
    )


def edit(model: ShapeModel, count: int) -> str:
    """Return cells: largest distance from a target as a fraction of the diagonal, and the relative time."""
    shape_times: list[float] = []
    times: list[float] = []
    rng, errors = np.random.default_rng(0), []
    diagonal = model.manifest.scale * model.mesh(MeshChoice.FINE).diagonal
    for k, (start, goal) in enumerate(zip(codes(model, count, 1), codes(model, count, 2), strict=True)):
        vertices = timed(shape_times, partial(model.shape, goal)).vertices
        chosen = rng.choice(len(vertices), (1, 3, 5, 10)[k % 4], replace=False)
        targets = [Target(int(v), vertices[v].tolist()) for v in chosen]
        found = timed(times, partial(model.edit, start, targets))
        errors.append(found.distances.max() / diagonal)
    return (
        f"median {np.median(errors):.3%}, largest {np.max(errors):.3%}; over 1 % in "
        f"{(np.array(errors) > 0.01).sum()} of {count} | {np.median(times) / np.median(shape_times):.1f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder of bundles")
    parser.add_argument("--count", type=int, default=200, help="codes to encode; a fifth as many edits")
    given = parser.parse_args()
    print("| model | | error | time / that of one shape |\n|---|---|---|---|")
    with threadpool_limits(1):
        for path in bundles(given.models):
            model = ShapeModel(read_bundle(path))
            model.encode(model.vertices)  # prepares what a model needs once
            print(f"| {path.parent.name} | encode | {encode(model, given.count)} |", flush=True)
            print(f"| {path.parent.name} | edit | {edit(model, max(1, given.count // 5))} |", flush=True)


if __name__ == "__main__":
    main()
