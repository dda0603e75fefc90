"""docs/measurements/NAME-models.png and NAME-modes.png: shapes of a run's models, and its modes.

``python -m benchmarks.pictures CONFIG RUN`` draws them from a finished run, after figures 4 and 5 of the paper.
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from numpy.typing import NDArray

from benchmarks.pages import MEASUREMENTS
from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.training.learning.composite import affine_sum
from shapespace.training.learning.networks import predict
from shapespace.training.report.pictures import CLAY, ERROR, MODE_REACH, Studio, ramp, tint
from shapespace.training.report.record import Record
from shapespace.training.runs.config import load
from shapespace.training.runs.sampling import read
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.stage import Run

#: Number of codes (the first fresh codes) and of modes (the strongest); pixels of a picture's side.
CODES, MODES, SIZE = 4, 6, 260
#: Margin around the shapes, as a share of the picture's longer side.
MARGIN = 0.02
#: Errors between which colours change, as shares of the diagonal, on a logarithmic scale.
LEAST, MOST = 1e-4, 3e-2


def models(run: Run, studio: Studio, path: Path) -> None:
    """Draw shapes of fresh codes: exact, and by each model with colours for the distance from the exact vertices."""
    learner, samples = learner_of(run), read(run.directory.exact / "fresh")
    codes, exact = samples.latents[:CODES], align(samples.vertices[:CODES].astype(np.float64), studio.base)
    latents, composite = torch.as_tensor(codes, dtype=torch.float32), learner.main()
    reference, eta = learner.collection.reference, run.config.export.eta_reconstruction
    rest = nric(reference.vertices, reference.connectivity)
    found: dict[str, NDArray] = {
        "composite": predict(composite, latents).numpy(),
        "our recipe, one factor": predict(learner.monolithic(), latents).numpy(),
        "the paper's single network": predict(learner.monolithic_paper(), latents).numpy(),
    }
    if run.config.networks.paper:
        found["the paper's system"] = predict(learner.paper(), latents).numpy()
    found["affine sum of factors"] = affine_sum(rest, predict(composite.factor_shapes, latents).numpy())
    compared(found, exact, studio, Reconstructor(reference, eta), path)


def compared(
    found: Mapping[str, NDArray], exact: FloatArray, studio: Studio, reconstruct: Reconstructor, path: Path
) -> None:
    """Draw exact shapes (n, V, 3), and shapes of NRIC (n, 2E) by the models' names with colours for the distance."""
    made = {
        name: align(np.stack([reconstruct(row, tolerance=1e-6).vertices for row in z]), exact)
        for name, z in found.items()
    }
    points = np.concatenate([exact, *made.values()]).reshape(-1, 3)
    studio = replace(studio, camera=studio.camera.framing(points, MARGIN))
    columns: list[tuple[str, list[NDArray[np.uint8]]]] = [("exact", [studio.pixels(x, SIZE, CLAY) for x in exact])]
    for name, shapes in made.items():
        away = np.linalg.norm(shapes - exact, axis=2) / reconstruct.reference.diagonal
        level = np.log(np.maximum(away, LEAST) / LEAST) / np.log(MOST / LEAST)
        pictures = [studio.pixels(x, SIZE, tint(ERROR, row)) for x, row in zip(shapes, level, strict=True)]
        columns.append((f"{name}\nmean {100 * away.mean():.3f} %", pictures))
    save(columns, path, f"distance of vertices: {LEAST:.2%} of the diagonal and less, to {MOST:.0%} and more")


def modes(run: Run, studio: Studio, path: Path) -> None:
    """Draw the strongest principal geodesic modes and sparse modes, each at its largest shown displacement."""
    found, mean = run.directory.modes_by_strength.read(), run.directory.mean.read()["vertices"]
    rows = {"principal geodesic modes": found["pga_vertices"], "sparse modes": found["vertices"]}
    pictures: list[list[NDArray[np.uint8]]] = [[] for _ in range(MODES)]
    closer = studio.closer(mean)
    for fields in rows.values():
        for column, field in zip(pictures, fields[:MODES], strict=False):
            column.append(moved(closer, mean, field))
    columns = [(f"mode {k + 1}", column) for k, column in enumerate(pictures)]
    save(columns, path, f"top: {', bottom: '.join(rows)}; colour: how far a vertex moves")


def moved(studio: Studio, mean: FloatArray, field: FloatArray) -> NDArray[np.uint8]:
    """Draw a mode (V, 3) at its largest shown displacement."""
    lengths = np.linalg.norm(field, axis=1)
    size = float(np.linalg.norm(np.ptp(mean, axis=0)))
    shape = mean + MODE_REACH * size / lengths.max() * field
    return studio.pixels(align(shape, studio.base), SIZE, tint(ramp("#1f6f8b"), lengths / lengths.max()))


def save(columns: list[tuple[str, list[NDArray[np.uint8]]]], path: Path, words: str) -> None:
    """Save a table of pictures."""
    height, width = columns[0][1][0].shape[:2]
    count = len(columns[0][1])
    size = (len(columns) * width / 110, count * height / 110 + 0.7)
    figure, axes = plt.subplots(count, len(columns), figsize=size, squeeze=False, layout="constrained")
    for (title, pictures), column in zip(columns, axes.T, strict=True):
        column[0].set_title(title, fontsize="small")
        for picture, axis in zip(pictures, column, strict=True):
            axis.imshow(picture)
            axis.set_axis_off()
    figure.supxlabel(words, fontsize="small")
    figure.savefig(path, dpi=110, facecolor="white")
    plt.close(figure)


def main() -> None:
    """Draw both pictures; only the first for a collection that is a product by design."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("config", type=Path)
    parser.add_argument("run", type=Path)
    given = parser.parse_args()
    run = Run(given.run, *load(given.config, stored=given.run / "config.toml"), given.run / "models")
    studio = Studio.of(Record(run.directory))
    if studio is None:
        raise SystemExit("Nothing to draw with: install embreex.")
    folder, name = MEASUREMENTS, given.config.stem
    models(run, studio, folder / f"{name}-models.png")
    if not run.by_design:
        modes(run, studio, folder / f"{name}-modes.png")


if __name__ == "__main__":
    main()
