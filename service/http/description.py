"""The contract as OpenAPI 3.1: what FastAPI gathers from the routes, and what it can't know."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from fastapi import APIRouter, FastAPI
from fastapi.openapi.utils import get_openapi
from fastapi.routing import APIRoute
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from shapespace.service.http.messages.bodies import JSONBody
from shapespace.service.http.messages.inference_messages import InferenceRequest
from shapespace.service.http.messages.schemas import Problem
from shapespace.service.http.middleware import OPEN
from shapespace.service.http.responses import problems

DESCRIPTION = """\
Learned product shape manifolds of triangle meshes. A latent code goes through small networks to edge lengths
and dihedral angles, and from those by Gauss–Newton to a mesh.

Coordinates are in the units of the training meshes, indices start at 0, every mesh is rigidly aligned to the
model's reference. Every error is a problem (RFC 9457) whose `detail` says what to do.
"""


#: Bodies that routes read by themselves or only answer with, beside those of JSONBody.
_MODELS: tuple[type[BaseModel], ...] = (InferenceRequest, Problem)
_KEYS = {
    "bearer": {"type": "http", "scheme": "bearer"},
    "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}


def describe(app: FastAPI, routers: Iterable[APIRouter]) -> None:
    """Have an application of some routers generate its description, and know each call's query parameters by it."""
    bodies = dict(_bodies(routers))

    def generate() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(
                title=app.title,
                version=app.version,
                summary=app.summary,
                description=DESCRIPTION,
                routes=app.routes,
            )
            models = dict.fromkeys((*_MODELS, *bodies.values()))
            _, definitions = models_json_schema(
                [(model, "validation") for model in models], ref_template="#/components/schemas/{model}"
            )
            components = schema["components"]
            for superfluous in ("HTTPValidationError", "ValidationError"):
                components["schemas"].pop(superfluous, None)
            components["schemas"] = dict(sorted((components["schemas"] | definitions["$defs"]).items()))
            components["securitySchemes"] = _KEYS
            # The empty one: a server without a key, which is the default.
            schema["security"] = [{}, *({name: []} for name in _KEYS)]
            for path, calls in schema["paths"].items():
                for method, call in calls.items():
                    _correct(path, call)
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


def _bodies(routers: Iterable[APIRouter]) -> Iterator[tuple[tuple[str, str], type[BaseModel]]]:
    """The model of each call's body, by path and method."""
    for route in (route for router in routers for route in router.routes if isinstance(route, APIRoute)):
        for dependency in route.dependant.dependencies:
            if isinstance(dependency.call, JSONBody):
                yield from (((route.path, method.lower()), dependency.call.model) for method in route.methods or ())


def _correct(path: str, call: dict[str, Any]) -> None:
    responses = call["responses"]
    # FastAPI supposes its own answer to bad parameters; every call that has any says which problems it answers.
    if "application/json" in responses.get("422", {}).get("content", {}):
        del responses["422"]
    if OPEN.fullmatch(path):
        call["security"] = []
    else:
        responses |= {str(status): answer for status, answer in problems(401).items()}
    call["responses"] = dict(sorted(responses.items()))
