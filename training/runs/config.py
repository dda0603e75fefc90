"""The typed configuration of a run, read from TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import ValidationError, model_validator

from shapespace.shell.energy import Material
from shapespace.training.runs.network_settings import FitSettings, LatentNetworkSettings, NetworkSettings, Recipe
from shapespace.training.runs.settings import (
    CollectionSettings,
    EvaluationSettings,
    ExportSettings,
    FactorSettings,
    MaterialSettings,
    ModeSettings,
    SampleSettings,
    SettingsTable,
)


class ConfigError(ValueError):
    """A configuration that can't be used, with a line for each fault."""


class VariantSettings(SettingsTable):
    """One row of the ablation: what differs from the main recipe, or from another variant."""

    title: str
    """Its name in the report and the tables."""
    base: str | None = None
    """Name of the variant that this one differs from; it must stand before this one. None is the main recipe."""
    factors: list[dict[str, Any]] | dict[str, Any] = {}
    """Settings of the factor networks that differ: one table for each factor, or one that is applied to all."""
    combiner: dict[str, Any] = {}
    """Settings of the combiner that differ. A correction of another kind starts from that kind's defaults."""

    def applied(self, base: Recipe) -> Recipe:
        """The recipe that results from a base.

        Raises:
            ValueError: as many tables of factors as there are factors in the base are needed.
            ValidationError: settings that can't be used.
        """
        below = base.model_dump(include=set(Recipe.model_fields))
        mine, theirs = self.factors, below["factors"]
        if isinstance(mine, list) or isinstance(theirs, list):
            count = len(theirs if isinstance(theirs, list) else mine)
            theirs = theirs if isinstance(theirs, list) else [theirs] * count
            mine = mine if isinstance(mine, list) else [mine] * count
            if len(mine) != len(theirs):
                raise ValueError(f"factors: {len(mine)} tables over {len(theirs)}")
            factors: Any = [_merged(a, b) for a, b in zip(theirs, mine, strict=True)]
        else:
            factors = _merged(theirs, mine)
        return Recipe.model_validate({"factors": factors, "combiner": _merged(below["combiner"], self.combiner)})


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Nested tables, the values of ``above`` over those of ``below``; a table of another ``kind`` replaces its own."""
    result = dict(below)
    for name, value in above.items():
        old = below.get(name)
        if isinstance(value, dict) and isinstance(old, dict) and value.get("kind", old.get("kind")) == old.get("kind"):
            value = _merged(old, value)
        result[name] = value
    return result


class Config(SettingsTable):
    """What a configuration consists of."""

    collection: CollectionSettings
    material: MaterialSettings = MaterialSettings()
    modes: ModeSettings = ModeSettings()
    factors: FactorSettings = FactorSettings()
    samples: SampleSettings = SampleSettings()
    networks: NetworkSettings = NetworkSettings()
    monolithic: LatentNetworkSettings = LatentNetworkSettings(hidden=[256, 256])
    monolithic_paper: LatentNetworkSettings = LatentNetworkSettings(
        hidden=[256, 256], fourier=0, skip_degree=0, energy=1, fit=FitSettings()
    )
    variants: dict[str, VariantSettings] = {}
    evaluation: EvaluationSettings = EvaluationSettings()
    export: ExportSettings

    @property
    def shell_material(self) -> Material:
        """The elastic material of the shell."""
        return Material(self.material.mu, self.material.lambda_, self.material.eta)

    @cached_property
    def recipes(self) -> dict[str, Recipe]:
        """The full recipe of each variant.

        Raises:
            ValueError: naming the variant and its faults.
        """
        found: dict[str, Recipe] = {}
        for name, variant in self.variants.items():
            if variant.base is not None and variant.base not in found:
                raise ValueError(f"variants.{name}.base: no variant {variant.base!r} stands before it")
            try:
                found[name] = variant.applied(found[variant.base] if variant.base else self.networks)
            except ValidationError as error:
                raise ValueError("; ".join(f"variants.{name}.{fault}" for fault in _faults(error))) from error
            except ValueError as error:
                raise ValueError(f"variants.{name}.{error}") from error
        return found

    @model_validator(mode="after")
    def _usable_variants(self) -> Config:
        for name, recipe in {"networks": self.networks, **self.recipes}.items():
            if recipe.combiner.correction.kind == "field" and self.collection.generator != "freaky-torus":
                raise ValueError(
                    f'{name}: kind = "field" is for features that move over the surface, which only the generator '
                    "freaky-torus has"
                )
        return self


def _faults(error: ValidationError) -> list[str]:
    """One line for each setting that can't be used."""
    words = {"extra_forbidden": "there is no such setting here"}
    faults = ((".".join(map(str, e["loc"])), words.get(e["type"], e["msg"])) for e in error.errors())
    return [": ".join(filter(None, fault)) for fault in faults]


def parse(text: str, source: str) -> Config:
    """Read a configuration from TOML text.

    Raises:
        ConfigError: naming the source and every faulty setting.
    """
    try:
        values: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not TOML: {error}") from error
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        faults = "".join(f"\n  {fault}" for fault in _faults(error))
        raise ConfigError(f"{source}: these settings can't be used{faults}") from error


def load(path: Path, data: Path | None = None, fractions: Sequence[float] = ()) -> tuple[Config, str]:
    """Read a configuration file, and apply the options of the command line to it.

    Args:
        path: of the file.
        data: replaces ``collection.data``.
        fractions: replace ``networks.fractions``.

    Returns:
        The configuration, and the text that says the same from any folder: ``collection.data`` made absolute, the
        arguments written in, all else as it stands.

    Raises:
        ConfigError: naming the file and every faulty setting.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: can't be read: {error}") from error
    config = parse(text, str(path))
    if data is None and config.collection.data is not None:
        data = path.parent / config.collection.data
    if data is not None or fractions:
        document: Any = tomlkit.parse(text)
        if data is not None:
            document["collection"]["data"] = str(data.resolve())
        if fractions:
            document.setdefault("networks", {})["fractions"] = list(fractions)
        text = tomlkit.dumps(document)
        config = parse(text, str(path))
    return config, text
