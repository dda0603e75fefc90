"""Runs of version 0.2 continue, and no stage hides from the list of stages."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from shapespace.training import stages
from shapespace.training.runs.config import load
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.stages.run import STAGES, execute
from shapespace.training.stages.stage import Run

#: Stamps that version 0.2 gave to the stages of these runs.
STAMPS = json.loads(Path(__file__).with_name("stamps_of_0_2.json").read_text())
RUNS = Path(__file__).parents[3] / "runs"


@pytest.mark.parametrize("name", STAMPS)
def test_no_stage_of_a_run_of_version_0_2_is_done_again(name: str, tmp_path: Path) -> None:
    directory, said = RunDirectory(tmp_path), list[str]()
    for stage, stamp in STAMPS[name].items():
        directory.stamp(stage).write(stamp)
    run = Run(tmp_path, *load(RUNS / name / "config.toml"), tmp_path / "models")
    assert not execute(run, show=said.append)
    assert said[0].startswith("networks.seeds")
    assert "python -m benchmarks.studies" in said[0]
    assert said[1:] == [f"{stage}: done before (1 s)" for stage in STAGES]
    assert [directory.stamp(stage).read() for stage in STAGES] == list(STAMPS[name].values())


def test_each_stage_has_one_file() -> None:
    files = {path.stem for path in Path(stages.__path__[0]).glob("*.py")} - {"__init__", "run", "stage"}
    assert files == STAGES.keys()
    assert list(STAMPS["figure"]) == list(STAGES)
