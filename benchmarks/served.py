"""docs/measurements/served.md: distance of served models from unseen shapes, next to simple models.

``python -m benchmarks.served --data FOLDER`` trains a model on four fifths of each collection and exports it. Its
``encode`` then finds the codes of the other fifth and of the training shapes. Then follows a model without the next
fifth, until each fifth was held out once, or ``--folds`` of them. Results are kept under
``--out``, so a killed call can be continued. A row keeps no fold of another version. ``python -m benchmarks.fit
--data OUT/models`` fits scans of the first fifth.
"""

import argparse
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchmarks import pages
from benchmarks.generalisation import SIMPLE, against_the_best
from benchmarks.pages import ROOT, table
from benchmarks.results import COLLECTIONS, MANNEQUIN, open_run
from shapespace.arrays import FloatArray
from shapespace.counted import counted
from shapespace.mesh.triangle_mesh import TriangleMesh, diagonal
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.runs.config import parse
from shapespace.training.space.generalisation import (
    RANDOM,
    PrincipalComponents,
    summary,
    to_nearest,
    vertex_distances,
)
from shapespace.training.space.held_out import simple_models
from shapespace.training.space.related import FOLDS, Related
from shapespace.training.stages.export import write_bundle_of
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run, read_meshes

#: Largest number of exponentials to learn from: joint, and of each factor.
JOINT, OF_FACTORS = 1000, 300
COLUMNS = ("unseen", "trained on")
#: Key of the figures of a model without stored training shapes.
WITHOUT_EXAMPLES = "nothing remembered"
#: Ending of the names of runs with half as many modes.
HALF = "-half"
#: Models, in the order of the rows.
NAMES = tuple(each + ending for each in (*COLLECTIONS, MANNEQUIN) for ending in ("", HALF))
#: Stored figures, one file for each row; a stored fold is not measured again.
FIGURES = ROOT / "runs" / "collections"

PAGE = """# Errors on unseen shapes

How near does a model come to a shape that it has never seen? [Is it for my data?](../is-it-for-me.md) has the
summary. Errors are mean distances of vertices in percent of the [diagonal](../reference/glossary.md#diagonal).

## Unseen shapes

{finding}

{unseen}

- After the slash stands the 95th percentile.
- *Components* are as many principal components. [Ratios](../reference/glossary.md#ratio) below 1 are good.
- In brackets stand the smallest and the largest ratio of a [fold](../reference/glossary.md#fold).{incomplete}
- *Map*: each fold chose its [map](../explanation/choosing.md#map-from-codes-to-shapes) by itself. Two names mean that
  folds chose differently.
- Each collection has a second model with half of its modes.

## Simple models

{simplest}

{simple}

Each figure is the error as a share of the error of principal components. The first column is our model without its
[memory](../reference/glossary.md#remembers) of training shapes (`export.examples = false`). [Modes
alone](generalisation.md#stronger-simple-models) explains the simple models, and compares them on coarse meshes. There,
straight lines of lengths and angles do better. The fine horse, dancer and bodies have creased places. An angle
between two faces changes by more than 180° from pose to pose there, and no straight line follows that.

## Training shapes and random shapes

Users get their own shapes back almost exactly, which comes from the memory. Random shapes of both models have similar
distances from the training shapes.

{known}

*Random shapes*: the [specificity](../reference/glossary.md#specificity), ours / of components, for {codes} codes drawn
evenly from the [bounds](../reference/glossary.md#bounds), in the first fold. A smaller distance is better. In the
figure's row, which is older, the bounds of components [were not
widened](../../benchmarks/NOTES.md#maps-from-codes-to-shapes), so their distance is a little too small.

## How it was measured

- Each fold trains and exports a model on four fifths of the shapes. Settings come from `examples/collections/`, without
  mirror images. {measured}
- Networks learned from at most {joint} [joint](../reference/glossary.md#joint-code) samples and {factors} of each
  factor.
- We gave the fine meshes of the unseen shapes to `encode` of the exported model. Simple models come from the same fine
  meshes. All find codes by vertices.
- The figure with 20 modes was measured before there were [local fields](../explanation/choosing.md#local-fields).
- For straight lines, `encode` now goes [farther outside the bounds](../../benchmarks/NOTES.md#local-fields). Measured
  with it: folds 1 to 3 of makehuman with 34 modes, and folds 0 to 2 of the horse with 10.
- No fold chose by its own unseen shapes, but we [changed the
  method](../explanation/how-we-know.md#which-choice-was-made-on-which-data) with some of them in view.
- `python -m benchmarks.served --data FOLDER` trains, measures and writes this page. Figures are in
  `runs/collections/`.
"""


