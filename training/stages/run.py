"""The stages of a run in order. Only stages whose settings, input or version have changed are done again."""

import json
import shutil
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from shapespace.bundle.writer import require_replaceable
from shapespace.training.collection.faults import Fault, IngestError
from shapespace.training.collection.listing import data_files
from shapespace.training.runs.atomic_files import DamagedFileError
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import NotARunError, RunDirectory
from shapespace.training.runs.progress import stage_place
from shapespace.training.stages import (  # fmt: skip
    STAGE_NAMES,
    evaluation,
    export,
    factors,
    generalisation,
    ingest,
    mean,
    modes,
    networks,
    samples,
)
from shapespace.training.stages.results import LostFile, bundle_fault, file_facts, lost_files, written
from shapespace.training.stages.stage import TOLERATED_LOSS, Run, Stage, StageWarning

_MODULES = (ingest, mean, modes, factors, samples, networks, generalisation, evaluation, export)
STAGES: dict[str, Stage] = {name: module.STAGE for name, module in zip(STAGE_NAMES, _MODULES, strict=True)}


class OldRunError(ValueError):
    """A run of version 0.1, which can't be continued."""


class LostTooMuchError(RuntimeError):
    """A stage lost too many logarithms or samples. Its files stay, and the message says how to continue."""


def refuse_old(directory: RunDirectory) -> None:
    """Raise OldRunError for a run of version 0.1: its files and settings may have another meaning today."""
    if directory.is_of_0_1():
        raise OldRunError(
            f"{directory.folder} is a run of version 0.1, which can't be continued or exported; run its "
            "configuration again with another folder as --out"
        )


def stage_keys(config: Config, data: str) -> dict[str, dict[str, str]]:
    """Return the digests of each stage by its name, see Stage.keys; ``data`` identifies the files of the collection."""
    found: dict[str, dict[str, str]] = {}
    for name, stage in STAGES.items():
        found[name] = stage.keys(config, data)
        data = found[name]["key"]
    return found


def execute(
    run: Run,
    until: str | None = None,
    *,
    keep_going: bool = False,
    command: str = "",
    show: Callable[[str], None] = print,
) -> bool:
    """Do the stages that are not done yet, by default all, up to and including ``until``. Return whether any was done.

    ``command`` continues this run, for messages; ``show`` receives one line at a time.

    Raises:
        LostTooMuchError: more than a quarter of the logarithms or samples are lost, and ``keep_going`` is false.
        NotARunError: the run directory holds something else, or the collection's data.
        RunInUseError: another process is working on the run.
        BundleError: the place of the bundle holds something else.
        DamagedFileError: a file was damaged, and was so again after its stage had made it anew.
    """
    repaired = set[Path]()
    run.directory.begin()
    _refuse_own_data(run)
    with run.directory.locked():
        while True:
            try:
                return _execute(run, until, keep_going=keep_going, command=command, show=show)
            except DamagedFileError as error:
                if error.path in repaired:
                    raise
                repaired.add(error.path)
                _discard(run.directory, error.path, show)


def _discard(directory: RunDirectory, path: Path, show: Callable[[str], None]) -> None:
    """Remove a damaged file, and have the stage that wrote it make it again."""
    for stage in reversed(STAGES.values()):
        results, begun = stage.results(directory), directory.stamp(stage.name).exists()
        if path in results or set(path.parents) & set(results) or (begun and path in stage.rewrites(directory)):
            _make_again(directory, LostFile(stage.name, path, "damaged"), show)
            return
    path.unlink(missing_ok=True)
    show(f"{path.relative_to(directory.folder)}: is damaged and was removed")


def _make_again(directory: RunDirectory, lost: LostFile, show: Callable[[str], None]) -> None:
    """Remove a lost file, and mark its stage as not done, with later ones that rewrite files of this stage."""
    lost.path.unlink(missing_ok=True)
    results = set(STAGES[lost.stage].results(directory))
    for name, stage in STAGES.items():
        if name == lost.stage or results & set(stage.rewrites(directory)):
            _mark_undone(directory, name)
    removed = " and was removed" if lost.why == "damaged" else ""
    file = lost.path.relative_to(directory.folder)
    show(f"{file}: is {lost.why}{removed}; the stage {lost.stage} computes it again")


def _mark_undone(directory: RunDirectory, name: str) -> None:
    """Take a finished stage for one that was interrupted, so that it begins again."""
    stamp = directory.stamp(name).read_if_written()
    if stamp.pop("seconds", None) is not None:
        directory.stamp(name).write(stamp)


