"""The training command: ``shapespace-train init|run|status|report|export``.

This module imports none of the packages that training needs, so that ``--help`` and ``--version`` always answer.
"""

from __future__ import annotations

import sys
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any

from shapespace.command_line import USAGE, CommandParser, missing_packages
from shapespace.training.stages import STAGE_NAMES

#: Packages of the extra ``train`` by the names of their modules, without those that are only faster.
NEEDED = (
    "PIL", "jinja2", "joblib", "matplotlib", "onnx", "onnxruntime", "onnxscript", "pydantic", "safetensors",
    "tomlkit", "torch", "tqdm", "trimesh",
)  # fmt: skip
#: What ``init`` reads.
MESHES = (
    "folder of OBJ, PLY, STL, OFF, glTF or VTK files; or one NPZ file with all shapes; or one GLB or glTF file "
    "whose morph targets are the shapes; or, with --file, a folder that has a folder for each subject"
)
SUBJECTS = "read this file from each folder in MESH_DIR, for data with one folder per subject; may have * and ?"


def _path(text: str) -> Path:
    """Return a path of the command line, which must not be empty, as after a misspelt variable of the shell."""
    if not text:
        raise ArgumentTypeError("it is empty; name a file or folder, . for this one")
    return Path(text)


def _add_command(commands: Any, name: str, purpose: str) -> CommandParser:
    command: CommandParser = commands.add_parser(name, help=purpose, description=f"{purpose[0].upper()}{purpose[1:]}.")
    return command


def parser() -> CommandParser:
    """Return the parser of the command line."""
    top = CommandParser(
        prog="shapespace-train", description="Train a model on your meshes and export it for the server."
    )
    commands = top.add_subparsers(required=True, metavar="COMMAND", dest="command")

    start = _add_command(commands, "init", "write a configuration for a folder of meshes in correspondence")
    start.add_argument(
        "meshes",
        type=_path,
        metavar="MESH_DIR",
        help=MESHES,
    )
    start.add_argument(
        "--out",
        type=_path,
        metavar="FILE.toml",
        help="file to write (default: the folder's name with .toml, in the current folder)",
    )
    start.add_argument(
        "--file",
        metavar="NAME",
        help=SUBJECTS,
    )
    start.add_argument(
        "--parts",
        nargs="+",
        default=[],
        metavar="NAME",
        help="names of the parts to keep, the main part first",
    )
    start.add_argument("--force", action="store_true", help="replace FILE.toml if it exists")

    run = _add_command(
        commands, "run", "train the model of a configuration; a repeated command continues where the last one stopped"
    )
    run.add_argument("config", type=_path, metavar="CONFIG.toml")
    run.add_argument(
        "--data",
        type=_path,
        metavar="DIR",
        help="folder of meshes or NPZ file, instead of collection.data in CONFIG.toml",
    )
    run.add_argument(
        "--out", type=_path, metavar="DIR", help="folder for the results (default: runs/ and the name of CONFIG.toml)"
    )
    run.add_argument(
        "--until", choices=STAGE_NAMES, metavar="STAGE", help=f"stop after this stage: {', '.join(STAGE_NAMES)}"
    )
    run.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a Dask scheduler, whose workers compute the samples"
    )
    run.add_argument(
        "--accept",
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="use these shapes although their size or vertex order differs from the others",
    )
    run.add_argument(
        "--keep-going",
        action="store_true",
        help="continue even if more than a quarter of the logarithms or samples fail",
    )

    status = _add_command(commands, "status", "show which stages of a run are done")
    report = _add_command(
        commands, "report", "write RUN/report.html, with pictures and figures of all stages that are done"
    )
    export = _add_command(
        commands,
        "export",
        "finish a run, and write its bundle where it is missing or damaged; or add decoder.onnx to a bundle",
    )
    for command in (status, report, export):
        command.add_argument("run", type=_path, metavar="RUN")
    for command in (run, export):
        command.add_argument(
            "--models", type=_path, default=Path("models"), help="folder for the finished bundle (default: models)"
        )
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
