"""docs/measurements/few-shapes.md: error on unseen shapes by the number of training shapes, next to simple models.

``python -m benchmarks.few_shapes --data FOLDER`` draws training shapes of each collection, chooses the map as a run
with ``geometry = "auto"`` does, and measures shapes that are never drawn. Exact maps replace networks. Finished draws
stay in ``runs/few-shapes.json``, so a killed call can be continued.
"""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from benchmarks import pages
from benchmarks.generalisation import SIMPLE, ingested, read_shapes
from benchmarks.pages import ROOT, table
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.generalisation import summary
from shapespace.training.space.held_out import held_out

#: Stored figures, one row for each draw.
FIGURES = ROOT / "runs" / "few-shapes.json"
#: Collections, those with joints first.
NAMES = ("hand", "figure", "makehuman", "samba", "faces", "hippocampus")
#: Numbers of training shapes, and how often they are drawn: chance matters most with few.
DRAWS = {5: 3, 10: 2, 20: 1, 40: 1, 80: 1}
#: The fewest shapes, in words.
FEWEST = {5: "five", 10: "ten"}
#: Number of shapes that are never drawn.
UNSEEN = 12
#: Keys of all models; the first is ours.
MODELS = ("modes", "components", *SIMPLE)

PAGE = """# How many shapes do you need?

{finding}

![Error on unseen shapes by the number of training shapes. The table below has the same numbers.](few-shapes.svg)

{table}

Each cell has our mean [vertex error](../reference/glossary.md#vertex-error) for {unseen} unseen shapes, in percent of
the [diagonal](../reference/glossary.md#diagonal). In brackets stand two ratios: to the error of [principal
components](../reference/glossary.md#principal-component), and to the error of the best of [four simple
models](generalisation.md#stronger-simple-models). Simple models have as many modes as ours, but at most one less than
shapes: there are no more. Ours adds modes of [local fields](../explanation/choosing.md#few-shapes). Empty cells: there
are too few shapes. {largest}

## What to do with few shapes

- **Choose them far apart.** Each joint should bend in several shapes, alone and with others.
- **Add mirror images** where left and right may be exchanged (`collection.mirror`). This page has none.
- **Look at the sliders.** {counts} The last ones come from local fields:
  they move single regions. They can fit an unseen shape, but none of your shapes shows them as a whole.{rises}

## How it was measured

- Training shapes are drawn at random: {draws}. Figures are means over the draws.
- Each draw chooses its [map](../explanation/choosing.md#map-from-codes-to-shapes) and its number of modes by itself
  (see `runs/few-shapes.json`). All models have the same coarse meshes.
- Exponentials are exact here. Networks add an error of their own, see [unseen shapes](served.md).
- `python -m benchmarks.few_shapes --data FOLDER` measures and writes this page. {measured}
"""


def measure(name: str, data: Path, out: Path, count: int, draw: int) -> dict[str, Any] | None:
    """Return the figures of one draw of ``count`` shapes; None if the collection has too few."""
    opened = ingested(name, data, out)
    reference, shapes, *_ = read_shapes(opened.directory)
    order = np.random.default_rng(0).permutation(len(shapes))
    unseen, others = order[:UNSEEN], order[UNSEEN:]
    if len(others) < count:
        return None
    drawn = np.random.default_rng(1 + draw).permutation(others)[:count]
    some = shapes[np.concatenate([np.sort(drawn), unseen])]
    material = opened.config.shell_material
    found = held_out(reference, some, np.arange(count, len(some)), None, ModeSettings(geometry="auto"), material)
    away = found.distances(some, reference.diagonal)
    return {"name": name, "shapes": count, "draw": draw, "modes_count": found.counts[-1], "map": found.maps[0]} | {
        kind: summary(away[kind][-1]) for kind in MODELS if kind in away
    }


