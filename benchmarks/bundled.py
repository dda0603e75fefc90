"""docs/measurements/bundled.md: figures of the committed runs of the bundled models.

``python -m benchmarks.bundled`` writes the page from ``runs/figure``, ``runs/freaky-torus`` and
``runs/freaky-torus-1000``. The figures of the paper's own system come from the folders next to these whose names end
in ``-paper``, where ``benchmarks.paper`` writes them. The command trains nothing.
"""

import json
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks import pages, served, studies
from benchmarks.pages import ROOT
from benchmarks.paper import SYSTEMS
from shapespace.coordinates.nric import WeightedNorm
from shapespace.training.collection.generators import freaky_torus
from shapespace.training.learning.evaluation import r_squared
from shapespace.training.runs.config import load

#: Models of `evaluation.json` in the order of the tables, in words.
MODELS = {
    "composite": "**our model**",
    "monolithic": "our recipe, one factor",
    "kernel": "kernel ridge regression",
    "paper": "the paper's own system, sizes chosen here",
    "paper_guessed": "the paper's own system, sizes guessed",
    "monolithic_paper": "the paper's monolithic network",
    "monolithic_chosen": "the paper's monolithic network, sizes chosen here",
    "affine": "affine sum, exact factors",
    "affine of learned factors": "affine sum, learned factors",
    "grid": "multilinear grid of each factor",
}


def record(name: str) -> dict[str, Any]:
    """Return the contents of a committed run, by the names of its files."""
    folder = ROOT / "runs" / name
    found: dict[str, Any] = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    found["evaluation"] = studies.EMPTY | found["evaluation"]
    config = folder / "config.toml"
    return found | {"config": load(config, stored=config)[0]}


def add_paper(found: dict[str, Any], again: dict[str, Any]) -> None:
    """Add the paper's own system to an evaluation, from another evaluation of the same networks and codes.

    Raises:
        ValueError: the other evaluation is of other networks.
    """
    if found["fresh"]["sha256"] != again["fresh"]["sha256"] or found["r2"]["composite"] != again["r2"]["composite"]:
        raise ValueError("the paper's own system was measured beside other networks")
    for system in (SYSTEMS.keys() | {"paper_guessed"}) & again["r2"].keys():
        for old, new in ((found, again), (found["fresh"], again["fresh"])):
            old["r2"][system] = new["r2"][system]
        found["sizes"][system] = again["sizes"][system]
    found |= {name: again[name] for name in ("paper_factors", "paper_guessed_factors") if name in again}


def without_bump(count: int = 1000) -> float:
    """Return R² of the torus without its bump, at random codes."""
    torus = freaky_torus.FreakyTorus()
    codes = torus.coordinates.uniform(count, np.random.default_rng(0))
    exact, norm = torus.shapes(codes).nric, WeightedNorm.of(torus.reference, 1e-2)
    torus.form = replace(freaky_torus.PAPER, bump_height=0.0)
    return r_squared(torus.shapes(codes).nric, exact, norm)["total"]


def page() -> str:
    """Return the text of the page."""
    names = {"figure": "figure", "torus": "freaky-torus", "alone": "freaky-torus-1000"}
    runs = {key: record(name) for key, name in names.items()}
    for key, name in names.items():
        if (again := ROOT / "runs" / f"{name}-paper" / "evaluation.json").is_file():
            add_paper(runs[key]["evaluation"], json.loads(again.read_text()))
    exported = runs["figure"]["config"].export
    manifest = json.loads((ROOT / "models" / exported.name / str(exported.version) / "manifest.json").read_text())
    folds = [fold["unseen"] for fold in pages.read_figures(served.FIGURES / f"{exported.name}.json")]
    torus = runs["torus"]["evaluation"]
    seeds = [seed["r2"] for run in runs.values() for seed in run["evaluation"]["seeds"]]
    return pages.render(
        "bundled",
        models=MODELS,
        bumpless=without_bump(),
        manifest=manifest,
        served=[served.average(folds, model, ("mean",)) for model in (None, "components")],
        other_angles=max(r2["angles"] for name, r2 in torus["fresh"]["r2"].items() if name != "composite"),
        lowest=min(r2["composite"]["total"] for r2 in seeds),
        measured=pages.measured_with(*(ROOT / "runs" / name / "evaluation.json" for name in names.values())),
        **runs,
    )


if __name__ == "__main__":
    pages.write("bundled", page())
