"""docs/measurements/results.md: the figures of the paper's tables for every collection.

Each collection is a run under ``--out``, so a killed call can be continued. Figures of finished runs are in
``runs/results/``, one file for each run, and are not measured again. The page is made from these files. Bundles are
written next to the runs, since they contain the collections' geometry.
"""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import tomlkit
import torch
from matplotlib.ticker import LogLocator, NullFormatter

import shapespace
from benchmarks import pages, studies
from benchmarks.pages import ROOT
from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.shell.space import ShellSpace
from shapespace.training.learning.baselines import Exact, factor_grids
from shapespace.training.learning.composite import affine_sum
from shapespace.training.learning.evaluation import HeldOutSamples, r_squared
from shapespace.training.learning.learner import Learner
from shapespace.training.learning.networks import predict
from shapespace.training.report.number_format import r2
from shapespace.training.runs import workers
from shapespace.training.runs.config import Config, load, parse
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.sampling import DONE, KNOWN, Collection, columns
from shapespace.training.space import modes
from shapespace.training.space.factors import group, overlap
from shapespace.training.space.generalisation import PrincipalComponents
from shapespace.training.space.logarithms import logarithms
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run

#: Ending of the names of runs with the paper's modes, and their settings: the shell's norm, the same sparsity for all.
SHELL, SHELL_MODES = "-shell", {"norm": "shell", "sparsity": 0.1, "log_steps": 16}
#: Run with the most modes that 110 shapes allow; the paper's bodies have as many modes and factors.
LARGEST = "hippocampus-80"
#: The paper's largest experiment, on bodies of the built-in generator of this name.
EXPRESSIVE = "expressive"
#: The generator of bodies of several people.
PEOPLE = "people"
#: Collections of real meshes, in the order of the tables. Contrasts are the hand without sparse modes, with one factor
#: and with the variants of the paper's outlook, the dancer from few samples, the largest runs, and runs with the
#: paper's modes.
COLLECTIONS = ("hand", "faces", "samba", "makehuman", "horse", "hippocampus")
CONTRASTS = (
    *("hand-pga", "hand-one-factor", "hand-outlook", "samba-few", LARGEST, EXPRESSIVE),
    *(name + SHELL for name in COLLECTIONS),
)
#: The bundled collection of shapes; its other figures are on the page of the bundled models.
MANNEQUIN = "figure"
#: Ending of the names of runs with mirror images, and the collections with a symmetric shape.
MIRRORED = "-mirrored"
SYMMETRIC = ("faces", "makehuman", MANNEQUIN)
#: Runs whose extrapolation is measured: an easy and a difficult one.
EXTRAPOLATED = ("hand", "samba")
#: Runs with multilinear grids of small factors, as in the paper's table.
GRIDDED = ("hand", "faces")
#: Studies, each with the last stage whose results it measures.
STUDIES = {"space": "samples", "limits": "evaluation", "grids": "samples"}
#: Stored figures, one file for each run.
FIGURES = ROOT / "runs" / "results"


def measured(run: RunDirectory, name: str) -> dict[str, Any]:
    """Return the figures of a study on the current state of a run; empty if settings, data or version have changed."""
    found, stamp = run.study(name).read_if_written(), run.stamp(STUDIES[name]).read_if_written()
    return found if found.get("key", "") == stamp.get("key") else {}


def have(run: RunDirectory, name: str, measure: Callable[[], dict[str, Any]]) -> None:
    """Measure a study if it has no current figures."""
    if not measured(run, name):
        print(f"{name} …")
        run.study(name).write({"key": run.stamp(STUDIES[name]).read()["key"], **measure()})


