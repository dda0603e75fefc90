"""The training command: ``shapespace-train init|run|status|report|export``."""

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

from shapespace.training.collection import init
from shapespace.training.collection.checks import IngestError
from shapespace.training.learning import ExportError
from shapespace.training.report.record import Record, ReportError
from shapespace.training.runs import workers
from shapespace.training.runs.atomic_files import DamagedFileError
from shapespace.training.runs.config import ConfigError, load
from shapespace.training.runs.directory import NotARunError, RunDirectory
from shapespace.training.runs.sampling import SamplesError
from shapespace.training.runs.workers import WorkersError
from shapespace.training.space.factors import FactorError
from shapespace.training.space.modes import ModeError
from shapespace.training.stages.mean import MeanError
from shapespace.training.stages.run import STAGES, LostTooMuchError, OldRunError, execute, refuse_old
from shapespace.training.stages.stage import Run

#: Exit codes: a fault of the input or of the machine, and a defect of the program (EX_SOFTWARE).
FAILURE, DEFECT = 1, 70
#: Errors whose message is a sentence for the user.
EXPECTED = (
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
    OSError,
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
        raise ConfigError(f"{folder} is no run directory: it holds no config.toml")
    refuse_old(directory)
    return Run(folder, *load(directory.config.path), models)


def _init(arguments: argparse.Namespace) -> None:
    out, collection = init.write(arguments.meshes, arguments.out, force=arguments.force)
    shapes, vertices = collection.vertices.shape[:2]
    print(f"{out}: for {shapes} shapes of {vertices} vertices and {len(collection.faces)} faces")
    for note in (*collection.notes, *(warning.sentence for warning in collection.warnings)):
        print(f"  {note}")
    accept = " ".join(shlex.quote(collection.names[warning.shape]) for warning in collection.warnings if warning.grave)
    if accept:
        print(f"A run would stop at {accept}: mend or remove these, or take them as they are with --accept {accept}")
    print(f"Next: {_program()} run {_here(out)}")


def _run(arguments: argparse.Namespace) -> None:
    config, source = load(arguments.config, arguments.data)
    folder = _folder(arguments)
    run = Run(folder, config, source, arguments.models, arguments.scheduler, arguments.accept)
    again = " ".join([_program(), *map(shlex.quote, sys.argv[1:])])
    _execute(run, arguments.until, keep_going=arguments.keep_going, command=again)
    if arguments.until not in (None, "export"):
        print(f"Done up to {arguments.until}; the same command without --until goes on from there")
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
    begun = ": ".join(filter(None, ("begun", Record(directory).at_work)))
    for name in STAGES:
        stamp = directory.stamp(name).read_if_written()
        state = f"done in {stamp['seconds']:.0f} s" if "seconds" in stamp else begun if "key" in stamp else "to do"
        print(f"{name:12} {state}")


def _report(arguments: argparse.Namespace) -> None:
    from shapespace.training.report.page import write_report

    print(write_report(RunDirectory(arguments.run)))


def _export(arguments: argparse.Namespace) -> None:
    run = _open(arguments.run, arguments.models)
    _execute(run, keep_going=True)
    print(f"{_here(run.bundle)} is ready. Next: {_serving(run.models)}")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    top = argparse.ArgumentParser(prog="shapespace-train", description="Learn a shape manifold and export its bundle.")
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    start = commands.add_parser("init", help="write a configuration for a folder of meshes in correspondence")
    start.add_argument("meshes", type=Path, metavar="MESH_DIR", help="OBJ, PLY, STL, OFF or glTF files, or one NPZ")
    start.add_argument("--out", type=Path, metavar="FILE.toml", help="default: the folder's name, here")
    start.add_argument("--force", action="store_true", help="replace the file if it is there")
    start.set_defaults(do=_init)

    run = commands.add_parser("run", help="do the stages of a configuration that are not done yet")
    run.add_argument("config", type=Path, metavar="CONFIG.toml")
    run.add_argument("--data", type=Path, metavar="DIR", help="folder of meshes or NPZ file, instead of the config's")
    run.add_argument("--out", type=Path, metavar="DIR", help="run directory (default: runs/ and the config's name)")
    run.add_argument("--until", choices=list(STAGES), metavar="STAGE", help=f"last stage to do: {', '.join(STAGES)}")
    run.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers draw the samples")
    run.add_argument(
        "--accept",
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="take these shapes though their size or the order of their vertices is another than that of the others",
    )
    run.add_argument(
        "--keep-going", action="store_true", help="go on where more than a quarter of logarithms or samples are lost"
    )
    run.set_defaults(do=_run)

    status = commands.add_parser("status", help="which stages of a run are done")
    status.set_defaults(do=_status)
    report = commands.add_parser("report", help="write RUN/report.html, pictures and figures of what is done so far")
    report.set_defaults(do=_report)
    export = commands.add_parser("export", help="finish a run and write its bundle again")
    export.set_defaults(do=_export)
    for command in (status, report, export):
        command.add_argument("run", type=Path, metavar="RUN")
    for command in (run, export):
        command.add_argument("--models", type=Path, default=Path("models"), help="where bundles go (default: models)")
    return top


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


def main() -> int:
    """Run the command. Every error ends with a message instead of a traceback."""
    arguments = parser().parse_args()
    received = [signal.SIGINT]

    def terminate(number: int, _: object) -> None:
        received[0] = signal.Signals(number)
        warnings.filterwarnings("ignore", category=UserWarning, module=r"joblib\b")  # on work that is cut short
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, terminate)
    signal.signal(signal.SIGTERM, terminate)
    try:
        arguments.do(arguments)
    except EXPECTED as error:
        print(f"shapespace-train: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        workers.stop()
        print("\nshapespace-train: stopped; the same command continues here", file=sys.stderr)
        return 128 + received[0]  # as shells report the end by a signal
    except Exception as error:
        what = " ".join(str(error).split())[:300]
        print(
            f"shapespace-train: something went wrong that should not have: {type(error).__name__}: {what}\n"
            f"Please report it with {_here(_keep_traceback(arguments))}, which says where; the same command tries the "
            "stage again",
            file=sys.stderr,
        )
        return DEFECT
    return 0


if __name__ == "__main__":
    sys.exit(main())
