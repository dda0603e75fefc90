"""docs/measurements/results.md: every collection from its meshes to the figures of the paper's tables, in one command.

Each collection is a run of its own under ``--out``, so what is done is not done again, and a killed call goes on where
it was. Bundles are written beside the runs: they hold the collections' geometry.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import jinja2
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from benchmarks import limits, space
from shapespace.mesh.rigid_motion import align
from shapespace.training.pipeline import Run, execute, learner_of
from shapespace.training.report.pictures import COMPOSITE, Studio
from shapespace.training.report.record import Record
from shapespace.training.runs.config import load
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import DONE, KNOWN, columns

ROOT = Path(__file__).resolve().parents[1]
#: Collections of real meshes, in the order of the tables; then the hand without sparse modes, and with one factor.
COLLECTIONS = ("hand", "faces", "samba", "makehuman", "horse", "hippocampus")
CONTRASTS = ("hand-pga", "hand-one-factor")
#: The bundled models, whose runs write the committed bundles.
OWN = ("freaky-torus", "figure")
#: Collections whose terms permit pictures of them, and the bundled models.
PICTURED = ("hand", "faces", "makehuman", "figure", "freaky-torus")
#: Runs whose extrapolation is measured: an easy and a difficult one.
EXTRAPOLATED = ("hand", "samba")
#: Studies, each with the last stage whose results it measures.
STUDIES = {"space": "samples", "limits": "evaluation"}


def measured(run: RunDirectory, name: str) -> dict[str, Any]:
    """What a study found on a run as it is now, or nothing: figures of other settings, data or versions don't count."""
    found, stamp = run.study(name).read_if_written(), run.stamp(STUDIES[name]).read_if_written()
    return found if found.get("key", "") == stamp.get("key") else {}


def have(run: RunDirectory, name: str, measure: Callable[[], dict[str, Any]]) -> None:
    """Measure where there is nothing yet."""
    if not measured(run, name):
        print(f"{name} …")
        run.study(name).write({"key": run.stamp(STUDIES[name]).read()["key"], **measure()})


class Row:
    """A run with everything that was measured on it."""

    def __init__(self, name: str, run: Run) -> None:
        self.name, self.directory, self.config = name, run.directory, run.config

    def study(self, name: str) -> dict[str, Any]:
        """See `measured`."""
        return measured(self.directory, name)

    @cached_property
    def ingest(self) -> dict[str, Any]:
        """Of the collection; nothing of one that is a product by design."""
        return self.directory.ingest.read_if_written()

    @cached_property
    def evaluation(self) -> dict[str, Any]:
        """Of the networks."""
        return self.directory.evaluation.read()

    @cached_property
    def sizes(self) -> list[int]:
        """Modes of each factor."""
        return [len(members) for members in self.directory.factors.read()["factors"]]

    @cached_property
    def of_factors(self) -> list[int]:
        """Exponentials drawn of each factor alone, every number once."""
        folders = map(self.directory.factor_samples, range(len(self.sizes)))
        return list(dict.fromkeys(len(columns(folder, "status").get("status", ())) for folder in folders))

    @cached_property
    def samples(self) -> dict[str, int]:
        """Exponentials drawn: ``joint`` and of the ``factors``, and how many of each ``failed``."""
        found = {"joint": 0, "factors": 0, "joint failed": 0, "factors failed": 0}
        own = [("factors", self.directory.factor_samples(j)) for j in range(len(self.sizes))]
        joint = [("joint", self.directory.samples), ("joint", self.directory.samples / KNOWN)]
        for kind, folder in joint + own:
            status = columns(folder, "status").get("status", np.array([]))
            found[kind] += len(status)
            found[f"{kind} failed"] += int((status != DONE).sum())
        return found

    @cached_property
    def _log(self) -> list[dict[str, Any]]:
        return list(self.directory.events())

    def seconds(self, stage: str) -> float:
        """That a stage took in all calls that finished it: a later one goes on from what is there."""
        return sum(line["seconds"] for line in self._log if line["event"] == "end" and line["stage"] == stage)

    def spread(self, model: str) -> tuple[float, float, float]:
        """R² of a model over the seeds: mean, smallest, largest."""
        values = [r2[model]["total"] for r2 in (self.evaluation["r2"], *(s["r2"] for s in self.evaluation["seeds"]))]
        return sum(values) / len(values), min(values), max(values)

    @cached_property
    def localisation(self) -> tuple[float, float]:
        """Share of the edges that carry 95 % of a mode's energy, mean over modes of PGA and of SPGA."""
        modes = self.directory.modes.read()
        return float(modes["pga_localisation"].mean()), float(modes["localisation"].mean())

    @cached_property
    def overlaps(self) -> tuple[float, float]:
        """Of supports of different factors: mean and largest."""
        shared = np.array(self.directory.factors.read()["overlap"])
        apart = shared[~np.eye(len(shared), dtype=bool)]
        return (float(apart.mean()), float(apart.max())) if len(apart) else (0.0, 0.0)


def open_run(name: str, data: Path, out: Path) -> Run:
    """The run of a collection, or of a model of our own."""
    if name in OWN:
        path, folder, models = ROOT / "examples" / f"{name}.toml", ROOT / "runs" / name, ROOT / "models"
        return Run(folder, *load(path), models)
    path = ROOT / "examples" / "collections" / f"{name}.toml"
    meshes = load(path)[0].collection.data.relative_to(path.parent)
    return Run(out / name, *load(path, data / meshes), out / "models")


