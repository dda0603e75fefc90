"""docs/measurements/served.md: how near served models come to unseen shapes, beside principal components.

``python -m benchmarks.served --data FOLDER`` trains a model on four fifths of each collection, exports it, and has its
``encode`` find the codes of the other fifth and of the shapes that it was trained on. What is done is kept under
``--out``: a killed call goes on. With ``--folds`` each of the other fifths is held out too, of a model of its own
without what is measured of networks. ``python -m benchmarks.fit --data OUT/models`` fits scans of the unseen shapes.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from benchmarks.generalisation import ROWS, beside_images, title
from benchmarks.results import MANNEQUIN, MIRRORED, ROOT, open_run
from benchmarks.space import CODES, to_nearest
from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh, diagonal
from shapespace.model.shape_model import ShapeModel, load
from shapespace.training.collection.generators import MESHES
from shapespace.training.collection.mirror import find_mirror, mirrored
from shapespace.training.pipeline import Run, execute, write_bundle_of
from shapespace.training.runs.config import parse
from shapespace.training.space.generalisation import FOLDS, PrincipalComponents, folds, summary, vertex_distances

#: Most exponentials to learn from: joint, and of each factor.
JOINT, OF_FACTORS = 1000, 300
COLUMNS = ("unseen", "trained on")
#: What the names of runs with half as many modes end in.
HALF = "-half"
#: Models, in the order of the rows.
NAMES = tuple(each + ending for each in ROWS for ending in ("", HALF))
#: What was measured, a file for each collection; one that is there is not measured again.
FIGURES = ROOT / "runs" / "collections"
#: Distances of the other folds, a list for each collection; what is done of it is kept, as a fold takes up to an hour.
OTHER_FOLDS = FIGURES / "folds"

#: Columns of the tables.
HEAD = (
    *("", "m", "unseen", "95 %", "components", "95 %", "ratio", "trained on", "components", "ratio"),
    *("specificity", "components", "unseen: components with images", "ratio"),
)
FOLDS_HEAD = (
    *("", "m", "unseen", "components", "ratio", "of folds"),
    *("trained on", "components", "ratio", "of folds"),
)
NETWORKS_HEAD = (
    *("", "m", "factors", "exponentials", "composite", "one factor", "kernel", "paper's one", "paper's own", "affine"),
    *("steps", "failed", "learned by", "MB"),
)

PAGE = """# Served models and shapes that they have not seen

For each collection a model was trained on four fifths of the shapes, with the settings of `examples` but
at most {joint} joint exponentials and {factors} of each factor, and exported; where there is a second row, another
model with half as many modes. Its `encode`, as it is served, was
given each shape's fine mesh. **unseen**: mean and 95th percentile over all vertices of the other fifth of the shapes,
of the distance to the shape of the code, in percent of the bounding box's diagonal; **components**: of as many
principal components of the same four fifths' fine meshes. Models *with mirror images* also learned from the images of
these shapes; the components beside them did not, and in the last columns are components that did. **trained on**: the
same of the shapes that made the model.
**specificity**: mean distance of {codes} random shapes, uniform in the bounds of the codes or of the components'
coefficients, to the nearest of the shapes that made the model: lower is better. `python -m benchmarks.served --data
FOLDER` trains, measures and writes this page; what it measured is in `runs/collections/`.

{head}
{rows}

## Five folds

Means over all shapes of a collection, each unseen by one of five models: the one above, and four more with another
fifth held out of each. **of folds**: the least and the greatest ratio of one of these. `--folds` trains and measures
them.

{folds_head}
{folds}

## Networks and exponentials

R² of the same models in the weighted norm with η = 1e-2, on codes that follow from a digest of the finished networks,
so that nothing can have been chosen on them. **exponentials** are all that the composite saw, joint ones and those of
factors. The others see the joint ones: **one factor** is our recipe without a product, **kernel** is kernel ridge
regression on the codes, **paper's one** is the paper's monolithic network. **paper's own** is the paper's whole system
(factor networks, convolutions on stars, dropout), which sees what the composite saw. Both are trained to convergence.
**affine** is the sum of the learned factors, on test codes. **steps**: 1 − R² of the exponentials to those of twice as
many steps. Where 1 − R² of the composite is less, it is nearer to these exponentials than these are to the limit.

{networks_head}
{networks}

![Hands of four fresh codes: exact, and by each model with the distance of vertices in colours](hand-models.png)

