"""All faults by name, and their outcomes: the table of docs/measurements/reliability.md."""

import os
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.faults.serving import Steady
from tests.faults.training import Undisturbed
from tests.service.conftest import Start


@dataclass(frozen=True)
class FaultTarget:
    """What a fault is injected into.

    Attributes:
        folder: an empty one.
        steady: a server that has to answer afterwards as it did before.
        start: starts further servers.
        undisturbed: returns a training run without faults.
    """

    folder: Path
    steady: Steady
    start: Start
    undisturbed: Callable[[], Undisturbed]


#: Injects a random instance of a fault, checks that nothing is lost, and returns the outcome in a few words.
Inflict = Callable[[FaultTarget, np.random.Generator], str]
FAULTS: dict[str, Inflict] = {}
OUTCOMES: defaultdict[str, Counter[str]] = defaultdict(Counter)
#: How often each fault is injected, each time a different instance.
SEEDS = int(os.environ.get("FAULT_SEEDS", "1"))


def fault(name: str) -> Callable[[Inflict], Inflict]:
    """A decorator that adds a fault to the catalogue."""

    def enter(inflict: Inflict) -> Inflict:
        FAULTS[name] = inflict
        return inflict

    return enter


def table() -> str:
    """The outcomes so far, as a Markdown table."""
    rows = ["| fault | tries | what happened |", "|---|---|---|"]
    for name, outcomes in OUTCOMES.items():
        told = "; ".join(f"{says} ({count} ×)" if len(outcomes) > 1 else says for says, count in outcomes.most_common())
        rows.append(f"| {name} | {outcomes.total()} | {told} |")
    return "\n".join(rows)
