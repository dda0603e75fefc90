"""Query parameters, fields of forms and JSON bodies derived from the library's options.

Names, defaults, limits and descriptions come from the dataclasses in ``shapespace.model.options``.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, asdict, fields
from typing import Annotated, Any, TypeVar, get_type_hints

from fastapi.exceptions import RequestValidationError
from pydantic import AfterValidator, BaseModel, Field, TypeAdapter, ValidationError, ValidationInfo, create_model

from shapespace.model.options import descriptions
from shapespace.service.http.messages.bodies import read_query
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases.fields import Number, NumbersByIndex, NumberText, Whole, WholeText
from shapespace.service.use_cases.forms import OPTIONS

M = TypeVar("M", bound=BaseModel)
K = TypeVar("K")

#: JSON types of options, which are stricter than Python's.
_BODY_TYPES: dict[Any, Any] = {
    int: Whole,
    float: Number,
    float | None: Number | None,
    Sequence[float]: Annotated[list[Number], Field(min_length=3, max_length=3, fail_fast=True)],
    Mapping[int, float]: NumbersByIndex,
}
#: Types of options in queries and forms.
_QUERY_TYPES: dict[Any, Any] = {int: WholeText, float | None: NumberText}


def body_of(
    kind: type, types: Mapping[Any, Any] | None = None, *, without: Sequence[str] = (), **limits: Mapping[str, Any]
) -> Callable[[type[M]], type[M]]:
    """Decorate the model of a JSON body with a member for each field of a dataclass.

    Args:
        kind: dataclass whose docstring describes its fields, and whose metadata holds their limits.
        types: further JSON types, by Python type.
        without: fields that the body does not have.
        limits: further limits, by field.
    """
    return _decorator(kind, _BODY_TYPES | dict(types or {}), {}, without, limits)


def query_of(
    kind: type, types: Mapping[Any, Any] | None = None, **limits: Mapping[str, Any]
) -> Callable[[type[M]], type[M]]:
    """Decorate the model of a query with a parameter for each field of a dataclass; arguments as for ``body_of``.

    Mappings and sequences are JSON in the query.
    """
    json_types = {Mapping[int, float]: NumbersByIndex} | dict(types or {})
    return _decorator(kind, _QUERY_TYPES, json_types, (), limits)


def options_of(kind: type[K], *given: BaseModel) -> K:
    """Return the options that models hold. Later models have priority; members that no client sent keep defaults."""
    names, sent = {field.name for field in fields(kind)}, dict[str, Any]()  # type: ignore[arg-type]
    for model in given:
        sent |= {name: getattr(model, name) for name in model.model_fields_set & names}
    return kind(**sent)


def options_with_fields(kind: type[K], query: BaseModel, body: type[BaseModel], fields: Mapping[str, str]) -> K:
    """Return the options from the query and from the fields of a form, which have priority.

    Args:
        kind: class of the options.
        query: the query. Fields are checked as its parameters.
        body: model of the field ``options``, which holds several options as JSON.
        fields: fields of the form by name, with those that are no options.

    Raises:
        RequestValidationError, RefusedError: a field has a wrong value, or the form says the same option twice.
    """
    names, text = type(query).model_fields, fields.get(OPTIONS, "")
    given = {name: value for name, value in fields.items() if name in names}
    try:
        sent = [read_query(text, OPTIONS, TypeAdapter(body))] if text.strip() else []
        checked = type(query).model_validate(given)
    except (RequestValidationError, ValidationError) as error:
        faults = ({**fault, "loc": ("form", *_place(fault["loc"]))} for fault in error.errors())
        raise RequestValidationError([*faults]) from None
    if twice := [name for name in given for each in sent if name in each.model_fields_set]:
        raise RefusedError("invalid-request", f"The form has {twice[0]} as a field and in {OPTIONS}. Send it once.")
    return options_of(kind, query, checked, *sent)


def _place(where: tuple) -> tuple:
    """Return the place of a fault in a form, without the word for a query."""
    return where[1:] if where[:1] == ("query",) else where


def _decorator(
    kind: type,
    types: Mapping[Any, Any],
    json_types: Mapping[Any, Any],
    without: Sequence[str],
    limits: Mapping[str, Mapping[str, Any]],
) -> Callable[[type[M]], type[M]]:
    hints, told = get_type_hints(kind), descriptions(kind)

    def derive(base: type[M]) -> type[M]:
        members: dict[str, Any] = {}
        for option in fields(kind):
            name, hint, default = option.name, hints[option.name], option.default
            if default is MISSING:
                default = ... if option.default_factory is MISSING else option.default_factory()
            described = {"description": told.get(name), **option.metadata, **limits.get(name, {})}
            examples = [json.dumps(example, default=asdict) for example in described.pop("examples", ())]
            if hint in json_types:
                default, hint = None, _json_text(json_types[hint])
                described["description"] = f"{described['description']} JSON, for example `{examples[0]}`."
            elif examples:
                described["examples"] = [json.loads(example) for example in examples]
            if name not in without:
                members[name] = types.get(hint, hint), Field(default, **described)
        return create_model(base.__name__, __base__=base, __module__=base.__module__, __doc__=base.__doc__, **members)

    return derive


def _json_text(kind: Any) -> Any:
    """Return the type of a query parameter that holds JSON of a type."""
    adapter = TypeAdapter(kind)

    def read(text: str, info: ValidationInfo) -> Any:
        return read_query(text, str(info.field_name), adapter)

    # A plain string for FastAPI, which would collect repeated parameters for a list.
    return Annotated[str, AfterValidator(read), Field(json_schema_extra={"contentMediaType": "application/json"})]
