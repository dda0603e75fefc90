"""The contract as OpenAPI 3.1; ``python -m service.openapi`` writes ``openapi/openapi.json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from fastapi.openapi.utils import get_openapi

from service.schemas import Problem

TARGET = Path(__file__).parent.parent / "openapi" / "openapi.json"
DESCRIPTION = """\
Learned product shape manifolds of triangle meshes. A latent code goes through small networks to edge lengths
and dihedral angles, and from those by Gauss–Newton to a mesh.

Coordinates are in the units of the training meshes, indices start at 0, every mesh is rigidly aligned to the
model's reference. Every error is a problem (RFC 9457) whose `detail` says what to do.
"""


def describe(app: FastAPI) -> None:
    """Have an application generate its description with the schema of problems in it."""

    def generate() -> dict[str, Any]:
        if app.openapi_schema is None:
            schema = get_openapi(
                title=app.title,
                version=app.version,
                summary=app.summary,
                description=DESCRIPTION,
                routes=app.routes,
            )
            schema["components"]["schemas"]["Problem"] = Problem.model_json_schema()
            app.openapi_schema = schema
        return app.openapi_schema

    app.openapi = generate  # type: ignore[method-assign]


def document() -> str:
    """The text of ``openapi/openapi.json``."""
    from service.app import create_app
    from service.settings import Settings

    return json.dumps(create_app(Settings()).openapi(), indent=2, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    TARGET.write_text(document(), encoding="utf-8")
    print(f"{TARGET.name} written")
