"""The command ``decode``: codes in, mesh files out."""

from __future__ import annotations

import csv
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from shapespace.command_line import FileOrFolder, fail, near
from shapespace.commands.parameters import (
    FORCE,
    FORMATS,
    MODEL,
    STANDARD,
    UnusableOutputError,
    choice,
    command,
    format_of,
    require_new,
    require_writable,
    write,
)
from shapespace.counted import counted
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import Bounds, Codes, Distribution
from shapespace.model.shape import Quality
from shapespace.model.shape_model import load
from shapespace.solve.outcome import Status

#: Table of the codes in a folder.
CODES = "codes.csv"


class _CodeType(click.ParamType):
    name = "code"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[float]:
        """Return the numbers of a text with commas."""
        try:
            return [float(part) for part in value.split(",")]
        except ValueError:
            self.fail(f"{value[:100]!r} is not a list of numbers, such as 0.1,-0.5,0", param, ctx)


PARAMS = (
    MODEL,
    click.Option(
        ["--latent"], type=_CodeType(), multiple=True, metavar="A,B,…",
        help="a code, with one number for each coordinate; may be given several times",
    ),
    click.Option(["--random"], type=click.IntRange(1, 1_000_000), metavar="N", help="number of random codes"),
    click.Option(
        ["--seed"], type=click.IntRange(0), default=0, show_default=True, metavar="S",
        help="seed of the random codes; the same seed gives the same codes",
    ),
    choice("--distribution", Distribution, f"distribution of the random codes (default: {Distribution.UNIFORM})"),
    choice("--quality", Quality, f"accuracy of the shapes (default: {Quality.AUTO})"),
    click.Option(["--no-examples"], is_flag=True, help="leave out what the model remembers of training shapes"),
    choice("--bounds", Bounds, f"what happens to codes outside the bounds (default: {Bounds.ALLOW})"),
    choice("--mesh", MeshChoice, f"mesh of the shapes (default: {MeshChoice.FINE})"),
    click.Option(["--format"], metavar="FORMAT", help=f"{', '.join(FORMATS)} (default: extension of --out, or glb)"),
    click.Option(
        ["--out"], type=FileOrFolder(), required=True, metavar="FILE_OR_FOLDER",
        help="where to write; - is standard output",
    ),
    FORCE,
)  # fmt: skip


@command
def decode(
    model: str,
    latent: Sequence[Sequence[float]],
    random: int | None,
    seed: int,
    distribution: str | None,
    quality: str | None,
    no_examples: bool,
    bounds: str | None,
    mesh: str | None,
    format: str | None,
    out: Path,
    force: bool,
) -> int:
    """Write the shapes of codes as mesh files; return 0 if the solver converged for all."""
    if latent and random:
        raise click.UsageError("choose --latent or --random", click.get_current_context())
    extension, is_folder = _kind_of(out, format)
    if not is_folder and (random or len(latent)) > 1:
        one, folder = ("standard output", "shapes") if out == STANDARD else (out, out.with_suffix(""))
        raise UnusableOutputError(f"{one} is one file; for several shapes, name a folder, such as {folder}")
    loaded, choice_of_mesh = load(model), MeshChoice(mesh or MeshChoice.FINE)
    given = loaded.sample(random, seed, Distribution(distribution or Distribution.UNIFORM)) if random else latent
    codes, inside = loaded.latents.codes(given, Bounds(bounds or Bounds.ALLOW))
    count = max(len(codes), 1)
    names = [f"shape-{k:0{len(str(count - 1))}}" for k in range(count)] if len(codes) else ["reference"]
    paths = [out / f"{name}.{extension}" if is_folder else out for name in names]
    table = [out / CODES] if is_folder and len(codes) else []
    require_new([*table, *paths], force=force)
    for path in table:
        write(path, _table(loaded.names, [each.name for each in paths], codes))
    faces, surface = loaded.mesh(choice_of_mesh).faces, loaded.decoder.surface(choice_of_mesh)
    how: dict[str, Any] = {"examples": not no_examples} | ({} if quality is None else {"quality": quality})
    missed = []
    with click.progressbar(paths, label="shapes", file=sys.stderr, hidden=not sys.stderr.isatty()) as bar:
        for k, path in enumerate(bar):
            if len(codes):
                shape = loaded.shape(codes[k], bool(inside[k]), choice_of_mesh, **how)
            else:
                shape = loaded.decoder.reference_shape(choice_of_mesh)
            if shape.diagnostics.status is not Status.CONVERGED:
                missed.append(f"{path.name} ({shape.diagnostics.status})")
            write(path, FORMATS[extension].encode(shape.vertices, faces, None, surface))
    if out != STANDARD:
        print(f"{near(out)}: {counted(count, 'shape')} and {CODES}" if table else near(out), file=sys.stderr)
    clamped = loaded.latents.codes(given, Bounds.CLAMP)[0]
    far = (np.abs(codes - clamped) > (loaded.upper - loaded.lower) / 2).any(axis=1)
    if guesses := [path.name for path, each in zip(paths, far, strict=False) if each]:
        named = ", ".join(guesses[:3]) + (", …" if len(guesses) > 3 else "")
        print(f"{named}: the code lies far outside the bounds, so the shape is a guess", file=sys.stderr)
    if missed:
        return fail(
            f"the solver did not converge for {', '.join(missed[:3])}: look at these shapes before you use them"
        )
    return 0


def _kind_of(out: Path, format: str | None) -> tuple[str, bool]:
    """Return the format of files, and whether they go into a folder; raises UnusableOutputError."""
    is_folder = out != STANDARD and (out.is_dir() or not out.suffix)
    if is_folder and out.exists() and not out.is_dir():
        raise UnusableOutputError(f"{out} is a file; name a folder, or a file with an extension such as .glb")
    if format:
        ending = out.suffix.lower()
        if not is_folder and ending != f".{format}" and ending[1:] in FORMATS:
            raise UnusableOutputError(f"{out} ends in {ending}, but --format is {format}; leave one of them out")
        return require_writable(format), is_folder
    return ("glb" if is_folder else format_of(out)), is_folder


def _table(names: Sequence[str], files: Sequence[str], codes: Codes) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["file", *names])
    writer.writerows([file, *code] for file, code in zip(files, codes.astype(str), strict=True))
    return text.getvalue().encode()
