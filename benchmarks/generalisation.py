"""docs/measurements/generalisation.md: distance of spaces from unseen shapes, next to principal components.

Five folds of each collection have their own mean, logarithms and modes, for the number of modes in the example and for
half of it. Exponentials replace networks. Finished folds are kept under ``--out``. A collection with five finished
folds has its figures in ``runs/folds/``, and is not measured again. The row ``people`` needs the extra ``people``.
"""

import argparse
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import pages
from benchmarks.pages import ROOT
from benchmarks.results import COLLECTIONS, MANNEQUIN, MIRRORED, PEOPLE, SYMMETRIC, open_run
from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.space.generalisation import LIGHT_STEPS, summary
from shapespace.training.space.geometry import Kind
from shapespace.training.space.held_out import HeldOut, held_out
from shapespace.training.space.related import FOLDS, Related
from shapespace.training.stages.ingest import ingest
from shapespace.training.stages.stage import Run

#: Stored figures, one file for each collection.
FIGURES = ROOT / "runs" / "folds"

PAGE = """# Unseen shapes, by modes alone

How near can modes come to a shape that was not used to find them? Here exact
[exponentials](../reference/glossary.md#exponential) compute the shapes, on coarse meshes. For models as the server
runs them, see [errors on unseen shapes](served.md). Errors are mean distances of vertices as shares of the
[diagonal](../reference/glossary.md#diagonal).

## Modes and principal components

The error is {gain} of the error of as many principal components for {better}. For the others
it is {rest} ([with half of the modes](../../benchmarks/NOTES.md#unseen-shapes-with-half-of-the-modes)).

The modes of the first three tables are exponentials without [local
fields](../explanation/choosing.md#local-fields). A run with `modes.geometry = "auto"` often chooses another
[map](../explanation/choosing.md#map-from-codes-to-shapes) for the horse, the dancer (samba) or the bodies (makehuman),
which has [smaller errors](served.md).

{plain}

## Stronger simple models

{strong}

{simple}

Each figure is the error as a share of the error of principal components. {collections}

- *Modes* and *components with memory* correct their errors at the training shapes, as our bundles do.
- The last two columns are the maps `nric` (lengths and angles) and `differential` (rotations and stretches of faces),
  which [training can choose](../explanation/choosing.md#map-from-codes-to-shapes).

## With mirror images

[Mirror images](../reference/glossary.md#mirror-image) of the training shapes help modes and components alike.

{mirrored}

The ratio is to components with images. Coarse meshes differ from the first table, so compare within a row.

{people}## How it was measured

- Five [folds](../reference/glossary.md#fold) leave each shape out once. Mean, logarithms and modes come from the other
  shapes. The error is the distance of the nearest exponential. {measured}
- All models have the same folds, coarse meshes of at most a thousand vertices, and number of coordinates. Exponentials
  have {steps} [time steps](../reference/glossary.md#time-steps), or 1 where a fold chose it.
- No fold chooses by its own unseen shapes, but we [changed the
  method](../explanation/how-we-know.md#which-choice-was-made-on-which-data) with such folds in view.
- For makehuman the ratios are upper bounds: the exponential ends where faces collapse. [Networks](served.md) still
  give a shape, which is nearer.
- `python -m benchmarks.generalisation --data FOLDER` measures and writes this page. Figures
  are in `runs/folds/`.
"""
PEOPLE_PAGE = """## An unseen pose, an unseen body

{finding}

{rows}

{bodies} adults stand in {poses} poses each ([generator](../how-to/collections.md#bodies-without-data-of-your-own)
`people`). The runs know all but every fifth pose or person, and [which shapes are
related](../explanation/choosing.md#related-shapes). They chose local fields and one of the maps `vertices` and
`differential` by themselves, and in the rows *auto* also the number of modes. They remember no shapes. A pose has more
angles than {poses} poses can show, so an unseen one needs many modes and [local
fields](../explanation/choosing.md#local-fields).

"""
#: A ratio below this is a clear gain.
PAYS = 0.7
#: A share of the best simple model's error: up to it a model is clearly better.
CLEARLY = 0.9
#: Simple models beside principal components, and their names on pages.
SIMPLE = {
    "remembering_components": "components with memory",
    "linear_nric": "straight lines of lengths and angles",
    "differential_coordinates": "differential coordinates",
}
#: Rows of the table.
ROWS = tuple(
    name + ending for name in (*COLLECTIONS, MANNEQUIN) for ending in ("", MIRRORED) if name in SYMMETRIC or not ending
)
#: What is left out of the bodies of `PEOPLE`, and its position in the names of shapes.
LEFT_OUT = {"pose": 1, "person": 0}
#: Maps that are compared for `PEOPLE`: with the others, hundreds of bodies take hours.
FAST: tuple[Kind, ...] = ("vertices", "differential")
#: Numbers of modes of `PEOPLE`, beside the number that a run chooses.
MANY = (48, 96)


