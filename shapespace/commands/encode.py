"""The command ``encode``: meshes in, a table of codes out."""

from __future__ import annotations

import csv
import os
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import click

from shapespace.command_line import FileOrFolder, fail
from shapespace.commands.parameters import FORCE, MODEL, REFUSED, STANDARD, chosen, command, options_of, require_new
from shapespace.counted import counted
from shapespace.model.options import EncodeOptions
from shapespace.model.shape_model import load

#: Columns of the table before the coordinates of the codes.
COLUMNS = ("file", "status", "reason", "error_mean", "error_max", "inside_bounds")
#: Status of a file that is no mesh of the model.
NO_MESH = "refused"

PARAMS = (
    MODEL,
    click.Argument(["files"], nargs=-1, required=True, type=FileOrFolder(), metavar="FILES…"),
    click.Option(
        ["--csv", "table"], type=FileOrFolder(), default="-", metavar="FILE",
        help="file for the table (default: standard output)",
    ),
    *options_of(EncodeOptions, without=("samples", "seed")),
    FORCE,
)  # fmt: skip


@command
def encode(model: str, files: Sequence[Path], table: Path, force: bool, **parameters: Any) -> int:
    """Write a line for each mesh, with its status and its code; return 0 if all files are meshes of the model."""
    require_new([table], force=force)
    loaded, options, refused = load(model), chosen(EncodeOptions, parameters), 0
    loaded.latents.fixed(options.fixed)
    if table != STANDARD:
        table.parent.mkdir(parents=True, exist_ok=True)
    bar = click.progressbar(files, label="meshes", file=sys.stderr, hidden=not sys.stderr.isatty())
    with nullcontext(sys.stdout) if table == STANDARD else table.open("w", encoding="utf-8", newline="") as file, bar:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*COLUMNS, *loaded.names])
        for path in bar:
            try:
                found = loaded.encode(path, options)
            except REFUSED as error:
                refused += 1
                row: list[Any] = [NO_MESH, str(error), "", "", "", *[""] * loaded.dimension]
            else:
                errors = [float(found.distances.mean()), float(found.distances.max())]
                row = [found.status, found.reason, *errors, found.inside_bounds, *found.code.astype(str)]
            writer.writerow([os.fspath(path), *row])
            file.flush()
    if refused:
        return fail(f"no code for {refused} of {counted(len(files), 'file')}: the column reason says why")
    return 0
