"""The bundled models are those that their committed runs exported."""

import json
import shutil
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import shapespace
from benchmarks.studies import Studies
from shapespace.bundle.reader import read_bundle
from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import MeshChoice
from shapespace.model.exact_shapes import exact_shape
from shapespace.training.collection.generators import freaky_torus
from shapespace.training.learning.composite import affine_sum
from shapespace.training.learning.evaluation import r_squared
from shapespace.training.runs.config import Config
from tests.training.conftest import Said

ROOT = Path(__file__).parents[3]
#: Versions of the bundled models.
MODELS = {"freaky-torus": "1", "figure": "4"}

#: What a run of version 0.1 left of the torus.
RUN_OF_0_1 = Path(__file__).parent / "run_of_0_1"


def today(name: str, config: dict[str, Any]) -> Config:
    """A configuration; the torus' is of before time steps were chosen, and bundles have variants written out."""
    steps: dict[str, dict[str, Any]] = {"modes": {"log_steps": 16}, "samples": {"steps": 16}}
    variant: dict[str, Any] = {"base": None, "factors": {}, "combiner": {}}
    before = steps if name == "freaky-torus" else {}
    sections = {section: each | config.get(section, {}) for section, each in before.items()}
    sections["variants"] = {key: variant | each for key, each in config.get("variants", {}).items()}
    return Config.model_validate(config | sections)


@pytest.mark.parametrize("name", MODELS)
def test_a_bundle_states_the_figures_and_the_configuration_of_the_committed_run(name: str) -> None:
    bundle = read_bundle(ROOT / "models" / name / MODELS[name])
    run = ROOT / "runs" / name
    evaluation = json.loads((run / "evaluation.json").read_text())
    assert evaluation.pop("made_by")["commit"]
    assert bundle.manifest.figures == evaluation
    assert today(name, bundle.manifest.origin.config) == today(name, tomllib.loads((run / "config.toml").read_text()))


@pytest.mark.parametrize("name", MODELS)
def test_an_example_is_the_recipe_of_the_committed_run(name: str) -> None:
    example, committed = (
        tomllib.loads(path.read_text())
        for path in (ROOT / "examples" / f"{name}.toml", ROOT / "runs" / name / "config.toml")
    )
    listed = Studies.listed(name)
    assert committed.get("networks", {}).pop("seeds", []) == listed.seeds
    assert committed.pop("variants", {}) == {k: v.model_dump(exclude_unset=True) for k, v in listed.variants.items()}
    assert example["evaluation"].pop("baselines")  # runs of 0.2 trained them without being asked
    # Runs give factors other names than at the time of the committed run.
    given = [list(each["export"].pop("names", {}).values()) for each in (example, committed)]
    assert given[0] == given[1]
    assert today(name, example) == today(name, committed)


@pytest.mark.parametrize("name", MODELS)
def test_a_bundle_meets_what_it_promises(name: str) -> None:
    folder = ROOT / "models" / name / MODELS[name]
    sizes = {path.name: path.stat().st_size for path in folder.iterdir()}
    graph = sizes.pop("decoder.onnx")
    assert graph <= sum(sizes.values()) <= 15 * 2**20
    figures = read_bundle(folder).manifest.figures
    r2 = {name: value["total"] for name, value in figures["r2"].items()}
    assert r2["composite"] >= 0.998
    assert r2["composite"] > max(r2["monolithic"], r2["affine"], r2["grid"])
    assert figures["vertex_error"]["mean"] <= 0.01


@pytest.mark.parametrize("folder", [*(ROOT / "runs" / name for name in MODELS), RUN_OF_0_1], ids=lambda path: path.name)
def test_committed_runs_can_be_looked_at(folder: Path, tmp_path: Path, said: Said) -> None:
    run = shutil.copytree(folder, tmp_path / "run")
    assert "export         to do" in said("status", run)
    assert "report.html" in said("report", run)


def test_the_figures_networks_follow_exponentials_that_nobody_drew_before() -> None:
    """R² of the committed ONNX files; the error of the affine sum of the factors alone is much larger."""
    model = shapespace.load(ROOT / "models" / "figure")
    codes, reference = model.sample(16, seed=20261123), model.reference
    answers = model.decode(codes, mesh="coarse").astype(np.float32)
    found = [
        exact_shape(model.decoder, code, answer, MeshChoice.COARSE) for code, answer in zip(codes, answers, strict=True)
    ]
    exact = np.stack([nric(e.vertices.astype(float) / model.manifest.scale, reference.connectivity) for e in found])
    factors = np.stack([model.decoder._networks(code[None])[0][0] for code in codes])
    predicted, affine = (
        np.stack([model.decoder.nric(code) for code in codes]),
        affine_sum(nric(reference.vertices, reference.connectivity), factors),
    )
    norm = WeightedNorm.of(reference, 1e-2)
    scores = {name: r_squared(z, exact, norm) for name, z in {"networks": predicted, "affine": affine}.items()}
    assert min(scores["networks"].values()) > 0.999
    assert 1 - scores["networks"]["total"] < (1 - scores["affine"]["total"]) / 3


def test_the_torus_networks_know_shape_and_bump_at_fresh_codes() -> None:
    """The committed ONNX files pass; a torus without its bump, or with an ellipse turned by 0.1, does not."""
    model, torus = shapespace.load(ROOT / "models" / "freaky-torus"), freaky_torus.FreakyTorus()
    codes = torus.coordinates.uniform(40, np.random.default_rng(20261123))
    exact, norm = torus.shapes(codes), WeightedNorm.of(torus.reference, 1e-2)
    few, size = exact.vertices[:8], torus.reference.diagonal
    flat = freaky_torus.FreakyTorus()
    flat.form = replace(freaky_torus.PAPER, bump_height=0.0)
    smooth = flat.shapes(codes)
    near = np.linalg.norm(few - smooth.vertices[:8], axis=2) > 0.1 * freaky_torus.PAPER.bump_height / torus.scale

    def fails(nric: np.ndarray, vertices: np.ndarray) -> list[str]:
        r2 = r_squared(nric, exact.nric, norm)
        away = np.linalg.norm(align(vertices, few) - few, axis=2) / size
        limits = {
            "total": r2["total"] < 0.998,
            "angles": r2["angles"] < 0.9,
            "mean": away.mean() > 0.002,
            "near the bump": away[near].mean() > 0.006,
        }
        return [name for name, over in limits.items() if over]

    decoded = model.decode(codes[:8], mesh="coarse") / model.manifest.scale
    assert fails(np.stack([model.decoder.nric(code) for code in codes]), decoded) == []
    assert {"total", "angles", "near the bump"} <= set(fails(smooth.nric, smooth.vertices[:8]))
    turned = torus.shapes(codes + np.array([0.1, 0, 0, 0]))
    assert "mean" in fails(turned.nric, turned.vertices[:8])
