"""Clients that others' generators make from the OpenAPI document: a mesh, an animation, and the code of a mesh."""

import json
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import httpx
import pytest

from shapespace.service.http.openapi import TARGET
from tests.service.conftest import ROOT, Server
from tests.service.glb import GLB

CODE = [0.1, 0.2, 0.3]
MODULES = ROOT / "tests" / "node_modules"
SCRIPT = ROOT / "tests" / "clients" / "typed.mts"


def run(*command: str | Path, cwd: Path) -> str:
    found = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout + found.stderr
    return found.stdout


def test_python(server: Server, client: httpx.Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "config.yml").write_text("post_hooks: []\n")
    options = ["--meta", "none", "--output-path", "generated", "--config", "config.yml", "--path", str(TARGET)]
    generator = Path(sys.executable).with_name("openapi-python-client")
    run(generator, "generate", *options, cwd=tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    from generated import Client, models, types  # type: ignore[import-not-found]
    from generated.api.codes import encode  # type: ignore[import-not-found]
    from generated.api.interpolations import (  # type: ignore[import-not-found]
        create_interpolation,
        get_interpolation,
    )
    from generated.api.shapes import get_mesh, post_mesh  # type: ignore[import-not-found]

    glb = client.post("/v1/models/small/mesh", json={"latent": CODE}).content
    with Client(base_url=server.url) as generated:
        assert get_mesh.sync("small", client=generated, latent=CODE).payload.read() == glb
        body = models.MeshRequest(latent=CODE)
        assert post_mesh.sync("small", client=generated, body=body).payload.read() == glb
        keys = models.Animation(keyframes=[CODE, [0.4, 0.1, 0.0]], frames=3)
        made = create_interpolation.sync("small", client=generated, body=keys)
        animation = get_interpolation.sync(made.id, client=generated).payload.read()
        assert GLB(animation).key_count == 3
        form = models.EncodeFilesBody(types.File(BytesIO(glb), "shape.glb"))
        assert encode.sync("small", client=generated, body=form).latent == pytest.approx(CODE, abs=1e-3)


@pytest.mark.long
def test_typescript(server: Server, client: httpx.Client, tmp_path: Path) -> None:
    (tmp_path / "node_modules").symlink_to(MODULES)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / SCRIPT.name).write_bytes(SCRIPT.read_bytes())
    run("node", MODULES / "openapi-typescript" / "bin" / "cli.js", TARGET, "-o", "schema.d.ts", cwd=tmp_path)
    options = ["--strict", "--target", "es2022", "--module", "nodenext", "--lib", "es2022,dom,dom.iterable"]
    run("node", MODULES / "typescript" / "bin" / "tsc", *options, SCRIPT.name, cwd=tmp_path)
    found = json.loads(run("node", "typed.mjs", server.url, cwd=tmp_path))
    assert "small" in found["models"]
    assert found["meshes"] == 2 * [len(client.post("/v1/models/small/mesh", json={"latent": CODE}).content)]
    assert found["animation"] > found["meshes"][0]
    assert found["latent"] == pytest.approx(CODE, abs=1e-3)
