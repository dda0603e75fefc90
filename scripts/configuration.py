"""Write ``docs/reference/configuration.md``: every setting of a configuration, from the models that read it."""

import json
import types
from collections import defaultdict
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

Brackets have the default, then other choices and limits. A setting with only a type has no fixed default:
its text says what holds without it. The run refuses unknown settings. The [glossary](glossary.md) explains the words.
"""
RESEARCH = """\
## For research: kinds of networks

Settings of the variants on the [pages of measurements](../measurements/results.md).
"""
NO_EFFECT = """\
## Settings of version 0.2 that have no effect

{}. `python -m benchmarks.studies` trains such variants now.
"""
NAMES = {int: "whole number", float: "number", str: "text", bool: "`true` or `false`", Path: "path"}


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return the models that a type contains."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return list(dict.fromkeys(model for part in get_args(annotation) for model in models_in(part)))


def limits(metadata: list[Any]) -> Iterator[str]:
    """Yield the limits of a value, in words: not that a number of things is no negative number."""
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    for constraint in [other for each in metadata for other in getattr(each, "metadata", [each])]:
        for name, sign in signs.items():
            bound = getattr(constraint, name, None)
            if bound is not None and f"{sign} {bound}" not in ("> 0", "≥ 0", "≥ 1"):
                yield f"{sign} {bound:,}"
        if pattern := getattr(constraint, "pattern", None):
            yield f"matches `{pattern}`"
        if isinstance(constraint, annotated_types.MaxLen):
            yield f"at most {constraint.max_length} long"


def words(annotation: Any) -> str:
    """Return a type in words."""
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f"`{json.dumps(value)}`" for value in parts)
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


def value(field: FieldInfo, default: Any) -> str:
    """Return the default of a setting as TOML, and what else the setting may have."""
    annotation, bounds = field.annotation, list(limits(field.metadata))
    kind = words(annotation)
    if default is PydanticUndefined:
        return ", ".join(["required", *bounds])
    if default is None or isinstance(default, BaseModel) or default == {}:
        return ", ".join([f"one of {kind}" if kind.startswith("`") else kind, *bounds])
    text = f"`{json.dumps(float(default) if annotation is float else default)}`"
    if get_origin(annotation) in (Union, types.UnionType):
        return " or ".join([text, *(other for other in map(words, get_args(annotation)) if other != text)])
    choices = kind.split(", ") if get_origin(annotation) is Literal or default == [] else kind.split(", ")[1:]
    return ", ".join([text, *(choice for choice in choices if choice != text), *bounds])


def shown(default: BaseModel | None, name: str, field: FieldInfo) -> Any:
    """Return the default of a setting in a table; PydanticUndefined if the setting is required."""
    return getattr(default, name) if default else field.get_default(call_default_factory=True, validated_data={})


class Page:
    """The reference page: each model once, with all tables that it describes."""

    def __init__(self) -> None:
        #: The tables of each model: path, kind (or empty), and default.
        self.places: dict[type[BaseModel], list[tuple[str, str, BaseModel | None]]] = {}
        self._visit(Config, "", "", None)
        #: The first model with each row: other models refer to it.
        self.rows: dict[str, type[BaseModel]] = {}

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

    def _link(self, model: type[BaseModel]) -> str:
        place, kind, _ = self.places[model][0]
        return f"[{kind or place}](#{self._anchor(model).translate(str.maketrans(' ', '-', '.(),')).lower()})"

    def _row(self, name: str, field: FieldInfo, default: BaseModel | None) -> str:
        meaning = " ".join((field.description or "").split()).replace("``", "`")
        links = [self._link(model) for model in models_in(field.annotation)]
        meaning = " ".join(filter(None, [meaning, f"See {', '.join(links)}." if links else ""]))
        return f"- **`{field.alias or name}`** ({value(field, shown(default, name, field))}): {meaning}"

    def _section(self, model: type[BaseModel]) -> Iterator[str]:
        (path, kind, default), *others = self.places[model]
        yield f"### {self._anchor(model)}"
        yield ""
        yield " ".join((model.__doc__ or "").split()).replace("``", "`")
        yield ""
        rows, known = [], defaultdict(list)
        for name, field in model.model_fields.items():
            if f"{path}.{name}" not in IGNORED and not (kind and name == "kind"):
                row = self._row(name, field, default)
                if (first := self.rows.setdefault(row, model)) is model:
                    rows.append(row)
                else:
                    known[first].append(f"`{field.alias or name}`")
        if rows:
            yield from (*rows, "")
        if known:
            same = [f"{', '.join(names)} as in {self._link(first)}" for first, names in known.items()]
            yield from (f"Also {'; '.join(same)}.", "")
        if others:
            yield "These tables have the same settings, some with other defaults:"
            yield ""
        for place, its_kind, other in others:
            differing = [
                f"`{field.alias or name} = {json.dumps(getattr(other, name))}`"
                for name, field in model.model_fields.items()
                if other and not models_in(field.annotation) and getattr(other, name) != shown(default, name, field)
            ]
            also = f"- `{place}`" + (f" ({its_kind})" if its_kind else "")
            yield also + (f": {', '.join(differing)}" if differing else "")
        if others:
            yield ""

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