def _check_results(run: Run, until: str | None, show: Callable[[str], None]) -> None:
    """Have the stages up to ``until`` make again what is missing or damaged, and `export` the bundle."""
    directory, order = run.directory, list(STAGES)
    for lost in list(lost_files(STAGES.values(), directory)):
        if until is None or order.index(lost.stage) <= order.index(until):
            _make_again(directory, lost, show)
    exported = "seconds" in directory.stamp("export").read_if_written()
    if until in (None, "export") and exported and (why := bundle_fault(run.bundle)):
        _mark_undone(directory, "export")
        show(f"{run.bundle}: is {why}; the stage export writes it again")


def _execute(run: Run, until: str | None, *, keep_going: bool, command: str, show: Callable[[str], None]) -> bool:
    directory = run.directory
    keys, data = _prepare(run, show)
    _check_results(run, until, show)
    order = list(STAGES)
    if until in (None, "export") and "seconds" not in directory.stamp("export").read_if_written():
        # before hours of work
        materials = directory.surface_names.read_if_written().get("materials", ())
        require_replaceable(run.bundle, [material["texture"] for material in materials])
        if sentence := replaces_another(run):
            show(sentence)
    if until is None or order.index(until) >= order.index("networks"):
        # First: loaded after the libraries that solve other stages' equations, its results differ in the last bits.
        import_module("torch")
        if "seconds" not in directory.stamp("networks").read_if_written():
            import_module("shapespace.training.learning.device").training_device(run.config.networks.device)
    done = False
    for name, stage in STAGES.items():
        stamp = directory.stamp(name).read_if_written()
        if "seconds" in stamp:
            show(f"{name}: done before ({stamp['seconds']:.0f} s)")
        else:
            _do(stage, run, keys[name], stamp, show)
            done = True
        if name == "ingest" and data != directory.data.read_if_written():
            directory.data.write(data)
        warnings = stage.warnings(directory)
        for warning in warnings:
            show(f"  {warning.sentence}")
        if not keep_going:
            _refuse_loss(name, warnings, f"{command} --keep-going" if command else "")
        if name == until:
            break
    return done


def replaces_another(run: Run) -> str:
    """Return a sentence if the run will replace a bundle that it has not written; empty otherwise."""
    own = f"{run.bundle.parent.name}/{run.bundle.name}"
    written = any(event.get("event") == "exported" and event.get("bundle") == own for event in run.directory.events())
    if written or not run.bundle.exists():
        return ""
    return (
        f"{run.bundle} exists, and this run has not written it. The stage export will replace it. To keep it, set "
        "another name or version under [export] in the configuration"
    )


def _prepare(run: Run, show: Callable[[str], None]) -> tuple[dict[str, dict[str, str]], dict[str, dict[str, Any]]]:
    """Remove outdated results and write the configuration. Return the keys of the stages, and facts about the data."""
    directory, source = run.directory, run.config.collection.data
    data, known = _data_facts(run), directory.data.read_if_written()
    if data:  # a run from a generator has none, and is done again where it is of version 0.1
        refuse_old(directory)
    if gone := bool(source and known and not source.exists()):
        data = known
    elif source and known and (changes := _changes(known, data)):
        show(f"data: {changes}; all stages from ingest on run again")
    if unused := run.config.unused:
        show(
            f"{', '.join(unused)}: not used any more; to make these studies of a finished run, use python -m "
            "benchmarks.studies in the repository"
        )
    for sentence in run.config.ineffective:
        show(f"{sentence}, so it has no effect")
    keys = stage_keys(run.config, json.dumps({name: facts["sha256"] for name, facts in data.items()}) if data else "")
    stamp = directory.stamp("ingest").read_if_written()
    changed = stamp.get("key") != keys["ingest"]["key"]
    if gone and not changed:
        show(f"data: {source} does not exist any more; the run continues with the results of ingest")
    elif gone:
        raise IngestError(Fault(str(source), "no such file or folder", "check its name"))
    elif changed and "seconds" in stamp and not run.by_design:
        _ = run.meshes  # raises its errors before results are removed
    _forget(directory, keys, show)
    directory.config.write(run.source)
    return keys, data


