"""Studies on finished runs, recipes of variants, and rows of the measurement pages."""

import json
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks import bundled, pages, paper, results, served, studies
from benchmarks.results import have, measured
from benchmarks.studies import SeedLearner, ShareLearner, Studies, Variant, recipes
from shapespace.coordinates.nric import WeightedNorm
from shapespace.training.learning.evaluation import Model, r_squared
from shapespace.training.learning.learner import Learner
from shapespace.training.learning.networks import predict
from shapespace.training.runs.config import load, parse
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.network_settings import (
    CombinerSettings,
    DenseSettings,
    FitSettings,
    ProductSettings,
    Recipe,
)
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.stage import Run
from tests.training.conftest import TINY


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
    monkeypatch.setattr(pages, "MEASUREMENTS", tmp_path)
    results.write_page()
    page = (tmp_path / "results.md").read_text()
    sizes, shapes = row["sizes"], row["ingest"]["shapes"]
    assert f"| horse | {shapes}, {sum(sizes)}, {len(sizes)} ({min(sizes)} – {max(sizes)}) |" in page
    one, kernel = (row["evaluation"]["fresh"]["r2"][model]["total"] for model in ("monolithic", "kernel"))
    assert f"| horse | 0.8765 | {one:.4f} | **{kernel:.4f}** |" in page, "the best is bold"
    assert "On 0 of the 1 collections, our model (composite) follows the exact shapes best. Not on horse." in page
    assert "yet: hand, faces, samba, makehuman, hippocampus." in page
    assert results.spread(row, "composite")[1] <= results.spread(row, "composite")[0]
    assert "## Number of samples" not in page, "nothing of what was not measured"


def test_a_row_of_folds_counts_each_shape_once() -> None:
    def fold(own: float, components: float, shapes: int) -> dict[str, object]:
        found = {"mean": own, "p95": 0.1}
        return found | {
            "components": {"mean": components, "p95": 0.1},
            served.WITHOUT_EXAMPLES: found,
            "shapes": shapes,
        }

    folds = [fold(0.01, 0.02, 1), fold(0.04, 0.02, 3)]
    for model in (None, served.WITHOUT_EXAMPLES):
        assert served.average(folds, model) == "3.250\N{NO-BREAK SPACE}/\N{NO-BREAK SPACE}10.000"
        assert served.ratio(folds, model) == "1.62 (0.50–2.00)"
    assert served.average(folds, "components") == "2.000\N{NO-BREAK SPACE}/\N{NO-BREAK SPACE}10.000"


def test_a_model_measured_later_meets_the_codes_of_the_others(copy: Run) -> None:
    """The main networks, in the place of the paper's that take hours, reach again what they have reached."""
    before = copy.directory.evaluation.read()
    same = {"paper": "composite", "monolithic_chosen": "monolithic_paper"}
    assert same.keys() == paper.SYSTEMS.keys()
    settings = {"composite": copy.config.networks, "monolithic_paper": copy.config.monolithic_paper}
    after = deepcopy(before)
    paper.measure(copy, after, {system: settings[model] for system, model in same.items()})
    for old, new in ((before, after), (before["fresh"], after["fresh"])):
        for system, model in same.items():
            assert new["r2"][system] == pytest.approx(old["r2"][model], abs=1e-6)
    bundled.add_paper(before, after)
    for system in same:
        assert before["fresh"]["r2"][system] == after["fresh"]["r2"][system]

    before["fresh"]["seed"] += 1
    with pytest.raises(paper.OtherSamplesError, match="the kernel has"):
        paper.measure(copy, before, {})


def r2(learner: Learner, model: Model, part: str) -> float:
    rows, joint = learner.split[part], learner.joint
    norm = WeightedNorm.of(learner.collection.reference, learner.config.evaluation.eta)
    z = predict(model, torch.as_tensor(joint.latents[rows], dtype=torch.float32)).numpy()
    return r_squared(z, joint.nric[rows], norm)["total"]


def test_studies_add_their_figures_and_networks_to_a_finished_run(copy: Run) -> None:
    directory, variant = copy.directory, Variant(title="other", combiner={"correction": {"coefficients": 3}})
    before = directory.evaluation.read()
    main = {path.stem: path.read_bytes() for path in directory.networks()}
    studies.add(copy, Studies(variants={"a": variant}, fractions=[0.5], seeds=[1]))
    figures = directory.evaluation.read()
    assert {name: figures[name] for name in before} == before
    networks = {path.stem: path.read_bytes() for path in directory.networks()}
    assert {name: networks[name] for name in main} == main
    assert directory.histories.read().keys() == networks.keys()
    assert "other" in directory.report.read()

    learner = learner_of(copy)
    half, free = ShareLearner(learner, 0.5), ShareLearner(learner, 0.5, all_of_factors=True)
    recipe = recipes(copy.config.networks, {"a": variant})["a"]
    assert figures["validation"]["samples"] == len(learner.split["validation"])
    (share,), (seed,) = figures["fractions"], figures["seeds"]
    assert share["training_samples"] == len(half.rows["train"]) == 22
    assert share["exponentials"] == {"composite": half.exponentials(), "all of factors": free.exponentials()}
    other = SeedLearner(learner, 1)
    for said, found in (
        (figures["validation"]["r2"]["composite"], r2(learner, learner.main(), "validation")),
        (figures["variants"]["a"]["r2"], r2(learner, learner.composite(recipe), "validation")),
        (share["r2"]["composite"], r2(half, half.main(), "test")),
        (share["r2"]["all of factors"], r2(free, free.main(), "test")),
        (seed["r2"]["composite"], r2(other, other.main(), "test")),
    ):
        assert said["total"] == pytest.approx(found, abs=1e-6)
    assert other.split["test"].tolist() != learner.split["test"].tolist()
    assert {path.stem: path.read_bytes() for path in directory.networks()} == networks, "learned again"


