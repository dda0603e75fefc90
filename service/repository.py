"""The bundles that are served, by name and version."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

from service.bundle import BundleError, read_bundle
from service.shape_model import ShapeModel

logger = logging.getLogger(__name__)


class UnknownModelError(LookupError):
    """No model of that name."""


class UnknownVersionError(LookupError):
    """The model has no such version."""


class ModelRepository:
    """Every bundle of a folder that can be trusted.

    A bundle that can't is left out with one line in the log, and the others are served.

    Args:
        folder: holds NAME/VERSION/; hidden entries and plain files beside the names are passed over.
        threads: shapes that a model may work on at once.
    """

    def __init__(self, folder: Path, threads: int = 1) -> None:
        self._models: dict[str, dict[int, ShapeModel]] = {}
        for path in _versions(folder):
            try:
                model = ShapeModel(read_bundle(path), threads)
            except (BundleError, OSError) as error:
                reason = " ".join(str(error).split())
                logger.error("bundle %s/%s is not served: %s", path.parent.name, path.name, reason)
            else:
                self._models.setdefault(model.manifest.name, {})[int(model.manifest.version)] = model
                logger.info("bundle %s/%s is served", path.parent.name, path.name)

    def __iter__(self) -> Iterator[ShapeModel]:
        """The newest version of every model, by name."""
        return (versions[max(versions)] for _, versions in sorted(self._models.items()))

    def __len__(self) -> int:
        return len(self._models)

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
                f"{name} has no version {version!r}. Choose one of {', '.join(self.versions(name))}, or none "
                "for the newest."
            )
        return versions[max(versions)]

    def by_digest(self, prefix: str) -> ShapeModel | None:
        """The model whose digest begins with ``prefix``."""
        models = (model for versions in self._models.values() for model in versions.values())
        return next((model for model in models if model.digest.startswith(prefix)), None)

    def _named(self, name: str) -> dict[int, ShapeModel]:
        if name not in self._models:
            known = ", ".join(sorted(self._models)) or "none at the moment"
            raise UnknownModelError(f"There is no model {name!r}. Choose one of those that /v1/models lists: {known}.")
        return self._models[name]


def _versions(folder: Path) -> Iterator[Path]:
    if not folder.is_dir():
        logger.error("there is no folder %s: no models are served", folder)
        return
    for name in sorted(folder.iterdir()):
        if name.name.startswith(".") or not name.is_dir():
            continue
        for version in sorted(name.iterdir()):
            if not version.name.startswith(".") and version.is_dir():
                yield version
