"""The real command on a finished run: nothing is done twice, and what a change needs is done again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from shapespace.bundle.geometry import Geometry
from shapespace.bundle.reader import read_bundle
from shapespace.training.__main__ import main
from shapespace.training.learning import ExportError
from shapespace.training.learning.export import export
from shapespace.training.runs.config import load, parse
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import read
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.run import STAGES
from shapespace.training.stages.stage import Run
from tests.training.conftest import command
from tests.training.whole_runs.conftest import CONFIG


def again(copy: Run, monkeypatch: pytest.MonkeyPatch, old: str = "", new: str = "", until: str = "export") -> None:
    """The same command on a copy of the run, with a change of the configuration."""
    config = copy.directory.folder.parent / "bars.toml"
    assert copy.source.count(old or "[export]") == 1
    config.write_text(copy.source.replace(old, new) if old else copy.source)
    folder = copy.directory.folder
    arguments = ["run", str(config), "--out", str(folder), "--models", str(copy.models), "--until", until]
    monkeypatch.setattr(sys, "argv", ["shapespace-train", *arguments])
    assert main() == 0


def seconds(run: Run) -> dict[str, float]:
    return {name: run.directory.stamp(name).read().get("seconds", 0) for name in STAGES}


def test_the_same_command_again_does_nothing_and_a_changed_setting_only_its_stages(
    copy: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = seconds(copy)
    again(copy, monkeypatch)
    assert seconds(copy) == before
    again(copy, monkeypatch, "reconstructions = 4", "reconstructions = 3", "evaluation")
    after = seconds(copy)
    assert {name for name in STAGES if before[name] != after[name]} == {"evaluation", "export"}
    assert after["evaluation"] > after["export"] == 0


def test_modes_that_are_lost_are_found_again_and_put_in_the_order_of_the_factors(
    copy: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    directory = copy.directory
    paths = [directory.mean.path, directory.modes.path, directory.modes_by_strength.path]
    before, times = [path.read_bytes() for path in paths], seconds(copy)
    paths[1].unlink()
    again(copy, monkeypatch, until="factors")
    assert seconds(copy)["modes"] == times["modes"], "the factors alone write them again"
    for path in paths:
        path.unlink()
    again(copy, monkeypatch, until="evaluation")
    assert [path.read_bytes() for path in paths] == before
    assert seconds(copy)["samples"] == times["samples"]


@pytest.mark.long
def test_a_description_changes_the_bundle_alone(copy: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    before, name = seconds(copy), copy.directory.factors.read()["names"][0]
    described = f'"Another description."\nnames = {{ "{name}" = "the end" }}'
    again(copy, monkeypatch, '"A run for the tests."', described)
    after = seconds(copy)
    assert {name for name in STAGES if before[name] != after[name]} == {"export"}
    manifest = read_bundle(copy.bundle).manifest
    assert manifest.description == "Another description."
    assert manifest.factors[0].name == "the end"
    assert manifest.latent_names[0].startswith("the end")


def test_more_samples_are_drawn_beside_those_that_are_there(copy: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    files = sorted(copy.directory.samples.glob("part-*.npz")) + sorted(copy.directory.samples.glob("factor-*/*.npz"))
    before = {path: path.stat().st_mtime_ns for path in files}
    again(copy, monkeypatch, "\ncount = 60", "\ncount = 70", "samples")
    assert not any("seconds" in copy.directory.stamp(name).read() for name in list(STAGES)[-3:])
    shown = ("evaluation.json", "gallery.npz", "report.html", "networks/histories.json")
    assert not any((copy.directory.folder / name).exists() for name in shown), "figures of the former samples"
    drawn = read(copy.directory.samples).index
    assert len(drawn[drawn >= 0]) == 70
    assert {path: path.stat().st_mtime_ns for path in files} == before
    copy.source = copy.source.replace("steps = 4\npart", "steps = 2\npart")
    again(copy, monkeypatch, "\ncount = 60", "\ncount = 10", "samples")
    assert all(path.stat().st_mtime_ns != before[path] for path in files if path.exists())


def test_without_baselines_nothing_is_trained_for_comparison(copy: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    # Other networks follow, so this stage would be done again too, though it has nothing to do with them.
    monkeypatch.setitem(STAGES, "generalisation", replace(STAGES["generalisation"], run=lambda run: None))
    again(copy, monkeypatch, "baselines = true\n", "", "evaluation")
    kinds = {path.stem.rpartition("-")[0] for path in copy.directory.networks()}
    assert (
        kinds == {"combiner", "factor-0", "factor-1"} == {k.rpartition("-")[0] for k in copy.directory.histories.read()}
    )
    found = copy.directory.evaluation.read()
    assert found["r2"].keys() == {"composite", "kernel", "affine", "affine of learned factors", "limit"}
    assert found["fresh"]["r2"].keys() == {"composite", "kernel"}
    assert copy.directory.report.exists()


def test_networks_that_are_not_needed_any_more_are_removed(
    run: Path, copy: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    again(copy, monkeypatch, "[monolithic]\nhidden = [16]", "[monolithic]\nhidden = [8]", "networks")
    before, after = ({path.stem for path in directory.networks()} for directory in (RunDirectory(run), copy.directory))
    changed = sorted(name.rpartition("-")[0] for name in before ^ after)
    assert changed == ["monolithic"] * 2 + ["monolithic-combiner"] * 2
    assert len(before) == len(after)
    assert copy.directory.histories.read().keys() == after


@pytest.mark.parametrize(
    ("more", "says"),
    [
        pytest.param("tolerance = 1e-12\n", "differ by", marks=pytest.mark.long),
        ('names = { nose = "a" }\n', "'nose', which is neither"),
    ],
)
def test_export_refuses_networks_that_onnx_computes_otherwise_and_a_name_for_nothing(
    more: str, says: str, run: Path, tmp_path: Path
) -> None:
    opened = Run(run, *load(run / "config.toml"), tmp_path)
    geometry = Geometry(reference=opened.collection.reference)
    with pytest.raises(ExportError, match=says):
        export(learner_of(opened).main(), opened.collection, parse(CONFIG + more, "more"), {}, "", tmp_path, geometry)
    assert not opened.bundle.exists()


def results(run: Path) -> dict[str, object]:
    """Contents of all files of a run, except times, logs and the report."""
    found: dict[str, object] = {}
    for path in sorted(run.rglob("*")):
        name = str(path.relative_to(run))
        if path.suffix == ".npz":
            with np.load(path) as file:
                found |= {f"{name}/{key}": file[key].tobytes() for key in file}
        elif path.suffix == ".safetensors":
            found |= {f"{name}/{key}": value.tobytes() for key, value in load_file(path).items()}
        elif path.suffix == ".onnx":
            found[name] = path.read_bytes()
        elif path == run / "evaluation.json":
            found[name] = {k: v for k, v in json.loads(path.read_text()).items() if k != "times"}
    return found


@pytest.mark.long
def test_a_run_killed_in_every_stage_ends_as_one_that_nobody_disturbed(run: Path, folder: Path, tmp_path: Path) -> None:
    again, rng = tmp_path / "again", np.random.default_rng(0)
    log = again / "log.jsonl"
    for stage in STAGES:
        process = subprocess.Popen(
            command(folder / "bars.toml", again), stdout=subprocess.DEVNULL, start_new_session=True
        )
        while f'"begin", "stage": "{stage}"' not in (log.read_text() if log.exists() else ""):
            assert process.poll() is None, "the run ended before it could be killed"
            time.sleep(0.01)
        time.sleep(rng.uniform(0, 0.5))
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    subprocess.run(command(folder / "bars.toml", again), check=True, capture_output=True)
    one, other = results(run), results(again)
    assert one.keys() == other.keys()
    assert [name for name in one if one[name] != other[name]] == []


@pytest.mark.long
def test_init_writes_a_configuration_that_the_command_takes(folder: Path, tmp_path: Path) -> None:
    few, out = tmp_path / "few", tmp_path / "mine.toml"
    # Each mesh is held out in turn, so that the time grows with their square.
    shutil.copytree(folder / "meshes", few, ignore=shutil.ignore_patterns("bar4.*"))
    shapespace = [sys.executable, "-m", "shapespace.training"]
    subprocess.run([*shapespace, "init", str(few), "--out", str(out)], check=True, capture_output=True)
    text, default = out.read_text(), "# coarse_vertices = 1000"
    assert default in text
    out.write_text(text.replace(default, "coarse_vertices = 120"))
    run = command(out, tmp_path / "run", "--until", "mean")
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "run" / "mean.npz") as mean:
        assert str(mean["status"]) == "converged"
