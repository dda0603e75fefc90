"""The training command: ``shapespace-train init|run|status|report|export``."""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

from training import init
from training.config import ConfigError, load
from training.export import ExportError
from training.factors import FactorError
from training.ingest import IngestError
from training.modes import ModeError
from training.pipeline import STAGES, Run, execute
from training.record import Record, ReportError
from training.report import write_report
from training.workers import WorkersError

FAILURE = 1


def _open(folder: Path, models: Path) -> Run:
    source = folder / "config.toml"
    if not source.is_file():
        raise ConfigError(f"{folder} is no run directory: it holds no config.toml")
    return Run(folder, *load(source), models)


def _init(arguments: argparse.Namespace) -> None:
    out, collection = init.write(arguments.meshes, arguments.out, force=arguments.force)
    shapes, vertices = collection.vertices.shape[:2]
    print(f"{out}: for {shapes} shapes of {vertices} vertices and {len(collection.faces)} faces")
    for note in collection.notes:
        print(f"  {note}")
    print(f"Next: shapespace-train run {shlex.quote(str(out))}")


def _run(arguments: argparse.Namespace) -> None:
    config, source = load(arguments.config, arguments.data, arguments.fractions)
    folder = arguments.out or Path("runs") / arguments.config.stem
    execute(Run(folder, config, source, arguments.models, arguments.scheduler), arguments.until)


def _status(arguments: argparse.Namespace) -> None:
    run = _open(arguments.run, arguments.models)
    begun = ": ".join(filter(None, ("begun", Record(run.folder).at_work)))
    for name in STAGES:
        stamp = run.stamp(name)
        state = f"done in {stamp['seconds']:.0f} s" if "seconds" in stamp else begun if stamp else "to do"
        print(f"{name:12} {state}")


def _report(arguments: argparse.Namespace) -> None:
    print(write_report(arguments.run))


def _export(arguments: argparse.Namespace) -> None:
    execute(_open(arguments.run, arguments.models))


def parser() -> argparse.ArgumentParser:
    """The command line."""
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
    run.add_argument(
        "--fractions",
        type=float,
        nargs="+",
        default=(),
        metavar="F",
        help="also learn from these shares of the samples",
    )
    run.add_argument("--out", type=Path, metavar="DIR", help="run directory (default: runs/ and the config's name)")
    run.add_argument("--until", choices=list(STAGES), metavar="STAGE", help=f"last stage to do: {', '.join(STAGES)}")
    run.add_argument("--scheduler", metavar="ADDRESS", help="Dask scheduler whose workers draw the samples")
    run.set_defaults(do=_run)

    status = commands.add_parser("status", help="which stages of a run are done")
    status.set_defaults(do=_status)
    report = commands.add_parser("report", help="write RUN/report.html, pictures and figures of what is done so far")
    report.set_defaults(do=_report)
    export = commands.add_parser("export", help="finish a run and write its bundle again")
    export.set_defaults(do=_export)
    for command in (status, report, export):
        command.add_argument("run", type=Path, metavar="RUN")
    for command in (run, status, export):
        command.add_argument("--models", type=Path, default=Path("models"), help="where bundles go (default: models)")
    return top


def main() -> int:
    """Run the command; faults of the user's making are one message, not a traceback."""
    arguments = parser().parse_args()
    try:
        arguments.do(arguments)
    except (ConfigError, ExportError, FactorError, IngestError, ModeError, ReportError, WorkersError, OSError) as error:
        print(f"shapespace-train: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt:
        print("\nshapespace-train: stopped; the same command continues here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
