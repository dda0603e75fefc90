"""The served bundles by name and version, which can be reloaded while requests run."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from shapespace.bundle.reader import BundleError, check_place, manifest_digest, read_bundle, read_files
from shapespace.files.limits import in_words
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.process_memory import trim_heap
from shapespace.service.limits.sandbox_messages import (
    ClosedError,
    DiedError,
    FailedError,
    LateError,
    OutOfMemoryError,
    SandboxError,
    in_a_line,
)
from shapespace.service.logs import printable
from shapespace.service.refusals import RefusedError
from shapespace.service.repository.validation import BundleValidator, bundle_folders
from shapespace.service.versions import DefaultVersions, DefaultVersionsError

logger = logging.getLogger(__name__)

#: State of a folder of bundles: (path, size, time of change, inode) of each file.
Signature = tuple[tuple[str, int, int, int], ...]


Models = Mapping[str, Mapping[int, ShapeModel]]


@dataclass(frozen=True)
class Changes:
    """Result of a reload: bundles as NAME/VERSION, or failed if the folder could not be read and nothing changed."""

    loaded: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    failed: bool = False


class ModelRepository:
    """All valid bundles of a folder.

    The server reads a bundle only after a separate process has loaded and run it once, and only if it is unchanged
    since. An invalid bundle is refused with one line in the log; the others are served. A reload never alters a model
    in use. It builds new models and then replaces the whole list at once. A request keeps the model that it holds, and
    no request sees half of a change.

    Args:
        folder: holds NAME/VERSION/; hidden entries and plain files are ignored.
        threads: number of shapes that a model may compute at once.
        validator: validation that has begun already, for the first load.
        defaults: versions that answer requests without a version.
        file: file with more default versions, which every reload reads again. ``defaults`` wins over it.
    """

    def __init__(
        self,
        folder: Path,
        threads: int = 1,
        validator: BundleValidator | None = None,
        defaults: DefaultVersions | None = None,
        file: Path | None = None,
    ) -> None:
        self._folder, self._threads = folder, threads
        self._given, self._file, self._filed = defaults or DefaultVersions(), file, DefaultVersions()
        # Replaced in one step, so that no request sees new models with old default versions.
        self._served: tuple[Models, DefaultVersions] = {}, self._given
        self._validator, self._closed = validator or BundleValidator(), False
        #: Bundles that the latest reload refused, faults of default versions, and signature of the folder before it.
        self.refused: list[str] = []
        self.faults: list[str] = []
        self.seen: Signature = ()
        self.reload()

    def reload(self) -> Changes:
        """Load the folder as it is now. Do not call it twice at once; it never raises because of a bundle.

        A model whose bundle is identical byte for byte stays. If a bundle has become invalid, its old model stays. If
        the folder cannot be read, every model stays.
        """
        try:
            return self._reload(self._validator)
        finally:
            self._validator.close()
            self._validator = BundleValidator()  # it starts no process before there is a bundle to validate
            if self._closed:
                self._validator.close()

    def _reload(self, validator: BundleValidator) -> Changes:
        self.seen = self.signature()  # first, so that changes from now on are noticed
        try:
            folders, unreadable = bundle_folders(self._folder)
        except OSError as error:
            logger.error("the models folder can't be read, so nothing changes: %s", in_words(error))
            self._serve(self._served[0])
            return Changes(failed=True)
        changes = Changes()
        before = {(model.manifest.name, model.manifest.version): model for model in self.all()}
        models: dict[str, dict[int, ShapeModel]] = {}

        def serve(model: ShapeModel) -> None:
            models.setdefault(model.manifest.name, {})[int(model.manifest.version)] = model

        validator.begin(folder for folder in folders if _is_new(folder, before.get((folder.parent.name, folder.name))))
        for folder in folders:
            place = printable(f"{folder.parent.name}/{folder.name}")
            model = before.pop((folder.parent.name, folder.name), None)
            try:
                new = self._load(folder, model, validator)
                if new is not model:
                    changes.loaded.append(place)
                    logger.info("bundle %s is served", place)
                serve(new)
            except ClosedError:
                return Changes()
            except Exception as error:  # one bundle must not keep the others from being served
                changes.refused.append(place)
                if model is None:
                    logger.error("bundle %s is not served: %s", place, _reason(error))
                else:
                    logger.error("bundle %s is refused, and the bundle loaded before stays: %s", place, _reason(error))
                    serve(model)
        for folder, fault in unreadable.items():
            changes.refused.append(printable(folder.name))
            logger.error("%s can't be read, so it stays as it was: %s", printable(folder.name), in_words(fault))
            for key in [key for key in before if key[0] == folder.name]:
                serve(before.pop(key))
        for name, version in before:
            changes.removed.append(f"{name}/{version}")
            logger.info("bundle %s/%s is gone and no longer served", name, version)
        self.refused = changes.refused
        self._serve(models)
        if changes.loaded or changes.removed:
            trim_heap()
        return changes

    def _serve(self, models: Models) -> None:
        """Serve these models, with the default versions that the file names now."""
        faults = []
        try:
            self._filed = DefaultVersions.read(self._file) if self._file else self._filed
        except DefaultVersionsError as error:
            faults.append(f"The default versions stay as they were. {error}")
        defaults = self._given.over(self._filed)
        self._served, self.faults = (models, defaults), faults + defaults.faults(models)
        for fault in self.faults:
            logger.error("%s", fault)

    def close(self) -> None:
        """End running validations; their bundles stay as they are."""
        self._closed = True
        self._validator.close()

    def _load(self, folder: Path, model: ShapeModel | None, validator: BundleValidator) -> ShapeModel:
        """Return the model of a bundle: the present one, or a new one if the bundle has changed."""
        check_place(folder)
        if model is not None and manifest_digest(folder) == model.digest:
            read_files(folder, model.manifest)
            return model
        return ShapeModel(read_bundle(folder, validator.digest(folder)), self._threads)

    def signature(self) -> Signature:
        """Return the state of the folder and of the file, which changes with any bundle, without reading bundles."""
        paths = [self._file] if self._file else []
        with suppress(OSError):  # the folder is changing; the next check compares again
            for folder in bundle_folders(self._folder)[0]:
                paths.append(folder)
                with suppress(OSError):
                    paths += folder.iterdir()
        found = []
        for path in paths:
            with suppress(OSError):
                status = path.stat(follow_symlinks=path == self._file)
                found.append((str(path), status.st_size, status.st_mtime_ns, status.st_ino))
        return tuple(sorted(found))

    def __iter__(self) -> Iterator[ShapeModel]:
        """Iterate over the models by name, each in the version that answers requests without a code."""
        models, defaults = self._served
        return (versions[defaults.choose(name, versions)] for name, versions in sorted(models.items()))

    def __len__(self) -> int:
        return len(self._served[0])

    def all(self) -> Iterator[ShapeModel]:
        """Return every version of every model."""
        return (model for versions in self._served[0].values() for model in versions.values())

    def versions(self, name: str) -> list[str]:
        """Return the versions of a model, oldest first; raises RefusedError, unknown-model."""
        return [str(version) for version in sorted(_named(name, self._served[0]))]

    def share(self, model: ShapeModel) -> float:
        """Return the share of the codes, from 0 to 1, that a model answers if requests name no version."""
        (models, defaults), name = self._served, model.manifest.name
        return defaults.share(name, int(model.manifest.version), models[name]) if name in models else 0.0

    def divides(self, name: str) -> bool:
        """Return whether several versions of a model answer requests without a version, each its share."""
        models, defaults = self._served
        return defaults.divides(name, models.get(name, {}))

    def get(self, name: str, version: str | None = None, key: bytes | None = None) -> ShapeModel:
        """Return a model; raises RefusedError, unknown-model or unknown-version.

        Args:
            name: name of the model.
            version: its version; by default what ``DefaultVersions.choose`` chooses.
            key: what ``DefaultVersions.choose`` divides requests by.
        """
        models, defaults = self._served
        versions = _named(name, models)
        if version is None:
            return versions[defaults.choose(name, versions, key)]
        for number, model in versions.items():
            if str(number) == version:
                return model
        known = ", ".join(map(str, sorted(versions)))
        raise RefusedError(
            "unknown-version",
            f"{name} has no version {version!r}. Choose one of {known}, or none for the default version.",
        )

    def by_digest(self, prefix: str) -> ShapeModel | None:
        """Return the model whose digest begins with ``prefix``."""
        return next((model for model in self.all() if model.digest.startswith(prefix)), None)


def _named(name: str, models: Models) -> Mapping[int, ShapeModel]:
    if name not in models:
        known = ", ".join(sorted(models)) or "none at the moment"
        raise RefusedError("unknown-model", f"There is no model {name!r}. /v1/models lists the models: {known}.")
    return models[name]


def _is_new(folder: Path, model: ShapeModel | None) -> bool:
    """Return whether a folder holds a bundle that differs from the served model."""
    try:
        check_place(folder)
        return model is None or manifest_digest(folder) != model.digest
    except (BundleError, OSError):
        return False  # loading the bundle reports the reason


def _reason(error: Exception) -> str:
    """Return the fault of a bundle in one line."""
    match error:
        case FailedError(kind=FailedError.UNEXPECTED) | DiedError() | LateError() | OutOfMemoryError():
            text = f"loaded in a separate process, {error}"
        case SandboxError() | BundleError():
            text = str(error)
        case OSError():
            text = in_words(error)
        case _:
            text = in_a_line(error)
    return " ".join(text.split())