def test_all_networks_are_tuned_together_once(copy: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    learner, settings = learner_of(copy), copy.config.networks
    tuned = settings.model_copy(update={"fine_tuning": FitSettings(max_epochs=2, batch_size=8)})
    first, plain = learner.composite(tuned), learner.main()
    assert sum(name.startswith("joint-") for name in learner.histories) == 1
    codes = torch.as_tensor(learner.joint.latents[:3], dtype=torch.float32)
    assert r2(learner, first, "validation") >= r2(learner, plain, "validation"), "the best epoch counts"
    monkeypatch.setattr(Learner, "joint", None)  # samples are not needed any more
    again = learner_of(copy).composite(tuned)
    with torch.no_grad():
        assert torch.equal(first(codes), again(codes))


def test_networks_learn_in_the_norm_of_their_settings(copy: Run) -> None:
    learner, settings = learner_of(copy), copy.config.networks
    once, eta = FitSettings(max_epochs=1), 0.01
    recipe = Recipe(
        factors=settings.factors.model_copy(update={"eta": eta, "fit": once}),
        combiner=CombinerSettings(correction=DenseSettings(hidden=[4], fit=once), eta=eta),
    )
    root = np.sqrt(WeightedNorm.of(learner.collection.reference, eta).squared)
    for part in learner.composite(recipe).parts:
        factor = part.scaling.factor.numpy()
        np.testing.assert_allclose(factor / factor[0], root / root[0], rtol=1e-5)


def test_every_run_of_the_pages_has_valid_studies() -> None:
    for name in (*results.COLLECTIONS, *results.CONTRASTS, results.MANNEQUIN, "freaky-torus"):
        listed = Studies.listed(name)
        path = next((results.ROOT / "examples").rglob(f"{name}.toml"), None)
        if path is None:
            assert listed == Studies(), "a run with the modes of another example"
        else:
            assert recipes(load(path)[0].networks, listed.variants).keys() == listed.variants.keys()
    assert Studies.listed("hand").fractions == [0.2, 0.05]


def changed(base: Recipe, **variants: dict[str, Any]) -> dict[str, Recipe]:
    """Recipes of variants, which need no title here."""
    return recipes(base, {name: Variant(title="", **values) for name, values in variants.items()})


TINY_RECIPE = parse(TINY, "tiny").networks


def test_a_variant_is_what_differs_from_the_main_recipe() -> None:
    correction = {"width": 3, "fit": {"max_epochs": 2}}
    (found,) = changed(TINY_RECIPE, a={"combiner": {"correction": correction}}).values()
    own = TINY_RECIPE.combiner.correction
    fit = own.fit.model_copy(update={"max_epochs": 2})
    assert found.factors == TINY_RECIPE.factors
    assert found.combiner.correction == own.model_copy(update={"width": 3, "fit": fit})


def test_a_variant_is_what_differs_from_its_base() -> None:
    first, second = changed(
        TINY_RECIPE,
        a={"combiner": {"symmetries": False, "correction": {"width": 3}}},
        b={"base": "a", "combiner": {"correction": {"layers": 1}}},
    ).values()
    assert second.combiner.correction == first.combiner.correction.model_copy(update={"layers": 1})
    assert not second.combiner.symmetries


def test_a_correction_of_another_kind_starts_from_its_defaults() -> None:
    (found,) = changed(TINY_RECIPE, a={"combiner": {"correction": {"kind": "products", "coefficients": 7}}}).values()
    assert found.combiner.correction == ProductSettings(coefficients=7)


def test_factors_of_a_variant_differ_all_alike_or_each_for_itself() -> None:
    tables = [{}, {"hidden": [5]}, {"skip_orders": []}]
    alike, each = changed(TINY_RECIPE, a={"factors": {"energy": 1.0}}, b={"factors": tables}).values()
    main = TINY_RECIPE.factors
    assert alike.factors == [factor.model_copy(update={"energy": 1.0}) for factor in main]
    assert each.factors[0] == main[0]
    assert (each.factors[1].hidden, each.factors[1].energy) == ([5], main[1].energy)
    assert (each.factors[2].skip_orders, each.factors[2].fourier) == ([], main[2].fourier)
    (one,) = changed(Recipe(), a={}).values()
    assert one == Recipe()


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"base": "b"}, r"variants\.a\.base: no variant 'b' stands before it"),
        ({"factors": [{}, {}]}, r"variants\.a: factors: 2 tables over 3"),
        ({"combiner": {"correction": {"widht": 3}}}, r"variants\.a: (.|\n)*widht"),
    ],
)
def test_a_faulty_variant_is_named(values: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        changed(TINY_RECIPE, a=values)
