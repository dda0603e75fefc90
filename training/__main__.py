"""The commands that train: ``init``, ``run``, ``status``, ``report`` and ``export``, also as ``shapespace-train``.

This module imports none of the packages that training needs, so that ``--help`` and ``--version`` always answer.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import click

from shapespace.command_line import FileOrFolder, Program, Several, Subcommand, call
from shapespace.training.stages import STAGE_NAMES

#: Packages of the extra ``train`` by the names of their modules, without those that are only faster.
NEEDED = (
    "PIL", "filelock", "jinja2", "joblib", "matplotlib", "onnx", "onnxruntime", "onnxscript", "pydantic", "safetensors",
    "tomlkit", "torch", "tqdm", "trimesh",
)  # fmt: skip
#: What ``init`` reads.
_MESHES = (
    "MESH_DIR is a folder of OBJ, PLY, STL, OFF, glTF or VTK files; or one NPZ file with all shapes; or one GLB or "
    "glTF file whose morph targets are the shapes; or, with --file, a folder that has a folder for each subject."
)
_SUBJECTS = "read this file from each folder in MESH_DIR, for data with one folder per subject; may have * and ?"
_UNTIL = f"stop after this stage: {', '.join(STAGE_NAMES)}"
_RUN = click.Argument(["run"], type=FileOrFolder(), metavar="RUN")
_MODELS = click.Option(
    ["--models"],
    type=FileOrFolder(standard=False),
    default="models",
    help="folder for the finished bundle (default: models)",
)


def _subcommand(
    name: str, work: str, purpose: str, params: Sequence[click.Parameter], examples: Sequence[str], details: str = ""
) -> Subcommand:
    return Subcommand(
        name,
        f"shapespace.training.commands:{work}",
        help=f"{purpose}\n\n{details}",
        short_help=purpose,
        params=params,
        examples=examples,
        needs=NEEDED,
        extra="train",
    )


COMMANDS = (
    _subcommand(
        "init",
        "initialise",
        "Write a configuration for a folder of meshes in correspondence.",
        [
            click.Argument(["meshes"], type=FileOrFolder(), metavar="MESH_DIR"),
            click.Option(
                ["--out"],
                type=FileOrFolder(standard=False),
                metavar="FILE.toml",
                help="file to write (default: the folder's name with .toml, in the current folder)",
            ),
            click.Option(["--file"], metavar="NAME", help=_SUBJECTS),
            Several(["--parts"], metavar="NAME…", help="names of the parts to keep, the main part first"),
            click.Option(["--force"], is_flag=True, help="replace FILE.toml if it exists"),
        ],
        ["meshes", "study --file body.obj", "bodies --parts body eyes"],
        _MESHES,
    ),
    _subcommand(
        "run",
        "run",
        "Train the model of a configuration; a repeated command continues where the last one stopped.",
        [
            click.Argument(["config"], type=FileOrFolder(), metavar="CONFIG.toml"),
            click.Option(
                ["--data"],
                type=FileOrFolder(),
                metavar="DIR",
                help="folder of meshes or NPZ file, instead of collection.data in CONFIG.toml",
            ),
            click.Option(
                ["--out"],
                type=FileOrFolder(standard=False),
                metavar="DIR",
                help="folder for the results (default: runs/ and the name of CONFIG.toml)",
            ),
            click.Option(["--until"], type=click.Choice(STAGE_NAMES), metavar="STAGE", help=_UNTIL),
            click.Option(
                ["--scheduler"],
                metavar="ADDRESS",
                help="address of a Dask scheduler, whose workers compute the samples",
            ),
            Several(
                ["--accept"],
                metavar="FILE…",
                help="use these shapes although their size or vertex order differs from the others",
            ),
            click.Option(
                ["--keep-going"],
                is_flag=True,
                help="continue even if more than a quarter of the logarithms or samples fail",
            ),
            _MODELS,
        ],
        ["meshes.toml", "meshes.toml --until modes", "meshes.toml --accept bar3.obj --out runs/again"],
    ),
    _subcommand("status", "status", "Show which stages of a run are done.", [_RUN], ["runs/meshes"]),
    _subcommand(
        "report",
        "report",
        "Write RUN/report.html, with pictures and figures of all stages that are done.",
        [_RUN],
        ["runs/meshes"],
    ),
    _subcommand(
        "export",
        "export",
        "Finish a run, and write its bundle where it is missing or damaged; or add decoder.onnx to a bundle.",
        [_RUN, _MODELS],
        ["runs/meshes", "runs/meshes --models path/to/models"],
    ),
)
PROGRAM = Program(COMMANDS, help="Train a model on your meshes and export it for the server.")


def main() -> int:
    """Run the command line, and return its exit code."""
    return call("shapespace-train", PROGRAM)


if __name__ == "__main__":
    sys.exit(main())
