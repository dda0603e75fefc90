"""Fault injection into real processes: after every fault, nothing is lost.

The suite injects a few faults once; ``make long faults`` twenty different instances of each, and prints the table.
"""

import zlib

import numpy as np
import pytest

# These modules add their faults to the catalogue.
from tests.faults import on_bundles, on_clients, on_processes, on_requests, on_training  # noqa: F401
from tests.faults.catalogue import FAULTS, OUTCOMES, SEEDS, FaultTarget

#: One fault of bundles and one of clients.
IN_SUITE = {
    "files of a bundle are cut short, bits are flipped, or the manifest lies",
    "clients vanish while they send, wait or read",
}


@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in IN_SUITE else pytest.mark.long) for name in FAULTS]
)
def test_nothing_is_lost(name: str, seed: int, target: FaultTarget) -> None:
    outcome = FAULTS[name](target, np.random.default_rng([seed, zlib.crc32(name.encode())]))
    OUTCOMES[name][outcome] += 1
