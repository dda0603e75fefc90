"""Messages of a run: changed data, what failed in each stage, where a traceback is, and what comes next."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace.files.formats import MESH_FORMATS
from shapespace.model.decoder import Decoder
from shapespace.training.commands import HOME
from shapespace.training.learning import ExportError
from shapespace.training.report.page import page
from shapespace.training.report.record import Record
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.stages.export import write_bundle_of
from shapespace.training.stages.results import remember
from shapespace.training.stages.run import STAGES
from shapespace.training.stages.stage import Run
from tests.faults.training import CONFIG, bars
from tests.training.conftest import TINY, Said
from tests.training.whole_runs.test_the_same_command import results

SHAPES, FACES = bars(6)


def write(path: Path, vertices: np.ndarray) -> None:
    path.write_bytes(MESH_FORMATS["obj"].encode(vertices, FACES))


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory with a configuration and meshes."""
    (tmp_path / "meshes").mkdir()
    for k, shape in enumerate(SHAPES[:5]):
        write(tmp_path / "meshes" / f"bar{k}.obj", shape)
    (tmp_path / "bars.toml").write_text(CONFIG.replace("bars.npz", "meshes"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_faults_of_the_user_s_making_are_one_message(place: Path, said: Said) -> None:
    (place / "bad.toml").write_text("[collection]\n")
    (place / "latin.toml").write_bytes("# Größe".encode("latin-1"))
    (place / "models" / "bars" / "1").mkdir(parents=True)
    (place / "models" / "bars" / "1" / "pose.obj").touch()
    for arguments, says in (
        (("run", "bad.toml"), "export: is not there; add it"),
        (("run", "none.toml"), "none.toml: can't be read: there is no such file or folder"),
        (("run", "meshes"), "meshes: can't be read: it is a folder"),
        (("run", "latin.toml"), "it is not text in UTF-8"),
        (("run", "bars.toml", "--out", "bad.toml/x"), "bad.toml/x/stages: it is a file or lies below one"),
        (("run", "bars.toml", "--data", "none", "--until", "ingest"), "none: no such file or folder"),
        (("run", "bars.toml"), "models/bars/1 holds pose.obj, which no export has written"),
        (("run", "bars.toml", "--models", "bad.toml"), "bad.toml is a file, and bundles lie in a folder"),
        (("init", "meshes", "--out", "none/bars.toml"), "none/bars.toml: can't be written: there is no such"),
        (("init", "meshes", "--out", "meshes", "--force"), "meshes: can't be written: it is a folder"),
        (("status", "nowhere"), "is not a run directory"),
        (("report", "meshes"), "is not a run directory"),
        (("export", "bad.toml"), "is not a run directory"),
    ):
        said(*arguments, code=1)
        assert says in said.errors, arguments
        assert len(said.errors.splitlines()) <= 2, said.errors


def test_status_tells_how_far_a_run_is(run: Path, said: Said) -> None:
    lines = dict(line.split(maxsplit=1) for line in said("status", str(run)).splitlines())
    assert list(lines) == list(STAGES)
    assert all(state.startswith("done in") for state in lines.values())


def test_status_of_a_stage_at_work_tells_its_samples(copy: Run, said: Said) -> None:
    copy.directory.stamp("samples").write({"key": "", "basis": ""})
    log = copy.directory.folder / "log.jsonl"
    lines = log.read_text().splitlines()
    at = max(k for k, line in enumerate(lines) if '"samples of factor 1"' in line)
    log.write_text("\n".join(lines[: at + 1]))
    assert "samples        begun: samples of factor 1: 60 of 60" in said("status", str(log.parent)).splitlines()


def test_changed_data_are_read_again_and_it_is_said(place: Path, said: Said) -> None:
    run = "run", "bars.toml", "--until", "ingest"
    meshes = place / "meshes"
    assert "done before" not in said(*run)

    def read(says: str | None) -> None:
        words = said(*run)
        assert ("ingest: done before" in words) == (says is None)
        assert "data:" not in words if says is None else f"data: {says};" in words

    def names() -> list[str]:
        with np.load(place / "runs" / "bars" / "shapes.npz") as file:
            return file["names"].tolist()

    read(None)
    write(meshes / "bar9.obj", SHAPES[5])
    read("1 added (bar9.obj)")
    assert names() == ["bar0", "bar1", "bar2", "bar3", "bar4", "bar9"]
    read(None)
    os.utime(meshes / "bar2.obj", (0, 0))
    read(None)  # a new modification time alone is no change
    size = (meshes / "bar2.obj").stat().st_size
    write(meshes / "bar2.obj", SHAPES[5])
    write(meshes / "bar9.obj", SHAPES[2])
    read("2 changed (bar2.obj, bar9.obj)")
    assert abs((meshes / "bar2.obj").stat().st_size - size) < 2000
    (meshes / "bar5.obj").write_text("v 0 0 0")
    said(*run, code=1)
    assert "bar5.obj" in said.errors
    (meshes / "bar5.obj").unlink()
    read(None)  # the earlier results are still there
    (meshes / "bar4.obj").unlink()
    (meshes / "notes.txt").write_text("no mesh")
    read("1 removed (bar4.obj)")
    meshes.rename(place / "elsewhere")
    words = said(*run)
    assert "does not exist any more" in words
    assert "ingest: done before" in words
    said(*run, "--data", "misspelt", code=1)
    assert "misspelt: no such file or folder; check its name" in said.errors
    (place / "other").mkdir()
    for k in (1, 2, 3):
        write(place / "other" / f"bar{k}.obj", SHAPES[k])
    assert "ingest: done before" in said(*run), "nothing was removed"
    assert "data: 2 removed (bar0.obj, bar9.obj)" in said(*run, "--data", "other")
    assert "ingest: done before" in said(*run, "--data", "other")
    (place / "bars.toml").write_text(CONFIG.replace('data = "bars.npz"', ""))
    assert "collection.data is missing" in said(*run, code=1)
    assert "ingest         done" in said("status", "runs/bars")


def test_a_run_of_version_0_1_is_not_continued_and_loses_nothing(place: Path, said: Said) -> None:
    said("run", "bars.toml", "--until", "mean")
    run = RunDirectory(place / "runs" / "bars")
    run.data.path.unlink()
    for stage in ("ingest", "mean"):
        stamp = run.stamp(stage).read()
        del stamp["version"]
        run.stamp(stage).write(stamp)
    run.config.write(run.config.read().replace('correction = { kind = "kernel" }', "kernel = 12"))
    before = {path: path.read_bytes() for path in run.folder.rglob("*") if path.is_file()}
    for arguments in (("run", "bars.toml"), ("export", "runs/bars")):
        (sentence,) = said(*arguments, code=1).splitlines()
        assert sentence.startswith("shapespace-train: runs/bars is a run of version 0.1, ")
        assert "--out" in sentence
    assert {path: path.read_bytes() for path in run.folder.rglob("*") if path.is_file()} == before


def test_a_stage_of_another_version_is_done_again_with_all_that_follows(
    place: Path, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    until_factors = "run", "bars.toml", "--until", "factors"
    said(*until_factors)
    assert "this version" not in said(*until_factors)
    monkeypatch.setitem(STAGES, "modes", replace(STAGES["modes"], version=STAGES["modes"].version + 1))
    words = said(*until_factors)
    assert words.count("this version") == 1
    assert "modes: this version of shapespace computes other numbers; the stages from modes on run again" in words
    assert [name for name in STAGES if f"{name}: done before" in words] == ["ingest", "mean"]
    # The format of releases before stages had versions.
    RunDirectory(place / "runs" / "bars").stamp("factors").write({"key": "0", "basis": "0", "seconds": 1.0})
    words = said(*until_factors)
    assert "factors: this version" in words
    assert "factors: done before" not in words


def test_a_setting_that_came_and_went_leaves_nothing_and_costs_no_samples(place: Path, said: Said) -> None:
    config, run = place / "bars.toml", RunDirectory(place / "runs" / "bars")
    said("run", "bars.toml", "--until", "modes")
    assert run.modes.read().keys() == run.modes_by_strength.read().keys() | {"rank"}
    said("run", "bars.toml", "--until", "samples")
    before, grouping = run.modes.read(), run.factors.read()
    drawn = {path: path.stat().st_mtime_ns for path in run.samples.rglob("part-*.npz")}
    text = config.read_text()
    config.write_text(text.replace("log_steps = 2", "log_steps = 3"))
    said("run", "bars.toml", "--until", "modes")
    assert not run.factors.exists()
    np.testing.assert_array_equal(run.modes.read()["nric"], run.modes_by_strength.read()["nric"])
    done = [line.split()[0] for line in said("status", "runs/bars").splitlines() if "done in" in line]
    assert done == ["ingest", "mean", "modes"]
    assert "to do" in page(Record(run))
    config.write_text(text)
    said("run", "bars.toml", "--until", "samples")
    assert {path: path.stat().st_mtime_ns for path in run.samples.rglob("part-*.npz")} == drawn
    after = run.modes.read()
    assert run.factors.read() == grouping
    assert before.keys() == after.keys()
    assert all(np.array_equal(before[name], after[name]) for name in before)
    strongest = run.modes_by_strength.read()
    np.testing.assert_array_equal(strongest["nric"][after["rank"]], after["nric"])


def test_a_killed_run_goes_on_and_ends_as_one_that_nobody_disturbed(place: Path, said: Said) -> None:
    whole, killed = (("run", "bars.toml", "--out", out, "--until", "samples") for out in ("whole", "killed"))
    process = subprocess.Popen(
        [sys.executable, "-m", "shapespace.training", *killed],
        stdout=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(HOME)},
    )
    while not list(place.glob("killed/samples/part-*.npz")):
        assert process.poll() is None, "the run ended before it could be killed"
        time.sleep(0.001)
    os.killpg(process.pid, signal.SIGSTOP)
    before = {path: path.read_bytes() for path in (place / "killed").rglob("*") if path.is_file()}
    for other in (killed, ("export", "killed")):
        (sentence,) = said(*other, code=1).splitlines()
        assert re.search(rf": process {process.pid} on \S+ is working on the run killed: wait until", sentence)
    assert {path: path.read_bytes() for path in (place / "killed").rglob("*") if path.is_file()} == before
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    said(*whole)
    words = said(*killed)
    assert "factors: done before" in words
    one, other = (results(place / out) for out in ("whole", "killed"))
    assert one == other
    assert any("samples/split" in name for name in one)


def test_a_product_by_design_has_its_factors_without_modes(place: Path, said: Said) -> None:
    (place / "torus.toml").write_text(TINY)
    said("run", "torus.toml", "--until", "factors")
    run = RunDirectory(place / "runs" / "torus")
    assert run.factors.read()["factors"] == [[0], [1], [2, 3]]
    assert run.reference_mesh().vertices.shape == (2048, 3)
    assert not run.mean.exists()
    assert not run.modes.exists()


def test_an_odd_shape_stops_the_run_until_it_is_accepted(place: Path, said: Said) -> None:
    write(place / "meshes" / "bar3.obj", 1000 * SHAPES[3])
    words = said("init", "meshes")
    assert re.search(r"meshes/bar3\.obj: has another size: its lengths are [\d,]+ times the median", words)
    assert "--accept bar3" in words
    run = "run", "bars.toml", "--until", "ingest"
    refused = said(*run, code=1)
    assert re.search(r"meshes/bar3\.obj: has another size: its lengths are [\d,]+ times the median", refused)
    assert refused.endswith("--accept bar3\n")
    assert not (place / "runs" / "bars" / "reference.npz").exists()
    assert "bar3.obj: has another size" in said(*run, "--accept", "bar3.obj")
    assert "bar3.obj: has another size" in page(Record(RunDirectory(place / "runs" / "bars")))


def test_one_folder_per_subject_is_read_from_init_to_report(place: Path, said: Said) -> None:
    study = place / "study"
    for k, shape in enumerate(SHAPES):
        (study / f"sub-{k:02}").mkdir(parents=True)
        write(study / f"sub-{k:02}" / "body.obj", shape)
    (study / "dataset.json").touch()
    (study / "sub-03" / "notes.txt").touch()
    refused = said("init", "study", code=1)
    assert "study: has no meshes, but its folders have; read one file from each folder" in refused
    assert "--file body.obj (" in refused
    words = said("init", "study", "--file", "body.obj")
    notes = (
        "left out, as only body.obj is read from each folder: notes.txt",
        "left out, as they are not in a subject's folder: dataset.json",
    )
    assert all(f"  {note}\n" in words for note in notes)
    run = "run", "study.toml", "--until", "ingest"
    words = said(*run)
    assert all(f"  {note}\n" in words for note in notes)
    assert all(note.replace("'", "&#39;") in page(Record(RunDirectory(place / "runs" / "study"))) for note in notes)
    with np.load(place / "runs" / "study" / "shapes.npz") as file:
        assert file["names"].tolist()[:6] == [f"sub-{k:02}" for k in range(6)]
        assert file["files"].tolist()[2] == "sub-02/body.obj"
    assert "ingest: done before" in said(*run)
    write(study / "sub-01" / "body.obj", SHAPES[1] * [1, 1.1, 1])
    assert "data: 1 changed (sub-01/body.obj)" in said(*run)


def test_all_faults_of_a_folder_are_one_table(place: Path, said: Said) -> None:
    meshes = place / "meshes"
    (meshes / "bar1.obj").write_text("")
    write(meshes / "bar2.obj", 1000 * SHAPES[2])
    write(meshes / "bar5.obj", SHAPES[5])
    for command_line in (("init", "meshes"), ("run", "bars.toml", "--until", "ingest")):
        said(*command_line, code=1)
        head, columns, *rows = said.errors.splitlines()
        assert head == "shapespace-train: the meshes have 2 faults:"
        assert columns.split() == ["file", "what", "is", "wrong", "what", "to", "do"]
        assert [Path(row.split()[0]).name for row in rows] == ["bar1.obj", "bar2.obj"]
        assert re.search("has no faces  +export it again, or leave it out$", rows[0])
        assert re.search(r"has another size: .* median of all shapes +check its unit .* --accept bar2\)$", rows[1])
    assert not (place / "meshes.toml").exists()


def done_up_to_modes(place: Path, said: Said) -> Path:
    said("run", "bars.toml", "--until", "modes")
    return place / "runs" / "bars"


def test_lost_logarithms_are_said_and_stop_the_run(place: Path, said: Said) -> None:
    run = done_up_to_modes(place, said)
    assert STAGES["modes"].warnings(RunDirectory(run)) == []
    modes = json.loads((run / "modes.json").read_text())
    for steps, says, stops in (
        ([4, 4, 4, 8, 4], "1 of 5 logarithms needed more time steps: bar3", False),
        ([4, 0, 4, 4, 4], "for 1 of 5 shapes no geodesic was found, so a straight line replaces it: bar1", False),
        ([4, 0, 4, 0, 4], "for 2 of 5 shapes no geodesic was found, so a straight line replaces it: bar1, bar3", True),
    ):
        (run / "modes.json").write_text(json.dumps(modes | {"steps": steps, "log_steps": 4, "asked": 9}))
        remember(STAGES["modes"], RunDirectory(run))
        words = said("run", "bars.toml", "--until", "factors", code=int(stops))
        assert f"  {says}\n" in words
        assert "  found 2 of 9 modes, because the others would be zero" in words
        assert (says in page(Record(RunDirectory(run)))) is True
        assert (run / "factors.json").exists() != stops
        (run / "factors.json").unlink(missing_ok=True)
        (run / "stages" / "factors.json").unlink(missing_ok=True)
    assert "material.eta" in words
    assert words.rstrip().endswith("shapespace-train run bars.toml --until factors --keep-going")
    said("run", "bars.toml", "--until", "factors", "--keep-going")
    assert (run / "factors.json").exists()


def test_failed_samples_are_counted_by_factor(place: Path) -> None:
    run = place / "run"
    (run / "samples" / "factor-1").mkdir(parents=True)
    (run / "factors.json").write_text('{"factors": [[0], [1]], "names": ["left", "upper right"]}')
    latents = np.random.default_rng(0).uniform(-1, 1, (40, 2))
    status = np.where(np.abs(latents[:, 1]) > 0.8, "failed", "done")
    reason = np.where(status == "failed", "stalled: a face turns", "")
    count = int((status == "failed").sum())
    for folder in (run / "samples", run / "samples" / "factor-1"):
        used = latents.copy()
        used[:5] *= 0.85
        np.savez(folder / "part-00000.npz", asked=latents, latents=used, status=status, reason=reason)
    shortened, joint, own_shortened, own = STAGES["samples"].warnings(RunDirectory(run))
    assert shortened.sentence.startswith("5 of 40 codes of joint samples had no shape and were moved")
    assert own_shortened.sentence.startswith("5 of 40 codes of samples of factor 'upper right' had no shape")
    lost = status == "failed"
    lost[:5] = True
    assert shortened.share == own_shortened.share == lost.mean()
    assert joint.sentence == f"{count} of 40 joint samples failed (stalled), most in factor 'upper right'"
    assert own.sentence == f"{count} of 40 samples of factor 'upper right' failed (stalled)"
    assert joint.share == own.share == count / 40


def test_a_traceback_is_written_and_not_shown(place: Path, said: Said) -> None:
    said("run", "bars.toml", "--until", "ingest")
    run = place / "runs" / "bars"
    np.savez(run / "shapes.npz", other=np.zeros(1))  # what no run writes
    remember(STAGES["ingest"], RunDirectory(run))
    done = subprocess.run(
        [sys.executable, "-m", "shapespace.training", "run", "bars.toml"],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(HOME)},
    )
    assert done.returncode == 70
    assert "Traceback" not in done.stderr
    assert "internal error" in done.stderr
    assert "runs/bars/traceback.txt" in done.stderr
    assert "Traceback" in (place / "runs" / "bars" / "traceback.txt").read_text()


def test_the_next_command_works_from_where_one_stands(
    copy: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Said
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    (tmp_path / "bars.toml").write_text(copy.source)
    words = said("run", "../bars.toml", "--out", "../run", "--models", "../run/models").splitlines()[-1]
    bundle, following = words.split(" is ready. Next: ")
    assert bundle == "../run/models/bars/1"
    assert (Path(bundle) / "manifest.json").is_file()
    setting, *words_of = shlex.split(following)
    name, _, value = setting.partition("=")
    assert (name, Path(value).resolve()) == ("SHAPESPACE_MODELS_DIR", (tmp_path / "run" / "models").resolve())
    assert words_of[0] == "make"
    subprocess.run([*words_of, "--dry-run"], check=True, capture_output=True, env={**os.environ, name: value})


def test_a_model_without_shapes_inside_its_bounds_is_refused_in_words_of_training(
    copy: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def measure(decoder: Decoder) -> None:
        decoder.shape(np.full(decoder.latents.dimension, 1e30, np.float32))

    monkeypatch.setattr("shapespace.training.learning.export.measure_accuracy", measure)
    with pytest.raises(
        ExportError, match=r"has no shape, so the model is too poor.*What may help: more samples\.count"
    ):
        write_bundle_of(copy, {})
