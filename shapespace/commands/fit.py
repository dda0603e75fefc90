"""The command ``fit``: a scan in, its code and its shape out."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from shapespace.command_line import FileOrFolder
from shapespace.commands.parameters import (
    FORCE,
    FORMATS,
    MODEL,
    STANDARD,
    chosen,
    command,
    format_of,
    options_of,
    require_new,
    write,
)
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.model.decoder import MeshChoice
from shapespace.model.fit_result import FitStatus
from shapespace.model.options import FitOptions
from shapespace.model.scan import InvalidScanError
from shapespace.model.shape_model import load
from shapespace.solve.deadline import Deadline

PARAMS = (
    MODEL,
    click.Argument(["scan"], type=FileOrFolder(), metavar="SCAN"),
    click.Option(["--out"], type=FileOrFolder(), metavar="FILE", help="mesh file for the fitted shape, on the scan"),
    click.Option(
        ["--json", "answer"], type=FileOrFolder(), metavar="FILE",
        help="file for all results, as the HTTP call answers them; - is standard output",
    ),
    click.Option(
        ["--deadline"], type=click.FloatRange(0, min_open=True), metavar="SECONDS",
        help="time after which the best result so far counts",
    ),
    *options_of(FitOptions),
    FORCE,
)  # fmt: skip


@command
def fit(
    model: str,
    scan: Path,
    out: Path | None,
    answer: Path | None,
    deadline: float | None,
    force: bool,
    **parameters: Any,
) -> None:
    """Write the fitted shape and the results, and say how the fit ended."""
    if out and out == answer:
        raise click.UsageError("--out and --json name one file: name two", click.get_current_context())
    unwritten = [name for name in ("samples", "points", "used") if parameters.get(name)]
    if unwritten and not answer:
        name = unwritten[0]
        raise click.UsageError(f"--{name}: only --json FILE shows the result, so add it", click.get_current_context())
    require_new([path for path in (out, answer) if path], force=force)
    format = format_of(out) if out else ""
    loaded = load(model)
    limit = None if deadline is None else Deadline(seconds=deadline)
    try:
        found = loaded.fit_scan(scan, chosen(FitOptions, parameters), deadline=limit)
    except (MeshError, InvalidScanError) as error:
        raise MeshError(f"{scan}: {error}") from None
    if out:
        mesh, surface = loaded.mesh(), loaded.decoder.surface(MeshChoice.FINE)
        write(out, FORMATS[format].encode(found.placement(found.shape.vertices), mesh.faces, None, surface))
    if answer:
        write(answer, TypeAdapter(Any).dump_json(found.answer(), fallback=_lists) + b"\n")
    told = sys.stderr if STANDARD in (out, answer) else sys.stdout
    print(f"{found.status}: {found.reason}\ncode: {','.join(found.code.astype(str))}", file=told)
    if found.status is not FitStatus.CONVERGED:
        print(f"The status is {found.status}: look at the fitted shape before you use it", file=sys.stderr)


def _lists(array: NDArray) -> list[Any]:
    """Return an array as nested lists, float32 with as few digits as identify each number."""
    return (array.astype(str).astype(float) if array.dtype == np.float32 else array).tolist()
