"""What all stages share: the description of a stage, its warnings, and the run that it works on."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from shapespace.arrays import FloatArray
from shapespace.training.collection.generators import MESHES, PRODUCTS
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.mesh_collection import MeshCollection
from shapespace.training.runs.config import Config, ConfigError
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.runs.sampling import Collection, draw
from shapespace.training.space.shell_collection import ShellCollection
from shapespace.training.space.straight_collection import StraightCollection
from shapespace.training.space.straight_lines import StraightLines

#: A stage stops the run if it loses a larger share of its logarithms or samples.
TOLERATED_LOSS = 0.25
#: A file has this part of the usual number of samples where there are few of them, or each takes long.
SMALLER = 10
#: Most names in a sentence.
LISTED_NAMES = 6


@dataclass(frozen=True)
class StageWarning:
    """One thing that a stage could not do, the lost share of logarithms or samples, and what may help."""

    sentence: str
    share: float = 0.0
    advice: str = ""


def listed(names: list[str]) -> str:
    """Return the first names, and the number of the others."""
    more = f" and {len(names) - LISTED_NAMES} more" if len(names) > LISTED_NAMES else ""
    return ", ".join(names[:LISTED_NAMES]) + more


def read_meshes(config: Config) -> MeshCollection:
    """Read the collection of a run; raises ConfigError where none is named, IngestError where it can't be used."""
    settings = config.collection
    if settings.generator is not None:
        return MESHES[settings.generator]()
    if settings.data is None:
        raise ConfigError("collection.data is missing: set it to the folder of the meshes, or give --data")
    return read_collection(settings.data, settings.parts, settings.file)


class Run:
    """A run: its directory, its configuration with its text, the folder of bundles, and what it needs from outside.

    ``scheduler`` is for workers.run. `ingest` takes the shapes ``accepted`` though their size or vertex order differs.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        source: str,
        models: Path,
        scheduler: str | None = None,
        accepted: Sequence[str] = (),
    ) -> None:
        self.directory, self.config, self.models, self.scheduler = RunDirectory(folder), config, models, scheduler
        self.accepted, self.source = accepted, source

    @property
    def by_design(self) -> bool:
        """Whether the collection is a product whose generator gives factors and bounds."""
        return self.config.collection.generator in PRODUCTS

    @cached_property
    def meshes(self) -> MeshCollection:
        """The meshes to compute with; raises the errors of `read_meshes`, and IngestError if some must be accepted."""
        meshes = read_meshes(self.config)
        meshes.require_accepted(self.accepted)
        return meshes

    @cached_property
    def collection(self) -> Collection:
        """The parametrised collection. A collection of meshes has one after the stage `factors`."""
        generator = self.config.collection.generator
        if generator in PRODUCTS:
            return PRODUCTS[generator]()
        factors, modes = self.directory.factors.read(), self.directory.modes.read()
        grouped = dict(zip(factors["names"], factors["factors"], strict=True))
        scale, codes = float(self.directory.reference.read()["scale"]), self.directory.training_codes()
        if kind := self.directory.straight_kind():
            field = modes["vertices" if kind == "vertices" else "nric" if kind == "nric" else "differential"]
            lines = StraightLines(
                kind=kind,
                reference=self.directory.mean_mesh(),
                mean=modes["mean"],
                modes=field.reshape(len(field), -1),
                weights=np.ones(modes["mean"].shape),
                coefficients=codes,
            )
            return StraightCollection(lines, modes["lower"], modes["upper"], grouped, scale)
        return ShellCollection(
            reference=self.directory.mean_mesh(),
            modes=modes["vertices"],
            lower=modes["lower"],
            upper=modes["upper"],
            factors=grouped,
            steps=self.config.samples.steps or self.directory.steps(),
            first_step=self.config.exponential.first_step,
            material=self.config.shell_material,
            scale=scale,
            codes=codes,
        )

    @property
    def bundle(self) -> Path:
        """Folder of the bundle."""
        return self.models / self.config.export.name / str(self.config.export.version)

    def draw(
        self,
        folder: Path,
        latents: FloatArray,
        title: str,
        *,
        shorten: bool,
        collection: Collection | None = None,
        few: bool = False,
    ) -> None:
        """Compute samples of codes (n, m) into a folder, and log the progress; see sampling.draw. Where they are few,
        files are smaller, so that all cores have work.
        """
        size = self.config.samples.part_size
        parts = draw(
            collection or self.collection,
            folder,
            latents,
            max(1, size // SMALLER) if few else size,
            title,
            shorten=shorten,
            scheduler=self.scheduler,
        )
        for done, total, failed in parts:
            self.directory.log("progress", what=title, done=done, total=total, failed=failed)


@dataclass(frozen=True)
class Stage:
    """One stage of a run."""

    name: str  # name on the command line and in the run directory
    # Version of the numerics. Raise it in the commit after which the same settings and input give other numbers.
    version: int
    # the part of the configuration that the stage reads
    settings: Callable[[Config], Sequence[BaseModel | dict[str, Any]]]
    run: Callable[[Run], None]  # does the stage. It continues from what an interrupted call has left
    # Paths that are removed where the settings, the version or an earlier stage has changed. Files are removed at once,
    # because a reader would take them for current. Folders of samples are removed when the stage begins, because the
    # change may be taken back until then.
    results: Callable[[RunDirectory], Sequence[Path]]
    # files that the stage writes too, and that stay where its settings change
    rewrites: Callable[[RunDirectory], Sequence[Path]] = lambda _: []
    # what the finished stage could not do, read from its files
    warnings: Callable[[RunDirectory], list[StageWarning]] = lambda _: []
    # settings that may change without removing folders, since the stage adds what is missing
    amounts: frozenset[str] = frozenset()
    meshes_only: bool = False  # whether a product by design skips the stage

    def keys(self, config: Config, before: str) -> dict[str, str]:
        """Return digests of the input of the stage: ``key`` of all input, ``basis`` of all input but the amounts.

        ``before`` is the key of the stage before, or of the data.
        """
        settings = [s if isinstance(s, dict) else s.model_dump(mode="json") for s in self.settings(config)]
        rest = [{k: v for k, v in s.items() if k not in self.amounts} for s in settings]

        def digest(read: list[dict[str, Any]]) -> str:
            return hashlib.sha256(json.dumps([self.name, self.version, read, before]).encode()).hexdigest()

        return {"key": digest(settings), "basis": digest(rest)}


def against_failures(run: RunDirectory) -> str:
    """Return what helps if logarithms or samples fail. More vertices help only if the meshes were simplified."""
    setting, mesh = ("collection.coarse_vertices or ", "coarse mesh") if run.prolongation.exists() else ("", "mesh")
    return f"a larger {setting}material.eta, because the usual cause is a thin or folded part of the {mesh}"
