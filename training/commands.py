"""What the commands ``init``, ``run``, ``status``, ``report`` and ``export`` do."""

from __future__ import annotations

import functools
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import DECODER, MANIFEST
from shapespace.bundle.writer import amend_bundle
from shapespace.command_line import carry_out, near
from shapespace.model.accuracy import measure_accuracy
from shapespace.model.decoder import Decoder
from shapespace.training.collection import init
from shapespace.training.collection.faults import IngestError
from shapespace.training.learning import DeviceError, ExportError
from shapespace.training.report.record import ReportError, require_run
from shapespace.training.runs import workers
from shapespace.training.runs.atomic_files import DamagedFileError
from shapespace.training.runs.config import ConfigError, load
from shapespace.training.runs.directory import NotARunError, RunDirectory, RunInUseError
from shapespace.training.runs.sampling import SamplesError
from shapespace.training.runs.workers import WorkersError
from shapespace.training.space.factors import FactorError
from shapespace.training.space.modes import ModeError
from shapespace.training.stages.mean import MeanError
from shapespace.training.stages.results import lost_files
from shapespace.training.stages.run import STAGES, LostTooMuchError, OldRunError, execute, refuse_old
from shapespace.training.stages.stage import Run, listed

#: Errors whose message is a sentence for the user.
EXPECTED = (
    BundleError,
    ConfigError,
    DamagedFileError,
    DeviceError,
    ExportError,
    FactorError,
    IngestError,
    LostTooMuchError,
    MeanError,
    ModeError,
    NotARunError,
    OldRunError,
    ReportError,
    RunInUseError,
    SamplesError,
    WorkersError,
)
#: The repository, which holds the Makefile, unless this is an installed package.
HOME = Path(__file__).parents[2]


#: Modules that do the same as the programs, where these are not on the PATH.
MODULES = {"shapespace": "shapespace", "shapespace-train": "shapespace.training"}


def _program() -> str:
    """Return the command that calls this program again from here."""
    called, name = Path(sys.argv[0]), str(click.get_current_context().find_root().info_name)
    if called.stem != name:
        return f"{shlex.quote(sys.executable)} -m {MODULES[name]}"
    return name if shutil.which(name) else near(called)


def _serving(models: Path) -> str:
    """Return the command that serves a folder of bundles."""
    setting = f"SHAPESPACE_MODELS_DIR={shlex.quote(str(models.resolve()))} "
    if not (HOME / "Makefile").is_file():
        return f"{setting}shapespace-serve"
    where = "" if Path.cwd() == HOME else f" -C {near(HOME)}"
    return f"{'' if models.resolve() == HOME / 'models' else setting}make{where} serve"


def _open(folder: Path, models: Path) -> Run:
    directory = RunDirectory(folder)
    if not directory.is_run():
        raise ConfigError(
            f"{folder} is not a run directory: it has no config.toml; name a folder that run has "
            "written, such as runs/NAME"
        )
    refuse_old(directory)
    stored = directory.config.path
    return Run(folder, *load(stored, stored=stored), models)


def _command(work: Callable[..., None]) -> Callable[..., int]:
    """Make a command of a function: its errors end with a message, and a traceback goes into the run directory."""

    @functools.wraps(work)
    def command(**options: Any) -> int:
        def finish() -> None:
            try:
                work(**options)
            except KeyboardInterrupt:
                signal.signal(signal.SIGTERM, signal.SIG_IGN)
                workers.stop()
                raise

        def folder() -> Path | None:
            run = options.get("run") or ("config" in options and _folder(options["config"], options["out"]))
            return run if run and RunDirectory(run).was_begun() else None

        return carry_out(
            finish,
            EXPECTED,
            stopped="stopped. The same command continues from here",
            advice="The same command tries the stage again",
            folder=folder,
        )

    return command


