"""The bundled model is the one its committed run made."""

from __future__ import annotations

import json
import shutil
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from shapespace.bundle.reader import read_bundle
from shapespace.training.__main__ import main
from shapespace.training.collection.generators import PRODUCTS
from shapespace.training.learning.networks import candidates
from shapespace.training.runs.config import CombinerSettings, Config, LatentNetworkSettings, load

ROOT = Path(__file__).parents[3]
#: Versions of the bundled models.
MODELS = {"freaky-torus": "1", "figure": "2"}


#: Settings of a combiner that version 0.1 took where the configuration did not say.
COMBINER_OF_0_1 = {
    "layers": 0, "kernel": 12, "polynomial": 0, "monomials": 1800, "pairwise": 0, "symmetries": True,
    "width": 24, "neighbourhood": "star", "crop": 0, "residual": True, "edge_channels": 4, "dropout": 0.0,
    "fit": {"schedule": "cosine", "learning_rate": 2e-3, "batch_size": 16, "max_epochs": 12},
}  # fmt: skip


def combiner(written: dict[str, Any]) -> dict[str, Any]:
    """Of 0.1, as it is written today."""
    old = COMBINER_OF_0_1 | written
    if not old["layers"]:
        assert old["kernel"]
        assert not old["polynomial"]
        assert not old["pairwise"]
        correction = {"kind": "kernel", "coefficients": old["kernel"]}
    else:
        assert not old["kernel"]
        assert not old["polynomial"]
        names = ("layers", "width", "neighbourhood", "crop", "residual", "edge_channels", "dropout", "fit")
        correction = {"kind": "convolutions", "products": old["pairwise"], **{name: old[name] for name in names}}
    return CombinerSettings.model_validate({"correction": correction, "symmetries": old["symmetries"]}).model_dump()


def latent_network(written: dict[str, Any]) -> dict[str, Any]:
    """Of 0.1, as it is written today; what is not written has not changed."""
    no_layer = {"skip_orders": []} if written.get("skip_orders", ()) is None else {}
    return LatentNetworkSettings.model_validate(written | no_layer).model_dump()


def recipe(written: dict[str, Any]) -> dict[str, Any]:
    factors = written.get("factors") or {}
    some = [latent_network(each) for each in factors] if isinstance(factors, list) else latent_network(factors)
    return {"factors": some, "combiner": combiner(written.get("combiner") or {})}


def today(config: dict[str, Any]) -> Config:
    """A configuration, of 0.1 if it is that of a product: there a variant was whole."""
    if config["collection"]["generator"] not in PRODUCTS:
        return Config.model_validate(config)
    networks = config.get("networks", {})
    values = config | {"networks": networks | recipe(networks)}
    values.pop("modes", None)  # which a product doesn't read
    if "monolithic" in config:
        values["monolithic"] = latent_network(config["monolithic"])
    main = {name: networks.get(name) for name in ("factors", "combiner")}
    values["variants"] = {
        name: {"title": v["title"]} | recipe(main | {key: value for key, value in v.items() if value is not None})
        for name, v in config.get("variants", {}).items()
    }
    return Config.model_validate(values)


@pytest.mark.parametrize("name", MODELS)
def test_a_bundle_states_the_figures_and_the_configuration_of_the_committed_run(name: str) -> None:
    bundle = read_bundle(ROOT / "models" / name / MODELS[name])
    run = ROOT / "runs" / name
    assert bundle.manifest.figures == json.loads((run / "evaluation.json").read_text())
    assert today(bundle.manifest.origin.config) == today(tomllib.loads((run / "config.toml").read_text()))


@pytest.mark.parametrize("name", MODELS)
def test_an_example_is_the_recipe_of_the_committed_run(name: str) -> None:
    example, _ = load(ROOT / "examples" / f"{name}.toml")
    run = today(tomllib.loads((ROOT / "runs" / name / "config.toml").read_text()))
    apart = {"networks": {"factors", "combiner"}, "variants": True}
    assert example.model_dump(exclude=apart) == run.model_dump(exclude=apart)
    assert [(key, variant.title) for key, variant in example.variants.items()] == [
        (key, variant.title) for key, variant in run.variants.items()
    ]
    assert example.recipes == run.recipes
    assert example.networks.factors == run.networks.factors
    assert candidates(example.networks.combiner.correction) == candidates(run.networks.combiner.correction)
    assert example.networks.combiner.symmetries == run.networks.combiner.symmetries


@pytest.mark.parametrize("name", MODELS)
def test_a_bundle_meets_what_it_promises(name: str) -> None:
    folder = ROOT / "models" / name / MODELS[name]
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 15 * 2**20
    figures = read_bundle(folder).manifest.figures
    r2 = {name: value["total"] for name, value in figures["r2"].items()}
    assert r2["composite"] >= 0.99
    assert r2["composite"] > max(r2["monolithic"], r2["affine"], r2["grid"])
    assert figures["vertex_error"]["mean"] <= 0.01


@pytest.mark.parametrize("name", MODELS)
def test_a_run_of_version_0_1_can_be_looked_at(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(ROOT / "runs" / name, tmp_path / "run")
    for command, says in (("status", "export       to do"), ("report", "report.html")):
        monkeypatch.setattr(sys, "argv", ["shapespace-train", command, str(run)])
        assert main() == 0
        assert says in capsys.readouterr().out
