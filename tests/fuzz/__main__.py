"""Measure requests' cost: ``python -m tests.fuzz [PART OF A KIND'S NAME] [--examples N] [--seed SEED] …``.

Sends requests generated to be expensive, one after the other, and prints the most expensive ones.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial

from tests.fuzz.cost import DEADLINE, serving, summary
from tests.fuzz.kinds import KINDS, World, made


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", nargs="?", default="", help="only kinds whose name has this part")
    parser.add_argument("--examples", type=int, default=len(KINDS), help="of all kinds together")
    parser.add_argument("--seed", type=int, default=0, help="of each kind's first example")
    parser.add_argument("--deadline", type=float, default=DEADLINE, help="of the server, in seconds")
    parser.add_argument("--most", type=int, default=20, help="rows of the table")
    given = parser.parse_args()
    names = [name for name in KINDS if given.kind in name]
    costs = []
    with serving(given.deadline) as trial:
        world = World.of(trial.server.url)
        for k in range(given.examples):
            name, seed = names[k % len(names)], given.seed + k // len(names)
            costs.append(trial.try_out(name, seed, partial(made, name, seed, world)))
            if costs[-1].over:
                print(f"{name} {seed}: {'; '.join(costs[-1].over)}", flush=True)
    print(summary(costs, given.most))
    return 1 if any(cost.over for cost in costs) else 0


if __name__ == "__main__":
    sys.exit(main())
