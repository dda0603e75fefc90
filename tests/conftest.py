"""Fixtures shared by tests of several packages."""

import numpy as np
import pytest
from httpx._config import DEFAULT_TIMEOUT_CONFIG

# A busy machine may take longer for an answer than the five seconds that httpx waits.
for phase in ("connect", "read", "write", "pool"):
    setattr(DEFAULT_TIMEOUT_CONFIG, phase, 120.0)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    # Whole runs take minutes in a few tests: begun last, they would keep one process busy after all others are done.
    items.sort(key=lambda item: "whole_runs" not in item.path.parts)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(7)
