"""Runs of version 0.2 continue; a setting belongs to its stage; the list of stages is complete."""

import json
from pathlib import Path

import numpy as np
import pytest

from shapespace.training import stages
from shapespace.training.runs.config import load, parse
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.stages.run import STAGES, execute, stage_keys
from shapespace.training.stages.stage import Run, against_failures
from tests.training.conftest import TINY

HERE, RUNS = Path(__file__).parent, Path(__file__).parents[3] / "runs"
#: Stamps that version 0.2 gave to the stages of these runs.
STAMPS = json.loads((HERE / "stamps_of_0_2.json").read_text())


@pytest.mark.parametrize("name", STAMPS)
def test_no_stage_of_a_run_of_version_0_2_is_done_again(name: str, tmp_path: Path) -> None:
    directory, said = RunDirectory(tmp_path), list[str]()
    for stage, stamp in STAMPS[name].items():
        directory.stamp(stage).write(stamp)
    stored = next(path for path in (HERE / f"{name}_of_0_2.toml", RUNS / name / "config.toml") if path.is_file())
    run = Run(tmp_path, *load(stored, stored=stored), tmp_path / "models")
    assert not execute(run, "evaluation", show=said.append)  # there is no bundle
    assert said[0].startswith("networks.seeds")
    assert "python -m benchmarks.studies" in said[0]
    assert said[1] == "evaluation.grid_nodes needs evaluation.baselines, so it has no effect"
    assert said[2:] == [f"{stage}: done before (1 s)" for stage in list(STAGES)[:-1]]
    assert [directory.stamp(stage).read() for stage in STAGES] == list(STAMPS[name].values())


@pytest.mark.parametrize(
    ("section", "setting", "again"),
    [
        ("export", "eta_reconstruction = 0.001", "evaluation"),  # reconstructs vertices as the bundle will
        ("export", "tolerance = 0.001", "export"),
        ("samples", "seed = 5", "samples"),
    ],
)
def test_a_setting_is_read_by_its_stage_and_none_before(section: str, setting: str, again: str) -> None:
    header = f"[{section}]"
    assert TINY.count(header) == 1
    one, other = (
        stage_keys(parse(text, "here"), "data") for text in (TINY, TINY.replace(header, f"{header}\n{setting}"))
    )
    names = list(STAGES)
    assert [name for name in names if one[name] != other[name]] == names[names.index(again) :]


def test_each_stage_has_one_file() -> None:
    files = {path.stem for path in Path(stages.__path__[0]).glob("*.py")} - {"__init__", "results", "run", "stage"}
    assert files == STAGES.keys()
    assert list(STAMPS["figure"]) == list(STAGES)


def test_the_time_of_a_stage_adds_up_over_calls(tmp_path: Path) -> None:
    run = RunDirectory(tmp_path)
    lines = [
        ("begin", "samples", "a", 0),
        ("progress", None, None, 20),  # killed here
        ("begin", "samples", "a", 100),
        ("stopped", "samples", None, 105),
        ("begin", "samples", "b", 200),  # other settings
        ("progress", None, None, 230),
    ]
    run.begin()
    with (tmp_path / "log.jsonl").open("w") as log:
        for event, stage, key, second in lines:
            time = f"2026-01-01T00:{second // 60:02}:{second % 60:02}.000+00:00"
            log.write(json.dumps({"time": time, "event": event, "stage": stage, "key": key}) + "\n")
        log.write('{"event": "progress"}\n')
    assert (run.spent("samples", "a"), run.spent("samples", "b"), run.spent("mean", "a")) == (25, 30, 0)
    run.log("end", stage="samples")
    assert run.spent("samples", "a") == 0


def test_more_vertices_are_advised_only_where_the_mesh_was_simplified(tmp_path: Path) -> None:
    directory = RunDirectory(tmp_path)
    assert against_failures(directory).startswith("a larger material.eta")
    directory.prolongation.write(vertices=np.zeros(1))
    assert against_failures(directory).startswith("a larger collection.coarse_vertices or material.eta")
