"""Every fault by its name, and what came of it: the table of docs/measurements/reliability.md."""

from __future__ import annotations

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
class Arena:
    """Where a fault is inflicted.

    Attributes:
        folder: an empty one.
        steady: a server that has to answer afterwards as it did before.
        start: starts further servers.
        undisturbed: gives a training run that nothing has happened to.
    """

    folder: Path
    steady: Steady
    start: Start
    undisturbed: Callable[[], Undisturbed]


#: Inflicts a fault at random, checks that nothing is lost, and says in a few words what happened.
Inflict = Callable[[Arena, np.random.Generator], str]
FAULTS: dict[str, Inflict] = {}
OUTCOMES: defaultdict[str, Counter[str]] = defaultdict(Counter)
#: How often each fault is inflicted, differently each time.
SEEDS = int(os.environ.get("FAULT_SEEDS", "1"))


def fault(name: str) -> Callable[[Inflict], Inflict]:
    """Enter a fault into the catalogue."""

    def enter(inflict: Inflict) -> Inflict:
        FAULTS[name] = inflict
        return inflict

    return enter


def table() -> str:
    """What happened so far, as Markdown."""
    rows = ["| fault | tries | what happened |", "|---|---|---|"]
    for name, outcomes in OUTCOMES.items():
        told = "; ".join(f"{says} ({count} ×)" if len(outcomes) > 1 else says for says, count in outcomes.most_common())
        rows.append(f"| {name} | {outcomes.total()} | {told} |")
    return "\n".join(rows)