@_command
def initialise(meshes: Path, out: Path | None, file: str | None, parts: Sequence[str], force: bool) -> None:
    """Write a configuration for a folder of meshes."""
    written, collection = init.write(meshes, out, force=force, parts=parts, file=file)
    shapes, vertices = collection.vertices.shape[:2]
    print(f"{written}: for {shapes} shapes of {vertices} vertices and {len(collection.faces)} faces")
    for note in (*collection.notes, *(warning.sentence for warning in collection.warnings)):
        print(f"  {note}")
    accept = " ".join(shlex.quote(collection.names[warning.shape]) for warning in collection.warnings if warning.grave)
    if accept:
        print(f"A run would stop at {accept}: correct or remove it. --accept {accept} uses it as it is")
    print(f"Next: {_program()} run {near(written)}" + (f" --accept {accept}" if accept else ""))


@_command
def run(
    config: Path,
    data: Path | None,
    out: Path | None,
    until: str | None,
    scheduler: str | None,
    accept: Sequence[str],
    keep_going: bool,
    models: Path,
) -> None:
    """Train the model of a configuration."""
    folder = _folder(config, out)
    settings, source = load(config, data, RunDirectory(folder).config.path)
    begun = Run(folder, settings, source, models, scheduler, accept)
    again = " ".join([_program(), *map(shlex.quote, sys.argv[1:])])
    _execute(begun, until, keep_going=keep_going, command=again)
    if until not in (None, "export"):
        print(f"Done up to {until}. The same command without --until continues from there")
    else:
        print(f"{near(begun.bundle)} is ready. Next: {_serving(begun.models)}")


def _folder(config: Path, out: Path | None) -> Path:
    """Return the run directory of a configuration."""
    return out or Path("runs") / config.stem


def _execute(run: Run, until: str | None = None, *, keep_going: bool, command: str = "") -> None:
    """Do the stages that are not done yet, then write the report if it is out of date."""
    done = execute(run, until, keep_going=keep_going, command=command)
    directory = run.directory
    if directory.evaluation.exists() and (done or not directory.report.exists()):
        from shapespace.training.report.page import write_report

        print(f"report: {write_report(directory)}")


@_command
def status(run: Path) -> None:
    """Show which stages of a run are done."""
    directory = RunDirectory(run)
    require_run(directory)
    begun = ": ".join(filter(None, ("begun", directory.at_work())))
    lost = list(lost_files(STAGES.values(), directory))
    for name in STAGES:
        stamp = directory.stamp(name).read_if_written()
        state = f"done in {stamp['seconds']:.0f} s" if "seconds" in stamp else begun if "key" in stamp else "to do"
        if faults := [f"{path.relative_to(directory.folder)} is {why}" for stage, path, why in lost if stage == name]:
            state = f"to do again: {listed(faults)}"
        print(f"{name:{max(map(len, STAGES))}} {state}")


@_command
def report(run: Path) -> None:
    """Write the report of a run."""
    from shapespace.training.report.page import write_report

    print(write_report(RunDirectory(run)))


@_command
def export(run: Path, models: Path) -> None:
    """Finish a run and write its bundle, or add ``decoder.onnx`` to a bundle."""
    if (run / MANIFEST).is_file() and not (run / "config.toml").exists():
        _complete(run.resolve())
        return
    opened = _open(run, models)
    _execute(opened, keep_going=True)
    print(f"{near(opened.bundle)} is ready. Next: {_serving(opened.models)}")


def _complete(folder: Path) -> None:
    """Write what this version exports and older ones did not: ``decoder.onnx``, ``auto_error`` and the card."""
    from shapespace.training.learning.decoder_graph import decoder_graph

    bundle = read_bundle(folder)
    decoder = Decoder(bundle)
    made = decoder_graph(bundle, decoder)
    amend_bundle(folder, made, auto_error=measure_accuracy(decoder).auto_error)
    print(f"{near(folder)} has {DECODER} now" if made.entry else f"{near(folder)} has no {DECODER}: {made.absent}")
