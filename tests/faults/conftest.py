"""Shared by all faults: a server to inject them into, and a training run without faults to compare with."""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.faults.catalogue import OUTCOMES, FaultTarget, table
from tests.faults.serving import Steady
from tests.faults.training import Undisturbed
from tests.service.conftest import starting


@pytest.fixture(scope="session")
def steady(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Steady]:
    with starting() as start:
        steady = Steady(tmp_path_factory.mktemp("steady"), start)
        yield steady
        steady.close()


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> object:
    return cache(lambda: Undisturbed(tmp_path_factory.mktemp("undisturbed")))


@pytest.fixture
def target(tmp_path: Path, steady: Steady, undisturbed: object) -> Iterator[FaultTarget]:
    with starting() as start:
        yield FaultTarget(tmp_path, steady, start, undisturbed)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if OUTCOMES:
        terminalreporter.section("what faults came to")
        terminalreporter.write_line(table())