def four_fifths(name: str, data: Path, out: Path, fold: int = 0) -> tuple[Run, FloatArray, FloatArray]:
    """Return the run of a collection without one fold, its fine training meshes (n, V, 3), and the held-out meshes.

    A name that ends in ``HALF`` gets half as many modes.
    """
    example = open_run(name.removesuffix(HALF), data, out)
    meshes = read_meshes(example.config)
    held = Related.none(len(meshes.names)).folds()[fold]
    known, names = (np.delete(array, held, axis=0) for array in (meshes.vertices, np.array(meshes.names)))
    ending = f"-fold-{fold}" if fold else ""
    file = out / "data" / f"{name.removesuffix(HALF)}{ending}.npz"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, vertices=known, faces=meshes.faces, names=names)
    document: Any = tomlkit.parse(example.source)
    document["collection"].pop("generator", None)
    document["collection"]["data"] = str(file.resolve())
    document["modes"]["geometry"] = "auto"  # as `init` writes it
    if name.endswith(HALF):
        document["modes"]["count"] = -(-document["modes"]["count"] // 2)
    joint, factors = example.config.samples.count, example.config.samples.factor_counts
    document["samples"]["count"] = min(joint, JOINT)
    document["samples"]["factor_counts"] = min(factors, OF_FACTORS) if isinstance(factors, int) else OF_FACTORS
    document.pop("evaluation", None)
    document.get("networks", {}).pop("paper", None)
    document["export"].pop("names", None)
    document["export"]["name"] = name + ending
    text = tomlkit.dumps(document)
    run = Run(out / (name + ending), parse(text, name), text, out / "models")
    return run, known, meshes.vertices[held]


def encoded(model: ShapeModel, shapes: FloatArray) -> FloatArray:
    """Return vertex distances (n, V) between shapes (n, V, 3) and their encoded shapes, as shares of the diagonal."""
    size = float(diagonal(model.vertices))
    return np.stack([model.encode(shape).distances for shape in shapes]) / size


def without_examples(run: Run) -> ShapeModel:
    """Return the model of a run without the stored training shapes of its bundle."""
    settings = run.config.export.model_copy(update={"examples": False})
    config = run.config.model_copy(update={"export": settings})
    other = Run(run.directory.folder, config, run.source, run.models / WITHOUT_EXAMPLES)
    return load(other.bundle if other.bundle.exists() else write_bundle_of(other, figures={}))


def simple(known: FloatArray, unseen: FloatArray, model: ShapeModel) -> dict[str, dict[str, float]]:
    """Return figures of the simple models of the known shapes (n, V, 3), with as many coordinates as a model."""
    reference = TriangleMesh.from_arrays(model.vertices, model.faces)
    size = float(diagonal(model.vertices))
    models = simple_models(reference, known, np.ones(len(known), dtype=bool))
    return {
        kind: summary(vertex_distances(models[kind](unseen, model.dimension), unseen, size))
        for kind in SIMPLE
        if kind in models
    }


def measure(name: str, data: Path, out: Path, fold: int) -> dict[str, Any]:
    """Train without a fold, and measure the model; the first fold has further figures."""
    run, known, unseen = four_fifths(name, data, out, fold)
    execute(run, "samples", keep_going=True)
    model = load(run.bundle if run.bundle.exists() else write_bundle_of(run, figures={}))
    m, size = model.dimension, float(diagonal(model.vertices))
    linear, without = PrincipalComponents.of(known, model.vertices), without_examples(run)
    found: dict[str, Any] = {"modes": m, "map": run.directory.geometry.read().get("kind", "exponential")}
    for kind, shapes in zip(COLUMNS, (unseen, known), strict=True):
        others = vertex_distances(linear.nearest(shapes, m), shapes, size)
        found[kind] = summary(encoded(model, shapes)) | {
            "components": summary(others),
            WITHOUT_EXAMPLES: summary(encoded(without, shapes)),
            "shapes": len(shapes),
        }
    found[COLUMNS[0]] |= simple(known, unseen, model)
    if fold:
        return found
    np.savez(out / "models" / f"{name}.npz", vertices=unseen)
    drawn = np.stack([model.decode(code) for code in model.sample(RANDOM, 0)])
    others = linear.random(m, RANDOM, np.random.default_rng(0))
    return found | {"specificity": [to_nearest(each, known, size) for each in (drawn, others)]}


def over_shapes(folds: list[dict[str, Any]], model: str | None = None, key: str = "mean") -> float:
    """Return a figure as a mean over all shapes: of the model, or of another in the same folds."""
    figures = [(fold[model] if model else fold)[key] for fold in folds]
    return float(np.average(figures, weights=[fold["shapes"] for fold in folds]))


def average(folds: list[dict[str, Any]], model: str | None = None, keys: tuple[str, ...] = ("mean", "p95")) -> str:
    """Return a cell with means over all shapes: of the model, of another in the same folds, or nothing."""
    if "mean" not in (folds[0][model] if model else folds[0]):
        return ""
    return "\N{NO-BREAK SPACE}/\N{NO-BREAK SPACE}".join(f"{100 * over_shapes(folds, model, key):.3f}" for key in keys)


def ratio(folds: list[dict[str, Any]], model: str | None = None) -> str:
    """Return a cell with the ratio of means to the components' means, and the folds' smallest and largest ratio."""
    some = [fold[model] if model else fold for fold in folds]
    if "mean" not in some[0]:
        return ""
    found = np.array([(each["mean"], fold["components"]["mean"]) for each, fold in zip(some, folds, strict=True)])
    each = found[:, 0] / found[:, 1]
    return f"{over_shapes(folds, model) / over_shapes(folds, 'components'):.2f}" + (
        f" ({each.min():.2f}–{each.max():.2f})" if folds[1:] else ""
    )


def best_simple(folds: list[dict[str, Any]]) -> tuple[str, float] | None:
    """Return the key of the best simple model, and the share of its error that ours is; None if unmeasured."""
    measured = [kind for kind in SIMPLE if all(kind in fold for fold in folds)]
    if not measured:
        return None
    means = {kind: over_shapes(folds, kind) for kind in ("components", *measured)}
    best = min(means, key=lambda kind: means[kind])
    return best, over_shapes(folds) / means[best]


def incomplete(rows: dict[str, list[dict[str, Any]]]) -> str:
    """Say which rows don't have all folds, and which were measured before runs chose their map."""
    few: dict[int, list[str]] = {}
    for name, found in rows.items():
        if len(found) < FOLDS:
            title = f"{name.removesuffix(HALF)} with half of its modes" if name.endswith(HALF) else name
            few.setdefault(len(found), []).append(title)
    said = [  # one fold has no range
        f" Rows without brackets have only 1 of {FOLDS} folds."
        if count == 1
        else f" Only {count} of {FOLDS} folds: {', '.join(titles)}."
        for count, titles in few.items()
    ]
    if not all("map" in fold for found in rows.values() for fold in found):
        said.append("\n- Rows without a last figure are older: exponentials were the only map then.")
    return "".join(said)


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "served")
    parser.add_argument("names", nargs="*", default=NAMES, help=f"of rows: {', '.join(NAMES)}")
    parser.add_argument("--folds", type=int, default=FOLDS, help="how many fifths are held out")
    given = parser.parse_args()
    for name in given.names:
        file = FIGURES / f"{name}.json"
        stored = pages.read_figures(file) if file.exists() else []
        found = [fold for fold in stored if "map" in fold]
        for fold in range(len(found), given.folds):
            found.append(measure(name, given.data, given.out, fold))
            pages.write_figures(file, found)
            write_page()