def _refuse_own_data(run: Run) -> None:
    """Raise NotARunError if the collection's data are where the run would write or remove its results."""
    source = run.config.collection.data
    results = {path.resolve() for stage in STAGES.values() for path in stage.results(run.directory)}
    places = {source.resolve(), *source.resolve().parents} if source else set()
    if source and (results & places or source.resolve() == run.directory.folder.resolve()):
        raise NotARunError(
            f"the data {source} are where the run {run.directory.folder} writes its results; name another run "
            "directory with --out, or move the data"
        )


def _do(stage: Stage, run: Run, keys: dict[str, str], stamp: dict[str, Any], show: Callable[[str], None]) -> None:
    directory, name = run.directory, stage.name
    if stamp.get("basis") != keys["basis"]:
        for path in filter(Path.is_dir, stage.results(directory)):
            shutil.rmtree(path)
    begun = keys | {"version": stage.version}
    before = directory.spent(name, keys["key"])
    directory.stamp(name).write(begun)
    directory.log("begin", stage=name, key=keys["key"])
    stages = [each for each, other in STAGES.items() if not (run.by_design and other.meshes_only)]
    straight = directory.straight_kind() is not None
    place = f" {stage_place(name, _seconds(directory), stages, straight=straight)}" if name in stages else ""
    show(f"{name} …{place}")
    start = time.monotonic()
    if stage.meshes_only and run.by_design:
        directory.log("skipped", why="the generator gives factors and bounds itself")
    else:
        try:
            stage.run(run)
        except BaseException:
            directory.log("stopped", stage=name)
            raise
    seconds = before + time.monotonic() - start
    directory.stamp(name).write(begun | {"seconds": seconds, "files": written(stage, directory)})
    directory.log("end", stage=name, seconds=round(seconds, 3))
    show(f"{name}: {seconds:.0f} s")


def _seconds(directory: RunDirectory) -> dict[str, float]:
    """Return the seconds of each stage that is done."""
    stamps = {name: directory.stamp(name).read_if_written() for name in STAGES}
    return {name: stamp["seconds"] for name, stamp in stamps.items() if "seconds" in stamp}


def _data_facts(run: Run) -> dict[str, dict[str, Any]]:
    """Return ``bytes``, ``time`` and ``sha256`` of each file of the collection, by name; none of a generator.

    A file is read again only where its size or its time differs from ``data.json``.
    """
    source = run.config.collection.data
    known, found = run.directory.data.read_if_written(), {}
    for path in data_files(source, run.config.collection.file) if source else ():
        name = path.relative_to(source).as_posix() if source and source.is_dir() else path.name
        found[name] = file_facts(path, known.get(name, {}))
    return found


def _changes(before: dict[str, dict[str, Any]], now: dict[str, dict[str, Any]]) -> str:
    def some(word: str, names: set[str]) -> str:
        more = ", …" if len(names) > 3 else ""
        return f"{len(names)} {word} ({', '.join(sorted(names)[:3])}{more})" if names else ""

    changed = {name for name in before.keys() & now.keys() if before[name]["sha256"] != now[name]["sha256"]}
    kinds = {"added": now.keys() - before.keys(), "removed": before.keys() - now.keys(), "changed": changed}
    return ", ".join(filter(None, (some(word, set(names)) for word, names in kinds.items())))


def _forget(directory: RunDirectory, keys: dict[str, dict[str, str]], show: Callable[[str], None]) -> None:
    """Remove stamps and files of other keys, so that all results in the directory belong together."""
    outdated = []
    for name, stage in STAGES.items():
        stamp = directory.stamp(name).read_if_written()
        if stamp.get("key") == keys[name]["key"]:
            continue
        if "key" in stamp:
            if stamp.get("version") != stage.version:
                outdated.append(name)
            directory.stamp(name).write({of: stamp[of] for of in ("basis", "version") if of in stamp})
        for path in stage.results(directory):
            if not path.is_dir():
                path.unlink(missing_ok=True)
    for name in outdated[:1]:
        show(f"{name}: this version of shapespace computes other numbers; the stages from {name} on run again")


def _refuse_loss(stage: str, warnings: list[StageWarning], command: str) -> None:
    grave = [warning for warning in warnings if warning.share > TOLERATED_LOSS]
    if grave:
        why = "; ".join(warning.sentence for warning in grave)
        advice = "; ".join(dict.fromkeys(warning.advice for warning in grave))
        raise LostTooMuchError(
            f"stopped after {stage}: {why}. This is more than a quarter, so the model would be poor.\n"
            f"What may help: {advice}." + (f"\nTo continue nevertheless: {command}" if command else "")
        )