def open_run(name: str, data: Path, out: Path) -> Run:
    """Return the run of a collection or of a generator; mirror images are used only if the name ends in ``MIRRORED``.

    A name that ends in ``SHELL`` gets the paper's modes, without the paper's system and the grid.
    """
    plain = name.removesuffix(MIRRORED).removesuffix(SHELL)
    path = (
        ROOT
        / "examples"
        / (f"{plain}.toml" if plain in (MANNEQUIN, EXPRESSIVE, PEOPLE) else f"collections/{plain}.toml")
    )
    meshes = load(path)[0].collection.data
    _, text = load(path, data / meshes.relative_to(path.parent) if meshes else None)
    document: Any = tomlkit.parse(text)
    document["collection"]["mirror"] = name.endswith(MIRRORED)
    if name.endswith(SHELL):
        document["modes"].update(SHELL_MODES)
        document.pop("networks", None)
    if name.endswith(SHELL) or name == EXPRESSIVE:
        document["evaluation"] = {"baselines": True}
    text = tomlkit.dumps(document)
    return Run(out / name, parse(text, name), text, out / "models")


def figures(name: str, run: Run) -> dict[str, Any]:
    """Finish a run, and return all its figures."""
    execute(run, "evaluation" if name in CONTRASTS else None, keep_going=True)
    studies.add(run, studies.Studies.listed(name))
    directory = run.directory
    if name in COLLECTIONS:
        have(directory, "space", lambda: compactness(directory, run.config))
    if name in EXTRAPOLATED:
        have(directory, "limits", lambda: {"extrapolation": extrapolation(learner_of(run))})
    if name in GRIDDED:
        have(directory, "grids", lambda: small_grids(run))
    factors, decomposed, ingest = directory.factors.read(), directory.modes.read(), directory.ingest.read()
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
            "sparse": float(decomposed["localisation"].mean()),
            "principal": float(decomposed["pga_localisation"].mean()),
        },
        "sizes": sizes,
        "overlap": [float(shared.mean()), float(shared.max())] if len(shared) else [0.0, 0.0],
        "drawn": drawn(directory, len(sizes)),
        "seconds": seconds(directory),
        "evaluation": directory.evaluation.read(),
        "settings": {key: getattr(run.config.evaluation, key) for key in ("reconstructions", "grid_size")},
        "studies": {study: measured(directory, study) for study in STUDIES},
    }


