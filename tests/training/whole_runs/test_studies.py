"""Studies of `benchmarks.results`: measured once, and again only after their run has changed."""

from pathlib import Path

from benchmarks.results import have, measured
from shapespace.training.runs.directory import RunDirectory


def test_a_study_is_measured_again_when_what_it_measured_has_changed(tmp_path: Path) -> None:
    run, found = RunDirectory(tmp_path), iter([1, 2])
    run.study("space").write({"figure": 0})  # the format before studies had keys
    assert measured(run, "space") == {}
    for key, figure in (("old", 1), ("old", 1), ("new", 2)):
        run.stamp("samples").write({"key": key, "seconds": 1.0})
        have(run, "space", lambda: {"figure": next(found)})
        assert measured(run, "space") == {"key": key, "figure": figure}
    run.stamp("samples").write({"basis": "another"})
    assert measured(run, "space") == {}