![The hand's principal geodesic modes and its sparse ones](hand-modes.png)

`python -m benchmarks.pictures` draws these from a run.
"""


def four_fifths(name: str, data: Path, out: Path, fold: int = 0) -> tuple[Run, FloatArray, FloatArray]:
    """The run of a collection without one of its folds, the fine meshes (n, V, 3) that it knows, and the others.

    With half as many modes where the name ends in ``HALF``, and mirror images where ``MIRRORED`` stands before.
    """
    example = open_run(name.removesuffix(HALF), data, out)
    collection = name.removesuffix(HALF).removesuffix(MIRRORED)
    if collection == MANNEQUIN:
        meshes = MESHES[MANNEQUIN]()
        whole = {"vertices": meshes.vertices, "faces": meshes.faces}
    else:
        with np.load(str(example.config.collection.data), allow_pickle=False) as arrays:
            whole = {key: arrays[key] for key in arrays.files}
    held = folds(len(whole["vertices"]))[fold]
    ending = f"-fold-{fold}" if fold else ""
    known = {key: array if key == "faces" else np.delete(array, held, axis=0) for key, array in whole.items()}
    file = out / "data" / f"{collection}{ending}.npz"
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        np.savez(file, **known)
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
    for studied in ("seeds", "fractions"):
        document.get("networks", {}).pop(studied, None)
    document["export"].pop("names", None)
    document["export"]["name"] = name + ending
    text = tomlkit.dumps(document)
    run = Run(out / (name + ending), parse(text, name), text, out / "models")
    return run, known["vertices"].astype(np.float64), whole["vertices"][held].astype(np.float64)


def encoded(model: ShapeModel, shapes: FloatArray) -> FloatArray:
    """(n, V) distances of vertices from shapes (n, V, 3) in correspondence, as shares of the diagonal."""
    size = float(diagonal(model.vertices))
    return np.stack([model.encode(shape).distances for shape in shapes]) / size


def with_images(known: FloatArray, model: ShapeModel) -> PrincipalComponents:
    """Components of shapes (n, V, 3) and their mirror images.

    Raises:
        ValueError: none of the shapes is symmetric.
    """
    symmetric = find_mirror(known, TriangleMesh.from_arrays(known[0], model.faces).edges)
    if symmetric is None:
        raise ValueError("none of the shapes is symmetric")
    return PrincipalComponents.of(np.concatenate([known, mirrored(known, symmetric[0])[0]]), model.vertices)


def distances(
    model: ShapeModel, linear: PrincipalComponents, unseen: FloatArray, known: FloatArray
) -> dict[str, dict[str, Any]]:
    """Of shapes (n, V, 3) of both kinds, from those of codes and from those of as many components."""
    found, size = {}, float(diagonal(model.vertices))
    for kind, shapes in zip(COLUMNS, (unseen, known), strict=True):
        others = vertex_distances(linear.nearest(shapes, model.dimension), shapes, size)
        found[kind] = summary(encoded(model, shapes)) | {"components": summary(others), "shapes": len(shapes)}
    return found


def measure_fold(name: str, data: Path, out: Path, fold: int) -> dict[str, Any]:
    """Distances alone, of a model that knows the other folds."""
    run, known, unseen = four_fifths(name, data, out, fold)
    file = run.directory.study("served")
    if not file.exists():
        execute(run, "samples", keep_going=True)
        model = load(write_bundle_of(run, figures={}))
        file.write(distances(model, PrincipalComponents.of(known, model.vertices), unseen, known))
        print(name, fold, file.read(), flush=True)
    return file.read()


def measure(name: str, data: Path, out: Path) -> dict[str, Any]:
    """Train, and measure what is trained."""
    run, known, unseen = four_fifths(name, data, out)
    execute(run, keep_going=True)
    unseen_file = out / "models" / f"{name}.npz"
    if not unseen_file.exists():
        np.savez(unseen_file, vertices=unseen)
    model = load(out / "models" / name)
    m, size = model.dimension, float(diagonal(model.vertices))
    linear = PrincipalComponents.of(known, model.vertices)
    found = {"modes": m, "evaluation": run.directory.evaluation.read(), **distances(model, linear, unseen, known)}
    if name.removesuffix(HALF).endswith(MIRRORED):
        others = vertex_distances(with_images(known, model).nearest(unseen, m), unseen, size)
        found["mirrored_components"] = summary(others)
    drawn = np.stack([model.decode(code) for code in model.sample(CODES, 0)])
    others = linear.random(m, CODES, np.random.default_rng(0))
    found["specificity"] = [to_nearest(each, known, size) for each in (drawn, others)]
    return found


def first_cells(name: str, found: dict[str, Any]) -> list[str]:
    """Of a row of any table."""
    return ["" if name.endswith(HALF) else title(name), str(found["modes"])]


def row(name: str, found: dict[str, Any]) -> str:
    """Of the table."""
    cells = first_cells(name, found)
    for kind in COLUMNS:
        own, other = found[kind], found[kind]["components"]
        both = [(own["mean"], own["p95"]), (other["mean"], other["p95"])]
        cells += [f"{100 * figure:.3f}" for pair in both for figure in (pair if kind == "unseen" else pair[:1])]
        cells.append(f"{own['mean'] / other['mean']:.2f}")
    cells += [f"{100 * figure:.2f}" for figure in found["specificity"]]
    cells += beside_images(found["unseen"], found.get("mirrored_components"))
    return f"| {' | '.join(cells)} |"


def folds_row(name: str, first: dict[str, Any], others: list[dict[str, Any]]) -> str:
    """Of the table of folds: means over all shapes, and the least and the greatest ratio of a fold."""
    cells, every = first_cells(name, first), [first, *others]
    for kind in COLUMNS:
        shapes = [fold[kind]["shapes"] for fold in every]
        means = np.array([(fold[kind]["mean"], fold[kind]["components"]["mean"]) for fold in every])
        own, other = np.average(means, axis=0, weights=shapes)
        ratios = means[:, 0] / means[:, 1]
        cells += [f"{100 * own:.3f}", f"{100 * other:.3f}", f"{own / other:.2f}"]
        cells.append(f"{ratios.min():.2f} – {ratios.max():.2f}")
    return f"| {' | '.join(cells)} |"


def network_row(name: str, found: dict[str, Any]) -> str:
    """Of the other table."""
    figures = found["evaluation"]
    fresh, sizes = figures["fresh"], figures["sizes"]
    r2 = [fresh["r2"].get(each) for each in ("composite", "monolithic", "kernel", "monolithic_paper", "paper")]
    cells = [
        *first_cells(name, found),
        str(len(figures["r2_factors"])),
        str(figures["exponentials"]),
        *(f"{each['total']:.4f}" if each else "" for each in r2),
    ]
    cells += [f"{figures['r2']['affine of learned factors']['total']:.4f}", f"{1 - fresh['steps']['total']:.1e}"]
    cells += [f"{fresh['failed']} of {fresh['codes']}", figures["correction"]["kind"]]
    cells.append(f"{sizes['composite'] / 1e6:.1f}")
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "served")
    parser.add_argument("names", nargs="*", default=NAMES, help=f"of rows: {', '.join(NAMES)}")
    parser.add_argument("--folds", action="store_true", help="hold out each fifth, not the first alone")
    given = parser.parse_args()
    for name in given.names:
        file, others = FIGURES / f"{name}.json", OTHER_FOLDS / f"{name}.json"
        if not file.exists():
            write(file, measure(name, given.data, given.out))
        found = json.loads(others.read_text()) if others.exists() else []
        for fold in range(1 + len(found), FOLDS) if given.folds else ():
            found.append(measure_fold(name, given.data, given.out, fold))
            write(others, found)
        write_page()


def read(folder: Path) -> dict[str, Any]:
    """What was measured and is there, by the names of rows."""
    return {each: json.loads(path.read_text()) for each in NAMES if (path := folder / f"{each}.json").exists()}


def write(file: Path, found: Any) -> None:
    """What was measured."""
    file.parent.mkdir(exist_ok=True)
    file.write_text(json.dumps(found, indent=1), encoding="utf-8")


def write_page() -> None:
    """The page of all that was measured."""
    done = read(FIGURES)
    page = PAGE.format(
        joint=JOINT,
        factors=OF_FACTORS,
        codes=CODES,
        head=head(HEAD),
        rows="\n".join(row(*each) for each in done.items()),
        folds_head=head(FOLDS_HEAD),
        folds="\n".join(
            folds_row(name, done[name], found) for name, found in read(OTHER_FOLDS).items() if len(found) == FOLDS - 1
        ),
        networks_head=head(NETWORKS_HEAD),
        networks="\n".join(network_row(*each) for each in done.items()),
    )
    (ROOT / "docs" / "measurements" / "served.md").write_text(page, encoding="utf-8")


def head(columns: tuple[str, ...]) -> str:
    """Of a table."""
    return f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}"


if __name__ == "__main__":
    main()
