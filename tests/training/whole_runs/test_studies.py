"""Studies of `benchmarks.results`: measured once, and again only after their run has changed; and rows of pages."""

import json
import shutil
from copy import deepcopy
from pathlib import Path

import pytest

from benchmarks import bundled, paper, results, served
from benchmarks.results import have, measured
from shapespace.training.learning.learner import Learner
from shapespace.training.pipeline import Run
from shapespace.training.runs.config import load
from shapespace.training.runs.directory import RunDirectory


def test_a_study_is_measured_again_when_what_it_measured_has_changed(tmp_path: Path) -> None:
    run, found = RunDirectory(tmp_path), iter([1, 2])
    run.study("space").write({"figure": 0})  # the format before studies had keys
    assert measured(run, "space") == {}
    for key, figure in (("old", 1), ("old", 1), ("new", 2)):
        run.stamp("samples").write({"key": key, "seconds": 1.0})
        have(run, "space", lambda: {"figure": next(found)})
        assert measured(run, "space") == {"key": key, "figure": figure}
    run.stamp("samples").write({"basis": "another"})
    assert measured(run, "space") == {}


def test_the_page_of_results_says_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    committed = results.FIGURES / "horse.json"
    row = json.loads(committed.read_text())
    row["evaluation"]["fresh"]["r2"]["composite"]["total"] = 0.87654
    (tmp_path / "horse.json").write_text(json.dumps(row))
    monkeypatch.setattr(results, "FIGURES", tmp_path)
    monkeypatch.setattr(results, "DOCS", tmp_path)
    results.write_page()
    page = (tmp_path / "results.md").read_text()
    assert "| horse | 35 | 20 | 5 |" in page
    kernel = row["evaluation"]["fresh"]["r2"]["kernel"]["total"]
    assert f"| 0.8765 | 0.9981 | **{kernel:.4f}** |" in page, "the best is bold"
    assert "yet: hand, faces, samba, makehuman, hippocampus." in page
    assert results.spread(row, "composite")[1] <= results.spread(row, "composite")[0]
    assert "| bodies" not in page, "aims of what was not measured"


def test_a_row_of_folds_counts_each_shape_once() -> None:
    def fold(own: float, components: float, shapes: int) -> dict[str, object]:
        found = {"mean": own, "p95": 0.1}
        return found | {"components": {"mean": components, "p95": 0.1}, served.ALONE: found, "shapes": shapes}

    cells = served.compared([fold(0.01, 0.02, 1), fold(0.04, 0.02, 3)])
    assert cells[:6] == ["3.250", "10.000", "2.000", "10.000", "1.62", "0.50 – 2.00"]
    assert cells[6:] == ["3.250", "1.62", "0.50 – 2.00"]


def test_a_model_measured_later_meets_the_codes_of_the_others(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The main networks, in the place of the paper's that take hours, reach again what they have reached."""
    folder = shutil.copytree(tiny_run, tmp_path / "run")
    run = Run(folder, *load(folder / "config.toml"), tmp_path / "models")
    before = json.loads((folder / "evaluation.json").read_text())
    monkeypatch.setattr(Learner, "paper", Learner.main)
    after = deepcopy(before)
    paper.measure(run, after)
    for old, new in ((before, after), (before["fresh"], after["fresh"])):
        assert new["r2"]["paper"] == pytest.approx(old["r2"]["composite"], abs=1e-6)
    bundled.add_paper(before, after)
    assert before["fresh"]["r2"]["paper"] == after["fresh"]["r2"]["paper"]

    before["fresh"]["seed"] += 1
    with pytest.raises(paper.OtherSamplesError, match="the kernel has"):
        paper.measure(run, before)
