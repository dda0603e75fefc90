"""What a run never does: write into other folders, read devices, end for good at a damaged file, or leave processes."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from shapespace.training.runs.atomic_files import DamagedFileError, JsonFile, NpzFile
from shapespace.training.runs.config import load
from shapespace.training.runs.directory import NotARunError, RunDirectory
from shapespace.training.stages.run import replaces_another
from shapespace.training.stages.stage import Run
from tests.training.conftest import TINY, Said, command, train

MINE = """
[collection]
data = "{}"
[export]
name = "mine"
title = "Mine"
description = "For the tests."
licence = "MIT"
"""
FOREIGN = ["shapes.npz", "report.html", "samples/mine.txt", "config.toml", "notes.txt", ".hidden"]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return path


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_run_says_beforehand_that_it_replaces_the_bundle_of_another_run(config: Path, tmp_path: Path) -> None:
    run = Run(tmp_path / "run", *load(config), tmp_path / "models")
    run.directory.begin()
    assert replaces_another(run) == ""
    run.bundle.mkdir(parents=True)
    assert "tiny-torus/1 exists, and this run has not written it" in replaces_another(run)
    run.directory.log("exported", bundle="tiny-torus/1")
    assert replaces_another(run) == ""


@pytest.mark.parametrize("name", FOREIGN)
def test_a_folder_with_other_files_is_left_alone(name: str, config: Path, tmp_path: Path, said: Said) -> None:
    mine = tmp_path / "mine"
    (mine / name).parent.mkdir(parents=True)
    (mine / name).write_text("mine")
    said("run", config, "--out", mine, "--until", "ingest", code=1)
    assert "is not a run directory" in said.errors
    assert contents(mine) == {name: b"mine"}


def test_a_file_in_place_of_the_folder_is_left_alone(config: Path, tmp_path: Path, said: Said) -> None:
    (tmp_path / "mine").write_text("mine")
    said("run", config, "--out", tmp_path / "mine", code=1)
    assert "mine is no folder" in said.errors
    assert (tmp_path / "mine").read_text() == "mine"


def test_empty_folders_and_runs_are_continued(config: Path, tmp_path: Path, said: Said) -> None:
    empty, killed = tmp_path / "out", tmp_path / "killed"
    empty.mkdir()
    (killed / "stages").mkdir(parents=True)  # killed before it had written its configuration
    for out in (empty, empty, killed):
        said("run", config, "--out", out, "--until", "ingest")


@pytest.mark.parametrize("place", ["", "shapes.npz", "samples/mine.npz"])
def test_data_inside_the_results_are_refused(place: str, tmp_path: Path, said: Said) -> None:
    out = tmp_path / "out"
    data = out / place
    RunDirectory(out).begin()
    RunDirectory(out).config.write("")
    if place:
        data.parent.mkdir(exist_ok=True)
        np.savez(data, vertices=np.zeros((3, 4, 3)), faces=np.zeros((1, 3), int))
    config = tmp_path / "mine.toml"
    config.write_text(MINE.format(data))
    before = contents(out)
    said("run", config, "--out", out, code=1)
    assert "writes its results" in said.errors
    assert contents(out) == before


def test_devices_are_no_collections(tmp_path: Path, said: Said) -> None:
    config = tmp_path / "mine.toml"
    config.write_text(MINE.format("/dev/zero"))
    said("run", config, "--out", tmp_path / "out", code=1)
    assert "neither a file nor a folder" in said.errors
    os.mkfifo(tmp_path / "pipe.obj")
    config.write_text(MINE.format(tmp_path))
    for name in ("a", "b"):
        (tmp_path / f"{name}.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    said("run", config, "--out", tmp_path / "out", code=1)
    assert "pipe.obj: can't be read" in said.errors


def test_devices_and_pipes_are_no_configurations(tmp_path: Path, said: Said) -> None:
    os.mkfifo(tmp_path / "pipe.toml")
    for place in ("/dev/zero", tmp_path / "pipe.toml"):
        said("run", place, code=1)
        assert f"{place}: can't be read: it is a device or a pipe" in said.errors


def flip(path: Path, place: int) -> None:
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def test_damaged_results_are_named_and_made_again(config: Path, tmp_path: Path, said: Said) -> None:
    out = tmp_path / "out"
    run = "run", config, "--out", out, "--until"
    said(*run, "samples")
    part = out / "samples" / "part-00001.npz"
    arrays = NpzFile(part).read()
    flip(part, part.read_bytes().index(b"nric.npy") + 5000)
    words = said(*run, "networks")
    assert "samples/part-00001.npz: is damaged and was removed; the stage samples computes it again" in words
    np.testing.assert_equal(NpzFile(part).read(), arrays)
    RunDirectory(out).stamp("samples").path.write_bytes(b"damaged")
    assert "stages/samples.json: is damaged" in said(*run, "samples")
    np.testing.assert_equal(NpzFile(part).read(), arrays)


def test_a_damaged_file_is_told_from_one_that_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    with pytest.raises(FileNotFoundError):
        JsonFile(path).read()
    path.write_text("{")
    with pytest.raises(DamagedFileError, match=r"x\.json is damaged; give the command run"):
        JsonFile(path).read()
    with pytest.raises(NotARunError):
        RunDirectory(tmp_path).begin()


def processes(session: int) -> list[int]:
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = stat.read_text().rpartition(")")[2].split()
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(int(stat.parent.name))
    return found


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_run_with_a_sentence_and_all_its_processes(
    number: signal.Signals, config: Path, tmp_path: Path
) -> None:
    config.write_text(TINY.replace("count = 60", "count = 400000", 1))
    out = tmp_path / "out"
    environment = os.environ | {"LOKY_MAX_CPU_COUNT": "2"}
    process = subprocess.Popen(
        command(config, out), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env=environment,
    )  # fmt: skip
    while not any((out / "samples").glob("part-*.npz")):
        assert process.poll() is None, "the run ended by itself"
        time.sleep(0.01)
    process.send_signal(number)
    said = process.communicate()[1]
    assert process.returncode == 128 + number
    # Before that, a slow machine says how far it is.
    assert said.splitlines()[-1] == "shapespace-train: stopped. The same command continues from here"
    assert said.count("shapespace-train:") == 1
    assert "Traceback" not in said
    while processes(process.pid):  # ends by the tests' own limit, if ever
        time.sleep(0.01)
    shutil.rmtree(out)


@pytest.fixture
def finished(run: Path, tmp_path: Path) -> Path:
    """A copy of the shared run and its bundle."""
    return Path(shutil.copytree(run, tmp_path / "out"))


#: Files of a finished run, and the stage that makes each.
RESULTS = {
    "reference.npz": "ingest",
    "factors.json": "factors",
    "samples/split.npz": "samples",
    "samples/factor-1/part-00000.npz": "samples",
    "networks/histories.json": "networks",
    "networks/monolithic-*.safetensors": "networks",
    "exact/fresh/part-00000.npz": "evaluation",
    "gallery.npz": "evaluation",
}


WHY = pytest.mark.parametrize("why", ["damaged", "missing"])


@pytest.mark.long
@WHY
def test_a_finished_run_makes_again_what_is_damaged_or_missing(
    why: str, folder: Path, finished: Path, said: Said
) -> None:
    config = folder / "bars.toml"
    before = {next(finished.glob(name)): stage for name, stage in RESULTS.items()}
    contents_before = {path: path.read_bytes() for path in before}
    for path in before:
        flip(path, path.stat().st_size // 2) if why == "damaged" else path.unlink()
    # In a process of its own: another order of loading libraries gives other last bits.
    status, words = said("status", finished), train(config, finished, "--until", "evaluation")
    for path, stage in before.items():
        name, removed = path.relative_to(finished), " and was removed" if why == "damaged" else ""
        assert f"{name} is {why}" in next(line for line in status.splitlines() if line.startswith(f"{stage} "))
        assert f"{name}: is {why}{removed}; the stage {stage} computes it again" in words
        if path.suffix == ".npz":
            assert path.read_bytes() == contents_before[path]
    assert "mean: done before" in words
    run = "run", config, "--out", finished, "--models", finished / "models", "--until", "evaluation"
    assert "again" not in said("status", finished) + said(*run)


@pytest.mark.long
@WHY
def test_a_bundle_that_is_missing_or_damaged_is_written_again(why: str, finished: Path) -> None:
    models = finished / "models"
    bundle = models / "bars" / "1"
    before = contents(bundle)
    if why == "damaged":
        (bundle / "manifest.json").write_text("{")
    else:
        shutil.rmtree(models)
    export = [sys.executable, "-m", "shapespace.training", "export", finished, "--models", models]
    words = subprocess.run(export, capture_output=True, text=True, check=True).stdout
    assert f"{bundle}: is {why}; the stage export writes it again" in words
    assert contents(bundle) == before


@pytest.mark.long
def test_a_damaged_log_is_no_obstacle(finished: Path, said: Said) -> None:
    (finished / "log.jsonl").write_bytes(b'\xff\xfe{"event": 1}\n[1]\n{"event": "progress"}\n')
    assert "done in" in said("status", finished)
    said("report", finished)
