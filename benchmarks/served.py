"""docs/measurements/served.md: distance of served models from unseen shapes, next to principal components.

``python -m benchmarks.served --data FOLDER`` trains a model on four fifths of each collection and exports it. Its
``encode`` then finds the codes of the other fifth and of the training shapes. Then follows a model without the next
fifth, until each fifth was held out once, or ``--folds`` of them. Results are kept under ``--out``, so a killed call
can be continued. ``python -m benchmarks.fit --data OUT/models`` fits scans of the first fifth.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchmarks import pages
from benchmarks.generalisation import ROWS
from benchmarks.pages import ROOT, table
from benchmarks.results import MIRRORED, open_run
from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh, diagonal
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.collection.mirror import find_mirror, mirrored
from shapespace.training.runs.config import parse
from shapespace.training.space.generalisation import (
    FOLDS,
    RANDOM,
    PrincipalComponents,
    folds,
    summary,
    to_nearest,
    vertex_distances,
)
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
NAMES = tuple(each + ending for each in ROWS for ending in ("", HALF))
#: A ratio below this is a clear gain.
PAYS = 0.7
#: Stored figures, one file for each row; a stored fold is not measured again.
FIGURES = ROOT / "runs" / "collections"

PAGE = """# Errors on unseen shapes

How near does a model come to a shape that it has never seen? [Is it for my data?](../is-it-for-me.md) has the
summary. Errors are mean distances of vertices in percent of the [diagonal](../reference/glossary.md#diagonal); after
the slash stands the 95th percentile. Each collection also has a model with half of its modes. {measured}

## Unseen shapes

For {better}, our error is {gain} of the error of as many principal components. For the other collections with all
their modes it is {rest}.

{unseen}

The [ratio](../reference/glossary.md#ratio) has the smallest and the largest ratio of a
[fold](../reference/glossary.md#fold) in brackets. The last column is the ratio of the same model without its
[memory](../reference/glossary.md#remembers) of training shapes (`export.examples = false`). Memory helps most with
faces and the dancer (samba). Each fold of makehuman trains on 35 or 36 shapes, which limits its modes.

With [mirror images](../reference/glossary.md#mirror-image) of the training shapes, faces have a ratio of {images}
without memory. Components that know these images too are as good.

## Training shapes

Users get their own shapes back almost exactly. This comes from the memory, not from better modes, as the last column
shows.

{known}

## Random shapes

Random shapes of our models look more like the collection than random shapes of components. The exception is the
dancer.

{first}

The table has the [specificity](../reference/glossary.md#specificity) in percent of the diagonal, of {codes} codes
drawn evenly from the bounds, in the first fold.

## How it was measured

- We trained and exported each model five times on four fifths of the shapes, so that each shape was unseen once.
  Settings come from `examples/collections/`, without mirror images.
- Networks learned from at most {joint} [joint](../reference/glossary.md#joint-code) samples and {factors} of each
  factor.
- `encode` of the exported model got the fine meshes. Components come from the fine meshes of the same four fifths.
- No fold chose by its own unseen shapes, but we [changed the
  method](../explanation/how-we-know.md#which-choice-was-made-on-which-data) with some of them in view.
- `python -m benchmarks.served --data FOLDER` trains, measures and writes this page. Figures are in
  `runs/collections/`.
"""


def four_fifths(name: str, data: Path, out: Path, fold: int = 0) -> tuple[Run, FloatArray, FloatArray]:
    """Return the run of a collection without one fold, its fine training meshes (n, V, 3), and the held-out meshes.

    A name that ends in ``HALF`` gets half as many modes; ``MIRRORED`` before that adds mirror images.
    """
    example = open_run(name.removesuffix(HALF), data, out)
    meshes = read_meshes(example.config)
    held = folds(len(meshes.names))[fold]
    known, names = (np.delete(array, held, axis=0) for array in (meshes.vertices, np.array(meshes.names)))
    ending = f"-fold-{fold}" if fold else ""
    file = out / "data" / f"{name.removesuffix(HALF).removesuffix(MIRRORED)}{ending}.npz"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, vertices=known, faces=meshes.faces, names=names)
    document: Any = tomlkit.parse(example.source)
    document["collection"].pop("generator", None)
    document["collection"]["data"] = str(file.resolve())
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


def with_images(known: FloatArray, model: ShapeModel) -> PrincipalComponents:
    """Return components of shapes (n, V, 3) and their mirror images.

    Raises:
        ValueError: none of the shapes is symmetric.
    """
    symmetric = find_mirror(known, TriangleMesh.from_arrays(known[0], model.faces).edges)
    if symmetric is None:
        raise ValueError("none of the shapes is symmetric")
    return PrincipalComponents.of(np.concatenate([known, mirrored(known, symmetric[0])[0]]), model.vertices)


def measure(name: str, data: Path, out: Path, fold: int) -> dict[str, Any]:
    """Train without a fold, and measure the model; the first fold has further figures."""
    run, known, unseen = four_fifths(name, data, out, fold)
    execute(run, "samples", keep_going=True)
    model = load(run.bundle if run.bundle.exists() else write_bundle_of(run, figures={}))
    m, size = model.dimension, float(diagonal(model.vertices))
    linear, without = PrincipalComponents.of(known, model.vertices), without_examples(run)
    found: dict[str, Any] = {"modes": m}
    for kind, shapes in zip(COLUMNS, (unseen, known), strict=True):
        others = vertex_distances(linear.nearest(shapes, m), shapes, size)
        found[kind] = summary(encoded(model, shapes)) | {
            "components": summary(others),
            WITHOUT_EXAMPLES: summary(encoded(without, shapes)),
            "shapes": len(shapes),
        }
    if fold:
        return found
    np.savez(out / "models" / f"{name}.npz", vertices=unseen)
    if name.removesuffix(HALF).endswith(MIRRORED):
        others = vertex_distances(with_images(known, model).nearest(unseen, m), unseen, size)
        found["mirrored_components"] = summary(others)
    drawn = np.stack([model.decode(code) for code in model.sample(RANDOM, 0)])
    others = linear.random(m, RANDOM, np.random.default_rng(0))
    return found | {"specificity": [to_nearest(each, known, size) for each in (drawn, others)]}


def average(folds: list[dict[str, Any]], model: str | None = None, keys: tuple[str, ...] = ("mean", "p95")) -> str:
    """Return a cell with means over all shapes: of the model, of another in the same folds, or nothing."""
    some = [fold[model] if model else fold for fold in folds]
    if "mean" not in some[0]:
        return ""
    weights = [fold["shapes"] for fold in folds]
    return "\N{NO-BREAK SPACE}/\N{NO-BREAK SPACE}".join(
        f"{100 * np.average([each[key] for each in some], weights=weights):.3f}" for key in keys
    )


def ratio(folds: list[dict[str, Any]], model: str | None = None) -> str:
    """Return a cell with the ratio of means to the components' means, and the folds' smallest and largest ratio."""
    some = [fold[model] if model else fold for fold in folds]
    if "mean" not in some[0]:
        return ""
    found = np.array([(each["mean"], fold["components"]["mean"]) for each, fold in zip(some, folds, strict=True)])
    mean, components = np.average(found, axis=0, weights=[fold["shapes"] for fold in folds])
    each = found[:, 0] / found[:, 1]
    return f"{mean / components:.2f}" + (f" ({each.min():.2f}–{each.max():.2f})" if folds[1:] else "")


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
        found = pages.read_figures(file) if file.exists() else []
        for fold in range(given.folds):
            if fold < len(found) and "mean" in found[fold][COLUMNS[0]]:
                continue
            found[fold : fold + 1] = [measure(name, given.data, given.out, fold)]
            pages.write_figures(file, found)
            write_page()


def write_page() -> None:
    """Write the page from all stored figures."""
    files = {name: FIGURES / f"{name}.json" for name in NAMES}
    rows = {name: pages.read_figures(file) for name, file in files.items() if file.exists()}
    images = ratio([fold["unseen"] for fold in rows.pop("faces" + MIRRORED)], WITHOUT_EXAMPLES).split()[0]
    tables: dict[str, list[list[str]]] = {"unseen": [], "known": [], "first": []}
    whole: dict[str, str] = {}
    for name, found in rows.items():
        modes = [fold["modes"] for fold in found]
        count = " – ".join(map(str, sorted({min(modes), max(modes)})))
        title = f"{name.removesuffix(HALF)}, {count} modes"
        unseen, known = ([fold[kind] for fold in found] for kind in COLUMNS)
        alone = ratio(unseen, WITHOUT_EXAMPLES).partition(" (")[0]
        tables["unseen"].append([title, average(unseen), average(unseen, "components"), ratio(unseen), alone])
        if name.endswith(HALF):
            continue
        whole[name] = ratio(unseen).split()[0]
        alone = average(known, WITHOUT_EXAMPLES, ("mean",))
        tables["known"].append([title, average(known), average(known, "components"), alone])
        tables["first"].append([title, *(f"{100 * figure:.2f}" for figure in found[0]["specificity"])])
    better = {name: found for name, found in whole.items() if float(found) < PAYS}
    rest = [found for name, found in whole.items() if name not in better]
    heads = {
        "unseen": ("our error", "components", "ratio", "ratio without memory"),
        "known": ("our error", "components", "ours without memory"),
        "first": ("our random shapes", "of components"),
    }
    page = PAGE.format(
        joint=JOINT,
        factors=OF_FACTORS,
        codes=RANDOM,
        better=" and ".join(", ".join(better).rsplit(", ", 1)),
        gain=f"{min(better.values())} to {max(better.values())}",
        rest=f"{min(rest)} to {max(rest)}",
        images=images,
        measured=pages.measured_with(*(files[name] for name in rows)),
        **{kind: table(("", *heads[kind]), cells) for kind, cells in tables.items()},
    )
    pages.write("served", page)


if __name__ == "__main__":
    main()
