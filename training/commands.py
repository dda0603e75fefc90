"""What the commands of ``shapespace-train`` do, and how their errors are told."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import DECODER, MANIFEST
from shapespace.bundle.writer import add_decoder
from shapespace.files.limits import in_words
from shapespace.model.decoder import Decoder
from shapespace.training.collection import init
from shapespace.training.collection.faults import IngestError
from shapespace.training.learning import ExportError
from shapespace.training.report.record import ReportError, require_run
from shapespace.training.runs import workers
from shapespace.training.runs.atomic_files import DamagedFileError
from shapespace.training.runs.config import ConfigError, load
from shapespace.training.runs.directory import NotARunError, RunDirectory
from shapespace.training.runs.sampling import SamplesError
from shapespace.training.runs.workers import WorkersError
from shapespace.training.space.factors import FactorError
from shapespace.training.space.modes import ModeError
from shapespace.training.stages.mean import MeanError
from shapespace.training.stages.results import lost_files
from shapespace.training.stages.run import STAGES, LostTooMuchError, OldRunError, execute, refuse_old
from shapespace.training.stages.stage import Run, listed

#: Exit codes: a fault of the input or of the machine, and a defect of the program (EX_SOFTWARE).
FAILURE, DEFECT = 1, 70
#: Errors whose message is a sentence for the user.
EXPECTED = (
    BundleError,
    ConfigError,
    DamagedFileError,
    ExportError,
    FactorError,
    IngestError,
    LostTooMuchError,
    MeanError,
    ModeError,
    NotARunError,
    OldRunError,
    ReportError,
    SamplesError,
    WorkersError,
)
#: The repository, which holds the Makefile, unless this is an installed package.
HOME = Path(__file__).parents[2]


def _here(path: Path) -> str:
    """Return a path as a user can type it in the working directory."""
    near = os.path.relpath(path)
    return shlex.quote(str(path.resolve()) if near.startswith(os.path.join("..", "..")) else near)


def _program() -> str:
    """Return the command that calls this program again from here."""
    called = Path(sys.argv[0])
    if called.name != "shapespace-train":
        return f"{shlex.quote(sys.executable)} -m shapespace.training"
    return called.name if shutil.which(called.name) else _here(called)


def _serving(models: Path) -> str:
    """Return the command that serves a folder of bundles."""
    setting = f"SHAPESPACE_MODELS_DIR={shlex.quote(str(models.resolve()))} "
    if not (HOME / "Makefile").is_file():
        return f"{setting}shapespace-serve"
    where = "" if Path.cwd() == HOME else f" -C {_here(HOME)}"
    return f"{'' if models.resolve() == HOME / 'models' else setting}make{where} serve"


def _open(folder: Path, models: Path) -> Run:
    directory = RunDirectory(folder)
    if not directory.is_run():
        raise ConfigError(
            f"{folder} is not a run directory: it has no config.toml; name a folder that run has "
            "written, such as runs/NAME"
        )
    refuse_old(directory)
    return Run(folder, *load(directory.config.path), models)


def _init(arguments: argparse.Namespace) -> None:
    out, collection = init.write(
        arguments.meshes, arguments.out, force=arguments.force, parts=arguments.parts, file=arguments.file
    )
    shapes, vertices = collection.vertices.shape[:2]
    print(f"{out}: for {shapes} shapes of {vertices} vertices and {len(collection.faces)} faces")
    for note in (*collection.notes, *(warning.sentence for warning in collection.warnings)):
        print(f"  {note}")
    accept = " ".join(shlex.quote(collection.names[warning.shape]) for warning in collection.warnings if warning.grave)
    if accept:
        print(f"A run would stop at {accept}: correct or remove it, or use it as it is with --accept {accept}")
    print(f"Next: {_program()} run {_here(out)}")


def _run(arguments: argparse.Namespace) -> None:
    config, source = load(arguments.config, arguments.data)
    folder = _folder(arguments)
    run = Run(folder, config, source, arguments.models, arguments.scheduler, arguments.accept)
    again = " ".join([_program(), *map(shlex.quote, sys.argv[1:])])
    _execute(run, arguments.until, keep_going=arguments.keep_going, command=again)
    if arguments.until not in (None, "export"):
        print(f"Done up to {arguments.until}. The same command without --until continues from there")
    else:
        print(f"{_here(run.bundle)} is ready. Next: {_serving(run.models)}")


def _execute(run: Run, until: str | None = None, *, keep_going: bool, command: str = "") -> None:
    """Do the stages that are not done yet, then write the report if it is out of date."""
    done = execute(run, until, keep_going=keep_going, command=command)
    directory = run.directory
    if directory.evaluation.exists() and (done or not directory.report.exists()):
        from shapespace.training.report.page import write_report

        print(f"report: {write_report(directory)}")


def _folder(arguments: argparse.Namespace) -> Path:
    """Return the run directory of a command line; ``init`` has none."""
    if "run" in arguments:
        return Path(arguments.run)
    return Path(arguments.out or Path("runs") / arguments.config.stem)


def _status(arguments: argparse.Namespace) -> None:
    directory = RunDirectory(arguments.run)
    require_run(directory)
    begun = ": ".join(filter(None, ("begun", directory.at_work())))
    lost = list(lost_files(STAGES.values(), directory))
    for name in STAGES:
        stamp = directory.stamp(name).read_if_written()
        state = f"done in {stamp['seconds']:.0f} s" if "seconds" in stamp else begun if "key" in stamp else "to do"
        if faults := [f"{path.relative_to(directory.folder)} is {why}" for stage, path, why in lost if stage == name]:
            state = f"to do again: {listed(faults)}"
        print(f"{name:12} {state}")


def _report(arguments: argparse.Namespace) -> None:
    from shapespace.training.report.page import write_report

    print(write_report(RunDirectory(arguments.run)))


def _export(arguments: argparse.Namespace) -> None:
    if (arguments.run / MANIFEST).is_file() and not (arguments.run / "config.toml").exists():
        _add_decoder(arguments.run.resolve())
        return
    run = _open(arguments.run, arguments.models)
    _execute(run, keep_going=True)
    print(f"{_here(run.bundle)} is ready. Next: {_serving(run.models)}")


def _add_decoder(folder: Path) -> None:
    """Write ``decoder.onnx`` into a bundle that has none, or replace it."""
    from shapespace.training.learning.decoder_graph import decoder_graph

    bundle = read_bundle(folder)
    made = decoder_graph(bundle, Decoder(bundle))
    add_decoder(folder, made)
    print(f"{_here(folder)} has {DECODER} now" if made.entry else f"{_here(folder)} has no {DECODER}: {made.absent}")


def _keep_traceback(arguments: argparse.Namespace) -> Path:
    """Write the traceback of the current exception into the run directory, or into a temporary folder."""
    text = traceback.format_exc()
    folders = [] if "meshes" in arguments else [_folder(arguments)]
    runs = [folder for folder in folders if RunDirectory(folder).was_begun()]
    for folder in (*runs, Path(tempfile.mkdtemp())):
        path = RunDirectory(folder).traceback.path
        try:
            path.write_text(text, encoding="utf-8")
        except OSError:
            continue
        break
    return path


_COMMANDS = {"init": _init, "run": _run, "status": _status, "report": _report, "export": _export}


def carry_out(arguments: argparse.Namespace) -> int:
    """Do what a command line says and return the exit code. Every error ends with a message, not with a traceback."""
    received = [signal.SIGINT]

    def terminate(number: int, _: object) -> None:
        received[0] = signal.Signals(number)
        warnings.filterwarnings("ignore", category=UserWarning, module=r"joblib\b")  # on work that is cut short
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, terminate)
    signal.signal(signal.SIGTERM, terminate)
    try:
        _COMMANDS[arguments.command](arguments)
    except EXPECTED as error:
        return _fail(str(error))
    except OSError as error:
        return _fail(in_words(error))
    except KeyboardInterrupt:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        workers.stop()
        print("\nshapespace-train: stopped. The same command continues from here", file=sys.stderr)
        return 128 + received[0]  # as shells report the end by a signal
    except Exception as error:
        what = " ".join(str(error).split())[:300]
        print(
            f"shapespace-train: internal error: {type(error).__name__}: {what}\n"
            f"Please report it, and attach {_here(_keep_traceback(arguments))}. The same command tries the stage again",
            file=sys.stderr,
        )
        return DEFECT
    return 0


def _fail(sentence: str) -> int:
    print(f"shapespace-train: {sentence}", file=sys.stderr)
    return FAILURE
