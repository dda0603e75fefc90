"""The card of a bundle: exported with it, counted in its manifest, optional when it is read."""

import json
import shutil
from pathlib import Path

import pytest
import yaml

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import CARD, MANIFEST
from shapespace.bundle.writer import amend_bundle
from shapespace.model.shape_model import load
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT


def head_and_text(folder: Path) -> tuple[dict, str]:
    nothing, head, text = (folder / CARD).read_text(encoding="utf-8").split("---\n", 2)
    assert nothing == ""
    return yaml.safe_load(head), text


def test_every_exported_bundle_has_a_card_in_its_manifest(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path, "small", fine=True)
    assert CARD in json.loads((folder / MANIFEST).read_text())["files"]
    head, text = head_and_text(folder)
    assert head["library_name"] == "shapespace"
    assert head["license"] == "cc0-1.0"
    assert "512 vertices and the same 1024 faces" in text
    for name in ("size", "turn (an angle)", "twist"):
        assert f"| {name} |" in text
    (folder / CARD).write_text("another card")
    with pytest.raises(BundleError, match=r"README\.md has 12 bytes"):
        read_bundle(folder)


def test_a_bundle_without_a_card_loads_and_can_be_given_one(tmp_path: Path) -> None:
    folder = tmp_path / "figure" / "4"
    shutil.copytree(ROOT / "models" / "figure" / "4", folder)
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["files"].pop(CARD, None)
    (folder / CARD).unlink(missing_ok=True)
    facts = {
        "licence": "All rights: *reserved*",
        "title": "Left|right\n---\nx: y",
        "figures": {"r2": {"composite": {"total": "high"}}, "generalisation": []},
    }
    (folder / MANIFEST).write_text(json.dumps(manifest | facts))
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    code = [0.1] * 20
    shape = load(folder).decode(code, mesh="coarse")
    amend_bundle(folder)
    after = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert {name for name in after if after[name] != before.get(name)} == {CARD, MANIFEST}
    assert (load(folder).decode(code, mesh="coarse") == shape).all()
    head, text = head_and_text(folder)
    assert (head["license"], head["license_name"]) == ("other", "all-rights-reserved")
    assert "metrics" not in head
    assert "# Left\\|right --- x: y\n" in text
    amend_bundle(folder)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == after


def test_the_card_of_the_figure_has_its_figures(tmp_path: Path) -> None:
    folder = tmp_path / "figure" / "4"
    shutil.copytree(ROOT / "models" / "figure" / "4", folder)
    amend_bundle(folder)
    head, text = head_and_text(folder)
    assert head["metrics"] == ["r_squared", "vertex_error"]
    manifest = json.loads((folder / MANIFEST).read_text())
    (result,) = head["model-index"][0]["results"]
    assert result["metrics"][0]["value"] == manifest["figures"]["r2"]["composite"]["total"]
    assert "left out, the mean vertex error is 0.12 % of the diagonal. Principal components have 0.93 %" in text
