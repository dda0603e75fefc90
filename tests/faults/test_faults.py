"""Faults of every kind, inflicted on real processes: whatever happens, nothing is lost.

One of each in the whole suite; ``make faults`` inflicts twenty, all different, and prints the table.
"""

import zlib

import numpy as np
import pytest

# Modules that enter their faults.
from tests.faults import on_bundles, on_clients, on_processes, on_requests, on_training  # noqa: F401
from tests.faults.catalogue import FAULTS, OUTCOMES, SEEDS, Arena


@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize("name", FAULTS)
def test_nothing_is_lost(name: str, seed: int, arena: Arena) -> None:
    outcome = FAULTS[name](arena, np.random.default_rng([seed, zlib.crc32(name.encode())]))
    OUTCOMES[name][outcome] += 1
