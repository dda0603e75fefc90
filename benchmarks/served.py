"""docs/measurements/served.md: how near served models come to unseen shapes, beside principal components.

``python -m benchmarks.served --data FOLDER`` trains a model on four fifths of each collection, exports it, and has its
``encode`` find the codes of the other fifth and of the shapes that it was trained on; then a model without the next
fifth, until each was held out once, or as many as ``--folds`` says. What is done is kept under ``--out``: a killed call
goes on. ``python -m benchmarks.fit --data OUT/models`` fits scans of the first fifth.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchmarks.generalisation import ROWS, beside_images, title
from benchmarks.results import MIRRORED, ROOT, open_run
from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh, diagonal
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.collection.mirror import find_mirror, mirrored
from shapespace.training.pipeline import Run, execute, write_bundle_of
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
from shapespace.training.space.stages import read_meshes

#: Most exponentials to learn from: joint, and of each factor.
JOINT, OF_FACTORS = 1000, 300
COLUMNS = ("unseen", "trained on")
#: Of the shapes that a model was trained on: by one that remembers nothing of them.
ALONE = "nothing remembered"
#: What the names of runs with half as many modes end in.
HALF = "-half"
#: Models, in the order of the rows.
NAMES = tuple(each + ending for each in ROWS for ending in ("", HALF))
#: What was measured, a file for each row; a fold that is there is not measured again.
FIGURES = ROOT / "runs" / "collections"

HEAD = (
    *("", "m", "folds", "unseen", "95 %", "components", "95 %", "ratio", "of folds"),
    *("trained on", "components", "ratio", "of folds", "nothing remembered", "ratio", "of folds"),
    *("specificity", "components"),
    *("unseen: components with images", "ratio"),
)

PAGE = """# Served models and shapes that they have not seen

