"""The stages of a run, in order: what each reads of the configuration, what it leaves, and when it is done again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from shapespace.training.runs.config import Config, ModeSettings
from shapespace.training.runs.directory import RunDirectory


@dataclass(frozen=True)
class Stage:
    """One stage.

    Attributes:
        version: of its numerics. Raise it in the commit after which the same settings and input give other numbers.
        settings: the part of the configuration that it reads.
        results: what is removed where that part, the version, or an earlier stage has changed: files at once, as they
            would be taken for current, folders of samples when the stage begins, as the change may be taken back.
        amounts: settings that may change without it, since the stage knows what is there and what is missing.
    """

    version: int
    settings: Callable[[Config], Sequence[BaseModel | dict[str, Any]]]
    results: Callable[[RunDirectory], Sequence[Path]] = lambda run: ()
    amounts: frozenset[str] = frozenset()

    def keys(self, name: str, config: Config, before: str) -> dict[str, str]:
        """See `stage_keys`; ``before`` is the key of the stage before, or of the data."""
        settings = [s if isinstance(s, dict) else s.model_dump(mode="json") for s in self.settings(config)]
        rest = [{k: v for k, v in s.items() if k not in self.amounts} for s in settings]

        def digest(read: list[dict[str, Any]]) -> str:
            return hashlib.sha256(json.dumps([name, self.version, read, before]).encode()).hexdigest()

        return {"key": digest(settings), "basis": digest(rest)}


def _of_mean(modes: ModeSettings) -> ModeSettings:
    """K, and where that is chosen the number of modes by which it is."""
    if modes.log_steps == "auto":
        return ModeSettings(count=modes.count)
    return ModeSettings(log_steps=modes.log_steps)


STAGES: dict[str, Stage] = {
    "ingest": Stage(
        version=1,
        settings=lambda config: [config.collection],
        results=lambda run: [
            run.reference.path,
            run.prolongation.path,
            run.shapes.path,
            run.ingest.path,
            run.surface.path,
            run.surface_names.path,
        ],
    ),
    "mean": Stage(
        version=3,
        settings=lambda config: [config.material, _of_mean(config.modes)],
        results=lambda run: [run.mean.path],
    ),
    "modes": Stage(
        version=2,
        settings=lambda config: [config.modes],
        results=lambda run: [run.modes_by_strength.path, run.modes.path, run.decomposition.path],
    ),
    "factors": Stage(
        version=1,
        settings=lambda config: [config.factors],
        results=lambda run: [run.factors.path],
    ),
    "samples": Stage(
        version=1,
        settings=lambda config: [config.samples],
        results=lambda run: [run.samples],
        amounts=frozenset({"count", "factor_counts", "shapes", "derivatives"}),
    ),
    # Networks are in files named by what decides their contents, so that a change leaves alone those it doesn't touch.
    "networks": Stage(
        version=5,
        settings=lambda config: [
            config.networks,
            config.monolithic,
            config.monolithic_paper,
            *config.variants.values(),
        ],
        results=lambda run: [run.histories.path],
    ),
    "generalisation": Stage(
        version=1,
        settings=lambda config: [],
        results=lambda run: [run.generalisation.path, run.least_general.path],
    ),
    "evaluation": Stage(
        version=2,
        settings=lambda config: [config.evaluation, config.export.model_dump(include={"eta_reconstruction"})],
        results=lambda run: [run.evaluation.path, run.gallery.path, run.report.path, run.exact],
    ),
    "export": Stage(
        version=1,
        settings=lambda config: [config.export],
        results=lambda run: [run.encoded.path, run.least_near.path],
    ),
}


def stage_keys(config: Config, data: str) -> dict[str, dict[str, str]]:
    """For each stage digests of what it depends on: ``key`` of everything, ``basis`` of all but its amounts.

    Args:
        config: of the run.
        data: identifies the files of the collection.
    """
    found: dict[str, dict[str, str]] = {}
    for name, stage in STAGES.items():
        found[name] = stage.keys(name, config, data)
        data = found[name]["key"]
    return found
