"""docs/measurements/generalisation.md: distance of spaces from unseen shapes, next to principal components.

Five folds of each collection have their own mean, logarithms and modes, for the number of modes in the example and for
half of it. Exponentials replace networks. Finished folds are kept under ``--out``. A collection with five finished
folds has its figures in ``runs/folds/``, and is not measured again.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import pages
from benchmarks.pages import ROOT
from benchmarks.results import COLLECTIONS, MANNEQUIN, MIRRORED, SYMMETRIC, open_run
from shapespace.training.space.generalisation import LIGHT_STEPS, folds, held_out, summary
from shapespace.training.stages.ingest import ingest

#: Stored figures, one file for each collection.
FIGURES = ROOT / "runs" / "folds"

INTRODUCTION = """# Shapes that a space has not seen

Distance of a vertex from its place after rigid alignment, in percent of the bounding box's diagonal: mean and 95th
percentile over all vertices of all shapes, each held out in one of five folds that found mean, logarithms and modes
without it. **Modes**: the code whose exponential comes closest in vertices, in **K** time steps, {steps} or as the
folds chose; no networks.
**Components**: principal components of the aligned vertices, as many. On coarse meshes of at most a thousand vertices.
Rows *with mirror images* also learn from the images of the shapes that they know, which a symmetric shape of the
collection gives, on another coarse mesh; components are without and, in the last columns, with them too.
No fold chooses on its own held-out shapes: settings are those of `examples`, and each fold chooses K, and sparsity
where the settings leave it open, by the shapes that it knows. But how modes are found was settled with such folds in
view ([how we know](../explanation/how-we-know.md#which-choice-was-made-on-which-data)), and the rule for K was changed
twice after ([notes](notes.md#why-faces-are-no-nearer-than-components)). Rows of samba and of makehuman were measured
with K = 8 before K could be chosen.

Makehuman is further away here than [served networks](served.md) are: some of its poses lie where exponentials end, as
faces collapse on the way, and networks go on there ([notes](notes.md#where-exponentials-end)). The ratios of its rows
are upper bounds.

`python -m benchmarks.generalisation --data FOLDER` measures and writes this page; a collection is in
it once all its folds are measured, with figures in `runs/folds/`.

| | shapes | m | K | modes: mean | 95 % | components: mean | 95 % | ratio | components with images: mean | ratio |
|---|---|---|---|---|---|---|---|---|---|---|
"""
#: Rows of the table.
ROWS = tuple(
    name + ending for name in (*COLLECTIONS, MANNEQUIN) for ending in ("", MIRRORED) if name in SYMMETRIC or not ending
)


def measure(name: str, data: Path, out: Path) -> dict[str, Any]:
    """Return figures of a collection by number of coordinates, over all shapes, each from the fold that held it out."""
    opened = open_run(name, data, out)
    run, config = opened.directory, opened.config
    if not run.shapes.exists():
        run.folder.mkdir(parents=True, exist_ok=True)
        ingest(opened)
    reference, given = run.reference_mesh(), run.shapes.read()
    shapes, original, own = given["vertices"], given["original"], run.own_shapes()
    m = config.modes.count
    counts = None if m == "auto" else [-(-m // 2), m]
    every = []
    for k, index in enumerate(folds(len(own))):
        file = run.study(f"fold-{k}")
        if not file.exists():
            material = config.shell_material
            found = held_out(reference, shapes, index, counts, config.modes, material, original=original)
            away = found.distances(shapes, reference.diagonal)
            file.write(
                {"counts": found.counts, "steps": int(found.steps[0])}
                | {kind: [each.tolist() for each in rows] for kind, rows in away.items()}
            )
            means = {kind: [round(100 * float(np.mean(each)), 4) for each in rows] for kind, rows in away.items()}
            print(name, k, means, flush=True)
        every.append(file.read())
    return {
        "shapes": len(own),
        "counts": every[0]["counts"],
        "steps": sorted({fold["steps"] for fold in every}),
        **{
            kind: [summary(np.concatenate(some)) for some in zip(*(fold[kind] for fold in every), strict=True)]
            for kind in every[0]
            if kind not in ("counts", "steps")
        },
    }


def title(name: str) -> str:
    """Return the title of a row."""
    return name.replace(MIRRORED, ", with mirror images")


def beside_images(own: dict[str, float], images: dict[str, float] | None) -> list[str]:
    """Return the last cells of a row: error of components with mirror images, and the ratio to it, if measured."""
    return [f"{100 * images['mean']:.3f}", f"{own['mean'] / images['mean']:.2f}"] if images else ["", ""]


def rows(name: str, found: dict[str, Any]) -> list[str]:
    """Return the rows of a collection."""
    result: list[str] = []
    mirrored = found.get("mirrored_components", [None] * len(found["counts"]))
    each = zip(found["counts"], found["modes"], found["components"], mirrored, strict=True)
    for count, own, other, images in each:
        figures = [f"{100 * figure:.3f}" for figure in (own["mean"], own["p95"], other["mean"], other["p95"])]
        cells = [
            "" if result else title(name),
            str(found["shapes"]),
            str(count),
            ", ".join(map(str, found["steps"])),
            *figures,
            f"{own['mean'] / other['mean']:.2f}",
        ]
        cells += beside_images(own, images)
        result.append(pages.row(cells))
    return result


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "generalisation")
    parser.add_argument("names", nargs="*", default=ROWS)
    given = parser.parse_args()
    for name in given.names:
        file = FIGURES / f"{name}.json"
        if not file.exists():
            found = measure(name, given.data, given.out)
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(found, indent=1), encoding="utf-8")
        done = {each: json.loads(path.read_text()) for each in ROWS if (path := FIGURES / f"{each}.json").exists()}
        table = "\n".join(row for each in done.items() for row in rows(*each))
        page = INTRODUCTION.format(steps=LIGHT_STEPS) + table + "\n"
        pages.write("generalisation", page)


if __name__ == "__main__":
    main()