For each collection models were trained on four fifths of the shapes, with the settings of `examples` but at most
{joint} joint exponentials and {factors} of each factor, without mirror images where a row doesn't say so, and
exported; where there is a second row, other models with half as many modes. The `encode` of each, as it is served,
was given the fine meshes of the other fifth, so that over five **folds** each shape is unseen once. **unseen**: mean
distance of all vertices of these shapes to the shape of the code, in percent of the bounding box's diagonal, and the
mean of the folds' 95th percentiles; **components**: of as many principal components of the same four fifths' fine
meshes. **trained on**: the same of the shapes that made a model, which a bundle
[remembers](../explanation/mathematics.md#networks): it adds what modes and networks miss of them. Components remember
nothing, so this says that users get their own shapes back, not that the modes are better; **nothing remembered** is a
model without it (`export.examples = false`) beside the same components.

**folds**: with all five each shape is unseen once; rows with fewer know only some shapes. Rows without *trained on* are
of older models, trained and encoded before models remembered. **of folds**: the least and the greatest ratio of a fold.
**m**: of the first fold, others may differ by one.

Of the first fold alone: **specificity**, the mean distance of {codes} random shapes, uniform in the bounds of the codes
or of the components' coefficients, to the nearest of the shapes that made the model (lower is better); and the last
columns. Models *with mirror images* also learned from the images of these shapes; the components beside them did not,
and in the last columns are components that did, beside the same fold of the model.

How well networks follow exponentials is on [another page](results.md), and [a third](generalisation.md) has exact
exponentials in place of networks; on makehuman networks come nearer, as they go on where exponentials end.
`python -m benchmarks.served --data FOLDER` trains, measures and writes this page; what it measured is in
`runs/collections/`. Some rows are of [older networks](notes.md#kernels-in-patches).

| {head} |
|{line}
{rows}
"""


def four_fifths(name: str, data: Path, out: Path, fold: int = 0) -> tuple[Run, FloatArray, FloatArray]:
    """The run of a collection without one of its folds, the fine meshes (n, V, 3) that it knows, and the others.

    With half as many modes where the name ends in ``HALF``, and mirror images where ``MIRRORED`` stands before.
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
    for section in ("variants", "evaluation"):
        document.pop(section, None)
    for studied in ("seeds", "fractions", "paper"):
        document.get("networks", {}).pop(studied, None)
    document["export"].pop("names", None)
    document["export"]["name"] = name + ending
    text = tomlkit.dumps(document)
    run = Run(out / (name + ending), parse(text, name), text, out / "models")
    return run, known, meshes.vertices[held]


def encoded(model: ShapeModel, shapes: FloatArray) -> FloatArray:
    """(n, V) distances of vertices from shapes (n, V, 3) in correspondence, as shares of the diagonal."""
    size = float(diagonal(model.vertices))
    return np.stack([model.encode(shape).distances for shape in shapes]) / size


def forgetful(run: Run) -> ShapeModel:
    """The model of a run without what its bundle remembers of the training shapes."""
    settings = run.config.export.model_copy(update={"examples": False})
    config = run.config.model_copy(update={"export": settings})
    other = Run(run.directory.folder, config, run.source, run.models / ALONE)
    return load(other.bundle if other.bundle.exists() else write_bundle_of(other, figures={}))


def with_images(known: FloatArray, model: ShapeModel) -> PrincipalComponents:
    """Components of shapes (n, V, 3) and their mirror images.

    Raises:
        ValueError: none of the shapes is symmetric.
    """
    symmetric = find_mirror(known, TriangleMesh.from_arrays(known[0], model.faces).edges)
    if symmetric is None:
        raise ValueError("none of the shapes is symmetric")
    return PrincipalComponents.of(np.concatenate([known, mirrored(known, symmetric[0])[0]]), model.vertices)


def measure(name: str, data: Path, out: Path, fold: int) -> dict[str, Any]:
    """Train without a fold, and measure what is trained; more of the first fold."""
    run, known, unseen = four_fifths(name, data, out, fold)
    execute(run, "samples", keep_going=True)
    model = load(run.bundle if run.bundle.exists() else write_bundle_of(run, figures={}))
    m, size = model.dimension, float(diagonal(model.vertices))
    linear = PrincipalComponents.of(known, model.vertices)
    found: dict[str, Any] = {"modes": m}
    for kind, shapes in zip(COLUMNS, (unseen, known), strict=True):
        others = vertex_distances(linear.nearest(shapes, m), shapes, size)
        found[kind] = summary(encoded(model, shapes)) | {"components": summary(others), "shapes": len(shapes)}
    found[ALONE] = found[COLUMNS[1]] | summary(encoded(forgetful(run), known))
    if fold:
        return found
    np.savez(out / "models" / f"{name}.npz", vertices=unseen)
    if name.removesuffix(HALF).endswith(MIRRORED):
        others = vertex_distances(with_images(known, model).nearest(unseen, m), unseen, size)
        found["mirrored_components"] = summary(others)
    drawn = np.stack([model.decode(code) for code in model.sample(RANDOM, 0)])
    others = linear.random(m, RANDOM, np.random.default_rng(0))
    return found | {"specificity": [to_nearest(each, known, size) for each in (drawn, others)]}


def row(name: str, folds: list[dict[str, Any]]) -> str:
    """Of the table: means over all shapes, and the least and the greatest ratio of a fold."""
    first = folds[0]
    cells = ["" if name.endswith(HALF) else title(name), str(first["modes"]), str(len(folds))]
    for kind in (*COLUMNS, ALONE):
        found = [fold[kind] for fold in folds if kind in fold]
        if not found:
            cells += [""] * 4
            continue
        figures = np.array([[(each[key], each["components"][key]) for key in ("mean", "p95")] for each in found])
        means = np.average(figures, axis=0, weights=[each["shapes"] for each in found])
        shown = {"unseen": means.T.ravel(), ALONE: means[0, :1]}.get(kind, means[0])
        cells += [f"{100 * figure:.3f}" for figure in shown]
        ratios = figures[:, 0, 0] / figures[:, 0, 1]
        cells += [f"{means[0, 0] / means[0, 1]:.2f}", f"{ratios.min():.2f} – {ratios.max():.2f}" if found[1:] else ""]
    cells += [f"{100 * figure:.2f}" for figure in first["specificity"]]
    cells += beside_images(first["unseen"], first.get("mirrored_components"))
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Measure and write."""
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
            if fold < len(found) and COLUMNS[1] in found[fold]:
                continue
            found[fold : fold + 1] = [measure(name, given.data, given.out, fold)]
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(found, indent=1), encoding="utf-8")
            write_page()


def write_page() -> None:
    """The page of all that was measured."""
    files = {name: FIGURES / f"{name}.json" for name in NAMES}
    rows = [row(name, json.loads(file.read_text())) for name, file in files.items() if file.exists()]
    page = PAGE.format(
        joint=JOINT,
        factors=OF_FACTORS,
        codes=RANDOM,
        head=" | ".join(HEAD),
        line="---|" * len(HEAD),
        rows="\n".join(rows),
    )
    (ROOT / "docs" / "measurements" / "served.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
