"""Invalid configurations are refused with a sentence; those in the repository are valid."""

from pathlib import Path
from typing import get_args

import pytest

from shapespace.training.collection.generators import MESHES, PRODUCTS
from shapespace.training.runs.config import Config, ConfigError, load, parse
from shapespace.training.runs.settings import CollectionSettings
from shapespace.training.stages.run import stage_keys
from tests.training.conftest import TINY

EXAMPLES = sorted((Path(__file__).parents[3] / "examples").rglob("*.toml"))


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_example_is_a_configuration_and_what_is_kept_of_it_says_the_same(path: Path) -> None:
    config = load(path)[0]
    assert Config.model_validate(config.model_dump(mode="json", by_alias=True)) == config


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("count = 60", "count = 60\ncuont = 3", r"samples.cuont: there is no such setting here; did you mean count\?"),
        ("[samples]", "[sample]", r"  sample: there is no such setting here; did you mean samples\?"),
        ("count = 60", "count = 60\nzebra = 3", "samples.zebra: there is no such setting here; remove it"),
        ("count = 60", "count = 60\nBool = 3", "samples.Bool: there is no such setting here"),
        ("count = 60", "count = 'many'", "samples.count: needs a whole number$"),
        ("count = 60", "count = 2", "samples.count: needs a number of at least 10$"),
        ("[export]", "[modes]\ncount = 'all'\n[export]", "modes.count: needs a whole number or 'auto'$"),
        ("[export]", "[modes]\ngeometry = 'flat'\n[export]", "modes.geometry: needs 'auto', 'vertices', "),
        ('generator = "freaky-torus"', 'generator = "teapot"', "collection.generator"),
        ('name = "tiny-torus"', 'name = "../up"', "export.name: needs small letters, digits and hyphens"),
        ("[export]", "[export", "not TOML"),
        ('licence = "MIT"', "", "export.licence: is not there; add it"),
        ("products = 2", "cofficients = 2", "networks.combiner.correction.convolutions.cofficients"),
        ('kind = "convolutions"', 'kind = "kernels"', "networks.combiner.correction"),
        ("products = 2", "products = 2\nresidual = false", "products need residual"),
        ("products = 2", "crop = 60\nintegrability = 1", "integrability needs whole shapes"),
        ("[export]", "[factors]\nmodes = [[0, 1], [1]]\n[export]", "modes has 1 more than once"),
        ("[export]", "[factors]\nmodes = [[0], []]\n[export]", "factors.modes.1"),
        ("[export]", "[factors]\nmodes = [[0, -1]]\n[export]", "factors.modes.0.1"),
        ("[export]", "[factors]\ncount = 2\nmodes = [[0]]\n[export]", "either count or modes"),
        (
            "[export]",
            "[modes]\ncount = 3\n[factors]\nmodes = [[5, 4, 3]]\n[export]",
            "there is no mode 3, 4, 5; these modes are in no factor: 0, 1, 2. There are 3 modes, counted from 0 to 2",
        ),
        ("[export]", "[modes]\ncount = 3\n[factors]\ncount = 4\n[export]", "count = 4 is more than modes.count = 3"),
    ],
)
def test_a_faulty_setting_is_named(old: str, new: str, says: str) -> None:
    assert old in TINY
    with pytest.raises(ConfigError, match=f"here.toml(.|\n)*{says}"):
        parse(TINY.replace(old, new, 1), "here.toml")


def test_settings_that_need_others_are_told() -> None:
    alone = TINY.replace("[export]", '[export]\nup = "+z"', 1).replace("baselines = true", "", 1)
    needs = ["evaluation.grid_nodes needs evaluation.baselines", "export.up needs export.faces"]
    assert parse(alone, "here.toml").ineffective == needs
    assert parse(TINY.replace("[export]", '[export]\nup = "+z"\nfaces = "+x"', 1), "here.toml").ineffective == []


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: can't be read"):
        load(tmp_path / "none.toml")


