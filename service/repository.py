"""The bundles that are served, by name and version, and how they change while requests run."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from service.bundle import BundleError, read_bundle
from service.memory import give_back
from service.shape_model import ShapeModel

logger = logging.getLogger(__name__)

#: Changes when anything in a folder of bundles does: (path, size, time of change, inode) of each file.
Signature = tuple[tuple[str, int, int, int], ...]


class UnknownModelError(LookupError):
    """No model of that name."""


class UnknownVersionError(LookupError):
    """The model has no such version."""


@dataclass(frozen=True)
class Changes:
    """What a look at the folder found, as NAME/VERSION.

    Attributes:
        loaded: bundles that are new, or other than before.
        removed: bundles that are no longer there.
        refused: bundles that can't be trusted.
    """

    loaded: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)


class ModelRepository:
    """Every bundle of a folder that can be trusted.

    A bundle that can't is left out with one line in the log, and the others are served. A model in use is never
    altered: a reload builds what is new beside it and then puts another list of models in the place of the whole
    list, so that a request which holds a model keeps it, and none sees one half of a change.

    Args:
        folder: holds NAME/VERSION/; hidden entries and plain files beside the names are passed over.
        threads: shapes that a model may work on at once.

    Attributes:
        refused: bundles that the latest look refused.
        seen: the folder's signature before that look.
    """

    def __init__(self, folder: Path, threads: int = 1) -> None:
        self._folder, self._threads = folder, threads
        self._models: Mapping[str, Mapping[int, ShapeModel]] = {}
        self.refused: list[str] = []
        self.seen: Signature = ()
        self.reload()

    def reload(self) -> Changes:
        """Read and verify every bundle again; not to be called twice at once.

        A model whose bundle is the same byte for byte stays as it is. Where a bundle can't be trusted any more, or
        the whole folder is out of reach, what was loaded before stays.
        """
        changes = Changes()
        self.seen = self.signature()  # first, so that what changes from now on makes a difference
        try:
            paths = list(_versions(self._folder))
        except OSError as error:
            logger.error("the models folder can't be read, so that nothing changes: %s", error)
            return changes
        before = {(m.manifest.name, m.manifest.version): m for m in self.all()}
        models: dict[str, dict[int, ShapeModel]] = {}
        for path in paths:
            place = f"{path.parent.name}/{path.name}"
            model = before.pop((path.parent.name, path.name), None)
            try:
                bundle = read_bundle(path)
                if model is None or bundle.digest != model.digest:
                    model = ShapeModel(bundle, self._threads)
                    changes.loaded.append(place)
                    logger.info("bundle %s is served", place)
            except (BundleError, OSError) as error:
                reason = " ".join(str(error).split())
                changes.refused.append(place)
                if model is None:
                    logger.error("bundle %s is not served: %s", place, reason)
                else:
                    logger.error("bundle %s is refused, and what was loaded before stays: %s", place, reason)
            if model is not None:
                models.setdefault(model.manifest.name, {})[int(model.manifest.version)] = model
        for name, version in before:
            changes.removed.append(f"{name}/{version}")
            logger.info("bundle %s/%s is gone and no longer served", name, version)
        self._models, self.refused = models, changes.refused
        if changes.loaded or changes.removed:
            give_back()
        return changes

    def signature(self) -> Signature:
        """Something that differs once any bundle does, without reading one."""
        found = []
        try:
            for version in _versions(self._folder):
                with os.scandir(version) as entries:
                    for entry in entries:
                        status = entry.stat(follow_symlinks=False)
                        found.append((entry.path, status.st_size, status.st_mtime_ns, status.st_ino))
                found.append((str(version), 0, 0, 0))
        except OSError:
            pass  # it is being changed at this moment: the next look will tell
        return tuple(sorted(found))

    def __iter__(self) -> Iterator[ShapeModel]:
        """The newest version of every model, by name."""
        return (versions[max(versions)] for _, versions in sorted(self._models.items()))

    def __len__(self) -> int:
        return len(self._models)

    def all(self) -> Iterator[ShapeModel]:
        """Every version of every model."""
        return (model for versions in self._models.values() for model in versions.values())

    def versions(self, name: str) -> list[str]:
        """Versions of a model, oldest first, by number; raises UnknownModelError."""
        return [str(version) for version in sorted(self._named(name))]

    def get(self, name: str, version: str | None = None) -> ShapeModel:
        """A model, the newest version by default; raises UnknownModelError or UnknownVersionError."""
        versions = self._named(name)
        for number, model in versions.items():
            if str(number) == version:
                return model
        if version is not None:
            raise UnknownVersionError(
                f"{name} has no version {version!r}. Choose one of {', '.join(map(str, sorted(versions)))}, or none "
                "for the newest."
            )
        return versions[max(versions)]

    def by_digest(self, prefix: str) -> ShapeModel | None:
        """The model whose digest begins with ``prefix``."""
        return next((model for model in self.all() if model.digest.startswith(prefix)), None)

    def _named(self, name: str) -> Mapping[int, ShapeModel]:
        models = self._models
        if name not in models:
            known = ", ".join(sorted(models)) or "none at the moment"
            raise UnknownModelError(f"There is no model {name!r}. Choose one of those that /v1/models lists: {known}.")
        return models[name]


def _versions(folder: Path) -> Iterator[Path]:
    """Folders NAME/VERSION; raises OSError."""
    for name in sorted(folder.iterdir()):
        if name.name.startswith(".") or not name.is_dir():
            continue
        for version in sorted(name.iterdir()):
            if not version.name.startswith(".") and version.is_dir():
                yield version
