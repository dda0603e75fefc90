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
