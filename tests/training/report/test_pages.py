"""Pages that are written from the committed figures in runs/: they say what these say."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import bundled, fit, generalisation, pages, results, served, stages, verdict

WRITERS: dict[str, Callable[[], None]] = {
    "bundled": lambda: pages.write("bundled", bundled.page()),
    "fit": fit.write_page,
    "generalisation": generalisation.write_page,
    "growth": stages.write_page,
    "results": results.write_page,
    "served": served.write_page,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_committed_page_of_measurements_is_what_its_module_writes(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    committed = (pages.MEASUREMENTS / f"{name}.md").read_text(encoding="utf-8")
    monkeypatch.setattr(pages, "MEASUREMENTS", tmp_path)
    WRITERS[name]()
    assert (tmp_path / f"{name}.md").read_text(encoding="utf-8") == committed


def test_the_verdict_and_its_chart_are_what_the_runs_say() -> None:
    found = verdict.collections()
    assert verdict.page(found) == verdict.PAGE.read_text(encoding="utf-8")
    chart = verdict.CHART.read_text(encoding="utf-8")
    assert len(chart) < 60_000
    for each in found:
        bars = [each.ratio, *([each.ratios[each.best]] if each.best else [])]
        assert all(f">{bar:.2f}</text>" in chart for bar in bars), each.name


def test_a_simple_model_that_is_measured_later_is_in_the_verdict(tmp_path: Path) -> None:
    shutil.copytree(verdict.RUNS, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "collections" / "hand.json"
    folds = json.loads(file.read_text(encoding="utf-8"))
    for fold in folds:
        for rival, share in (("linear skinning", 0.25), ("a worse one", 1.5)):
            fold["unseen"][rival] = {key: share * value for key, value in fold["unseen"]["components"].items()}
    file.write_text(json.dumps(folds), encoding="utf-8")
    found = verdict.collections(tmp_path)
    assert "for hands (0.25): linear skinning." in verdict.page(found, tmp_path)
    chart = tmp_path / "chart.svg"
    verdict.draw(found, chart)
    assert ">0.25</text>" in chart.read_text(encoding="utf-8")
