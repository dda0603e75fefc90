"""The bundled model is the one its committed run made."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shapespace.bundle.reader import read_bundle
from shapespace.training.runs.config import Config, load

ROOT = Path(__file__).parents[2]
MODELS = ["freaky-torus", "figure"]


@pytest.mark.parametrize("name", MODELS)
def test_a_bundle_states_the_figures_and_the_configuration_of_the_committed_run(name: str) -> None:
    bundle = read_bundle(ROOT / "models" / name / "1")
    run = ROOT / "runs" / name
    assert bundle.manifest.figures == json.loads((run / "evaluation.json").read_text())
    # A setting that came later stands for what was done without it.
    assert Config.model_validate(bundle.manifest.origin.config) == load(run / "config.toml")[0]
    assert (run / "config.toml").read_text() == (ROOT / "examples" / f"{name}.toml").read_text()


@pytest.mark.parametrize("name", MODELS)
def test_a_bundle_meets_what_it_promises(name: str) -> None:
    folder = ROOT / "models" / name / "1"
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 15 * 2**20
    figures = read_bundle(folder).manifest.figures
    r2 = {name: value["total"] for name, value in figures["r2"].items()}
    assert r2["composite"] >= 0.99
    assert r2["composite"] > max(r2["monolithic"], r2["affine"], r2["grid"])
    assert figures["vertex_error"]["mean"] <= 0.01
