"""The training command: ``shapespace-train run|status|export``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from training.config import ConfigError, load
from training.export import ExportError
from training.pipeline import STAGES, Run, execute

FAILURE = 1


def _open(folder: Path, models: Path) -> Run:
    source = folder / "config.toml"
    if not source.is_file():
        raise ConfigError(f"{folder} is no run directory: it holds no config.toml")
    return Run(folder, *load(source), models)


def _run(arguments: argparse.Namespace) -> None:
    config, source = load(arguments.config, arguments.data, arguments.fractions)
    folder = arguments.out or Path("runs") / arguments.config.stem
    execute(Run(folder, config, source, arguments.models), arguments.until)


def _status(arguments: argparse.Namespace) -> None:
    run = _open(arguments.run, arguments.models)
    for name in STAGES:
        stamp = run.stamp(name)
        state = f"done in {stamp['seconds']:.0f} s" if "seconds" in stamp else "begun" if stamp else "to do"
        print(f"{name:12} {state}")


def _export(arguments: argparse.Namespace) -> None:
    execute(_open(arguments.run, arguments.models))


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = argparse.ArgumentParser(prog="shapespace-train", description="Learn a shape manifold and export its bundle.")
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    run = commands.add_parser("run", help="do the stages of a configuration that are not done yet")
    run.add_argument("config", type=Path, metavar="CONFIG.toml")
    run.add_argument("--data", type=Path, metavar="DIR", help="folder of meshes or NPZ file, instead of the config's")
    run.add_argument(
        "--fractions", type=float, nargs="+", default=(), metavar="F", help="also learn from these shares of the samples"
    )
    run.add_argument("--out", type=Path, metavar="DIR", help="run directory (default: runs/ and the config's name)")
    run.add_argument("--until", choices=list(STAGES), metavar="STAGE", help=f"last stage to do: {', '.join(STAGES)}")
    run.set_defaults(do=_run)

    status = commands.add_parser("status", help="which stages of a run are done")
    status.set_defaults(do=_status)
    export = commands.add_parser("export", help="finish a run and write its bundle again")
    export.set_defaults(do=_export)
    for command in (status, export):
        command.add_argument("run", type=Path, metavar="RUN")
    for command in (run, status, export):
        command.add_argument("--models", type=Path, default=Path("models"), help="where bundles go (default: models)")
    return top


def main() -> int:
    """Run the command; faults of the user's making are one message, not a traceback."""
    arguments = parser().parse_args()
    try:
        arguments.do(arguments)
    except (ConfigError, ExportError) as error:
        print(f"shapespace-train: {error}", file=sys.stderr)
        return FAILURE
    except KeyboardInterrupt:
        print("\nshapespace-train: stopped; the same command continues here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
