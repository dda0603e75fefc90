"""Progress: nothing for the first seconds, then whole lines, suitable for a log."""

import time

import pytest

from shapespace.training.runs import progress
from shapespace.training.stages import STAGE_NAMES


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
    said, end = "", time.monotonic() + 120
    with progress.waiting("elastic mean"):
        while "elastic mean: 0" not in said:
            assert time.monotonic() < end
            time.sleep(0.05)
            said += capfd.readouterr().err


def test_a_stage_has_a_place_and_an_estimate_from_the_stages_before() -> None:
    names = list(progress.SHARES)
    assert progress.stage_place("ingest", {}, names) == "stage 1 of 9"
    assert progress.stage_place("mean", {"ingest": 30}, names) == "stage 2 of 9"
    done = {name: 60.0 * progress.SHARES[name] for name in names[:4]}
    left = 100 - sum(progress.SHARES[name] for name in names[:4])
    assert progress.stage_place("samples", done, names) == f"stage 5 of 9, about {left} min left"
    assert progress.stage_place("export", done, names) == "stage 9 of 9, about 1 min left"
    twice = {name: 4 * seconds for name, seconds in done.items()}
    assert progress.stage_place("samples", twice, names) == f"stage 5 of 9, about {4 * left / 60:.0f} h left"
    brief = {name: seconds / 100 for name, seconds in done.items()}
    assert progress.stage_place("samples", brief, names) == "stage 5 of 9, less than a minute left"
    measured = {"ingest": 4.0, "mean": 113.0}  # of straight lines; 105 s were left
    assert progress.stage_place("modes", measured, names, straight=True) == "stage 3 of 9, about 2 min left"
    # A product by design skips three stages, and a later stage that was done before says nothing about this one.
    few = [name for name in names if name not in ("mean", "modes", "generalisation")]
    assert (
        progress.stage_place("networks", done | {"samples": 2520, "export": 1e6}, few)
        == "stage 4 of 6, about 21 min left"
    )


def test_every_stage_has_a_share_of_the_time() -> None:
    for shares in (progress.SHARES, progress.STRAIGHT_SHARES):
        assert list(shares) == list(STAGE_NAMES)
        assert sum(shares.values()) == 100


def test_what_is_quick_says_nothing(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "DELAY", 600)  # whatever else this machine does
    assert slowly(10, 0) == list(range(10))
    with progress.waiting("elastic mean"):
        pass
    assert not capfd.readouterr().err.strip()
