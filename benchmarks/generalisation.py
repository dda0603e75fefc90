"""docs/measurements/generalisation.md: how near spaces come to unseen shapes, beside principal components.

Five folds of each collection, each with mean, logarithms and modes of its own, for as many modes as the example has
and half of that. Exponentials stand for networks. A fold that is done is kept under ``--out`` and not done again; a
collection whose folds are all done has its figures in ``runs/folds/``, and is not measured again while they are there.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.results import COLLECTIONS, ROOT, open_run
from shapespace.training.space import stages
from shapespace.training.space.generalisation import folds, held_out, summary

#: What was measured, a file for each collection.
FIGURES = ROOT / "runs" / "folds"

INTRODUCTION = """# Shapes that a space has not seen

Distance of a vertex from its place after rigid alignment, in percent of the bounding box's diagonal: mean and 95th
percentile over all vertices of all shapes, each held out in one of five folds that found mean, logarithms and modes
without it. **Modes**: the code whose exponential comes closest in vertices, in {steps} time steps; no networks.
**Components**: principal components of the aligned vertices, as many. On coarse meshes of at most a thousand vertices.
Folds choose nothing: settings are those of `examples/collections`. `python -m benchmarks.generalisation --data FOLDER`
measures and writes this page; a collection is in it once all its folds are measured, with figures in `runs/folds/`.

| | shapes | coordinates | modes: mean | 95 % | components: mean | 95 % | modes / components |
|---|---|---|---|---|---|---|---|
"""


def measure(name: str, data: Path, out: Path) -> dict[str, Any]:
    """Figures of a collection, by number of coordinates: of all its shapes, each in the fold that held it out."""
    opened = open_run(name, data, out)
    run, config = opened.directory, opened.config
    if not run.shapes.exists():
        run.folder.mkdir(parents=True, exist_ok=True)
        stages.ingest(run, config)
    shapes, reference = run.shapes.read()["vertices"], run.reference_mesh()
    m = config.modes.count
    counts = None if m == "auto" else [-(-m // 2), m]
    every = []
    for k, index in enumerate(folds(len(shapes))):
        file = run.study(f"fold-{k}")
        if not file.exists():
            material = stages.material(config)
            found = held_out(reference, shapes, index, counts, config.modes, material, stages.LIGHT_STEPS)
            away = found.distances(shapes, reference.diagonal)
            file.write(
                {"counts": found.counts} | {kind: [each.tolist() for each in rows] for kind, rows in away.items()}
            )
            means = {kind: [round(100 * float(np.mean(each)), 4) for each in rows] for kind, rows in away.items()}
            print(name, k, means, flush=True)
        every.append(file.read())
    return {
        "shapes": len(shapes),
        "counts": every[0]["counts"],
        **{
            kind: [summary(np.concatenate(some)) for some in zip(*(fold[kind] for fold in every), strict=True)]
            for kind in ("modes", "components")
        },
    }


def rows(name: str, found: dict[str, Any]) -> list[str]:
    """Of the table."""
    result: list[str] = []
    for count, own, other in zip(found["counts"], found["modes"], found["components"], strict=True):
        figures = [f"{100 * figure:.3f}" for figure in (own["mean"], own["p95"], other["mean"], other["p95"])]
        cells = [name if not result else "", str(found["shapes"]), str(count), *figures]
        result.append(f"| {' | '.join(cells)} | {own['mean'] / other['mean']:.2f} |")
    return result


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "generalisation")
    parser.add_argument("names", nargs="*", default=COLLECTIONS)
    given = parser.parse_args()
    for name in given.names:
        file = FIGURES / f"{name}.json"
        if not file.exists():
            found = measure(name, given.data, given.out)
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(found, indent=1), encoding="utf-8")
        done = {
            each: json.loads(path.read_text()) for each in COLLECTIONS if (path := FIGURES / f"{each}.json").exists()
        }
        table = "\n".join(row for each in done.items() for row in rows(*each))
        page = INTRODUCTION.format(steps=stages.LIGHT_STEPS) + table + "\n"
        (ROOT / "docs" / "measurements" / "generalisation.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
