"""Files of the bundled models, read by trimesh, and those in glTF by the Khronos validator."""

import io
import json
import subprocess
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh

from shapespace.files.formats import MESH_FORMATS
from tests.service.conftest import ROOT
from tests.service.glb import GLB, VALIDATOR

MODELS = sorted(folder.name for folder in (ROOT / "models").iterdir())


@pytest.fixture(params=MODELS)
def model(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


def code(client: httpx.Client, model: str, share: float) -> list[float]:
    """A code at some share of the way from the lower to the upper bounds."""
    card = client.get(f"/v1/models/{model}").raise_for_status().json()
    return [low + share * (high - low) for low, high in zip(card["lower"], card["upper"], strict=True)]


def files(client: httpx.Client, model: str, formats: list[str], **params: Any) -> dict[str, bytes]:
    """A shape in several formats."""
    body = {"latent": code(client, model, 0.7)}
    path = f"/v1/models/{model}/mesh"
    return {
        format: client.post(path, json=body, params={**params, "format": format}).raise_for_status().content
        for format in formats
    }


def test_trimesh_reads_every_format_of_a_shape(client: httpx.Client, model: str) -> None:
    found = files(client, model, [*MESH_FORMATS, "json"])
    expected = json.loads(found.pop("json"))
    vertices, faces = np.array(expected["vertices"]), np.array(expected["faces"])
    with np.load(io.BytesIO(found.pop("npz"))) as arrays:
        assert np.array_equal(arrays["vertices"], vertices.astype(np.float32))
        assert np.array_equal(arrays["faces"], faces)
    tolerance = 1e-5 * np.linalg.norm(np.ptp(vertices, axis=0))
    normals = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]], vertices[faces[:, 2]] - vertices[faces[:, 0]])
    for format, content in found.items():
        mesh = trimesh.load_mesh(io.BytesIO(content), file_type=format, process=False)
        np.testing.assert_allclose(mesh.triangles, vertices[faces], atol=tolerance, err_msg=format)
        if format == "stl":  # STL has one normal for each face
            stored = np.frombuffer(content, np.dtype("<3f4, <9f4, <u2"), offset=84)["f0"]
            unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
            np.testing.assert_allclose(stored, unit, atol=1e-3)
        else:
            np.testing.assert_allclose(mesh.vertices, vertices, atol=tolerance, err_msg=format)
            assert np.array_equal(mesh.faces, faces), format

    assert trimesh.Trimesh(vertices, faces, process=False).volume > 0, "wound inside out"
    at_vertices = np.zeros_like(vertices)
    for corner in faces.T:
        np.add.at(at_vertices, corner, normals)
    at_vertices /= np.linalg.norm(at_vertices, axis=1, keepdims=True)
    glb = GLB(found["glb"])
    np.testing.assert_allclose(glb.array(glb.primitive["attributes"]["NORMAL"]), at_vertices, atol=1e-3)


def test_the_validator_finds_no_fault_in_any_gltf(client: httpx.Client, model: str, tmp_path: Path) -> None:
    contents: dict[str, bytes] = {"reference.glb": client.get(f"/v1/models/{model}/mesh").content}
    for options in ({}, {"color": "stretch"}, {"color": "bending"}):
        for format, content in files(client, model, ["glb", "gltf"], **options).items():
            contents[f"{'-'.join(['shape', *options.values()])}.{format}"] = content
    for frames in (3, 65):
        body = {"keyframes": [code(client, model, share) for share in (0.5, 0.6)], "frames": frames}
        link = client.post(f"/v1/models/{model}/interpolations", json=body).raise_for_status().json()["links"]["glb"]
        contents[f"{frames}-frames.glb"] = client.get(link).raise_for_status().content
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    report = subprocess.run(
        ["node", VALIDATOR, *(tmp_path / name for name in contents)], capture_output=True, text=True, check=False
    )
    found = [json.loads(line) for line in report.stdout.splitlines()]
    assert len(found) == len(contents), report.stderr
    for name, issues in zip(contents, (each["issues"] for each in found), strict=True):
        assert issues["numErrors"] == issues["numWarnings"] == 0, (name, issues["messages"][:3])
