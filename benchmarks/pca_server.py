"""The least that a shape server does, for comparison: ``python -m benchmarks.pca_server MODELS``.

A shape is a mean plus m principal components of 64 random shapes. FastAPI answers it as the same GLB as our server.
"""

import sys
from pathlib import Path

import numpy as np
import uvicorn
from fastapi import FastAPI, Response
from pydantic import BaseModel

from benchmarks.bundles import bundles
from shapespace.files.formats import MESH_FORMATS
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import load


class Request(BaseModel):
    """A code."""

    latent: list[float]


def app(models: Path) -> FastAPI:
    """Return the application, with the principal components of every model in a folder."""
    server, spaces = FastAPI(), {}
    for path in bundles(models):
        model = load(path)
        shapes = model.decode(model.sample(64), quality="draft").reshape(64, -1)
        mean = shapes.mean(axis=0)
        axes = np.linalg.svd(shapes - mean, full_matrices=False)[2][: model.dimension]
        faces, surface = model.faces, model.decoder.surface(MeshChoice.FINE)
        spaces[model.manifest.name] = mean.astype(np.float32), axes.astype(np.float32), faces, surface

    @server.get("/v2/health/ready")
    def ready() -> dict[str, bool]:
        return {"ready": True}

    @server.post("/v1/models/{name}/mesh")
    async def mesh(name: str, request: Request) -> Response:
        mean, axes, faces, surface = spaces[name]
        vertices = (mean + np.array(request.latent, np.float32) @ axes).reshape(-1, 3)
        content = MESH_FORMATS["glb"].encode(vertices.astype(np.float64), faces, None, surface)
        return Response(content, media_type="model/gltf-binary")

    return server


if __name__ == "__main__":
    config = uvicorn.Config(app(Path(sys.argv[1])), port=0, log_level="error")
    sockets = [config.bind_socket()]
    print(f"http://127.0.0.1:{sockets[0].getsockname()[1]}", flush=True)
    uvicorn.Server(config).run(sockets)
