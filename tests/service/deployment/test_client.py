"""The Python client, with a server and without the rest of the project."""

import inspect
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path

import httpx
import numpy as np
import pytest

from shapespace.client import (
    Client,
    ClientError,
    EditParameters,
    EncodeParameters,
    FitParameters,
    Interpolation,
    SearchParameters,
)
from shapespace.model.options import EditOptions, EncodeOptions, FitOptions
from tests.service.bundles import SCALE, expected_nric, reference
from tests.service.conftest import ROOT, Server, Start
from tests.service.glb import GLB

CODES = np.array([[0.1, 0.7, 0.4], [0.0, -1.0, 0.2]])


@pytest.fixture
def shapes(server: Server) -> Iterator[Client]:
    with Client(server.url) as client:
        yield client


def test_models_and_cards(shapes: Client) -> None:
    assert {"figure", "freaky-torus", "small"} <= {model["name"] for model in shapes.models()}
    assert shapes.model("small")["version"] == "10"
    assert shapes.model("small", "2")["version"] == "2"


def test_shapes_come_as_files_and_arrays(shapes: Client) -> None:
    glb = GLB(shapes.mesh("small", CODES[0]))
    vertices = shapes.vertices("small", CODES)
    np.testing.assert_allclose(glb.positions, vertices[0], atol=1e-6)
    shape = shapes.shape("small", CODES[1])
    np.testing.assert_array_equal(shape.vertices, vertices[1])
    np.testing.assert_array_equal(shape.faces, reference().faces)
    np.testing.assert_allclose(shapes.shape("small").vertices, SCALE * reference().vertices, atol=1e-6)
    coarse, fine = (shapes.vertices("with-fine", CODES, mesh=mesh) for mesh in ("coarse", "fine"))
    assert coarse.shape[1] < fine.shape[1]
    assert shapes.mesh("small", CODES[0], "obj", version="2").startswith(b"v ")


def test_lengths_and_angles(shapes: Client) -> None:
    lengths, angles = shapes.nric("small", CODES)
    half = len(reference().edges)
    for k, code in enumerate(CODES):
        z = expected_nric(code)
        np.testing.assert_allclose(lengths[k], SCALE * z[:half], rtol=1e-5)
        np.testing.assert_allclose(angles[k], z[half:], atol=1e-5)


def test_an_interpolation_comes_whole_by_frames_and_as_a_stream(shapes: Client) -> None:
    path = shapes.interpolate("small", CODES, frames=4, stop=0.5)
    assert path.frames == 4
    vertices = path.vertices()
    np.testing.assert_array_equal(np.stack(list(path)), vertices)
    np.testing.assert_array_equal(vertices[0], shapes.vertices("small", CODES[:1])[0])
    np.testing.assert_allclose(GLB(path.file()).key(3), vertices[3], atol=1e-6)
    np.testing.assert_allclose(GLB(path.frame(2)).positions, vertices[2], atol=1e-6)


def test_codes_are_drawn_found_and_changed(shapes: Client, tmp_path: Path) -> None:
    codes = shapes.sample("small", 4, seed=7, distribution="gaussian")
    assert codes.shape == (4, 3)
    np.testing.assert_array_equal(codes, shapes.sample("small", 4, seed=7, distribution="gaussian"))
    shape = shapes.shape("small", codes[0])
    turned = replace(shape, vertices=shape.vertices @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], np.float32) + 5)
    (tmp_path / "shape.obj").write_bytes(shapes.mesh("small", codes[0], "obj"))
    for mesh, format in (
        (turned, None),
        (tmp_path / "shape.obj", None),
        (str(tmp_path / "shape.obj"), None),
        (shapes.mesh("small", codes[0], "ply"), "ply"),
    ):
        found = shapes.encode("small", mesh, format)
        np.testing.assert_allclose(shapes.shape("small", found["latent"]).vertices, shape.vertices, atol=0.01 * SCALE)
    vertex = 5
    wanted = shapes.shape("small", codes[1]).vertices[vertex]
    before = np.linalg.norm(shape.vertices[vertex] - wanted)
    edited = shapes.edit("small", codes[0], {vertex: wanted}, prior=0.0)
    assert edited["residual"] < 0.2 * before
    there = shapes.shape("small", edited["latent"], place=edited["placement"]).vertices[vertex]
    np.testing.assert_allclose(np.linalg.norm(there - wanted), edited["residual"], atol=1e-4)
    held = shapes.edit("small", codes[0], {vertex: wanted}, sigma=0.01, fixed={1: 0.25}, samples=2, prior_kind="ridge")
    assert held["latent"][1] == 0.25
    assert [code[1] for code in held["samples"]] == [0.25] * 2
    either = {vertex: {"position": wanted.tolist(), "sigma": 0.01}}
    assert shapes.edit("small", codes[0], either)["covariance"] != edited["covariance"]
    found = shapes.encode("small", shape, fixed={1: 0.25}, samples=2)
    assert found["latent"][1] == 0.25
    assert np.shape(found["samples"]) == (2, 3)
    assert shapes.sample("small", 4, distribution="population", temperature=0.1).shape == (4, 3)
    plain, unsure = (shapes.mesh("small", codes[0], "json", **o) for o in ({}, {"covariance": edited["covariance"]}))
    assert json.loads(unsure)["color"]["quantity"] == "spread"
    assert json.loads(unsure)["vertices"] == json.loads(plain)["vertices"]
    moved = {"translation": [1, 0, 0]}
    positions = [shapes.vertices("small", codes[:1], **options)[0] for options in ({}, {"place": moved})]
    np.testing.assert_allclose(positions[1] - positions[0], [[1, 0, 0]] * len(positions[0]), atol=1e-5)


