"""Fault injection into real processes: after every fault, nothing is lost.

The suite injects each fault once; ``make faults`` twenty different instances of each, and prints the table.
"""

import zlib

import numpy as np
import pytest

# These modules add their faults to the catalogue.
from tests.faults import on_bundles, on_clients, on_processes, on_requests, on_training  # noqa: F401
from tests.faults.catalogue import FAULTS, OUTCOMES, SEEDS, Arena


@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize("name", FAULTS)
def test_nothing_is_lost(name: str, seed: int, arena: Arena) -> None:
    outcome = FAULTS[name](arena, np.random.default_rng([seed, zlib.crc32(name.encode())]))
    OUTCOMES[name][outcome] += 1
