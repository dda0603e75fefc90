"""Models with a fine mesh: every call with the parameter ``mesh`` answers the mesh that it names."""

import io
import json
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from tests.meshes import read_mesh
from tests.service.bundles import SCALE, fine_reference, reference

MODEL = "/v1/models/with-fine"
CODE = [0.1, 0.7, 0.4]
MESHES = {"fine": fine_reference, "coarse": reference}


@pytest.fixture(params=[*MESHES, None], ids=["fine", "coarse", "default"])
def choice(request: pytest.FixtureRequest) -> dict[str, str]:
    """The query's ``mesh`` parameter, or none."""
    return {"mesh": request.param} if request.param else {}


@pytest.fixture
def rest(choice: dict[str, str]) -> TriangleMesh:
    """The expected mesh, at the reference."""
    return MESHES[choice.get("mesh", "fine")]()


def shape(client: httpx.Client, mesh: str, code: list[float]) -> np.ndarray:
    answer = client.post(f"{MODEL}/mesh", json={"latent": code, "mesh": mesh}, params={"format": "json"})
    return np.array(answer.raise_for_status().json()["vertices"])


def test_the_reference(client: httpx.Client, choice: dict[str, str], rest: TriangleMesh) -> None:
    answer = client.get(f"{MODEL}/mesh", params={"format": "json", **choice}).raise_for_status()
    assert np.array_equal(answer.json()["faces"], rest.faces)
    np.testing.assert_allclose(answer.json()["vertices"], SCALE * rest.vertices, atol=1e-6)
    assert json.loads(answer.headers["Shape-Diagnostics"])["iterations"] == 0


@pytest.mark.parametrize("format", [*MESH_FORMATS, "json"])
def test_files(client: httpx.Client, choice: dict[str, str], rest: TriangleMesh, format: str) -> None:
    expected = shape(client, choice.get("mesh", "fine"), CODE)
    link = client.get(f"{MODEL}/mesh", params={"latent": "0.1,0.7,0.4", "format": format, **choice})
    post = client.post(f"{MODEL}/mesh", json={"latent": CODE, **choice}, params={"format": format})
    assert link.content == post.raise_for_status().content
    assert link.headers["ETag"] == post.headers["ETag"]
    assert f".{format}" in link.headers["Content-Disposition"]
    if format == "json":
        assert np.array_equal(link.json()["faces"], rest.faces)
        return
    mesh = read_mesh(link.content, format)
    if format == "stl":
        np.testing.assert_allclose(mesh.vertices, expected[rest.faces].reshape(-1, 3), atol=1e-6)
    else:
        np.testing.assert_allclose(mesh.vertices, expected, atol=1e-6)
        assert np.array_equal(mesh.faces, rest.faces)


def test_positions_of_many(client: httpx.Client, choice: dict[str, str], rest: TriangleMesh) -> None:
    codes = [CODE, [0, 0, 0], [0.2, 3.0, 1.0]]
    body = {"latents": codes, **choice}
    answer = client.post(f"{MODEL}/vertices", json=body).raise_for_status().json()
    assert len(answer["diagnostics"]) == 3
    for code, vertices in zip(codes, answer["vertices"], strict=True):
        assert np.array_equal(vertices, shape(client, choice.get("mesh", "fine"), code))
    packed = client.post(f"{MODEL}/vertices", json=body, params={"format": "npz"}).raise_for_status()
    with np.load(io.BytesIO(packed.content)) as arrays:
        assert np.array_equal(arrays["vertices"], np.float32(answer["vertices"]))
        assert np.array_equal(arrays["faces"], rest.faces)
        assert list(arrays["iterations"]) == [d["iterations"] for d in answer["diagnostics"]]


def test_animations(client: httpx.Client, choice: dict[str, str], rest: TriangleMesh) -> None:
    body: dict[str, Any] = {"keyframes": [[0, 0, 0], CODE], "frames": 3, **choice}
    links = client.post(f"{MODEL}/interpolations", json=body).raise_for_status().json()["links"]
    last = shape(client, choice.get("mesh", "fine"), CODE)

    def get(link: str) -> bytes:
        return client.get(links[link]).raise_for_status().content

    with np.load(io.BytesIO(get("npz"))) as arrays:
        assert np.array_equal(arrays["vertices"][2], np.float32(last))
        assert np.array_equal(arrays["faces"], rest.faces)
    lines = [json.loads(line) for line in get("jsonl").splitlines()]
    assert np.array_equal(lines[0]["faces"], rest.faces)
    assert np.array_equal(lines[2]["vertices"], last)
    frame = client.get(links["frames"].format(k=2), params={"format": "json"}).raise_for_status().json()
    assert np.array_equal(frame["vertices"], last)
    assert np.array_equal(frame["faces"], rest.faces)


def test_both_meshes_are_one_shape_each_aligned_over_its_own_vertices(client: httpx.Client) -> None:
    fine, coarse = (shape(client, mesh, CODE) for mesh in ("fine", "coarse"))
    on_fine = fine.reshape(32, 16, 3)[::4, ::2].reshape(-1, 3)
    np.testing.assert_allclose(align(on_fine, coarse), coarse, atol=1e-6)
    for found, rest in ((fine, fine_reference()), (coarse, reference())):
        np.testing.assert_allclose(align(found, SCALE * rest.vertices), found, atol=1e-6)
    assert np.abs(coarse - SCALE * reference().vertices).max() > 0.05, "the test needs a shape that differs"


def test_the_fine_mesh_grows_with_the_coarse_one(client: httpx.Client) -> None:
    x = SCALE * fine_reference().vertices
    centre = x.mean(axis=0)
    np.testing.assert_allclose(shape(client, "fine", [0.15, 0, 0]), centre + 1.15 * (x - centre), atol=1e-5)


def test_entity_tags_depend_on_the_mesh(client: httpx.Client) -> None:
    for params in ({}, {"latent": "0.1,0.7,0.4"}):
        fine, coarse, default = (
            client.get(f"{MODEL}/mesh", params=params | more) for more in ({"mesh": "fine"}, {"mesh": "coarse"}, {})
        )
        assert fine.headers["ETag"] == default.headers["ETag"] != coarse.headers["ETag"]
        assert fine.content == default.content != coarse.content


def test_a_model_without_a_finer_mesh_answers_with_the_one_it_has(client: httpx.Client) -> None:
    fine, coarse = (
        client.get("/v1/models/small/mesh", params={"latent": "0.1,0.7,0.4", "mesh": mesh}).raise_for_status()
        for mesh in ("fine", "coarse")
    )
    assert fine.content == coarse.content
