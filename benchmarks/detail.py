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

Models of the first folds of [served.md](served.md), before some of them were trained anew there: how near fine answers
come to the files' fine meshes, and how rough they are.
**fine**, **coarse**: vertices. **carried**: the shape's own coarse vertices, taken from the file, with the weights
that carry the fine mesh along; **answered**: the fine mesh of the code that `encode` finds for the file. **unseen**
shapes had no part in mean, modes, networks and weights. **distance**: mean of all vertices after rigid alignment, in
percent of the bounding box's diagonal. **normals**: median angle between a face's normal and that in the file, in
degrees. **roughness**: median angle between the normals of neighbouring faces, as a multiple of the file's. All are
means over the shapes.

| | shapes | fine | coarse | carried: distance | normals | roughness | answered: distance | normals | roughness |
|---|---|---|---|---|---|---|---|---|---|
{rows}

## What it costs

Median time to carry one shape from {coarse} coarse vertices, a ball, beside one full shape of the figure without its
fine mesh, in one call on one thread. `python -m benchmarks.detail` measures and writes this page.

| fine vertices | ms | of a shape of the figure |
|---|---|---|
{costs}
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


def rows(name: str, out: Path) -> Iterator[str]:
    """Return rows of a collection: training shapes and unseen shapes."""
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
        cells = [f"{name}, {kind}", str(len(shapes)), f"{mesh.vertex_count:,}", f"{coarse.shape[1]:,}"]
        for each in (carried, answered):
            distance, normals, roughness = np.mean(each, axis=0)
            cells += [f"{100 * distance:.3f}", f"{normals:.2f}", f"{roughness:.3f}"]
        yield pages.row(cells)


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
    found = [row for name in there for row in rows(name, given.out)]
    cost = "\n".join(costs(load(ROOT / "models" / "figure")))
    page = PAGE.format(rows="\n".join(found), coarse=len(_ball(COARSE).vertices), costs=cost)
    pages.write("detail", page)


if __name__ == "__main__":
    main()
