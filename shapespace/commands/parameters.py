"""Arguments that the commands share, options derived from the library's options, and files that they write."""

from __future__ import annotations

import functools
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import click
from click.shell_completion import CompletionItem
from pydantic import ConfigDict, TypeAdapter, ValidationError

from shapespace.bundle.finding import models
from shapespace.bundle.reader import BundleError
from shapespace.command_line import carry_out, missing_packages
from shapespace.files.atomic import replaced_file
from shapespace.files.formats import MESH_FORMATS, OBJ_ZIP, USD_FORMATS, VTK_FORMATS
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.model.correspondence import InvalidMeshError
from shapespace.model.latent_space import LatentError
from shapespace.model.networks import ModelFailedError
from shapespace.model.options import descriptions
from shapespace.model.scan import InvalidScanError
from shapespace.refused_values import in_short

K = TypeVar("K")

#: Formats of mesh files by their extensions.
FORMATS = {**MESH_FORMATS, "zip": OBJ_ZIP, **USD_FORMATS, **VTK_FORMATS}
#: Module that writes a format, and the extra that installs it.
_WRITERS = dict.fromkeys(USD_FORMATS, ("pxr", "usd")) | dict.fromkeys(VTK_FORMATS, ("vtkmodules", "vtk"))
#: Sentences about faults of JSON, by pydantic's types.
_WORDS = {"unexpected_keyword_argument": "there is no such member; remove it or correct its spelling"}
#: The path of standard input or output.
STANDARD = Path("-")


class UnusableOutputError(ValueError):
    """A place that results can't be written to; the message says what to do."""


#: Errors whose message is a sentence for the user, also about one of several meshes.
REFUSED = (BundleError, InvalidMeshError, InvalidScanError, LatentError, MeshError, ModelFailedError)


class _ModelType(click.ParamType):
    name = "model"

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the names of models that begin like this, and folders."""
        named = [CompletionItem(name) for name in models() if name.startswith(incomplete)]
        return named or [CompletionItem(incomplete, type="dir")]


class _JsonType(click.ParamType):
    name = "json"

    def __init__(self, kind: Any) -> None:
        self._adapter: TypeAdapter[Any] = TypeAdapter(kind, config=ConfigDict(extra="forbid"))

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Return the value that JSON describes; fail with the first fault."""
        try:
            return self._adapter.validate_json(value)
        except ValidationError as error:
            self.fail(in_short(error.errors(include_url=False, include_input=False), _WORDS)[0], param, ctx)


MODEL = click.Argument(["model"], type=_ModelType(), metavar="MODEL")
FORCE = click.Option(["--force"], is_flag=True, help="replace files that exist")


def choice(name: str, kind: type[StrEnum], purpose: str) -> click.Option:
    """Return an option with the values of an enumeration; without it, the library's default counts."""
    return click.Option([name], type=_values(kind), help=purpose)


def _values(kind: type[StrEnum]) -> click.Choice[str]:
    return click.Choice([each.value for each in kind])


def options_of(kind: type, *, without: Sequence[str] = ()) -> list[click.Option]:
    """Return an option of the command line for each field of a class of the library's options.

    Names, limits and descriptions come from the class. Mappings and lists are JSON.
    """
    hints, told = get_type_hints(kind), descriptions(kind)
    found = []
    for field in fields(kind):
        if field.name in without:
            continue
        hint, limits = hints[field.name], field.metadata
        purpose, given = told[field.name].replace("`", ""), dict[str, Any]()
        if hint is bool:
            given = {"is_flag": True}
        elif isinstance(hint, type) and issubclass(hint, StrEnum):
            given = {"type": _values(hint), "default": str(field.default), "show_default": True}
        elif hint is int:
            given = {"type": click.IntRange(limits.get("ge")), "metavar": "N"}
        elif hint == float | None:
            given = {"type": click.FloatRange(limits.get("gt"), min_open=True), "metavar": "X"}
        else:
            example = json.dumps(limits["examples"][0], default=asdict)
            given, purpose = {"type": _JsonType(hint), "metavar": "JSON"}, f"{purpose} For example: '{example}'"
        found.append(
            click.Option([f"--{field.name.replace('_', '-')}"], help=purpose[0].lower() + purpose[1:], **given)
        )
    return found


def chosen(kind: type[K], parameters: Mapping[str, Any]) -> K:
    """Return the options of a class that the command line has; others keep their defaults."""
    names = {field.name for field in fields(kind)}  # type: ignore[arg-type]
    return kind(**{name: value for name, value in parameters.items() if name in names and value is not None})


def command(work: Callable[..., Any]) -> Callable[..., int]:
    """Make a command of a function: its errors end with a message, not with a traceback."""

    @functools.wraps(work)
    def carried_out(**parameters: Any) -> int:
        return carry_out(lambda: work(**parameters), (*REFUSED, UnusableOutputError))

    return carried_out


def require_new(paths: Iterable[Path], *, force: bool) -> None:
    """Raise UnusableOutputError if a file exists and may not be replaced."""
    for path in paths:
        if path != STANDARD and path.exists() and not (force and path.is_file()):
            remedy = "choose another name" if path.is_dir() else "--force replaces it, another name keeps it"
            raise UnusableOutputError(f"{path}: exists already; {remedy}")


def format_of(path: Path) -> str:
    """Return the format that the extension of a file names, GLB for standard output; raises UnusableOutputError."""
    if path != STANDARD and not path.suffix:
        raise UnusableOutputError(f"{path} has no extension, which tells the format: add .glb or another one")
    return require_writable(path.suffix[1:] or "glb")


def require_writable(format: str) -> str:
    """Return the name of a format in small letters; raises UnusableOutputError if it can't be written."""
    name = format.lower()
    if name not in FORMATS:
        raise UnusableOutputError(f"there is no format {format!r}; choose among {', '.join(FORMATS)}")
    module, extra = _WRITERS.get(name, ("trimesh", "model"))
    if sentence := missing_packages([module], extra):
        raise UnusableOutputError(f"writing {name} files {sentence}")
    return name


def write(path: Path, content: bytes) -> None:
    """Write a file, or to standard output for ``-``. Missing folders are created."""
    if path == STANDARD:
        sys.stdout.buffer.write(content)
        sys.stdout.buffer.flush()
        return
    with replaced_file(path) as file:
        file.write(content)
