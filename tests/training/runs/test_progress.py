"""Progress: nothing for the first seconds, then whole lines, suitable for a log."""

import time

import pytest

from shapespace.training.runs import progress


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "DELAY", 0.1)
    monkeypatch.setattr(progress, "PAUSE", 0)


def slowly(count: int, pause: float) -> list[int]:
    found = []
    for item in progress.progress(range(count), "reading", "file", count):
        time.sleep(pause)
        found.append(item)
    return found


@pytest.mark.usefixtures("impatient")
def test_what_takes_long_says_how_far_it_is(capfd: pytest.CaptureFixture[str]) -> None:
    assert slowly(10, 0.05) == list(range(10))
    lines = capfd.readouterr().err.replace("\r", "").splitlines()
    assert len(lines) > 2
    assert all(line.startswith("reading: ") and "/10" in line for line in lines)


@pytest.mark.usefixtures("impatient")
def test_what_cannot_say_how_far_it_is_says_how_long(capfd: pytest.CaptureFixture[str]) -> None:
    with progress.waiting("elastic mean"):
        time.sleep(2.3)
    assert "elastic mean: 00:0" in capfd.readouterr().err


def test_what_is_quick_says_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    assert slowly(10, 0) == list(range(10))
    with progress.waiting("elastic mean"):
        pass
    assert not capfd.readouterr().err.strip()