def study(name: str, run: Run) -> None:
    """Everything of one run that isn't there yet, or is of other settings."""
    print(f"\n{name}")
    execute(run, "evaluation" if name in CONTRASTS else None, keep_going=True)
    if name in COLLECTIONS:
        have(run.directory, "space", lambda: space.measure(run.directory, run.config))
    if name in EXTRAPOLATED:
        have(run.directory, "limits", lambda: {"extrapolation": limits.extrapolation(learner_of(run))})


def draw_strips(rows: list[Row], path: Path) -> None:
    """Between two random codes of each, all factors together, reconstructed from what the networks say."""
    strips = []
    for row in rows:
        record = Record(row.directory)
        if studio := Studio.of(record):
            strips.append(
                Image.fromarray(studio.pixels(align(record.gallery["strip_joint"], studio.base), 170, COMPOSITE))
            )
    if not strips:  # there are platforms without what draws them
        return
    width = max(strip.width for strip in strips)
    page = Image.new("RGB", (width, sum(strip.height for strip in strips)), "white")
    top = 0
    for strip in strips:
        page.paste(strip, ((width - strip.width) // 2, top), strip)
        top += strip.height
    page.save(path, optimize=True)


def plot_samples(rows: list[Row], path: Path) -> None:
    """R² by the share of the samples, of the three ways to learn from them."""
    figure, axes = plt.subplots(
        1, len(rows), figsize=(1.6 + 2.2 * len(rows), 2.9), sharey=True, layout="constrained", squeeze=False
    )
    for axis, row in zip(axes[0], rows, strict=True):
        whole = {"fraction": 1.0, "r2": row.evaluation["r2"] | {"all of factors": row.evaluation["r2"]["composite"]}}
        every = sorted([whole, *row.evaluation["fractions"]], key=lambda each: each["fraction"])
        at = [100 * each["fraction"] for each in every]
        for model, style in (("composite", "o-"), ("all of factors", "s--"), ("monolithic", "^:")):
            label = {"all of factors": "composite, all factor samples", "monolithic": "one factor"}.get(model, model)
            axis.plot(at, [1 - each["r2"][model]["total"] for each in every], style, label=label)
        axis.set(title=row.name, xscale="log", yscale="log", xlabel="joint samples (%)")
        axis.set_xticks(at, [f"{a:g}" for a in at], minor=False)
        axis.minorticks_off()
    axes[0, 0].set_ylabel("1 − R²")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="x-small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def plot_space(rows: list[Row], path: Path) -> None:
    """Generalisation by the number of modes, beside principal components of vertices."""
    figure, axes = plt.subplots(1, len(rows), figsize=(1.6 + 2.2 * len(rows), 2.9), layout="constrained", squeeze=False)
    for axis, row in zip(axes[0], rows, strict=True):
        found = row.study("space")
        for kind, style in (("modes", "o-"), ("components", "s--")):
            values = [100 * value for value in found["generalisation"][kind]]
            axis.plot(found["modes"], values, style, label={"modes": "sparse geodesic modes"}.get(kind, kind))
        axis.set(title=row.name, xscale="log", xlabel="modes", ylim=(0, None))
        ticks = [k for k in found["modes"] if 1.5 * k <= found["modes"][-1]] + found["modes"][-1:]
        axis.set_xticks(ticks, [str(k) for k in ticks], minor=False)
        axis.minorticks_off()
    axes[0, 0].set_ylabel("unseen shape, % of diagonal")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize="x-small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    """Do what is missing, then write the page with all that is there."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections, each NAME/fine.npz")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "results", help="folder of the runs")
    parser.add_argument("--only", nargs="*", choices=(*COLLECTIONS, *CONTRASTS, *OWN), help="runs to work on")
    parser.add_argument("--page", action="store_true", help="write the page from what is there, and compute nothing")
    arguments = parser.parse_args()
    runs = {name: open_run(name, arguments.data, arguments.out) for name in (*COLLECTIONS, *CONTRASTS, *OWN)}
    if not arguments.page:
        for name in arguments.only or runs:
            study(name, runs[name])
    rows = {name: Row(name, run) for name, run in runs.items() if run.directory.evaluation.exists()}
    real, ours = ([rows[name] for name in names if name in rows] for names in (COLLECTIONS, OWN))
    docs = ROOT / "docs" / "measurements"
    draw_strips([rows[name] for name in PICTURED if name in rows], docs / "results-shapes.png")
    if some := [row for row in real if row.evaluation["fractions"]]:
        plot_samples(some, docs / "results-samples.png")
    if some := [row for row in real if row.study("space")]:
        plot_space(some, docs / "results-space.png")
    environment = jinja2.Environment(  # noqa: S701 - Markdown
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    spaces, extrapolated = (any(row.study(name) for row in real) for name in ("space", "limits"))
    page = environment.get_template("results.md.jinja").render(
        rows=rows, real=real, ours=ours, spaces=spaces, extrapolated=extrapolated
    )
    (docs / "results.md").write_text(page, encoding="utf-8")
    print(f"\n{docs / 'results.md'}")


if __name__ == "__main__":
    main()
