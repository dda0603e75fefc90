"""What a report advises."""

from types import SimpleNamespace
from typing import Any

import pytest

from shapespace.training.report.verdict import advice


@pytest.mark.parametrize(("error", "advised"), [(3e-3, True), (3e-5, False)])
def test_a_model_with_a_negligible_error_gets_no_advice(error: float, advised: bool) -> None:
    facts = {"counts": [5], "modes": [{"mean": error}], "components": [{"mean": 10 * error}]}
    record: Any = SimpleNamespace(
        generalisation=facts,
        geometry={},
        evaluation={},
        config={},
        modes={},
        encoded={"shapes": 20, "modes": {"mean": error / 1000}},
    )
    assert any("More shapes" in sentence for sentence in advice(record)) is advised