@pytest.mark.parametrize(
    ("parameters", "options"),
    [(EncodeParameters, EncodeOptions), (EditParameters, EditOptions), (FitParameters, FitOptions)],
)
def test_parameters_are_the_options_of_the_library(parameters: type, options: type) -> None:
    assert set(parameters.__annotations__) == {"version", *(field.name for field in fields(options))}
    described = inspect.getsource(SearchParameters) + inspect.getsource(parameters)
    for name in parameters.__annotations__:
        assert re.search(rf"^ +{name}: .+  # ", described, re.MULTILINE), name


def test_problems_are_exceptions_that_say_what_to_do(shapes: Client) -> None:
    with pytest.raises(ClientError, match="Give exactly 3") as caught:
        shapes.vertices("small", [[1.0]])
    assert caught.value.status == 422
    assert caught.value.type == "urn:shapespace:problem:wrong-length"
    assert caught.value.request_id
    with pytest.raises(ClientError, match="There is no model"):
        shapes.model("large")
    with pytest.raises(ClientError, match="POST the keyframes"):
        next(iter(Interpolation(shapes, "abc", 3)))


def test_a_stream_that_ends_in_a_problem_is_an_exception_too(shapes: Client) -> None:
    path = shapes.interpolate("small", [CODES[0], [3.4e38, 0, 0]], frames=4)
    with pytest.raises(ClientError, match="nearer to the bounds") as caught:
        list(path)
    assert caught.value.status == 422
    assert caught.value.type == "urn:shapespace:problem:not-finite"


def test_a_proxy_that_names_a_date_to_ask_again_is_asked_again() -> None:
    answers = [
        httpx.Response(503, headers={"Retry-After": "Sat, 21 Nov 2026 18:00:00 GMT"}),
        httpx.Response(200, json={"models": []}),
    ]
    with Client("http://proxy") as client:
        client._http = httpx.Client(base_url="http://proxy", transport=httpx.MockTransport(lambda _: answers.pop(0)))
        assert client.models() == []


def test_it_brings_its_key_and_asks_a_busy_server_again(small_models: Path, start: Start) -> None:
    key = "sesame"
    url = start(small_models, workers=1, queue=0, api_key=key).url
    with Client(url) as stranger, pytest.raises(ClientError, match="Send the server's API key"):
        stranger.models()
    with pytest.raises(httpx.ConnectError), Client("http://127.0.0.1:9") as nobody:
        nobody.models()
    codes = np.tile(CODES[:1], (60, 1))
    with (
        ThreadPoolExecutor(3) as pool,
        Client(url, api_key=key, retries=30) as patient,
        Client(url, api_key=key, retries=0) as hasty,
    ):
        working = [pool.submit(patient.vertices, "small", codes) for _ in range(3)]
        refused: list[int] = []
        while not all(work.done() for work in working):
            try:
                hasty.vertices("small", CODES)
            except ClientError as error:
                refused.append(error.status)
        assert set(refused) == {503}
        assert all(len(work.result()) == 60 for work in working)


def test_it_needs_httpx_and_numpy_alone() -> None:
    program = """
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"fastapi", "onnxruntime", "orjson", "pydantic", "scipy", "starlette"}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Refuse())
import shapespace.client
print(sorted(name for name in sys.modules if name.startswith("shapespace")))
"""
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "['shapespace', 'shapespace.client']"
