"""The contract as OpenAPI 3.1: what FastAPI gathers from the routes, and what it can't know."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from service.inference import InferenceRequest
from service.middleware import OPEN
from service.responses import problems
from service.schemas import Problem

DESCRIPTION = """\
Learned product shape manifolds of triangle meshes. A latent code goes through small networks to edge lengths
and dihedral angles, and from those by Gauss–Newton to a mesh.

Coordinates are in the units of the training meshes, indices start at 0, every mesh is rigidly aligned to the
model's reference. Every error is a problem (RFC 9457) whose `detail` says what to do.
"""


#: Bodies that FastAPI doesn't read itself, or only answers with.
_MODELS: tuple[type[BaseModel], ...] = (InferenceRequest, Problem)
_KEYS = {
    "bearer": {"type": "http", "scheme": "bearer"},
    "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
}


def describe(app: FastAPI) -> None:
    """Have an application generate its description."""

    def generate() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(
                title=app.title,
                version=app.version,
                summary=app.summary,
                description=DESCRIPTION,
                routes=app.routes,
            )
            _, definitions = models_json_schema(
                [(model, "validation") for model in _MODELS], ref_template="#/components/schemas/{model}"
            )
            components = schema["components"]
            for superfluous in ("HTTPValidationError", "ValidationError"):
                components["schemas"].pop(superfluous, None)
            components["schemas"] = dict(sorted((components["schemas"] | definitions["$defs"]).items()))
            components["securitySchemes"] = _KEYS
            # The empty one: a server without a key, which is the default.
            schema["security"] = [{}, *({name: []} for name in _KEYS)]
            for path, calls in schema["paths"].items():
                for call in calls.values():
                    _correct(path, call)
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = generate  # type: ignore[method-assign]


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
