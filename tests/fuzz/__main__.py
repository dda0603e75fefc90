"""Measure requests' cost: ``python -m tests.fuzz [PART OF A KIND'S NAME] [--examples N] [--seed SEED] …``.

Sends requests generated to be expensive, one after the other, and prints the most expensive ones. Budgets are
of processor time, so the machine should have little else to do.
"""

import argparse
import sys
import time
from collections.abc import Iterable
from functools import partial

from tests.fuzz.cost import DEADLINE, LONGEST, Cost, CostTrial, serving, summary
from tests.fuzz.kinds import KINDS, World, made, shares


def measured(trial: CostTrial, world: World, examples: Iterable[tuple[str, int]]) -> list[Cost]:
    costs = []
    for name, seed in examples:
        costs.append(trial.try_out(name, seed, partial(made, name, seed, world)))
        if costs[-1].over:
            print(f"{name} {seed}: {'; '.join(costs[-1].over)}", flush=True)
    return costs


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", nargs="?", default="", help="only kinds whose name has this part")
    parser.add_argument("--examples", type=int, default=len(KINDS), help="of all kinds together")
    parser.add_argument("--seed", type=int, default=int(time.time()), help="of each kind's first example")
    parser.add_argument("--deadline", type=float, default=DEADLINE, help="of the server, in seconds")
    parser.add_argument("--most", type=int, default=20, help="rows of the table")
    parser.add_argument("--limits", action="store_true", help="also ask the slowest model for all that is allowed")
    given = parser.parse_args()
    counts = shares(given.examples, [name for name in KINDS if given.kind in name])
    with serving(given.deadline) as trial:
        world = World.of(trial.server.url)
        costs = measured(trial, world, ((name, given.seed + k) for name in counts for k in range(counts[name])))
    if given.limits:  # these take minutes each
        with serving(LONGEST) as trial:
            largest = World([World.of(trial.server.url).largest])
            costs += measured(trial, largest, ((name, given.seed) for name in counts if KINDS[name].limit))
    print(summary(costs, given.most))
    return 1 if any(cost.over for cost in costs) else 0


if __name__ == "__main__":
    sys.exit(main())
