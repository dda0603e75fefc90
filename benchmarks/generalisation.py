"""docs/measurements/generalisation.md: distance of spaces from unseen shapes, next to principal components.

Five folds of each collection have their own mean, logarithms and modes, for the number of modes in the example and for
half of it. Exponentials replace networks. Finished folds are kept under ``--out``. A collection with five finished
folds has its figures in ``runs/folds/``, and is not measured again.
"""

import argparse
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

PAGE = """# Unseen shapes, by modes alone

How near can the modes of a collection come to a shape that they were found without? This page has the answer for exact
[exponentials](../reference/glossary.md#exponential). [Served models](served.md) has it for networks, which users meet.

## Modes and principal components

For poses of hands and of the figure, modes leave much less than as many principal components; elsewhere about as much.

{plain}

The error is the mean distance of a vertex from its place, in percent of the
[diagonal](../reference/glossary.md#diagonal). The [ratio](../reference/glossary.md#ratio) is the error of modes divided
by the error of components. Each collection has two rows: with half of its modes and with all.

## With mirror images

Mirror images of the training shapes help modes and components alike on posed bodies; modes stay ahead there.

{mirrored}

Here modes also come from the [mirror images](../reference/glossary.md#mirror-image) of the training shapes. The ratio
is to the components that know these images too.

## How it was measured

- Five [folds](../reference/glossary.md#fold): each shape is left out once, and mean, logarithms and modes come from the
  other shapes. The error is of the nearest exponential to the shape left out, after rigid alignment.
- Meshes are coarse, with at most a thousand vertices. Rows with mirror images have another coarse mesh.
- K is the number of [time steps](../reference/glossary.md#time-steps): {steps}, or 1 where a fold chose it. The dancer
  (samba) and the posed bodies (makehuman) were measured before a fold could choose.
- No fold chooses by its own unseen shapes. The method itself was changed with such folds in view: see
  [how we know](../explanation/how-we-know.md#which-choice-was-made-on-which-data).
- For makehuman the ratios are upper bounds. Some of its poses lie where exponentials end, because faces collapse on the
  way; [served networks](served.md) go on there and come nearer.
- `python -m benchmarks.generalisation --data FOLDER` measures and writes this page. Figures, with 95th percentiles, are
  in `runs/folds/`.
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


def rows(name: str, found: dict[str, Any], others: tuple[str, ...]) -> list[list[str]]:
    """Return the rows of a collection: modes beside components, for each number of modes; the ratio is to the first."""
    result: list[list[str]] = []
    each = zip(found["counts"], found["modes"], *(found[other] for other in others), strict=True)
    for count, own, *components in each:
        title = f"{name}, K = {', '.join(map(str, found['steps']))}"
        errors = [f"{100 * some['mean']:.3f} %" for some in (own, *components)]
        result.append([f"{title}, {count} modes", *errors, f"{own['mean'] / components[0]['mean']:.2f}"])
    return result


def write_page() -> None:
    """Write the page from all stored figures."""
    done = {each: pages.read_figures(path) for each in ROWS if (path := FIGURES / f"{each}.json").exists()}
    plain = {name: found for name, found in done.items() if not name.endswith(MIRRORED)}
    images = {name.removesuffix(MIRRORED): found for name, found in done.items() if "mirrored_components" in found}
    page = PAGE.format(
        plain=pages.table(
            ("", "error of modes", "of components", "ratio"),
            (row for name, found in plain.items() for row in rows(name, found, ("components",))),
        ),
        mirrored=pages.table(
            ("", "error of modes", "of components with images", "of components without", "ratio to those with"),
            (row for name, found in images.items() for row in rows(name, found, ("mirrored_components", "components"))),
        ),
        steps=LIGHT_STEPS,
    )
    pages.write("generalisation", page)


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
            pages.write_figures(file, found)
        write_page()


if __name__ == "__main__":
    main()
