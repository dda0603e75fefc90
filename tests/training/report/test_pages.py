"""Pages that are written from the committed figures in runs/: they say what these say."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks import bundled, few_shapes, fit, generalisation, pages, results, served, stages, verdict
from shapespace.training.report.number_format import duration, percent, r2, short_of, size
from shapespace.training.runs.provenance import made_by

WRITERS: dict[str, Callable[[], None]] = {
    "bundled": lambda: pages.write("bundled", bundled.page()),
    "few-shapes": few_shapes.write_page,
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


@pytest.mark.parametrize(
    "file", sorted(pages.ROOT.glob("runs/**/*.json")), ids=lambda file: f"{file.parent.name}-{file.stem}"
)
def test_a_file_of_figures_says_what_made_it(file: Path) -> None:
    """Kinds of machines were not recorded before version 0.3."""
    made = json.loads(file.read_text(encoding="utf-8"))["made_by"]
    assert made.keys() == made_by().keys()
    assert made["version"]
    assert made["commit"]


def test_figures_are_written_with_what_made_them(tmp_path: Path) -> None:
    for found in ([{"mean": 1.5}], {"mean": 1.5}):
        pages.write_figures(tmp_path / "new" / "figures.json", found)
        read = pages.read_figures(tmp_path / "new" / "figures.json")
        assert read == (found if isinstance(found, list) else {"made_by": made_by()} | found)
        assert json.loads((tmp_path / "new" / "figures.json").read_text(encoding="utf-8"))["made_by"] == made_by()
    assert made_by()["machine"]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.99994, "0.9999"), (0.99996, "0.99996"), (0.9999996, "0.9999996"), (1, "1.0000"), (-2, "-2.0000")],
)
def test_no_r2_rounds_up_to_one(value: float, text: str) -> None:
    assert r2(value) == text
    assert short_of(100 * value, 1, 100) != "100.0" or value == 1


def test_numbers_have_no_exponents_and_few_zeros() -> None:
    shown = [*map(percent, (0, 3e-8, 0.000012, 0.00123, 1.0, 12.34)), size(2.34e9), duration(4e6)]
    assert [each.replace("\N{NO-BREAK SPACE}", " ") for each in shown] == [
        "0 %", "< 0.001 %", "0.0012 %", "0.12 %", "100 %", "1200 %", "2340 MB", "1110 h",
    ]  # fmt: skip


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
    folds = pages.read_figures(file)
    for fold in folds:
        for rival, share in (("linear skinning", 0.25), ("a worse one", 1.5)):
            fold["unseen"][rival] = {key: share * value for key, value in fold["unseen"]["components"].items()}
    pages.write_figures(file, folds)
    found = verdict.collections(tmp_path)
    hands = next(row for row in verdict.page(found, tmp_path).splitlines() if row.startswith("| hands, 57 | 12 |"))
    assert hands.endswith("| 0.25, linear skinning |")
    chart = tmp_path / "chart.svg"
    verdict.draw(found, chart)
    assert ">0.25</text>" in chart.read_text(encoding="utf-8")


def test_the_best_simple_model_is_the_rival_of_a_row() -> None:
    def fold(own: float, lines: float, shapes: int) -> dict[str, object]:
        others = {"components": {"mean": 0.05}, "linear_nric": {"mean": lines}}
        return others | {"mean": own, "shapes": shapes}

    folds = [fold(0.01, 0.02, 1), fold(0.03, 0.04, 3)]
    rival, share = served.best_simple(folds) or ("", 0.0)
    assert rival == "linear_nric"
    assert share == pytest.approx(0.025 / 0.035)
    assert served.best_simple([{"mean": 0.01, "shapes": 1, "components": {"mean": 0.05}}]) is None, "an older row"
    said = generalisation.against_the_best([share, 1.0, 0.904])
    assert said.startswith("Our error is 0.71 to 1.00 of the error of the best simple model. In 2 of 3 rows")


def test_draws_of_as_many_shapes_are_one_row_of_their_means() -> None:
    def drawn(count: int, own: float, components: float) -> dict[str, object]:
        row: dict[str, object] = {"name": "hand", "shapes": count, "modes_count": 3, "map": "nric"}
        return row | {"modes": {"mean": own}, "components": {"mean": components}}

    found = few_shapes.means([drawn(10, 0.01, 0.02), drawn(5, 0.03, 0.04), drawn(5, 0.05, 0.06)])
    assert [(key, row["modes"]) for key, row in found.items()] == [
        (("hand", 5), pytest.approx(0.04)),
        (("hand", 10), 0.01),
    ]
    assert few_shapes.simplest(found["hand", 5]) == ("components", pytest.approx(0.05))
    said = few_shapes.finding(found)
    assert "75 % (hand)" in said, "from 0.04 to 0.01 with one doubling"
    assert "0.50 (hand)" in said
