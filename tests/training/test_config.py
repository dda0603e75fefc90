"""Configurations that can't be used are refused in words; those that we ship can."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.training.conftest import TINY
from training.config import ConfigError, load, parse

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_a_configuration(path: Path) -> None:
    assert load(path).export.name


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("count = 60", "count = 60\ncuont = 3", "samples.cuont"),
        ("count = 60", "count = 'many'", "samples.count"),
        ("count = 60", "count = 2", "samples.count"),
        ('generator = "freaky-torus"', 'generator = "teapot"', "collection.generator"),
        ('name = "tiny-torus"', 'name = "../up"', "export.name"),
        ("[export]", "[export", "not TOML"),
        ('licence = "MIT"', "", "export.licence"),
    ],
)
def test_a_faulty_setting_is_named(old: str, new: str, says: str) -> None:
    assert old in TINY
    with pytest.raises(ConfigError, match=f"here.toml(.|\n)*{says}"):
        parse(TINY.replace(old, new, 1), "here.toml")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: can't be read"):
        load(tmp_path / "none.toml")


@pytest.mark.parametrize("written", ["meshes", "./sub/../meshes", "absolute"])
def test_data_lie_relative_to_the_configuration(written: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "meshes" if written == "absolute" else written
    (tmp_path / "here.toml").write_text(TINY.replace('generator = "freaky-torus"', f'data = "{data}"', 1))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load(Path("../here.toml")).collection.data == tmp_path.resolve() / "meshes"
    assert load(tmp_path / "here.toml") == load(Path("../here.toml"))
