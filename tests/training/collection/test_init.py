"""``init`` writes, for a folder of meshes, a configuration that works without changes."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.__main__ import main as every_command
from shapespace.files.formats import MESH_FORMATS
from shapespace.training import __main__ as command
from shapespace.training.collection.faults import IngestError
from shapespace.training.collection.groups import groups_of
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.init import slug, write
from shapespace.training.runs.config import Config, ConfigError, load, parse


def meshes(folder: Path, count: int = 4, subdivisions: int = 1) -> Path:
    folder.mkdir(parents=True)
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    for k in range(count):
        data = MESH_FORMATS["npz"].encode(ball.vertices * [1, 1, 1 + k], ball.faces)
        (folder / f"pose{k + 8}.npz").write_bytes(data)
    return folder


def run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", ["shapespace-train", *map(str, arguments)])
    return command.main()


def test_values_come_from_the_meshes(tmp_path: Path) -> None:
    folder = meshes(tmp_path / "My Meshes_2", 25)
    out, collection = write(folder, tmp_path / "here.toml")
    config, _ = load(out)
    assert config.collection.data == folder.resolve()
    assert config.collection.reference is None
    assert f'"{collection.names[collection.central]}", the most central' in out.read_text()
    assert "at most 24" in out.read_text()
    assert (config.export.name, config.export.title) == ("my-meshes-2", "My Meshes_2")
    assert "coarse_vertices" not in config.collection.model_fields_set


def test_scans_of_one_subject_are_related(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    for k, name in enumerate(["sub-01_ses-1", "sub-01_ses-2", "sub-02_ses-1", "sub-ab_ses-1"]):
        (tmp_path / f"{name}.npz").write_bytes(MESH_FORMATS["npz"].encode(ball.vertices * [1, 1, 1 + k], ball.faces))
    out, collection = write(tmp_path, tmp_path / "here.toml")
    expression = load(out)[0].collection.related
    assert expression is not None
    assert groups_of(collection.names, expression).tolist() == [0, 0, 1, 2]
    (tmp_path / "sub-01_ses-2.npz").unlink()
    once, _ = write(tmp_path, tmp_path / "here.toml", force=True)
    assert load(once)[0].collection.related is None


def test_large_meshes_are_coarsened(tmp_path: Path) -> None:
    out, _ = write(meshes(tmp_path / "large", 3, subdivisions=4), tmp_path / "here.toml")
    assert "coarse_vertices" in load(out)[0].collection.model_fields_set
    assert "0 takes all 2562" in out.read_text()


def test_what_is_commented_out_is_the_default_and_can_be_taken(tmp_path: Path) -> None:
    out, _ = write(meshes(tmp_path / "meshes"), tmp_path / "here.toml")
    taken, count = re.subn(r"^# (?=\w+ = )", "", out.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert count >= 6
    everything = parse(taken, "taken").model_dump(exclude={"factors": {"count"}})
    assert everything == parse(out.read_text(encoding="utf-8"), "left").model_dump(exclude={"factors": {"count"}})


def test_what_the_meshes_do_not_decide_is_left_alone(tmp_path: Path) -> None:
    config, _ = load(write(meshes(tmp_path / "meshes"), tmp_path / "here.toml")[0])
    for name in Config.model_fields.keys() - {"collection", "export"}:
        default = Config.model_fields[name].default
        if name == "modes":  # configurations without this setting keep what version 0.2 did
            default = default.model_copy(update={"geometry": "auto"})
        assert getattr(config, name) == default, name


def test_every_setting_says_what_it_does(tmp_path: Path) -> None:
    out, _ = write(meshes(tmp_path / "meshes"), tmp_path / "here.toml")
    settings = re.findall(r"^(?:# )?(\w+) = (.*)$", out.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert [name for name, value in settings if "    # " not in value] == ["description"]
    sections = re.findall(r"^\[(\w+)", out.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert set(sections) <= set(Config.model_fields)


@pytest.mark.parametrize("name", ["Größe & Co.", "日本", 'a "quoted" # \\n', "two\nlines", "-", "poses.v2"])
def test_any_name_of_a_folder_will_do(name: str, tmp_path: Path) -> None:
    folder = meshes(tmp_path / name)
    config, _ = load(write(folder, tmp_path / "here.toml")[0])
    assert config.export.title == name
    assert config.collection.data == folder.resolve()


def test_names_of_bundles() -> None:
    assert [slug(text) for text in ("Größe & Co.", "日本", "__A--b__")] == ["groe-co", "shapes", "a-b"]


def test_the_configuration_finds_the_meshes_from_wherever_it_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = meshes(tmp_path / "data" / "meshes")
    for place in (tmp_path, tmp_path / "data", tmp_path / "configs" / "deep"):
        place.mkdir(parents=True, exist_ok=True)
        monkeypatch.chdir(place)
        out, _ = write(folder)
        assert out == Path("meshes.toml")
        data = load(place / out)[0].collection.data
        assert data is not None
        assert read_collection(data).names == ("pose8", "pose9", "pose10", "pose11")
        assert str(tmp_path) not in out.read_text(), "no path of this machine"
    monkeypatch.chdir(folder)
    assert write(Path())[0] == Path("meshes.toml")


def test_an_npz_will_do(tmp_path: Path) -> None:
    collection = read_collection(meshes(tmp_path / "meshes"))
    np.savez(tmp_path / "all.npz", vertices=collection.vertices, faces=collection.faces)
    config, _ = load(write(tmp_path / "all.npz", tmp_path / "here.toml")[0])
    assert config.collection.data == (tmp_path / "all.npz").resolve()
    assert config.export.name == "all"


def test_nothing_is_replaced_unless_asked_for(tmp_path: Path) -> None:
    folder, out = meshes(tmp_path / "meshes"), tmp_path / "here.toml"
    out.write_text("mine")
    with pytest.raises(ConfigError, match=r"here\.toml: exists already; --force"):
        write(folder, out)
    assert out.read_text() == "mine"
    write(folder, out, force=True)
    assert load(out)[0].export.name == "meshes"
    with pytest.raises(ConfigError, match=r"here\.toml: is a configuration, from which run trains"):
        write(out, force=True)
    (tmp_path / "notes.md").write_text("mine")
    with pytest.raises(IngestError, match=r"notes\.md: is no mesh; a single file"):
        write(tmp_path / "notes.md")
    with pytest.raises(ConfigError, match="can't be written"):
        write(folder, tmp_path / "none" / "here.toml")


def test_bad_meshes_leave_no_configuration(tmp_path: Path) -> None:
    with pytest.raises(IngestError, match="has 2 shapes"):
        write(meshes(tmp_path / "meshes", 2), tmp_path / "here.toml")
    assert not (tmp_path / "here.toml").exists()


def test_the_command_says_what_comes_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = meshes(tmp_path / "my meshes")
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, "init", folder) == 0
    said = capsys.readouterr().out.splitlines()
    assert said == [
        "my meshes.toml: for 4 shapes of 42 vertices and 80 faces",
        "Next: shapespace-train run 'my meshes.toml'",
    ]
    monkeypatch.setattr(sys, "argv", ["shapespace", "init", str(folder), "--force"])
    assert every_command() == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Next: shapespace run 'my meshes.toml'"
    monkeypatch.setattr(sys, "argv", ["shapespace/__main__.py", "init", str(folder), "--force"])
    assert every_command() == 0
    assert capsys.readouterr().out.endswith(f"Next: {shlex.quote(sys.executable)} -m shapespace run 'my meshes.toml'\n")
    assert run(monkeypatch, "init", folder) == 1
    assert "exists already" in capsys.readouterr().err
    assert run(monkeypatch, "init", folder, "--force", "--out", "other.toml") == 0
    assert run(monkeypatch, "init", tmp_path / "none") == 1
    assert capsys.readouterr().err.endswith(f"shapespace-train: {tmp_path / 'none'}: no such file or folder\n")


def test_an_empty_path_is_refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run(monkeypatch, "init", "")
    assert "it is empty; name a file or folder" in capsys.readouterr().err


def test_help_names_all_that_can_be_read(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run(monkeypatch, "init", "--help")
    said = " ".join(capsys.readouterr().out.split())
    assert all(word in said for word in ("VTK", "morph targets", "folder for each subject"))
