"""Write ``docs/reference/configuration.md``: every setting of a configuration, from the models that read it."""

import json
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import annotated_types
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from shapespace.training.runs.config import IGNORED, Config

TARGET = Path(__file__).parents[1] / "docs" / "reference" / "configuration.md"
HEAD = """\
# Configuration

Every setting of a file for `shapespace run`. `shapespace init` writes such a file for your meshes. Most files need
only this:

```toml
[collection]
data = "scans"               # folder of meshes, relative to this file

[modes]
geometry = "auto"            # straight lines where they are enough

[samples]
count = 1500                 # fewer samples train faster

[export]
name = "hands"
title = "Hands"
description = "Hands in many poses."
licence = "CC0-1.0"

[export.names]               # new names of factors
"upper right bends" = "thumb"
```

The run refuses unknown settings. A dotted heading such as `networks.factors` is a table `[networks.factors]`. Words
such as *mode* and *factor* are in the [glossary](glossary.md).
"""
RESEARCH = """\
## For research: kinds of networks

These settings make the variants on the [pages of measurements](../measurements/results.md), among them the paper's own
networks.
"""
NO_EFFECT = """\
## Settings of version 0.2 that have no effect

The run reads and ignores {}. `python -m benchmarks.studies` trains such variants now.
"""
NAMES = {int: "whole number", float: "number", str: "text", bool: "`true` or `false`", Path: "path"}


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that a type contains."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return list(dict.fromkeys(model for part in get_args(annotation) for model in models_in(part)))


def limits(metadata: list[Any]) -> Iterator[str]:
    """Yield the limits of a value, in words."""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    for constraint in [other for each in metadata for other in getattr(each, "metadata", [each])]:
        for name, sign in signs.items():
            if (bound := getattr(constraint, name, None)) is not None:
                yield f"{sign} {bound:,}"
        if pattern := getattr(constraint, "pattern", None):
            yield f"matches `{pattern}`"
        if isinstance(constraint, annotated_types.MaxLen):
            yield f"at most {constraint.max_length} long"


def words(annotation: Any) -> str:
    """Return a type in words."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return " or ".join(f"`{json.dumps(value)}`" for value in parts)
    if origin is Annotated:
        return ", ".join([words(parts[0]), *limits(list(parts[1:]))])
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(words(part) for part in parts if part is not type(None)))
    if origin is list:
        kind, *bounds = words(parts[0]).split(", ")
        inside = kind.replace("list of", "lists of") if kind.startswith("list of") else f"{kind}s"
        return ", ".join([f"list of {kind if kind == 'text' else inside}", *bounds])
    if origin is dict:
        if parts[1] is Any:
            return "table"
        return f"{words(parts[1])} for each name"
    return "table" if models_in(annotation) else NAMES[annotation]


def value(default: Any) -> str:
    """Return a default as TOML."""
    if default is None:
        return "left out"
    return "" if isinstance(default, BaseModel) or default == {} else f"`{json.dumps(default)}`"


def shown(default: BaseModel | None, name: str, field: FieldInfo) -> Any:
    """Return the default of a setting in a table; PydanticUndefined if the setting is required."""
    return getattr(default, name) if default else field.get_default(call_default_factory=True, validated_data={})


class Page:
    """The reference page: each model once, with all tables that it describes."""

    def __init__(self) -> None:
        #: The tables of each model: path, kind (or empty), and default.
        self.places: dict[type[BaseModel], list[tuple[str, str, BaseModel | None]]] = {}
        self._visit(Config, "", "", None)

    def _visit(self, model: type[BaseModel], path: str, kind: str, default: BaseModel | None) -> None:
        self.places.setdefault(model, []).append((path, kind, default))
        for name, field in model.model_fields.items():
            inside = shown(default, name, field)
            place = f"{path}.{field.alias or name}".lstrip(".")
            if get_origin(field.annotation) is dict:
                place += ".NAME"
            others = models_in(field.annotation)
            for other in others:
                own = other.model_fields.get("kind") if len(others) > 1 else None
                its = ", ".join(get_args(own.annotation)) if own else kind
                self._visit(other, place, its, inside if isinstance(inside, other) else None)

    def _anchor(self, model: type[BaseModel]) -> str:
        place, kind, _ = self.places[model][0]
        return f"{place} ({kind})" if kind else place

    def _row(self, name: str, field: FieldInfo, default: BaseModel | None) -> str:
        here = shown(default, name, field)
        text = "required" if here is PydanticUndefined else value(here)
        kind = ", ".join([words(field.annotation), *limits(field.metadata)])
        meaning = " ".join((field.description or "").split()).replace("``", "`")
        links = [
            f"[{self._anchor(model)}](#{self._anchor(model).translate(str.maketrans(' ', '-', '.(),')).lower()})"
            for model in models_in(field.annotation)
        ]
        meaning = " ".join(filter(None, [meaning, f"See {', '.join(links)}." if links else ""]))
        cells = (f"`{field.alias or name}`", kind, text, meaning)
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

    def _section(self, model: type[BaseModel]) -> Iterator[str]:
        (path, kind, default), *others = self.places[model]
        yield f"### {self._anchor(model)}"
        yield ""
        yield " ".join((model.__doc__ or "").split()).replace("``", "`")
        yield ""
        for place, its_kind, other in others:
            differing = [
                f"`{field.alias or name} = {json.dumps(getattr(other, name))}`"
                for name, field in model.model_fields.items()
                if other and not models_in(field.annotation) and getattr(other, name) != shown(default, name, field)
            ]
            also = f"- also as `{place}`" + (f" ({its_kind})" if its_kind else "")
            yield also + (f", where the defaults are {', '.join(differing)}" if differing else "")
        if others:
            yield ""
        rows = []
        for name, field in model.model_fields.items():
            if f"{path}.{name}" not in IGNORED and not (kind and name == "kind"):
                rows.append(self._row(name, field, default))
        if rows:
            yield from ("| setting | type | default | meaning |", "|---|---|---|---|", *rows, "")

    def text(self) -> str:
        """Return the text of the page."""
        lines, research = [HEAD, "## Settings of a run", ""], [RESEARCH]
        for model, ((path, _, _), *_others) in self.places.items():
            part = research if path.startswith(("networks.", "monolithic")) else lines
            part.extend(self._section(model) if path else ())
        ignored = NO_EFFECT.format(", ".join(f"`{name}`" for name in IGNORED))
        return "\n".join([*lines, *research, ignored]).rstrip() + "\n"


if __name__ == "__main__":
    TARGET.write_text(Page().text(), encoding="utf-8")
    print(TARGET)  # noqa: T201 - commands talk to people
