"""docs/measurements/served.md: distance of served models from unseen shapes, next to principal components.

``python -m benchmarks.served --data FOLDER`` trains a model on four fifths of each collection and exports it. Its
``encode`` then finds the codes of the other fifth and of the training shapes. Then follows a model without the next
fifth, until each fifth was held out once, or ``--folds`` of them. Results are kept under ``--out``, so a killed call
can be continued. ``python -m benchmarks.fit --data OUT/models`` fits scans of the first fifth.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchmarks import pages
from benchmarks.generalisation import ROWS, beside_images, title
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
from shapespace.training.stages.ingest import read_meshes
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run

#: Largest number of exponentials to learn from: joint, and of each factor.
JOINT, OF_FACTORS = 1000, 300
COLUMNS = ("unseen", "trained on")
#: Key of the figures of a model without stored training shapes.
WITHOUT_EXAMPLES = "nothing remembered"
#: Ending of the names of runs with half as many modes.
HALF = "-half"
#: Models, in the order of the rows.
NAMES = tuple(each + ending for each in ROWS for ending in ("", HALF))
#: Stored figures, one file for each row; a stored fold is not measured again.
FIGURES = ROOT / "runs" / "collections"

PAGE = """# Served models and shapes that they have not seen

For each collection models were trained on four fifths of the shapes, with the settings of `examples` but at most
{joint} joint exponentials and {factors} of each factor, without mirror images where a row doesn't say so, and
exported; where there is a second row, other models with half as many modes. The `encode` of each, as it is served,
was given the fine meshes of shapes, and this page has the mean distance of all their vertices to the shape of the code,
in percent of the bounding box's diagonal, beside that to the nearest of as many principal **components** of the same
four fifths' fine meshes. **95 %**: mean of the folds' 95th percentiles. **of folds**: the least and the greatest ratio
of a fold. **m**: of all folds.

A bundle also [remembers](../explanation/mathematics.md#networks) the shapes that made it: it adds what modes and
networks miss of these, and less so at codes nearby. **Nothing remembered** is the same model without that
(`export.examples = false`): what modes and networks do alone. Rows with gaps are of older models, which remembered
nothing.

How well networks follow exponentials is on [another page](results.md), and [a third](generalisation.md) has exact
exponentials in place of networks; on makehuman networks come nearer, as they go on where exponentials end.
`python -m benchmarks.served --data FOLDER` trains, measures and writes this page; what it measured is in
`runs/collections/`. Some rows are of [older networks](notes.md#kernels-in-patches). No fold has chosen on its own
unseen shapes, but the method has been changed with some of them in view: see [how we
know](../explanation/how-we-know.md#which-choice-was-made-on-which-data).

## Unseen shapes

Those of the other fifth. With five **folds** each shape is unseen once.

{unseen}

## Shapes that it was trained on

Components remember nothing, so the first ratio says that users get their own shapes back, not that modes are better.

{known}

## Random shapes, and mirror images

Of the first fold alone. **Specificity**: the mean distance of {codes} random shapes, uniform in the bounds of the codes
or of the components' coefficients, to the nearest of the shapes that made the model (lower is better). Models *with
mirror images* also learned from the images of these shapes; the components above did not, but those here did, beside
the model that remembers nothing.

{first}
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


def average(folds: list[dict[str, Any]], some: list[dict[str, float]], key: str = "mean") -> str:
    """Return a cell with the mean over all shapes of summaries, one for each fold; empty if not measured."""
    if key not in some[0]:
        return ""
    return f"{100 * np.average([each[key] for each in some], weights=[fold['shapes'] for fold in folds]):.3f}"


def ratios(folds: list[dict[str, Any]], some: list[dict[str, float]]) -> list[str]:
    """Return cells: the ratio of means to the components' means, and the folds' smallest and largest ratio."""
    if "mean" not in some[0]:
        return ["", ""]
    found = np.array([(each["mean"], fold["components"]["mean"]) for each, fold in zip(some, folds, strict=True)])
    mean, components = np.average(found, axis=0, weights=[fold["shapes"] for fold in folds])
    each = found[:, 0] / found[:, 1]
    return [f"{mean / components:.2f}", f"{each.min():.2f} – {each.max():.2f}" if folds[1:] else ""]


def compared(folds: list[dict[str, Any]]) -> list[str]:
    """Return the cells of a kind of shapes: model, components, and the model without examples."""
    components, alone = ([fold[key] for fold in folds] for key in ("components", WITHOUT_EXAMPLES))
    means = [average(folds, some, key) for some in (folds, components) for key in ("mean", "p95")]
    return [*means, *ratios(folds, folds), average(folds, alone), *ratios(folds, alone)]


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
        found = json.loads(file.read_text()) if file.exists() else []
        for fold in range(given.folds):
            if fold < len(found) and "mean" in found[fold][COLUMNS[0]]:
                continue
            found[fold : fold + 1] = [measure(name, given.data, given.out, fold)]
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(found, indent=1), encoding="utf-8")
            write_page()


def write_page() -> None:
    """Write the page from all stored figures."""
    files = {name: FIGURES / f"{name}.json" for name in NAMES}
    rows = {name: json.loads(file.read_text()) for name, file in files.items() if file.exists()}
    tables: dict[str, list[list[str]]] = {"unseen": [], "known": [], "first": []}
    for name, found in rows.items():
        modes = [fold["modes"] for fold in found]
        start = ["" if name.endswith(HALF) else title(name), " – ".join(map(str, sorted({min(modes), max(modes)})))]
        unseen, known = ([fold[kind] for fold in found] for kind in COLUMNS)
        tables["unseen"].append([*start, str(len(found)), *compared(unseen)])
        tables["known"].append([*start, *compared(known)])
        specificity = [f"{100 * figure:.2f}" for figure in found[0]["specificity"]]
        images = beside_images(unseen[0][WITHOUT_EXAMPLES], found[0].get("mirrored_components"))
        tables["first"].append([*start, *specificity, *images])
    columns = ("95 %", "components", "95 %", "ratio", "of folds", WITHOUT_EXAMPLES, "ratio", "of folds")
    page = PAGE.format(
        joint=JOINT,
        factors=OF_FACTORS,
        codes=RANDOM,
        unseen=table(("", "m", "folds", "unseen", *columns), tables["unseen"]),
        known=table(("", "m", "trained on", *columns), tables["known"]),
        first=table(("", "m", "specificity", "components", "unseen: components with images", "ratio"), tables["first"]),
    )
    pages.write("served", page)


if __name__ == "__main__":
    main()