def means(rows: Iterable[dict[str, Any]]) -> dict[tuple[str, int], dict[str, Any]]:
    """Return mean errors of all models over the draws, by collection and number of shapes."""
    found: dict[tuple[str, int], list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault((row["name"], row["shapes"]), []).append(row)
    return {
        key: {
            kind: float(np.mean([each[kind]["mean"] for each in some]))
            for kind in MODELS
            if all(kind in each for each in some)
        }
        | {"maps": sorted({each["map"] for each in some}), "counts": sorted({each["modes_count"] for each in some})}
        for key, some in sorted(found.items(), key=lambda item: (NAMES.index(item[0][0]), item[0][1]))
    }


def simplest(row: dict[str, Any]) -> tuple[str, float]:
    """Return the key and the error of the best simple model."""
    kind = min((kind for kind in MODELS[1:] if kind in row), key=lambda kind: row[kind])
    return kind, row[kind]


def draw_chart(found: dict[tuple[str, int], dict[str, Any]], path: Path) -> None:
    """Draw the errors of our model, of components and of the best simple model, one panel for each collection."""
    names = [name for name in NAMES if any(key[0] == name for key in found)]
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": path.name, "font.size": 9}):
        figure = Figure(figsize=(8, 2.4 * -(-len(names) // 3) + 0.4), layout="constrained")
        panels = figure.subplots(-(-len(names) // 3), 3, squeeze=False, sharex=True).ravel()
        for panel in panels[len(names) :]:
            panel.set_visible(False)
        for name, panel in zip(names, panels, strict=False):
            counts = [key[1] for key in found if key[0] == name]
            rows = [found[name, count] for count in counts]
            lines = {
                "shapespace": ("#1f6f8b", [row["modes"] for row in rows]),
                "principal components": ("#b9b4a8", [row["components"] for row in rows]),
                "best simple model": ("#d98e4a", [simplest(row)[1] for row in rows]),
            }
            for style, (label, (colour, errors)) in zip(("-", "-", "--"), lines.items(), strict=True):
                panel.plot(counts, 100 * np.array(errors), style, color=colour, marker="o", markersize=3, label=label)
            panel.set(title=name, xscale="log", ylim=(0, None), xticks=list(DRAWS), xticklabels=list(map(str, DRAWS)))
            panel.minorticks_off()
            panel.spines[["top", "right"]].set_visible(False)
        figure.supxlabel("training shapes", fontsize=9)
        figure.supylabel("error, % of the diagonal", fontsize=9)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, fontsize=8, frameon=False)
        figure.savefig(
            path, format="svg", facecolor="white", metadata=dict.fromkeys(("Creator", "Date", "Format", "Type"))
        )


def finding(found: dict[tuple[str, int], dict[str, Any]]) -> str:
    """Say how the error falls with more shapes, and how ours compares where there are ten, as ranges."""

    def between(figures: dict[str, float], form: str) -> str:
        least, most = (choose(figures, key=lambda name: figures[name]) for choose in (min, max))
        return f"{form.format(figures[least])} ({least}) to {form.format(figures[most])} ({most})"

    falls = {}
    for name in NAMES:
        counts = [key[1] for key in found if key[0] == name]
        if len(counts) > 1:
            first, last = (found[name, count]["modes"] for count in (counts[0], counts[-1]))
            doublings = np.log2(counts[-1] / counts[0])
            falls[name] = 100 * (1 - (last / first) ** (1 / doublings))
    said = f"Each doubling of the shapes lowers the error on unseen shapes by {between(falls, '{:.0f} %')} on average."
    for number, word in FEWEST.items():
        rows = {key[0]: row for key, row in found.items() if key[1] == number}
        if rows:
            ratios = {name: row["modes"] / row["components"] for name, row in rows.items()}
            worst = max(row["modes"] / simplest(row)[1] for row in rows.values())
            share = between(ratios, "{:.2f}")
            said += (
                f"\n\nWith {word} shapes, our error is {share} of the error of principal components."
                f"\nIt is at most {worst:.2f} of the error of the best simple model."
            )
    return said


def sliders(found: dict[tuple[str, int], dict[str, Any]]) -> str:
    """Say how many modes a few shapes have."""
    said = []
    for number, word in FEWEST.items():
        counts = [count for key, row in found.items() if key[1] == number for count in row["counts"]]
        said.append(f"{min(counts):.0f} to {max(counts):.0f} modes from {word} shapes")
    return f"Training takes {' and '.join(said)}."


def rises(found: dict[tuple[str, int], dict[str, Any]]) -> Iterable[str]:
    """Yield a sentence for each collection and number of shapes with a larger error than half as many shapes have."""
    for (name, count), row in found.items():
        fewer = found.get((name, count // 2))
        if fewer and row["modes"] > fewer["modes"] and max(row["counts"]) < count:
            most, before = max(row["counts"]), max(fewer["counts"])
            yield (
                f"\n- **More shapes may have fewer modes.** With {count} shapes, {name} has {most:.0f} modes, none of "
                f"them local. With {count // 2} it has up to {before:.0f}, and a smaller error."
            )


def write_page() -> None:
    """Write the page and its chart from the stored figures."""
    found = means(pages.read_figures(FIGURES))

    def cell(row: dict[str, Any]) -> str:
        ratios = (row["modes"] / error for error in (row["components"], simplest(row)[1]))
        return f"{100 * row['modes']:.3f} ({', '.join(f'{ratio:.2f}' for ratio in ratios)})"

    *counts, most = DRAWS
    cells = [
        [name, *(cell(found[name, count]) if (name, count) in found else "" for count in counts)] for name in NAMES
    ]
    largest = [f"With {most} shapes, {name} has {cell(row)}." for (name, count), row in found.items() if count == most]
    draw_chart(found, pages.MEASUREMENTS / "few-shapes.svg")
    draws = ", ".join(f"{count} shapes {'once' if times == 1 else f'{times} times'}" for count, times in DRAWS.items())
    page = PAGE.format(
        finding=finding(found),
        table=table(("", *(f"{count} shapes" for count in counts)), cells),
        largest=" ".join(largest),
        rises="".join(rises(found)),
        counts=sliders(found),
        unseen=UNSEEN,
        draws=draws,
        measured=pages.measured_with(FIGURES),
    )
    pages.write("few-shapes", page)


def main() -> None:
    """Measure and write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "few-shapes")
    parser.add_argument("names", nargs="*", default=NAMES)
    given = parser.parse_args()
    rows = pages.read_figures(FIGURES) if FIGURES.exists() else []
    done = {(row["name"], row["shapes"], row["draw"]) for row in rows}
    for count, times in DRAWS.items():
        for name in given.names:
            for draw in range(times):
                if (name, count, draw) in done:
                    continue
                if row := measure(name, given.data, given.out, count, draw):
                    rows.append(row)
                    pages.write_figures(FIGURES, rows)
                    print(row, flush=True)
    write_page()


if __name__ == "__main__":
    main()
