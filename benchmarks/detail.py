"""docs/measurements/detail.md: fine detail of the files in the answers, and the time to add it.

``python -m benchmarks.detail`` measures the models that ``python -m benchmarks.served`` left in its ``--out``, on
their training shapes and on unseen shapes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from threadpoolctl import threadpool_limits

from benchmarks import pages
from benchmarks.pages import ROOT
from benchmarks.results import COLLECTIONS
from shapespace.arrays import FloatArray
from shapespace.mesh.prolongation import Prolongation
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh, diagonal, face_normals
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.learning.evaluation import median_seconds
from shapespace.training.runs.directory import RunDirectory

PAGE = """# Fine detail

How much of the fine mesh of your files is left in an answer? A model computes the
[coarse mesh](../reference/glossary.md#coarse-and-fine-mesh), and weights carry the fine mesh along.

## Weights alone

Carrying the fine mesh along costs little: 0.01 to 0.02 % of the diagonal, and the surface stays as rough as it was.

{carried}

Here the coarse vertices come from the file, so the errors come from the weights alone. The table has unseen shapes;
training shapes differ by at most 0.001 %.

## Whole answers

The error of an answer comes from its modes. Answers are as rough as the files; hippocampi alone are smoother.

{answered}

Here the answer is the fine mesh of the code that `encode` finds for the file. These models had no
[memory](../reference/glossary.md#remembers) of their training shapes yet; [today's models](served.md#training-shapes)
return training shapes more exactly.

- **distance**: mean over all vertices after alignment, in percent of the [diagonal](../reference/glossary.md#diagonal).
- **normals**: median angle in degrees between the normal of a face and the same normal in the file.
- **roughness**: median angle between the normals of neighbouring faces, divided by the same angle in the file.
- [Unseen shapes](../reference/glossary.md#unseen-shape) had no part in mean, modes, networks and weights.

## Time

Carrying the fine mesh takes less time than the coarse shape, up to 160,000 vertices.

| fine vertices | ms | share of a shape of the figure |
|---|---|---|
{costs}

These are median times of one call on one thread, from {coarse} coarse vertices of a ball. One full shape of the figure
without its fine mesh is the unit. `python -m benchmarks.detail` measures and writes this page, with models of the first
folds of [served models](served.md).
"""
#: Subdivisions of an icosahedron for the coarse ball and for the fine balls.
COARSE, FINE = 3, (4, 5, 6, 7)
REPEATS = 21


class Detail(NamedTuple):
    """Distance as a share of the diagonal, angle between normals in degrees, and roughness relative to the file's."""

    distance: float
    normals: float
    roughness: float

    @classmethod
    def of(cls, found: FloatArray, file: FloatArray, mesh: Connectivity) -> Detail:
        """Compare an answer (V, 3) with a file (V, 3)."""
        found = align(found, file)
        own, others = (face_normals(shape, mesh.faces) for shape in (found, file))
        away = np.linalg.norm(found - file, axis=1).mean() / diagonal(file)
        roughness = [float(np.median(_angles(*normals[mesh.edge_faces[mesh.interior]].swapaxes(0, 1))))
                     for normals in (own, others)]  # fmt: skip
        return cls(float(away), float(np.median(_angles(own, others))), roughness[0] / roughness[1])


def _angles(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.rad2deg(np.arccos(np.clip((a * b).sum(axis=-1), -1, 1)))


def rows(name: str, out: Path) -> Iterator[tuple[list[str], list[str]]]:
    """Return rows of both tables for a collection: training shapes and unseen shapes."""
    run, model = RunDirectory(out / name), load(out / "models" / name)
    reference, weights = run.reference.read(), Prolongation.from_arrays(run.prolongation.read())
    mesh = Connectivity(reference["fine_faces"], len(reference["fine_vertices"]))
    files = {"trained on": out / "data" / f"{name}.npz", "unseen": out / "models" / f"{name}.npz"}
    for kind, file in files.items():
        with np.load(file) as arrays:
            shapes = arrays["vertices"].astype(np.float64)
        coarse = shapes[:, reference["fine_index"]]
        carried = [Detail.of(weights(y), x, mesh) for y, x in zip(coarse, shapes, strict=True)]
        answered = [Detail.of(model.decode(model.encode(x).code), x, mesh) for x in shapes]
        sizes = str(len(shapes)), f"{mesh.vertex_count:,} / {coarse.shape[1]:,}"
        found = []
        for size, each in zip(reversed(sizes), (carried, answered), strict=True):
            distance, normals, roughness = np.mean(each, axis=0)
            figures = f"{100 * distance:.3f}", f"{normals:.2f}", f"{roughness:.3f}"
            found.append([f"{name}, {kind}", size, *figures])
        yield found[0], found[1]


def costs(model: ShapeModel) -> Iterator[str]:
    """Return rows of the time to carry balls, relative to a shape of a model."""
    code = model.sample(1, 0)[0]
    coarse = _ball(COARSE)

    def full() -> object:
        return model.decode(code, mesh="coarse")

    with threadpool_limits(1):
        shape = median_seconds(full, REPEATS)
        for subdivisions in FINE:
            fine = _ball(subdivisions)
            weights = Prolongation.of(coarse, fine)
            seconds = median_seconds(partial(weights, coarse.vertices), REPEATS)
            yield f"| {len(fine.vertices):,} | {1e3 * seconds:.2f} | {seconds / shape:.2f} |"


def _ball(subdivisions: int) -> TriangleMesh:
    ball = trimesh.creation.icosphere(subdivisions)
    return TriangleMesh.from_arrays(ball.vertices, ball.faces)


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "served", help="what benchmarks.served has left")
    given = parser.parse_args()
    there = [name for name in COLLECTIONS if (given.out / "models" / f"{name}.npz").exists()]
    found = [both for name in there for both in rows(name, given.out)]
    figures = "distance", "normals", "roughness"
    carried = pages.table(
        ("", "vertices, fine / coarse", *figures),
        ([own[0].removesuffix(", unseen"), *own[1:]] for own, _ in found[1::2]),
    )
    answered = pages.table(("", "shapes", *figures), (own for _, own in found))
    cost = "\n".join(costs(load(ROOT / "models" / "figure")))
    page = PAGE.format(carried=carried, answered=answered, coarse=len(_ball(COARSE).vertices), costs=cost)
    pages.write("detail", page)


if __name__ == "__main__":
    main()
