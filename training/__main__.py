"""The training command: ``shapespace-train init|run|status|report|export``.

This module imports none of the packages that training needs, so that ``--help`` and ``--version`` always answer.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from shapespace.command_line import USAGE, CommandParser, missing_packages
from shapespace.training.stages import STAGE_NAMES

#: Packages of the extra ``train`` by the names of their modules, without those that are only faster.
NEEDED = (
    "PIL", "jinja2", "joblib", "matplotlib", "onnx", "onnxruntime", "onnxscript", "pydantic", "safetensors",
    "tomlkit", "torch", "tqdm", "trimesh",
)  # fmt: skip


def _add_command(commands: Any, name: str, purpose: str) -> CommandParser:
    command: CommandParser = commands.add_parser(name, help=purpose, description=f"{purpose[0].upper()}{purpose[1:]}.")
    return command


def parser() -> CommandParser:
    """Return the parser of the command line."""
    top = CommandParser(prog="shapespace-train", description="Learn a shape manifold and export its bundle.")
    commands = top.add_subparsers(required=True, metavar="COMMAND", dest="command")

    start = _add_command(commands, "init", "write a configuration for a folder of meshes in correspondence")
    start.add_argument("meshes", type=Path, metavar="MESH_DIR", help="OBJ, PLY, STL, OFF or glTF files, or one NPZ")
    start.add_argument("--out", type=Path, metavar="FILE.toml", help="default: the folder's name, here")
    start.add_argument("--file", metavar="NAME", help="file to read from each folder in MESH_DIR, one for each subject")
    start.add_argument(
        "--parts",
        nargs="+",
        default=[],
        metavar="NAME",
        help="parts to keep, the main one first",
    )
    start.add_argument("--force", action="store_true", help="replace the file if it is there")

    run = _add_command(commands, "run", "do the stages of a configuration that are not done yet")
    run.add_argument("config", type=Path, metavar="CONFIG.toml")
    run.add_argument("--data", type=Path, metavar="DIR", help="folder of meshes or NPZ file, instead of the config's")
    run.add_argument("--out", type=Path, metavar="DIR", help="run directory (default: runs/ and the config's name)")
    run.add_argument("--until", choices=STAGE_NAMES, metavar="STAGE", help=f"last stage: {', '.join(STAGE_NAMES)}")
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

    status = _add_command(commands, "status", "show which stages of a run are done")
    report = _add_command(commands, "report", "write RUN/report.html, pictures and figures of what is done so far")
    export = _add_command(commands, "export", "finish a run and write its bundle again")
    for command in (status, report, export):
        command.add_argument("run", type=Path, metavar="RUN")
    for command in (run, export):
        command.add_argument("--models", type=Path, default=Path("models"), help="where bundles go (default: models)")
    return top


def main() -> int:
    """Run the command. Every error ends with a message instead of a traceback."""
    arguments = parser().parse_args()
    if sentence := missing_packages(NEEDED, "train"):
        print(f"shapespace-train: {sentence}", file=sys.stderr)
        return USAGE
    from shapespace.training.commands import carry_out

    return carry_out(arguments)


if __name__ == "__main__":
    sys.exit(main())