def compactness(run: RunDirectory, config: Config) -> dict[str, Any]:
    """Return the explained share of a collection, by the number of modes: compactness (Davies et al. 2002).

    Principal component analysis of the aligned vertices, the usual alternative, stands next to it. Both are measured
    with half of the modes and with all. Generalisation is in `benchmarks.generalisation`, specificity in
    `benchmarks.served`.
    """
    shapes, reference, mean = run.own_shapes(), run.reference_mesh(), run.mean.read()["vertices"]
    found = run.modes_by_strength.read()
    sparse, principal = found["vertices"], found["pga_vertices"]
    m = len(sparse)
    counts = [-(-m // 2), m]
    linear = PrincipalComponents.of(shapes, reference.vertices)
    centre, first_step = reference.with_vertices(mean), config.exponential.first_step
    space = ShellSpace(centre, config.shell_material, first_step=first_step)
    fields = logarithms(space, mean, shapes, run.decomposition.read()["log_steps"]).fields

    def explained(span: FloatArray) -> list[float]:
        return [modes.coefficients(space, mean, fields, span[:k], config.modes.norm)[1] for k in counts]

    return {
        "modes": counts,
        "compactness": {
            "modes": explained(sparse),
            "principal geodesics": explained(principal),
            "components": [linear.explained(k) for k in counts],
        },
    }


#: Factors by which the bounds are enlarged; number of codes in each, and their seed.
REACHES, CODES, SEED = (1.0, 1.25, 1.5), 100, 7


def extrapolation(learner: Learner) -> list[dict[str, Any]]:
    """Measure R² outside the training bounds: on uniform codes in the hypercube stretched about its centre.

    Codes inside the bounds are included.

    Returns:
        For each of ``REACHES`` the number of failed exponentials out of ``CODES``, and R² on the others: composite,
        one-factor network and affine sum of exact factors.
    """
    collection = learner.collection
    coordinates, factors = collection.coordinates, list(collection.factors.values())
    norm = WeightedNorm.of(collection.reference, learner.config.evaluation.eta)
    z_reference = nric(collection.reference.vertices, collection.reference.connectivity)
    middle, half = (coordinates.upper + coordinates.lower) / 2, (coordinates.upper - coordinates.lower) / 2
    unit = np.random.default_rng(SEED).uniform(-1, 1, (CODES, len(coordinates)))
    rows = []
    for reach in REACHES:
        codes = middle + reach * half * unit
        every = np.concatenate([codes, *(alone(codes, index) for index in factors)])
        z = exact_shapes(collection, every).reshape(1 + len(factors), CODES, -1)
        there = np.isfinite(z[..., 0])
        kept = there.all(axis=0)
        latents = torch.as_tensor(codes[kept], dtype=torch.float32)
        answers = {
            "composite": predict(learner.main(), latents).numpy(),
            "monolithic": predict(learner.monolithic(), latents).numpy(),
            "affine": affine_sum(z_reference, np.swapaxes(z[1:, kept], 0, 1)),
        }
        r2 = {name: r_squared(answer, z[0, kept], norm)["total"] for name, answer in answers.items()}
        rows.append({"reach": reach, "failed": int((~there[0]).sum()), "compared": int(kept.sum()), "r2": r2})
    return rows


def exact_shapes(collection: Collection, codes: FloatArray) -> FloatArray:
    """Return NRIC (n, 2E) of codes (n, m), NaN for a code without a shape."""
    done = dict(workers.run(collection.shapes, np.array_split(codes, -(-len(codes) // 10))))
    found = [done[k] for k in range(len(done))]
    z = np.concatenate([shapes.nric for shapes in found])
    z[[bool(reason) for shapes in found for reason in shapes.reasons]] = np.nan
    return z


#: Most modes of a factor with a grid, as in the paper, and most nodes along each of them.
GRID_MODES, GRID_NODES = 4, 16


def small_grids(run: Run) -> dict[str, Any]:
    """Measure an affine sum of multilinear grids on the test codes: one grid for each of many small factors.

    Returns the ``sizes`` of the factors, the ``nodes`` along the modes of each, ``bytes`` of all grids, R², and the
    number of test codes that were ``compared``. The others lie beside nodes without a shape.
    """
    learner = learner_of(run)
    collection, test = learner.collection, HeldOutSamples.of(learner)
    z = np.ascontiguousarray(run.directory.modes.read()["nric"])
    norm = WeightedNorm.of(run.directory.mean_mesh(), run.config.material.eta)
    # No factor gets more than twice the mean number of modes.
    groups = group(overlap(z, norm), -(-2 * len(z) // GRID_MODES))
    settings = run.config.evaluation.model_copy(update={"grid_nodes": GRID_NODES})

    def exact(name: str, codes: FloatArray) -> Exact:
        return Exact(exact_shapes(collection, codes).astype(np.float32), np.empty((0, 0, 0), np.float32))

    grids = factor_grids(collection.coordinates, groups, settings, exact)
    z_reference = nric(collection.reference.vertices, collection.reference.connectivity)
    found = affine_sum(z_reference, np.stack([grid(test.latents) for grid in grids], axis=1))
    kept = np.flatnonzero(np.isfinite(found).all(axis=1))
    return {
        "sizes": [len(index) for index in groups],
        "nodes": [grid.nodes for grid in grids],
        "bytes": sum(grid.size for grid in grids),
        "r2": test.r2_of(found[kept], kept),
        "compared": len(kept),
    }


def drawn(run: RunDirectory, factors: int) -> dict[str, Any]:
    """Count exponentials: ``joint``, ``of factors``, the ``failed`` of both, and the counts of ``each factor``."""

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
    """Return the seconds of each stage, summed over all calls, since a later call continues an earlier one."""
    ends = [line for line in run.events() if line["event"] == "end"]
    return {stage: sum(e["seconds"] for e in ends if e["stage"] == stage) for stage in {e["stage"] for e in ends}}


def spread(row: dict[str, Any], model: str) -> tuple[float, float, float]:
    """Return R² of a model over the seeds: mean, smallest, largest."""
    found = row["evaluation"]
    values = [r2[model]["total"] for r2 in (found["r2"], *(seed["r2"] for seed in found["seeds"]))]
    return sum(values) / len(values), min(values), max(values)


def leader(found: dict[str, Any]) -> str:
    """Return the model with the largest R²."""
    return max(found["r2"], key=lambda model: float(found["r2"][model]["total"]))


def leading(found: dict[str, Any]) -> str:
    """Return cells of composite, one factor and kernel, with the largest R² in bold."""
    models = ("composite", "monolithic", "kernel")
    values = [r2(found["r2"][model]["total"]) if model in found["r2"] else "–" for model in models]
    best = r2(max(found["r2"][model]["total"] for model in models if model in found["r2"]))
    return " | ".join(f"**{value}**" if value == best else value for value in values)


def joint_exponentials(row: dict[str, Any]) -> list[int]:
    """Return the number of joint exponentials that a model has seen: from all samples, then from each share of them."""
    every = row["drawn"]["joint"] - row["drawn"]["failed"]["joint"] - row["evaluation"]["test_samples"]
    # A composite from a share also learns from each joint code's part in each factor.
    shares = [some["exponentials"]["composite"] for some in row["evaluation"]["fractions"]]
    return [every, *(count // (1 + len(row["sizes"])) for count in shares)]


def worth(row: dict[str, Any]) -> float:
    """Return the cost of the derivatives of a run, in exponentials."""
    times = row["evaluation"]["times"]
    return float(times["exact, with derivatives"] / times["exact"] * row["evaluation"]["derivatives"])


def plot_samples(rows: dict[str, dict[str, Any]], path: Path) -> None:
    """Plot R² by the number of exponentials that a model has seen, including factor samples and derivatives."""
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


def in_order(evaluation: dict[str, Any]) -> bool:
    """Return whether R² on test codes has the order of the paper's table: system, single network, affine sum."""
    system, single, affine = (evaluation["r2"][model]["total"] for model in ("paper", "monolithic_paper", "affine"))
    return bool(system > single > affine)


def write_page() -> None:
    """Write the page from all stored figures."""
    rows = {
        name: pages.read_figures(file)
        for name in (*COLLECTIONS, *CONTRASTS)
        if (file := FIGURES / f"{name}.json").exists()
    }
    for row in rows.values():
        row["evaluation"] = studies.EMPTY | {"limit": None} | row["evaluation"]
        row["studies"] = {study: {} for study in STUDIES} | row["studies"]
    real = {name: rows[name] for name in COLLECTIONS if name in rows}
    if some := {name: row for name, row in real.items() if row["evaluation"]["fractions"]}:
        plot_samples(some, pages.MEASUREMENTS / "results-samples.png")
    chosen = {name: row for name, row in real.items() if "paper" in row["evaluation"]["r2"]}
    page = pages.render(
        "results",
        rows=rows,
        real=real,
        chosen=chosen,
        in_order={name: in_order(row["evaluation"]) for name, row in chosen.items()},
        shell={name: rows[name + SHELL] for name in COLLECTIONS if name + SHELL in rows},
        largest=rows.get(LARGEST),
        expressive=rows.get(EXPRESSIVE),
        torus=pages.read_figures(ROOT / "runs" / "freaky-torus-1000-paper" / "evaluation.json"),
        missing=[name for name in COLLECTIONS if name not in rows],
        missing_shell=[name for name in COLLECTIONS if name + SHELL not in rows],
        spread=spread,
        leading=leading,
        measured=pages.measured_with(*(FIGURES / f"{name}.json" for name in rows)),
        range=max(most - least for _, least, most in (spread(row, "composite") for row in real.values())),
        led=[name for name, row in real.items() if leader(row["evaluation"]["fresh"]) == "composite"],
    )
    pages.write("results", page)


def main() -> None:
    """Measure missing runs, and write the page after each."""
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
            pages.write_figures(file, found)
        write_page()


if __name__ == "__main__":
    main()
