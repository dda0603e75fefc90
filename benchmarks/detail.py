"""docs/measurements/detail.md: fine detail of the files in the answers.

``python -m benchmarks.detail`` measures the models that ``python -m benchmarks.served`` left in its ``--out``, on
unseen shapes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

import shapespace
from benchmarks import pages
from benchmarks.pages import ROOT
from benchmarks.results import COLLECTIONS
from shapespace.arrays import FloatArray
from shapespace.mesh.prolongation import Prolongation
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import Connectivity, diagonal, face_normals
from shapespace.model.shape_model import load
from shapespace.training.runs.directory import RunDirectory

PAGE = """# Fine detail

How much of your files' fine detail is left in an answer? A model computes the [coarse
mesh](../reference/glossary.md#coarse-and-fine-mesh), and fixed weights compute the fine mesh from it. The weights cost
at most 0.02 % of the [diagonal](../reference/glossary.md#diagonal) and keep the roughness.

Answers for unseen shapes are as rough as the files, with two exceptions. **Organs (hippocampi) lose a fifth of their
roughness**, and horses gain 7 %.

{table}

Left of an arrow is the fine mesh that the weights compute from the file's own coarse vertices. On the right is the
model's answer for the code that `encode` found. All shapes are [unseen](../reference/glossary.md#unseen-shape).

- **distance**: mean over all vertices, in percent of the diagonal.
- **normals**: median angle in degrees between the normal of a face and the same normal in the file.
- **roughness**: median angle between the normals of neighbouring faces, divided by the same angle in the file.

Measured in the first fold of [served models](served.md), with the code after {version}. `python -m
benchmarks.detail` measures and writes this page.
"""


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


def row(name: str, out: Path) -> list[str]:
    """Return the row of a collection: errors of the weights alone and of whole answers, for unseen shapes."""
    run, model = RunDirectory(out / name), load(out / "models" / name)
    reference, weights = run.reference.read(), Prolongation.from_arrays(run.prolongation.read())
    mesh = Connectivity(reference["fine_faces"], len(reference["fine_vertices"]))
    with np.load(out / "models" / f"{name}.npz") as arrays:
        shapes = arrays["vertices"].astype(np.float64)
    coarse = shapes[:, reference["fine_index"]]
    carried = np.mean([Detail.of(weights(y), x, mesh) for y, x in zip(coarse, shapes, strict=True)], axis=0)
    answered = np.mean([Detail.of(model.decode(model.encode(x).code), x, mesh) for x in shapes], axis=0)
    formats = "{:.3f}", "{:.2f}", "{:.3f}"
    factors = 100, 1, 1
    cells = [
        " → ".join(shown.format(factor * each[k]) for each in (carried, answered))
        for k, (shown, factor) in enumerate(zip(formats, factors, strict=True))
    ]
    return [name, f"{mesh.vertex_count} / {coarse.shape[1]}", *cells]


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "served", help="what benchmarks.served has left")
    given = parser.parse_args()
    there = [name for name in COLLECTIONS if (given.out / "models" / f"{name}.npz").exists()]
    head = "", "vertices, fine / coarse", "distance", "normals", "roughness"
    table = pages.table(head, (row(name, given.out) for name in there))
    pages.write("detail", PAGE.format(table=table, version=f"version {shapespace.__version__}"))


if __name__ == "__main__":
    main()
