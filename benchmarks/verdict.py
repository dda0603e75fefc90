"""docs/is-it-for-me.md and its chart, from the committed figures in runs/: ``python -m benchmarks.verdict``.

The command trains nothing. A simple model that ``runs/collections/NAME.json`` holds beside the principal components,
under a key of its own in ``unseen``, is compared without any change here: the best of them has a bar.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks import pages
from benchmarks.generalisation import SIMPLE
from benchmarks.pages import ROOT

RUNS, PAGE, CHART = ROOT / "runs", ROOT / "docs" / "is-it-for-me.md", ROOT / "docs" / "is-it-for-me.svg"
#: Collections with their titles.
TITLES = {
    "figure": "the bundled figure",
    "hand": "hands",
    "makehuman": "posed bodies",
    "horse": "a horse",
    "faces": "faces",
    "samba": "a captured dancer",
    "hippocampus": "hippocampi",
}
#: A model pays for its training if it has less than this share of the error of principal components, and less than
#: the error of every simple model.
PAYS = 0.7
#: Figures beside the errors of simple models in a fold: our own errors, and the number of shapes.
OURS = ("mean", "p95", "shapes", "nothing remembered")
COMPONENTS, WITH_IMAGES = "components", "components with mirror images"
#: Ending of the names of runs with half as many modes.
HALF = "-half"
#: Runs without baselines and studies, whose times are those of a user.
TIMED = ("hand-one-factor", "samba-few", "makehuman")


@dataclass
class CollectionErrors:
    """Mean vertex errors for unseen shapes, as shares of the bounding box's diagonal.

    Attributes:
        ratios: errors of simple models, as shares of the components' error.
    """

    name: str
    shapes: int
    modes: int
    error: float
    components: float
    ratios: dict[str, float] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The title in tables and in the chart."""
        return TITLES[self.name.removesuffix(HALF)]

    @property
    def ratio(self) -> float:
        """The model's error as a share of the components' error."""
        return self.error / self.components

    @property
    def pays(self) -> bool:
        """Whether the model is clearly better than principal components, and better than every simple model."""
        return self.ratio < min([PAYS, *self.ratios.values()])

    @property
    def best(self) -> str | None:
        """Name of the best simple model that is better than the principal components."""
        return min(self.ratios, key=lambda name: self.ratios[name], default=None)


def collection(name: str, runs: Path = RUNS) -> CollectionErrors:
    """Read the figures of one collection: all its folds, and what other runs say about simple models."""
    folds = pages.read_figures(runs / "collections" / f"{name}.json")
    unseen = [fold["unseen"] for fold in folds]
    shapes = [fold["shapes"] for fold in unseen]

    def mean(some: list[dict[str, Any]]) -> float:
        return float(np.average([each["mean"] for each in some], weights=shapes))

    found = CollectionErrors(
        name,
        shapes=sum(folds[0][kind]["shapes"] for kind in ("unseen", "trained on")),
        modes=max(fold["modes"] for fold in folds),
        error=mean(unseen),
        components=mean([fold[COMPONENTS] for fold in unseen]),
    )
    simple = set.intersection(*(set(fold) for fold in unseen)) - {*OURS, COMPONENTS}
    found.ratios = {
        SIMPLE.get(rival, rival): mean([fold[rival] for fold in unseen]) / found.components for rival in sorted(simple)
    }
    if (file := runs / "folds" / f"{name}-mirrored.json").exists():
        mirrored = pages.read_figures(file)
        found.ratios[WITH_IMAGES] = mirrored["mirrored_components"][-1]["mean"] / mirrored["components"][-1]["mean"]
    found.ratios = {rival: ratio for rival, ratio in found.ratios.items() if round(ratio, 2) < 1}
    return found


@dataclass
class TrainingTime:
    """Size of a training run, and the minutes that it took."""

    title: str
    vertices: int
    computed: int  # exact shapes that the networks learn from
    minutes: float


