"""What a report says of a model, and what it advises."""

import re
from types import SimpleNamespace
from typing import Any

import pytest

from shapespace.training.report.verdict import advice, verdict


def record(*errors: float, components: float = 0.03, **others: Any) -> Any:
    """A run with errors on unseen shapes by number of coordinates, 3 and then 6."""
    facts = {
        "counts": [3.0, 6.0][-len(errors) :],
        "modes": [{"mean": error} for error in errors],
        "components": [{"mean": components} for _ in errors],
    } | others.pop("facts", {})
    plain = {"map": "exponential", "geometry": {}, "evaluation": {}, "config": {}, "modes": {}, "encoded": {}}
    return SimpleNamespace(generalisation=facts, **plain | others)


@pytest.mark.parametrize(("error", "advised"), [(3e-3, True), (3e-5, False)])
def test_a_model_with_a_negligible_error_gets_no_advice(error: float, advised: bool) -> None:
    run = record(error, encoded={"shapes": 20, "modes": {"mean": error / 1000}})
    assert any("More shapes" in sentence for sentence in advice(run)) is advised


@pytest.mark.parametrize(
    ("count", "advised"), [(8, "with 6 coordinates instead of 3, .* Try modes.count = 12"), ("auto", ""), (20, "")]
)
def test_more_modes_are_advised_of_the_model_itself_where_there_is_room(count: int | str, advised: str) -> None:
    run = record(0.02, 0.01, config={"modes": {"count": count}}, encoded={"shapes": 20})
    found = " ".join(sentence for sentence in advice(run) if "modes.count" in sentence)
    assert not found if not advised else re.search(advised, found)


def test_the_verdict_says_if_unseen_shapes_had_another_map() -> None:
    facts = {"maps": ["nric"]}
    assert "error of straight lines of lengths and angles: without these" in verdict(record(0.01, facts=facts))
    assert "without these" not in verdict(record(0.01, facts=facts, map="nric"))


@pytest.mark.parametrize(("error", "named"), [(0.0299, "(PCA)"), (0.02, "(PCA with memory of the training shapes)")])
def test_of_equal_simple_models_the_simplest_is_named(error: float, named: str) -> None:
    assert named in verdict(record(0.01, facts={"remembering_components": [{"mean": error}]}))
