"""Files that the stages have left: facts about them, and which are missing or damaged since."""

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.training.runs.atomic_files import DamagedFileError, JsonFile, NpzFile
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.stages.stage import Stage


class LostFile(NamedTuple):
    """A result that can't be used any more."""

    stage: str  # name of the stage that makes it again
    path: Path
    why: str  # "missing" or "damaged"


def file_facts(path: Path, known: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``bytes``, ``time`` and ``sha256`` of a file. It is read only where its size or its time is not known."""
    stat = path.stat()
    facts = {"bytes": stat.st_size, "time": stat.st_mtime_ns}
    if all(known.get(fact) == value for fact, value in facts.items()):
        return {**facts, "sha256": known["sha256"]}
    with path.open("rb") as file:
        return {**facts, "sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def written(stage: Stage, run: RunDirectory) -> dict[str, dict[str, Any]]:
    """Return facts about the files of a stage that has just ended, by their paths in the run directory."""
    return {path.relative_to(run.folder).as_posix(): file_facts(path, {}) for path in _files(stage, run)}


def remember(stage: Stage, run: RunDirectory) -> None:
    """Take the files of a finished stage as they are now for its own, after something was added to them."""
    stamp = run.stamp(stage.name)
    if "files" in (before := stamp.read_if_written()):
        stamp.write(before | {"files": written(stage, run)})


def lost_files(stages: Iterable[Stage], run: RunDirectory) -> Iterator[LostFile]:
    """Yield the results of finished stages that are missing or damaged.

    Version 0.2 did not write down what a stage left; then only a file that can't be read counts.
    """
    known: dict[Path, tuple[str, dict[str, Any]]] = {}
    for stage in stages:
        stamp = run.stamp(stage.name).read_if_written()
        for path in stage.rewrites(run) if stamp else ():
            known.pop(path, None)
        if "seconds" not in stamp:
            continue
        if "files" in stamp:
            known |= {run.folder / name: (stage.name, facts) for name, facts in stamp["files"].items()}
        else:
            known |= {path: (stage.name, {}) for path in _files(stage, run)}
    for path, (name, facts) in known.items():
        if not path.is_file():
            yield LostFile(name, path, "missing")
        elif not _intact(path, facts):
            yield LostFile(name, path, "damaged")


def bundle_fault(folder: Path) -> str:
    """Return "missing" or "damaged" for a bundle that can't be served; empty if it can."""
    if not folder.is_dir():
        return "missing"
    try:
        read_bundle(folder)
    except (BundleError, OSError):
        return "damaged"
    return ""


def _files(stage: Stage, run: RunDirectory) -> list[Path]:
    inside = (p for path in stage.results(run) for p in (path.rglob("*") if path.is_dir() else [path]))
    every = (path for path in (*inside, *stage.rewrites(run)) if path.is_file())
    return [path for path in every if path.suffix != ".part" and path != run.report.path]


def _intact(path: Path, facts: Mapping[str, Any]) -> bool:
    """Return whether a file is what its stage left. Samples are large, and read only where size or time differ."""
    large = path.name.startswith("part-")
    if facts:
        return bool(file_facts(path, facts if large else {})["sha256"] == facts["sha256"])
    try:
        if path.suffix == ".json":
            JsonFile(path).read()
        elif path.suffix == ".npz" and not large:
            NpzFile(path).read()
    except DamagedFileError:
        return False
    return True