def write_page() -> None:
    """Write the page from all stored figures."""
    files = {name: FIGURES / f"{name}.json" for name in NAMES}
    rows = {name: pages.read_figures(file) for name, file in files.items() if file.exists()}
    tables: dict[str, list[list[str]]] = {"unseen": [], "simple": [], "known": []}
    shares: dict[str, float] = {}
    rivals: Counter[str] = Counter()
    for name, found in rows.items():
        modes = [fold["modes"] for fold in found]
        count = " – ".join(map(str, sorted({min(modes), max(modes)})))
        title = f"{name.removesuffix(HALF)}, {count} modes"
        unseen, known = ([fold[kind] for fold in found] for kind in COLUMNS)
        maps = ", ".join(sorted({fold.get("map", "exponential") for fold in found}))
        tables["unseen"].append([title, maps, average(unseen), ratio(unseen), ""])
        if best := best_simple(unseen):
            shares[title] = best[1]
            tables["unseen"][-1][-1] = f"{shares[title]:.2f}"
        if name.endswith(HALF):
            continue
        if best:
            rivals[SIMPLE.get(best[0], best[0])] += 1
            others = [ratio(unseen, kind) if kind in unseen[0] else "" for kind in (WITHOUT_EXAMPLES, *SIMPLE)]
            tables["simple"].append([title, *(each.partition(" (")[0] for each in others)])
        drawn = " / ".join(f"{100 * figure:.2f}" for figure in found[0]["specificity"])
        tables["known"].append(
            [title, *(average(known, model, ("mean",)) for model in (None, "components", WITHOUT_EXAMPLES)), drawn]
        )
    heads = {
        "unseen": ("map", "our error (%)", "ratio to components", "ratio to the best simple model"),
        "simple": ("ours without memory", *SIMPLE.values()),
        "known": ("our error", "of components", "ours without memory", "random shapes"),
    }
    page = PAGE.format(
        joint=JOINT,
        factors=OF_FACTORS,
        codes=RANDOM,
        finding=against_the_best(list(shares.values())),
        simplest="The best simple model is "
        + ", ".join(f"{rival} in {counted(count, 'row')}" for rival, count in rivals.most_common())
        + ".",
        incomplete=incomplete(rows),
        measured=pages.measured_with(*(files[name] for name in rows)),
        **{kind: table(("", *heads[kind]), cells) for kind, cells in tables.items()},
    )
    pages.write("served", page)


if __name__ == "__main__":
    main()
