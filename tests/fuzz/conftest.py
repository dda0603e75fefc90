"""Prints the table of request costs at the end of the tests."""

from __future__ import annotations

import pytest

from tests.fuzz.cost import COSTS, summary


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if COSTS:
        terminalreporter.section("what requests cost")
        terminalreporter.write_line(summary(COSTS))