def ingested(name: str, data: Path, out: Path) -> Run:
    """Return the run of a collection, with its shapes."""
    opened = open_run(name, data, out)
    if not opened.directory.shapes.exists():
        opened.directory.folder.mkdir(parents=True, exist_ok=True)
        ingest(opened)
    return opened


def measure(name: str, data: Path, out: Path) -> dict[str, Any]:
    """Return figures of a collection by number of coordinates, over all shapes, each from the fold that held it out."""
    opened = ingested(name, data, out)
    run, config = opened.directory, opened.config
    reference, shapes, related = read_shapes(run)
    m = config.modes.count
    counts = None if m == "auto" else [-(-m // 2), m]
    every = []
    for k, index in enumerate(related.folds()):
        file = run.study(f"fold-{k}")
        if not file.exists():
            material = config.shell_material
            found = held_out(reference, shapes, index, counts, config.modes, material, related=related)
            away = found.distances(shapes, reference.diagonal)
            file.write(
                {"counts": found.counts, "steps": int(found.steps[0])}
                | {kind: [each.tolist() for each in rows] for kind, rows in away.items()}
            )
            means = {kind: [round(100 * float(np.mean(each)), 4) for each in rows] for kind, rows in away.items()}
            print(name, k, means, flush=True)
        every.append(file.read())
    return {
        "shapes": related.originals,
        "counts": every[0]["counts"],
        "steps": sorted({fold["steps"] for fold in every}),
        **{
            kind: [summary(np.concatenate(some)) for some in zip(*(fold[kind] for fold in every), strict=True)]
            for kind in every[0]
            if kind not in ("counts", "steps")
        },
    }


def read_shapes(run: RunDirectory) -> tuple[TriangleMesh, FloatArray, Related]:
    """Read the reference, all shapes (n, V, 3), and which are related."""
    given = run.shapes.read()
    return run.reference_mesh(), given["vertices"], Related.of_arrays(given)


def measure_people(data: Path, out: Path) -> dict[str, Any]:
    """Return errors on unseen poses and persons, of a run's own choice of map and modes, and of more modes."""
    opened = ingested(PEOPLE, data, out)
    run, config = opened.directory, opened.config
    reference, shapes, _ = read_shapes(run)
    # "person 3, pose 2" is 3, 2
    numbers = np.array([[int(part.split()[1]) for part in name.split(", ")] for name in run.shapes.read()["names"]])
    found: dict[str, Any] = dict(zip(("bodies", "poses"), numbers.max(axis=0).tolist(), strict=True))
    for what, column in LEFT_OUT.items():
        file = run.study(f"unseen-{what}")
        if not file.exists():
            index = np.flatnonzero(numbers[:, column] % FOLDS == 0)
            related = Related(np.arange(len(shapes)), np.unique(numbers[:, column], return_inverse=True)[1])
            settings = config.modes.model_copy(update={"geometry": "auto", "count": "auto"})
            how: dict[str, Any] = {
                "material": config.shell_material,
                "related": related,
                "among": FAST,
                "remember": False,
            }
            auto = held_out(reference, shapes, index, None, settings, **how)
            settings = settings.model_copy(update={"geometry": auto.maps[0], "count": MANY[-1]})
            many = held_out(reference, shapes, index, MANY, settings, **how)
            file.write(
                {
                    "shapes": len(index),
                    "map": auto.maps[0],
                    "auto": _by_count(auto, shapes, reference.diagonal)[-1],
                    "many": _by_count(many, shapes, reference.diagonal),
                }
            )
        found[what] = file.read()
    return found


def _by_count(part: HeldOut, shapes: FloatArray, diagonal: float) -> list[dict[str, Any]]:
    """Return figures of held-out shapes for each number of modes."""
    away = part.distances(shapes, diagonal)
    return [
        {"count": count} | {kind: summary(each[k]) for kind, each in away.items()}
        for k, count in enumerate(part.counts)
    ]


def people_section(found: dict[str, Any]) -> str:
    """Return the section about people."""
    cells: list[list[str]] = []
    ratios: dict[str, list[str]] = {}
    for what in LEFT_OUT:
        every = [found[what]["auto"], *found[what]["many"]]
        for k, row in enumerate(every):
            shares = {kind: row[kind]["mean"] / row["components"]["mean"] for kind in ("modes", *SIMPLE) if kind in row}
            best = min(SIMPLE, key=lambda kind: shares.get(kind, np.inf))
            ratios.setdefault(what, []).append(f"{shares['modes']:.2f}")
            cells.append([
                f"{what}: {row['count']:.0f} modes{'' if k else ' (auto)'}, `{found[what]['map']}`",
                f"{100 * row['modes']['mean']:.3f} %",
                f"{100 * row['components']['mean']:.3f} %",
                f"{shares['modes']:.2f}",
                f"{shares[best]:.2f}, {SIMPLE[best]}",
            ])  # fmt: skip
    own, most = (" and ".join(f"{each[k]} for an unseen {what}" for what, each in ratios.items()) for k in (0, -1))
    return PEOPLE_PAGE.format(
        finding=f"As a share of the error of principal components, ours is {own}. With {MANY[-1]} modes it is {most}.",
        bodies=found["bodies"],
        poses=found["poses"],
        rows=pages.table(("unseen", "error", "of components", "ratio", "best simple model's ratio"), cells),
    )


def simple_rows(name: str, found: dict[str, Any]) -> list[list[str]]:
    """Return the rows of a collection: the error of each model as a share of the error of principal components."""
    return [
        [f"{name}, {count} modes"]
        + [f"{found[kind][k]['mean'] / found['components'][k]['mean']:.2f}" for kind in ("modes", *SIMPLE)]
        for k, count in enumerate(found["counts"])
    ]


def row(name: str, found: dict[str, Any], others: tuple[str, ...]) -> list[str]:
    """Return the row of a collection: all modes beside components; the ratio is to the first of these."""
    errors = [found[kind][-1]["mean"] for kind in ("modes", *others)]
    shown = (f"{100 * error:.3f} %" for error in errors)
    return [f"{name}, {found['counts'][-1]} modes", *shown, f"{errors[0] / errors[1]:.2f}"]


def between(ratios: Collection[float]) -> str:
    """Say the range of some ratios."""
    return f"{min(ratios):.2f} to {max(ratios):.2f}"


def against_the_best(shares: Sequence[float]) -> str:
    """Say how errors compare with the best simple model's, from their shares of it in each row of a table."""
    rounded = [round(share, 2) for share in shares]
    better = sum(share <= CLEARLY for share in rounded)
    return (
        f"Our error is {min(rounded):.2f} to {max(rounded):.2f} of the error of the best simple model. In {better} of "
        f"{len(rounded)} rows it is at most {CLEARLY} of it."
    )


def shares_of_the_best(found: dict[str, Any]) -> list[float]:
    """Return the error of a collection's modes as a share of the best simple model's, for each number of modes."""
    return [
        found["modes"][k]["mean"] / min(found[kind][k]["mean"] for kind in ("components", *SIMPLE))
        for k in range(len(found["counts"]))
    ]


def write_page() -> None:
    """Write the page from all stored figures."""
    done = {each: pages.read_figures(path) for each in ROWS if (path := FIGURES / f"{each}.json").exists()}
    plain = {name: found for name, found in done.items() if not name.endswith(MIRRORED)}
    simple = {name: found for name, found in plain.items() if found.keys() >= set(SIMPLE)}
    images = {name.removesuffix(MIRRORED): found for name, found in done.items() if "mirrored_components" in found}
    ratios = {name: found["modes"][-1]["mean"] / found["components"][-1]["mean"] for name, found in plain.items()}
    better = {name: ratio for name, ratio in ratios.items() if ratio < PAYS}
    rest = [ratio for name, ratio in ratios.items() if name not in better]
    people = FIGURES / f"{PEOPLE}.json"
    page = PAGE.format(
        people=people_section(pages.read_figures(people)) if people.exists() else "",
        better=pages.listed(list(better)),
        gain=between(better.values()),
        rest=between(rest),
        strong=against_the_best([share for found in simple.values() for share in shares_of_the_best(found)]),
        collections="" if simple.keys() == plain.keys() else f"We measured this for {pages.listed(list(simple))} only.",
        measured=pages.measured_with(*(FIGURES / f"{name}.json" for name in done)),
        simple=pages.table(
            ("", "modes", *SIMPLE.values()),
            (cells for name, found in simple.items() for cells in simple_rows(name, found)),
        ),
        plain=pages.table(
            ("", "error of modes", "of components", "ratio"),
            (row(name, found, ("components",)) for name, found in plain.items()),
        ),
        mirrored=pages.table(
            ("", "error of modes", "of components with images", "of components without", "ratio"),
            (row(name, found, ("mirrored_components", "components")) for name, found in images.items()),
        ),
        steps=LIGHT_STEPS,
    )
    pages.write("generalisation", page)


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "generalisation")
    parser.add_argument("names", nargs="*", default=(*ROWS, PEOPLE))
    given = parser.parse_args()
    for name in given.names:
        file = FIGURES / f"{name}.json"
        if not file.exists():
            found = measure_people(given.data, given.out) if name == PEOPLE else measure(name, given.data, given.out)
            pages.write_figures(file, found)
        write_page()


if __name__ == "__main__":
    main()
