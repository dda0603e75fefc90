"""OpenAPI 3.1: the description that FastAPI generates from the routes, completed."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from shapespace.files.reading import OCTET_STREAM
from shapespace.service.http.messages.bodies import JSONBody
from shapespace.service.http.messages.open_inference import IndexRequest, InferenceRequest
from shapespace.service.http.messages.schemas import MeshAnswer, Problem
from shapespace.service.http.middleware.access import OPEN
from shapespace.service.http.problems import KINDS, MEDIA_TYPE
from shapespace.service.use_cases.forms import OPTIONS
from shapespace.service.use_cases.shape_formats import SHAPE_FORMATS

DESCRIPTION = """\
Models that turn a few numbers, the latent code, into a triangle mesh. Small networks map the code to edge lengths
and dihedral angles. Gauss–Newton finds the mesh with these lengths and angles.

Coordinates are in the units of the training meshes, indices start at 0, every mesh is rigidly aligned to the
model's reference. Every error is a problem (RFC 9457) whose `detail` says what to do.
"""

_HEADERS = {
    name: {"description": description, "schema": {"type": "string"}}
    for name, description in {
        "ETag": "Strong; the same from every replica. Send it back as `If-None-Match` to get 304.",
        "Shape-Diagnostics": (
            "JSON: `status`, `iterations`, `residual`, `flipped_faces`, `integrability`, `plausibility`, "
            "`inside_bounds`, `model`, `quality`."
        ),
        "Model-Version": "Version of the model that answers.",
        "Shape-Color": "JSON, with `color`: `quantity`, `range` of the legend, `map`.",
        "Server-Timing": "Milliseconds by stage: `network`, `reconstruct`, `encode`.",
    }.items()
}
_FORM = "multipart/form-data"
_OPTIONS = {
    "type": "string",
    "contentMediaType": "application/json",
    "description": "Parameters of the query as one JSON object, which may be a file. A field with the name of a "
    "parameter does the same. Fields override the query.",
}
#: Models of bodies that FastAPI does not see, in addition to the models of JSONBody.
_MODELS: tuple[type[BaseModel], ...] = (IndexRequest, InferenceRequest, Problem)
_KEYS = {
    "bearer": {"type": "http", "scheme": "bearer"},
    "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}


def describe(app: FastAPI, routers: Iterable[APIRouter]) -> None:
    """Let an application describe its routers, and store the query parameters of each call in its state."""
    bodies = dict(_bodies(routers))

    def generate() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(
                title=app.title, version=app.version, summary=app.summary, description=DESCRIPTION, routes=app.routes
            )
            models = dict.fromkeys((*_MODELS, *bodies.values()))
            _, definitions = models_json_schema(
                [(model, "validation") for model in models], ref_template="#/components/schemas/{model}"
            )
            components = schema["components"]
            for superfluous in ("HTTPValidationError", "ValidationError"):
                components["schemas"].pop(superfluous, None)
            components["schemas"] = dict(sorted((components["schemas"] | definitions["$defs"]).items()))
            for part in components["schemas"].values():
                _say_defaults(part)
            components["securitySchemes"] = _KEYS
            # The empty requirement stands for a server without a key, the default.
            schema["security"] = [{}, *({name: []} for name in _KEYS)]
            for path, calls in schema["paths"].items():
                for method, call in calls.items():
                    _correct_responses(path, call)
                    for parameter in call.get("parameters", ()):
                        if parameter["schema"].get("type") == "array":
                            parameter |= {"style": "form", "explode": False}
                    if model := bodies.get((path, method)):
                        schema_of = {"schema": {"$ref": f"#/components/schemas/{model.__name__}"}}
                        call["requestBody"] = {"required": True, "content": {"application/json": schema_of}}
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = generate  # type: ignore[method-assign]
    app.state.query_parameters = {
        (path, method.upper()): [p["name"] for p in call.get("parameters", ()) if p["in"] == "query"]
        for path, calls in generate()["paths"].items()
        for method, call in calls.items()
    }


def binary(
    media_types: Mapping[str, str], description: str, *, cached: bool = True, coloured: bool = False
) -> dict[int | str, dict[str, Any]]:
    """Describe an answer in one of several binary formats, with an entity tag if ``cached``.

    An answer that may be ``coloured`` has a header with the legend.
    """
    schema = {"schema": {"type": "string", "format": "binary"}}
    # Generators of clients take the first type that they know, and read others than plain bytes as JSON or not at all.
    ordered = sorted({*media_types.values()} - {"application/json"}, key=lambda name: (name != OCTET_STREAM, name))
    others = dict.fromkeys(ordered, schema)
    left_out = {*(() if cached else ("ETag",)), *(() if coloured else ("Shape-Color",))}
    headers = {name: header for name, header in _HEADERS.items() if name not in left_out}
    answers: dict[int | str, dict[str, Any]] = {
        200: {"description": description, "content": others, "headers": headers}
    }
    if cached:
        answers[304] = {"description": "The client already has this answer, according to `If-None-Match`."}
    return answers


def mesh_answers(description: str) -> dict[int | str, dict[str, Any]]:
    """Describe a mesh in one of the formats of a shape."""
    media_types = {name: format.media_type for name, format in SHAPE_FORMATS.items()}
    answers = binary(media_types, description, coloured=True)
    answers[200]["model"] = MeshAnswer
    return answers


def upload(description: str) -> dict[str, Any]:
    """Describe a body that is a file, JSON of a mesh, or a form with a file.

    A file may have its own media type, and a form the query's parameters as fields. Neither is listed: generators of
    clients don't know the types, and would make two arguments of each parameter.
    """
    file = {"type": "string", "format": "binary", "description": description}
    form = {"type": "object", "properties": {"file": file, OPTIONS: _OPTIONS}, "required": ["file"]}
    content = {
        _FORM: {"schema": form},
        "application/json": {"schema": {"$ref": f"#/components/schemas/{MeshAnswer.__name__}"}},
        OCTET_STREAM: {"schema": file},
    }
    return {"requestBody": {"required": True, "content": content}}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Describe the problems that a call may answer."""
    reference = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    return {
        status: {
            "description": "; ".join(
                f"{kind.title} (`{name}`)" for name, kind in KINDS.items() if kind.status == status
            ),
            "content": reference,
        }
        for status in statuses
    }


def _bodies(routers: Iterable[APIRouter]) -> Iterator[tuple[tuple[str, str], type[BaseModel]]]:
    """Yield the model of each call's body, by path and method."""
    for route in (route for router in routers for route in router.routes if isinstance(route, APIRoute)):
        for dependency in route.dependant.dependencies:
            if isinstance(dependency.call, JSONBody):
                yield from (((route.path, method.lower()), dependency.call.model) for method in route.methods or ())


def _say_defaults(schema: dict[str, Any]) -> None:
    """Move default values into descriptions: openapi-typescript requires every member with a default."""
    for member in schema.get("properties", {}).values():
        default = member.pop("default", None)
        if isinstance(default, str | int | float):
            member["description"] = f"{member.get('description', '')} Default: `{json.dumps(default)}`.".strip()


def _correct_responses(path: str, call: dict[str, Any]) -> None:
    responses = call["responses"]
    # FastAPI adds its own answer to bad parameters; the routes declare the problems that they answer instead.
    if "application/json" in responses.get("422", {}).get("content", {}):
        del responses["422"]
    if OPEN.fullmatch(path):
        call["security"] = []
    else:
        responses |= {str(status): answer for status, answer in problems(401).items()}
    call["responses"] = dict(sorted(responses.items()))
