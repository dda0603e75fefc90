"""docs/measurements/generalisation.md: how near spaces come to unseen shapes, beside principal components.

Five folds of each collection, each with mean, logarithms and modes of its own, for as many modes as the example has and
half of that. Exponentials stand for networks. A fold that is done is kept under ``--out`` and not done again.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from benchmarks.results import COLLECTIONS, ROOT, open_run
from shapespace.training.space import stages
from shapespace.training.space.generalisation import FOLDS, folds, held_out

INTRODUCTION = """# Shapes that a space has not seen

Distance of a vertex from its place after rigid alignment, in percent of the bounding box's diagonal: mean and 95th
percentile over all vertices of all shapes, each held out in one of five folds that found mean, logarithms and modes
without it. **Modes**: the code whose exponential comes closest in vertices, in {steps} time steps; no networks.
**Components**: principal components of the aligned vertices, as many. On coarse meshes of at most a thousand vertices.
Folds choose nothing: settings are those of `examples/collections`. `python -m benchmarks.generalisation --data FOLDER`
measures and writes this page; a collection is in it once all its folds are measured.

| | shapes | coordinates | modes: mean | 95 % | components: mean | 95 % | modes / components |
|---|---|---|---|---|---|---|---|
"""


def measure(name: str, data: Path, out: Path) -> None:
    """Leave a file of figures for each fold of a collection."""
    opened = open_run(name, data, out)
    run, config = opened.directory, opened.config
    if not run.shapes.exists():
        run.folder.mkdir(parents=True, exist_ok=True)
        stages.ingest(run, config)
    shapes, reference = run.shapes.read()["vertices"], run.reference_mesh()
    m = config.modes.count
    counts = None if m == "auto" else [-(-m // 2), m]
    for k, index in enumerate(folds(len(shapes))):
        file = run.study(f"fold-{k}")
        if file.exists():
            continue
        material = stages.material(config)
        found = held_out(reference, shapes, index, counts, config.modes, material, stages.LIGHT_STEPS)
        away = {
            name: [each.tolist() for each in rows] for name, rows in found.distances(shapes, reference.diagonal).items()
        }
        file.write({"counts": found.counts, **away})
        print(
            name,
            k,
            {kind: [round(100 * float(np.mean(each)), 4) for each in rows] for kind, rows in away.items()},
            flush=True,
        )


def rows(name: str, out: Path) -> list[str]:
    """Of the table, once all folds are there."""
    files = sorted((out / name).glob("fold-*.json"))
    if len(files) < FOLDS:
        return []
    every = [json.loads(file.read_text()) for file in files]
    result = []
    for k, count in enumerate(every[0]["counts"]):
        distances = (
            100 * np.concatenate([np.array(fold[kind][k]) for fold in every]) for kind in ("modes", "components")
        )
        (own, own95), (other, other95) = ((each.mean(), np.percentile(each, 95)) for each in distances)
        shapes = sum(len(fold["modes"][k]) for fold in every)
        figures = [f"{figure:.3f}" for figure in (own, own95, other, other95)]
        cells = [name if k == 0 else "", str(shapes), str(count), *figures, f"{own / other:.2f}"]
        result.append(f"| {' | '.join(cells)} |")
    return result


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "generalisation")
    parser.add_argument("names", nargs="*", default=COLLECTIONS)
    given = parser.parse_args()
    for name in given.names:
        measure(name, given.data, given.out)
        table = "\n".join(row for each in COLLECTIONS for row in rows(each, given.out))
        page = INTRODUCTION.format(steps=stages.LIGHT_STEPS) + table + "\n"
        (ROOT / "docs" / "measurements" / "generalisation.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