def times(runs: Path = RUNS) -> list[TrainingTime]:
    """Return the times of whole runs, from the shortest to the longest."""
    found = []
    for name in TIMED:
        run = pages.read_figures(runs / "results" / f"{name}.json")
        counts, ingest = run["drawn"], run["ingest"]
        computed = counts["joint"] + counts["of factors"]
        title = TITLES[name.partition("-")[0]]
        found.append(TrainingTime(title, ingest["vertices"], computed, sum(run["seconds"].values()) / 60))
    log = [json.loads(line) for line in (runs / "figure" / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    ingested = next(line for line in log if line["event"] == "ingested")
    # Later calls of the same run repeat single stages.
    seconds = {line["stage"]: line["seconds"] for line in reversed(log) if line["event"] == "end"}
    computed = json.loads((runs / "figure" / "evaluation.json").read_text(encoding="utf-8"))["exponentials"]
    minutes = sum(seconds.values()) / 60
    found.append(TrainingTime(TITLES["figure"], ingested["vertices"], computed, minutes))
    return sorted(found, key=lambda run: run.minutes)


def drawing(found: list[CollectionErrors]) -> Figure:
    """Draw the bars of all collections: the model, the components, and the best simple model."""
    figure = Figure(figsize=(7.2, 0.62 * len(found) + 1.1), layout="constrained")
    axes: Axes = figure.subplots()
    beside = any(each.best for each in found)
    height = 0.8 / (3 if beside else 2)
    kinds: list[tuple[str, str, list[float | None]]] = [
        ("shapespace", "#1f6f8b", [each.ratio for each in found]),
        ("principal components", "#b9b4a8", [1.0] * len(found)),
    ]
    if beside:
        ratios = [each.ratios[each.best] if each.best else None for each in found]
        kinds.append(("best simple model that we measured, if better than components", "#d98e4a", ratios))
    for k, (label, colour, values) in enumerate(kinds):
        at = [i + (k - (len(kinds) - 1) / 2) * height for i, value in enumerate(values) if value is not None]
        there = [value for value in values if value is not None]
        bars = axes.barh(at, there, 0.9 * height, color=colour, label=label)
        axes.bar_label(bars, [f"{value:.2f}" for value in there], padding=3, fontsize=8)
    axes.set_yticks(range(len(found)), [each.title for each in found])
    axes.invert_yaxis()
    axes.set(xlim=(0, 1.1 * max(1.0, *(each.ratio for each in found))))
    axes.set_xlabel("error for unseen shapes, as a share of the error of principal components (less is better)")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=len(kinds), fontsize=8, frameon=False)
    return figure


def draw(found: list[CollectionErrors], path: Path = CHART) -> None:
    """Write the chart as SVG, with the same bytes for the same figures."""
    with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": path.name, "font.size": 9}):
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        drawing(found).savefig(path, format="svg", facecolor="white", metadata=nothing)


def cost_of_fewer_shapes(runs: Path) -> str:
    """Say how little accuracy a run with fewer computed shapes loses, by the example of the dancer."""
    fewer, every = (pages.read_figures(runs / "results" / f"{name}.json") for name in ("samba-few", "samba"))
    (few, less), (all_of_them, most) = (
        (run["drawn"]["joint"] + run["drawn"]["of factors"], run["evaluation"]["fresh"]["r2"]["composite"]["total"])
        for run in (fewer, every)
    )
    return (
        f"With {few} instead of {all_of_them} shapes, the dancer's networks have "
        f"[R²](reference/glossary.md#r-squared) {less:.4f} instead of {most:.4f}."
    )


def page(found: list[CollectionErrors], runs: Path = RUNS) -> str:
    """Return the text of the page."""
    by_name = {each.name: each for each in found}
    return pages.render(
        "verdict",
        every=found,
        better=[each for each in found if each.pays],
        equal=[each for each in found if not each.pays],
        worse=[each for each in found if round(min([1.0, *each.ratios.values()]), 2) < round(each.ratio, 2)],
        titles=lambda some: pages.listed([each.title for each in some]),
        range=lambda some: f"{min(each.ratio for each in some):.2f} to {max(each.ratio for each in some):.2f}",
        cost=cost_of_fewer_shapes(runs),
        measured=pages.measured_with(*(runs / "collections" / f"{name}.json" for name in by_name)),
        ratio_of=lambda name: f"{by_name[name].ratio:.2f}",
        fewer={"whole": by_name["samba"], "half": collection("samba" + HALF, runs)},
        times=times(runs),
        growth=pages.read_figures(runs / "growth.json")["rows"],
    )


def collections(runs: Path = RUNS) -> list[CollectionErrors]:
    """Return all collections, from the largest gain to the smallest."""
    return sorted((collection(name, runs) for name in TITLES), key=lambda each: each.ratio)


if __name__ == "__main__":
    measured = collections()
    draw(measured)
    PAGE.write_text(page(measured), encoding="utf-8")
