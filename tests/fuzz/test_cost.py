"""Requests generated to be expensive: none may exceed its budget.

Budgets are of processor time, so these tests need a machine with little else to do. ``make long costs`` sends
thousands of new requests and prints the most expensive. ``python -m tests.fuzz`` sends single kinds and seeds.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Iterator
from functools import partial

import pytest

from tests.fuzz.cost import COSTS, CostTrial, serving
from tests.fuzz.kinds import KINDS, World, made, shares

pytestmark = pytest.mark.long
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "0"))
COUNTS = shares(EXAMPLES) if EXAMPLES else {name: 1 for name, kind in KINDS.items() if not kind.long}
FIRST = int(time.time()) if EXAMPLES else 0


@pytest.fixture(scope="module")
def trial() -> Iterator[CostTrial]:
    with serving() as trial:
        yield trial


@pytest.fixture(scope="module")
def world(trial: CostTrial) -> World:
    return World.of(trial.server.url)


def try_out(name: str, seeds: Iterable[int], trial: CostTrial, world: World) -> None:
    costs = [trial.try_out(name, seed, partial(made, name, seed, world)) for seed in seeds]
    COSTS.extend(costs)
    assert not [f"{cost.name}, seed {cost.seed}: {'; '.join(cost.over)}" for cost in costs if cost.over]


@pytest.mark.parametrize("name", COUNTS)
def test_no_request_is_over_its_budget(name: str, trial: CostTrial, world: World) -> None:
    try_out(name, range(FIRST, FIRST + COUNTS[name]), trial, world)


if EXAMPLES:  # these take minutes each

    @pytest.fixture(scope="module")
    def patient() -> Iterator[CostTrial]:
        with serving(deadline=600) as trial:
            yield trial

    @pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if kind.limit])
    def test_what_may_be_asked_for_is_within_the_budget(name: str, patient: CostTrial, world: World) -> None:
        try_out(name, [FIRST], patient, World([world.largest]))
