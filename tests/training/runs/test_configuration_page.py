"""docs/reference/configuration.md is up to date with the settings in training/runs."""

from typing import Literal

import pytest
from pydantic import BaseModel, Field

from scripts import configuration
from scripts.configuration import TARGET, Page, value, words
from shapespace.training.runs.config import Config

SECTIONS = Config.model_json_schema()["$defs"]


def test_the_page_is_what_the_models_say() -> None:
    assert TARGET.read_text(encoding="utf-8") == Page().text(), "make configuration writes it"


@pytest.mark.parametrize("section", SECTIONS)
def test_every_setting_is_there_and_described(section: str) -> None:
    text = Page().text()
    for name, facts in SECTIONS[section]["properties"].items():
        ignored = facts.get("description", "").startswith("Not used any more")
        assert name == "kind" or (f".{name}`" in text if ignored else f"- **`{name}`** (" in text)
        assert name == "kind" or facts.get("description"), name


def test_types_and_bounds_in_words() -> None:
    assert words(list[float] | int | None) == "list of numbers or whole number"
    assert words(Literal["a", "b"]) == '`"a"`, `"b"`'
    fractions = Config.model_fields["networks"].annotation.model_fields["fractions"]
    assert words(fractions.annotation) == "list of numbers, < 1"


class Fit(BaseModel):
    """How."""

    rate: float = 0.5


class Kernel(BaseModel):
    """One way."""

    kind: Literal["kernel"] = "kernel"
    size: int = Field(12, ge=2)
    fit: Fit = Fit(rate=0.25)


class Choice(BaseModel):
    """Values."""

    size: int | Literal["auto"] = "auto"
    fraction: float = Field(0, ge=0, lt=1)
    way: Literal["up", "down"] | None = None
    parts: list[str] = []
    title: str


def test_values_begin_with_their_default() -> None:
    fields = Choice.model_fields.values()
    assert [value(field, field.get_default()) for field in fields] == [
        '`"auto"` or whole number',
        "`0.0`, < 1",
        'one of `"up"`, `"down"`',
        "`[]`, list of text",
        "required",
    ]


class Plain(BaseModel):
    """Another way."""

    kind: Literal["plain"] = "plain"
    fit: Fit = Fit()


class Networks(BaseModel):
    """All networks."""

    fit: Fit = Fit()
    way: Kernel | Plain = Kernel(size=3)
    other: Kernel = Kernel()


class Whole(BaseModel):
    """Everything."""

    networks: Networks = Networks()


def test_a_setting_of_several_kinds_has_a_table_for_each(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(configuration, "Config", Whole)
    text = Page().text()
    assert "See [kernel](#networksway-kernel), [plain](#networksway-plain)." in text
    kernel, plain = text.split("### networks.way (kernel)")[1].split("### networks.way (plain)")
    assert "- **`size`** (`3`, ≥ 2): " in kernel
    assert "- `networks.other`: `size = 12`" in kernel
    assert "Another way." in plain
    fit = text.split("### networks.fit")[1].split("##")[0]
    assert "- `networks.way.fit` (kernel): `rate = 0.25`\n" in fit
    assert "- `networks.way.fit` (plain)\n- `networks.other.fit`: `rate" in fit
    assert text.count("- **`fit`** (table): See") == 1
    assert all("Also `fit` as in [networks](#networks)." in part for part in (kernel, plain))
