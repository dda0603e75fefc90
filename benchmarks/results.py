"""docs/measurements/results.md: every collection from its meshes to the figures of the paper's tables.

Each collection is a run of its own under ``--out``, so a killed call goes on where it was. What was measured on a run
that is done is in ``runs/results/``, a file for each, and is not measured again while it is there; the page is made of
these files. Bundles are written beside the runs: they hold the collections' geometry.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jinja2
import matplotlib.pyplot as plt
import numpy as np
import tomlkit
from matplotlib.ticker import LogLocator, NullFormatter

import shapespace
from benchmarks import limits, space, studies
from shapespace.training.pipeline import Run, execute, learner_of
from shapespace.training.runs.config import load, parse
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import DONE, KNOWN, columns

ROOT = Path(__file__).resolve().parents[1]
#: What the names of runs with the paper's modes end in: in the shell's norm, as sparse for all.
SHELL, SHELL_MODES = "-shell", {"norm": "shell", "sparsity": 0.1, "log_steps": 16}
#: The largest that 110 shapes give: as many modes and factors as the paper's bodies have.
LARGEST = "hippocampus-80"
#: Collections of real meshes, in the order of the tables; then the hand without sparse modes, with one factor and with
#: what the paper's outlook names, the dancer from few samples, the largest, and all with the paper's modes.
COLLECTIONS = ("hand", "faces", "samba", "makehuman", "horse", "hippocampus")
CONTRASTS = (
    *("hand-pga", "hand-one-factor", "hand-outlook", "samba-few", LARGEST),
    *(name + SHELL for name in COLLECTIONS),
)
#: The bundled collection of shapes; its other figures are on the page of the bundled models.
MANNEQUIN = "figure"
#: What the names of runs with mirror images end in, and the collections that have a symmetric shape.
MIRRORED = "-mirrored"
SYMMETRIC = ("faces", "makehuman", MANNEQUIN)
#: Runs whose extrapolation is measured: an easy and a difficult one.
EXTRAPOLATED = ("hand", "samba")
#: Studies, each with the last stage whose results it measures.
STUDIES = {"space": "samples", "limits": "evaluation"}
#: What was measured, a file for each run.
FIGURES = ROOT / "runs" / "results"
DOCS = ROOT / "docs" / "measurements"


def measured(run: RunDirectory, name: str) -> dict[str, Any]:
    """What a study found on a run as it is now, or nothing: figures of other settings, data or versions don't count."""
    found, stamp = run.study(name).read_if_written(), run.stamp(STUDIES[name]).read_if_written()
    return found if found.get("key", "") == stamp.get("key") else {}


def have(run: RunDirectory, name: str, measure: Callable[[], dict[str, Any]]) -> None:
    """Measure where there is nothing yet."""
    if not measured(run, name):
        print(f"{name} …")
        run.study(name).write({"key": run.stamp(STUDIES[name]).read()["key"], **measure()})


def open_run(name: str, data: Path, out: Path) -> Run:
    """The run of a collection or the figure, without mirror images of its shapes unless the name ends in ``MIRRORED``.

    Where it ends in ``SHELL``, with these modes, and without the paper's system and the grid.
    """
    plain = name.removesuffix(MIRRORED).removesuffix(SHELL)
    path = ROOT / "examples" / (f"{plain}.toml" if plain == MANNEQUIN else f"collections/{plain}.toml")
    meshes = load(path)[0].collection.data
    _, text = load(path, data / meshes.relative_to(path.parent) if meshes else None)
    document: Any = tomlkit.parse(text)
    document["collection"]["mirror"] = name.endswith(MIRRORED)
    if name.endswith(SHELL):
        document["modes"].update(SHELL_MODES)
        for baselines in ("networks", "evaluation"):
            document.pop(baselines, None)
    text = tomlkit.dumps(document)
    return Run(out / name, parse(text, name), text, out / "models")


def figures(name: str, run: Run) -> dict[str, Any]:
    """Do what is missing of a run, and return everything that was measured on it."""
    execute(run, "evaluation" if name in CONTRASTS else None, keep_going=True)
    studies.add(run, studies.Studies.listed(name))
    directory = run.directory
    if name in COLLECTIONS:
        have(directory, "space", lambda: space.measure(directory, run.config))
    if name in EXTRAPOLATED:
        have(directory, "limits", lambda: {"extrapolation": limits.extrapolation(learner_of(run))})
    factors, modes, ingest = directory.factors.read(), directory.modes.read(), directory.ingest.read()
    sizes = [len(members) for members in factors["factors"]]
    shared = np.array(factors["overlap"])[~np.eye(len(sizes), dtype=bool)]
    decomposition = directory.decomposition.read()
    return {
        "version": shapespace.__version__,
        "ingest": {key: ingest[key] for key in ("shapes", "vertices", "coarse_vertices", "prolongation")},
        "explained": {"sparse": decomposition["explained"], "principal": decomposition["pga_explained"]},
        "linearised": decomposition["linearised_logarithms"],
        "steps": decomposition["log_steps"],
        "localisation": {
            "sparse": float(modes["localisation"].mean()),
            "principal": float(modes["pga_localisation"].mean()),
        },
        "sizes": sizes,
        "overlap": [float(shared.mean()), float(shared.max())] if len(shared) else [0.0, 0.0],
        "drawn": drawn(directory, len(sizes)),
        "seconds": seconds(directory),
        "evaluation": directory.evaluation.read(),
        "settings": {key: getattr(run.config.evaluation, key) for key in ("reconstructions", "grid_size")},
        "studies": {study: measured(directory, study) for study in STUDIES},
    }


