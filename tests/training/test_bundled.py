"""The bundled model is the one its committed run made."""

from __future__ import annotations

import json
from pathlib import Path

from service.bundle import read_bundle
from training.config import load

ROOT = Path(__file__).parents[2]


def test_the_bundle_states_the_figures_and_the_configuration_of_the_committed_run() -> None:
    bundle = read_bundle(ROOT / "models" / "freaky-torus" / "1")
    run = ROOT / "runs" / "freaky-torus"
    assert bundle.manifest.figures == json.loads((run / "evaluation.json").read_text())
    assert bundle.manifest.origin.config == load(run / "config.toml")[0].model_dump(mode="json", by_alias=True)
    assert (run / "config.toml").read_text() == (ROOT / "examples" / "freaky-torus.toml").read_text()


def test_the_bundle_meets_what_it_promises() -> None:
    folder = ROOT / "models" / "freaky-torus" / "1"
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 15 * 2**20
    figures = read_bundle(folder).manifest.figures
    r2 = {name: value["total"] for name, value in figures["r2"].items()}
    assert r2["composite"] >= 0.99
    assert r2["composite"] > max(r2["monolithic"], r2["affine"], r2["grid"])
    assert figures["vertex_error"]["mean"] <= 0.01
