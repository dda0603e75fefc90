"""The typed configuration of a run, read from TOML."""

from __future__ import annotations

import tomllib
from difflib import get_close_matches
from operator import attrgetter
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import Field, ValidationError, model_validator

from shapespace.files.limits import in_words, read_plain
from shapespace.refused_values import UNKNOWN, in_short
from shapespace.shell.energy import Material
from shapespace.training.runs.network_settings import FitSettings, LatentNetworkSettings, NetworkSettings
from shapespace.training.runs.settings import (
    CollectionSettings,
    EvaluationSettings,
    ExponentialSettings,
    ExportSettings,
    FactorSettings,
    MaterialSettings,
    ModeSettings,
    SampleSettings,
    SettingsTable,
)

#: Settings of version 0.2 that a run reads and ignores.
IGNORED = ("networks.fractions", "networks.seeds", "variants")


#: Sentences about faults, by pydantic's types.
_WORDS = {
    UNKNOWN: "there is no such setting here; remove it or correct its spelling",
    "string_pattern_mismatch": "needs small letters, digits and hyphens only, as in my-model",
}


class ConfigError(ValueError):
    """A configuration that can't be used, with a line for each fault."""


class Config(SettingsTable):
    """The tables of a configuration."""

    collection: CollectionSettings
    material: MaterialSettings = MaterialSettings()
    exponential: ExponentialSettings = ExponentialSettings()
    modes: ModeSettings = ModeSettings()
    factors: FactorSettings = FactorSettings()
    samples: SampleSettings = SampleSettings()
    networks: NetworkSettings = NetworkSettings()
    monolithic: LatentNetworkSettings = LatentNetworkSettings(hidden=[256, 256])
    """The network with one factor for the whole code, trained for comparison if ``evaluation.baselines``."""
    monolithic_paper: LatentNetworkSettings = LatentNetworkSettings(
        hidden=[256, 256], fourier=0, skip_degree=0, energy=1, fit=FitSettings()
    )
    """The paper's network with one factor, trained for comparison if ``evaluation.baselines``."""
    variants: dict[str, dict[str, Any]] = Field({})
    """Not used any more. Version 0.2 trained rows of an ablation; ``python -m benchmarks.studies`` does so now."""
    evaluation: EvaluationSettings = EvaluationSettings()
    export: ExportSettings

    @property
    def shell_material(self) -> Material:
        """The elastic material of the shell."""
        return Material(self.material.mu, self.material.lambda_, self.material.eta)

    @property
    def ineffective(self) -> list[str]:
        """Given settings that change nothing without another setting, with that setting."""
        needs = {
            "evaluation.grid_nodes needs evaluation.baselines": self.evaluation.grid_nodes
            and not self.evaluation.baselines,
            "export.up needs export.faces": "up" in self.export.model_fields_set and self.export.faces is None,
        }
        return [sentence for sentence, unmet in needs.items() if unmet]

    @property
    def unused(self) -> list[str]:
        """Names of the given settings that only version 0.2 used."""
        return [name for name in IGNORED if attrgetter(name)(self)]

    @model_validator(mode="after")
    def _factors_of_all_modes(self) -> Config:
        count, factors = self.modes.count, self.factors
        if count == "auto":  # the stage checks them
            return self
        if factors.modes is not None:
            factors.require_partition(count)
        if factors.count is not None and factors.count > count:
            raise ValueError(f"factors: count = {factors.count} is more than modes.count = {count}")
        return self

    @model_validator(mode="after")
    def _usable_correction(self) -> Config:
        if self.networks.combiner.correction.kind == "field" and self.collection.generator != "freaky-torus":
            raise ValueError(
                'networks: kind = "field" needs features that move over the surface, which only the generator '
                'freaky-torus has; choose "auto"'
            )
        return self


def parse(text: str, source: str) -> Config:
    """Read a configuration from TOML text. Raises ConfigError, which names the source and every faulty setting."""
    try:
        values: dict[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not TOML: {error}") from error
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        faults = [_with_spelling(fault) for fault in error.errors()]
        lines = [f"{source}: these settings can't be used", *in_short(faults, _WORDS)]
        raise ConfigError("\n  ".join(lines)) from error


def _with_spelling(fault: Any) -> dict[str, Any]:
    """Return a fault, with the setting that an unknown name most resembles."""
    if fault["type"] != UNKNOWN:
        return fault
    *way, name = fault["loc"]
    table: Any = Config
    for part in way:
        table = getattr(getattr(table, "model_fields", {}).get(part), "annotation", None)
    near = get_close_matches(str(name), getattr(table, "model_fields", ()), 1)
    return fault | ({"words": f"there is no such setting here; did you mean {near[0]}?"} if near else {})


def load(path: Path, data: Path | None = None, stored: Path | None = None) -> tuple[Config, str]:
    """Read a configuration file.

    ``data`` replaces ``collection.data``. ``stored`` is the configuration in the run directory, which need not exist
    and may be the same file. A run of version 0.2 has no ``exponential.first_step`` there, and keeps the paper's.

    Returns the configuration, and a text with the same meaning in any folder and in later versions:
    ``collection.data`` is absolute, ``exponential.first_step`` is given, all else is as it stands in the file. Raises
    ConfigError, which names the file and every faulty setting.
    """
    config, text = _load(path, data)
    if "first_step" in config.exponential.model_fields_set:
        return config, text
    formula = config.collection.generator == "freaky-torus"  # without exponentials
    if formula or (stored is not None and _is_of_0_2(stored)):
        return config.model_copy(update={"exponential": ExponentialSettings(first_step="paper")}), text
    document: Any = tomlkit.parse(text)
    document.setdefault("exponential", tomlkit.table())["first_step"] = config.exponential.first_step
    return config, tomlkit.dumps(document)


def _is_of_0_2(stored: Path) -> bool:
    """Return whether a run directory has a configuration, without a first step."""
    try:
        return "first_step" not in tomllib.loads(read_plain(stored).decode()).get("exponential", {})
    except (OSError, ValueError):
        return False


def _load(path: Path, data: Path | None = None) -> tuple[Config, str]:
    try:
        text = read_plain(path).decode("utf-8-sig").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path}: can't be read: it is not text in UTF-8; name a configuration, CONFIG.toml"
        ) from error
    except OSError as error:
        hint = "; init writes a configuration for a folder of meshes" if path.is_dir() else ""
        raise ConfigError(f"{path}: can't be read: {in_words(error, named=False)}{hint}") from error
    config = parse(text, str(path))
    if data is None and config.collection.data is not None:
        data = path.parent / config.collection.data
    if data is not None:
        document: Any = tomlkit.parse(text)
        document["collection"]["data"] = str(data.resolve())
        text = tomlkit.dumps(document)
        config = parse(text, str(path))
    return config, text