def drawn(run: RunDirectory, factors: int) -> dict[str, Any]:
    """Exponentials: ``joint`` and ``of factors``, how many of these ``failed``, and the counts of ``each factor``."""

    def statuses(folder: Path) -> list[str]:
        return list(columns(folder, "status").get("status", ()))

    joint = statuses(run.samples) + statuses(run.samples / KNOWN)
    each = [statuses(run.factor_samples(j)) for j in range(factors)]
    kinds = {"joint": joint, "of factors": [status for some in each for status in some]}
    return {
        **{kind: len(some) for kind, some in kinds.items()},
        "failed": {kind: sum(status != DONE for status in some) for kind, some in kinds.items()},
        "each factor": [len(some) for some in each],
    }


def seconds(run: RunDirectory) -> dict[str, float]:
    """That stages took in all calls that finished them: a later one goes on from what is there."""
    ends = [line for line in run.events() if line["event"] == "end"]
    return {stage: sum(e["seconds"] for e in ends if e["stage"] == stage) for stage in {e["stage"] for e in ends}}


def spread(row: dict[str, Any], model: str) -> tuple[float, float, float]:
    """R² of a model over the seeds: mean, smallest, largest."""
    found = row["evaluation"]
    values = [r2[model]["total"] for r2 in (found["r2"], *(seed["r2"] for seed in found["seeds"]))]
    return sum(values) / len(values), min(values), max(values)


def leading(found: dict[str, Any]) -> str:
    """Cells of composite, one factor and kernel, the largest R² bold."""
    cells = [f"{found['r2'][model]['total']:.4f}" for model in ("composite", "monolithic", "kernel")]
    return " | ".join(f"**{cell}**" if cell == max(cells) else cell for cell in cells)


def joint_exponentials(row: dict[str, Any]) -> list[int]:
    """How many joint exponentials a model has seen: from all samples, then from each share of them."""
    every = row["drawn"]["joint"] - row["drawn"]["failed"]["joint"] - row["evaluation"]["test_samples"]
    # The composite from a share has each joint code's part in each factor too.
    shares = [some["exponentials"]["composite"] for some in row["evaluation"]["fractions"]]
    return [every, *(count // (1 + len(row["sizes"])) for count in shares)]


def sampling(row: dict[str, Any]) -> float:
    """What all samples of a run took, in exponentials: a code with its derivatives as many as take as long."""
    return float(row["drawn"]["joint"] + row["drawn"]["of factors"] + worth(row))


def worth(row: dict[str, Any]) -> float:
    """How many exponentials take as long as the derivatives of a run."""
    times = row["evaluation"]["times"]
    return float(times["exact, with derivatives"] / times["exact"] * row["evaluation"]["derivatives"])


def plot_samples(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """R² by the exponentials that a model has seen, those of factors and the worth of derivatives included."""
    figure, axes = plt.subplots(
        1, len(rows), figsize=(1.6 + 2.2 * len(rows), 2.9), sharey=True, layout="constrained", squeeze=False
    )
    styles = {"composite": "o-", "all of factors": "s--", "monolithic": "^:", "kernel": "v-."}
    labels = {"all of factors": "composite, all factor samples", "monolithic": "one factor"}
    for axis, (name, row) in zip(axes[0], rows.items(), strict=True):
        found, derivatives = row["evaluation"], worth(row)
        r2, seen = found["r2"], found["exponentials"]
        whole = {
            "r2": r2 | {"all of factors": r2["composite"]},
            "exponentials": {"composite": seen, "all of factors": seen},
        }
        for model, style in styles.items():
            at = [
                (each["exponentials"].get(model, joint) + derivatives, 1 - each["r2"][model]["total"])
                for each, joint in zip([whole, *found["fractions"]], joint_exponentials(row), strict=True)
            ]
            axis.plot(*zip(*sorted(at), strict=True), style, label=labels.get(model, model))
        axis.set(title=name, xscale="log", yscale="log", xlabel="exponentials seen")
        axis.xaxis.set(major_locator=LogLocator(subs=(1, 3)), major_formatter="{x:g}", minor_formatter=NullFormatter())
    axes[0, 0].set_ylabel("1 − R²")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize="x-small")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def write_page() -> None:
    """From all figures that are there."""
    rows = {
        name: json.loads(file.read_text())
        for name in (*COLLECTIONS, *CONTRASTS)
        if (file := FIGURES / f"{name}.json").exists()
    }
    for row in rows.values():
        row["evaluation"] = studies.EMPTY | row["evaluation"]
    real = {name: rows[name] for name in COLLECTIONS if name in rows}
    if some := {name: row for name, row in real.items() if row["evaluation"]["fractions"]}:
        plot_samples(some, DOCS / "results-samples.png")
    environment = jinja2.Environment(  # noqa: S701 - Markdown
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    page = environment.get_template("results.md.jinja").render(
        rows=rows,
        real=real,
        shell={name: rows[name + SHELL] for name in COLLECTIONS if name + SHELL in rows},
        largest=rows.get(LARGEST),
        missing=[name for name in COLLECTIONS if name not in rows],
        missing_shell=[name for name in COLLECTIONS if name + SHELL not in rows],
        spread=spread,
        leading=leading,
        joint=joint_exponentials,
        sampling=sampling,
    )
    (DOCS / "results.md").write_text(page, encoding="utf-8")


def main() -> None:
    """Measure what is missing, and write the page after each run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of the collections, each NAME/fine.npz")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "results", help="folder of the runs")
    parser.add_argument("names", nargs="*", default=(*COLLECTIONS, *CONTRASTS), help="runs to measure, or all")
    given = parser.parse_args()
    for name in given.names:
        file = FIGURES / f"{name}.json"
        if not file.exists():
            print(f"\n{name}")
            found = figures(name, open_run(name, given.data, given.out))
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(found, indent=1), encoding="utf-8")
        write_page()


if __name__ == "__main__":
    main()