@pytest.mark.parametrize("written", ["meshes", "./sub/../meshes", "absolute"])
def test_data_lie_relative_to_the_configuration(written: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tmp_path / "meshes" if written == "absolute" else written
    (tmp_path / "here.toml").write_text(TINY.replace('generator = "freaky-torus"', f'data = "{data}"', 1))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load(Path("../here.toml"))[0].collection.data == tmp_path.resolve() / "meshes"
    assert load(tmp_path / "here.toml") == load(Path("../here.toml"))


def test_the_command_s_arguments_go_before_the_file_and_into_the_text_that_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    file.write_text("\ufeff# kept\n" + TINY.replace('generator = "freaky-torus"', 'data = "old"', 1))
    config, text = load(file, tmp_path / "new")
    assert config.collection.data == tmp_path / "new"
    assert text.startswith("# kept")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.toml").write_text(text)
    assert load(tmp_path / "run" / "config.toml") == (config, text)


def test_a_file_that_needs_no_changes_is_kept_as_it_stands() -> None:
    path = Path(__file__).parents[3] / "examples" / "freaky-torus.toml"
    assert load(path)[1] == path.read_text()


def test_every_generator_that_can_be_named_is_there() -> None:
    named = set(get_args(get_args(CollectionSettings.model_fields["generator"].annotation)[0]))
    assert named == PRODUCTS.keys() | MESHES.keys()
    assert not PRODUCTS.keys() & MESHES.keys()


def test_a_configuration_of_version_0_1_is_refused_in_a_sentence_that_says_what_to_write() -> None:
    path = Path(__file__).parents[1] / "whole_runs" / "run_of_0_1" / "config.toml"
    with pytest.raises(ConfigError) as caught:
        load(path)
    (line,) = str(caught.value).splitlines()[1:]
    assert "settings of version 0.1: write kernel as correction = { kind = " in line
    for name in ("pairwise", "layers", "crop", "fit"):
        assert name in line


def test_a_field_needs_features_that_move() -> None:
    table = '[networks.combiner.correction]\nkind = "field"\n'
    rest = '[export]\nname = "a"\ntitle = ""\ndescription = ""\nlicence = ""\n'
    assert parse(f'[collection]\ngenerator = "freaky-torus"\n{table}{rest}', "here")
    with pytest.raises(ConfigError, match="features that move over the surface"):
        parse(f'[collection]\ngenerator = "figure"\n{table}{rest}', "here")


def test_settings_that_only_version_0_2_used_are_accepted_and_named() -> None:
    runs = Path(__file__).parents[3] / "runs"
    assert load(runs / "freaky-torus" / "config.toml")[0].unused == ["networks.seeds", "variants"]
    assert not load(Path(__file__).parents[3] / "examples" / "freaky-torus.toml")[0].unused


def test_a_run_of_version_0_2_keeps_the_papers_first_step_and_a_new_one_names_its_own(tmp_path: Path) -> None:
    mine, stored = tmp_path / "here.toml", tmp_path / "config.toml"
    mine.write_text(TINY.replace("freaky-torus", "figure", 1))
    new, text = load(mine, stored=stored)
    assert new.exponential.first_step == "centred"
    stored.write_text(text)
    assert load(stored, stored=stored) == (new, text), "a run that is continued"
    assert load(mine, stored=stored) == (new, text)
    stored.write_text(mine.read_text())  # as version 0.2 did
    old, kept = load(mine, stored=stored)
    assert (old.exponential.first_step, kept) == ("paper", mine.read_text())
    stored.write_text("damaged [")
    assert load(mine, stored=stored)[0] == new, "as if there were no run"
    stored.write_text(mine.read_text())
    mine.write_text(f'{mine.read_text()}\n[exponential]\nfirst_step = "centred"\n')
    asked, text = load(mine, stored=stored)
    assert (asked.exponential.first_step, text) == ("centred", mine.read_text())
    assert stage_keys(old, "")["ingest"] == stage_keys(asked, "")["ingest"]
    assert stage_keys(old, "")["mean"] != stage_keys(asked, "")["mean"]


def test_new_settings_are_dumped_only_where_they_are_set() -> None:
    """So stages and networks of version 0.2, which are named by digests of dumps, keep their names."""
    usual, changed = (
        parse(TINY, "a.toml"),
        parse(TINY.replace("count = 60", 'count = 60\ndistribution = "ball"'), "a.toml"),
    )
    assert "distribution" not in usual.samples.model_dump()
    assert changed.samples.model_dump()["distribution"] == "ball"
    assert Config.model_validate(changed.model_dump(mode="json", by_alias=True)) == changed


def test_the_device_is_in_no_key() -> None:
    """Its results differ in rounding only, so a change of the device repeats no stage."""
    on_processor = TINY.replace("[networks.combiner", '[networks]\ndevice = "cpu"\n\n[networks.combiner')
    one, other = (stage_keys(parse(text, "here"), "data") for text in (TINY, on_processor))
    assert one == other
