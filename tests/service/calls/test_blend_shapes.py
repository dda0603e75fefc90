"""``blendshapes``: morph targets for programs that can't run networks, checked by the glTF specification."""

import asyncio
import json
from pathlib import Path

import httpx
import numpy as np
import pytest

from shapespace.client import Client
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel, load
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.refusals import RefusedError
from shapespace.service.use_cases import many_shapes
from shapespace.service.use_cases.many_shapes import blend_shapes_file
from tests.service.conftest import ROOT, Server
from tests.service.glb import GLB, khronos_report

PATH = "/v1/models/figure/blendshapes"


@pytest.fixture(scope="module")
def model() -> ShapeModel:
    return load(ROOT / "models" / "figure")


@pytest.fixture(scope="module")
def file(client: httpx.Client) -> bytes:
    return client.get(PATH, params={"mesh": "coarse"}).raise_for_status().content


def targets(file: bytes) -> np.ndarray:
    glb = GLB(file)
    return np.stack([glb.array(target["POSITION"]) for target in glb.primitive["targets"]]).astype(float)


def test_weights_of_one_lead_to_the_ends_of_each_coordinate(model: ShapeModel, file: bytes) -> None:
    glb, zero = GLB(file), np.zeros(20)
    rest = model.decode(zero, mesh="coarse", quality="full")
    np.testing.assert_allclose(glb.positions, rest, atol=1e-6)
    moves, mesh = targets(file), glb.tree["meshes"][0]
    names = mesh["extras"]["targetNames"]
    assert len(moves) == len(names) == 40 == len(mesh["weights"])
    assert not any(mesh["weights"])
    for k in (0, 7, 19):
        for side, sign, bounds in ((0, "+", model.upper), (1, "-", model.lower)):
            code = zero.copy()
            code[k] = bounds[k]
            assert names[2 * k + side] == f"{model.names[k]} {sign}"
            end = align(model.decode(code, mesh="coarse", quality="full"), rest)
            np.testing.assert_allclose(rest + moves[2 * k + side], end, atol=1e-5)


def test_the_error_that_it_states_is_that_of_the_linear_blend(model: ShapeModel, file: bytes) -> None:
    stated = GLB(file).tree["asset"]["extras"]["error"]
    rest, moves = model.decode(np.zeros(20), mesh="coarse"), targets(file)
    away = []
    for code in model.sample(30, seed=9):
        weights = np.stack([(code / model.upper).clip(0), (code / model.lower).clip(0)], axis=1).ravel()
        blend = rest + np.tensordot(weights, moves, 1)
        shape = align(model.decode(code, mesh="coarse"), blend)
        away.append(np.linalg.norm(shape - blend, axis=1).mean() / diagonal(model.vertices))
    assert np.mean(away) == pytest.approx(stated["mean"], rel=0.3)
    assert stated["mean"] < stated["p95"]


def test_it_is_sound_gltf(file: bytes, tmp_path: Path) -> None:
    path = tmp_path / "figure.glb"
    path.write_bytes(file)
    assert khronos_report(path)["issues"]["numErrors"] == 0


def test_it_is_kept_by_its_tag_and_tells_meshes_apart(client: httpx.Client) -> None:
    coarse, fine = (client.get(PATH, params={"mesh": mesh}).raise_for_status() for mesh in ("coarse", "fine"))
    assert coarse.headers["Content-Type"] == "model/gltf-binary"
    assert coarse.headers["ETag"] != fine.headers["ETag"]
    again = client.get(PATH, headers={"If-None-Match": fine.headers["ETag"]})
    assert again.status_code == 304
    assert client.get(PATH).content == fine.content
    assert len(GLB(fine.content).positions) == 4601


def test_angles_have_no_ends(client: httpx.Client) -> None:
    answer = client.get("/v1/models/freaky-torus/blendshapes")
    assert answer.status_code == 422
    assert answer.json()["type"].endswith(":periodic")
    assert "angles" in answer.json()["detail"]
    assert "blendshapes" not in client.get("/v1/models/freaky-torus").json()["links"]
    assert client.get("/v1/models/figure").json()["links"]["blendshapes"] == PATH


def test_more_than_an_answer_holds_is_refused_before_it_is_made(
    model: ShapeModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(many_shapes, "MOST_VERTICES", 41 * 1000 - 1)
    workers = Workers(1, 0, deadline=60)
    with pytest.raises(RefusedError, match="41 shapes of 1000 vertices are too many"):
        asyncio.run(blend_shapes_file(Caller(workers, "somebody", asyncio.Event().wait), model, MeshChoice.COARSE))
    workers.close()


def test_library_and_client_give_the_same(server: Server, model: ShapeModel, file: bytes) -> None:
    with Client(server.url) as client:
        assert client.blend_shapes("figure", mesh="coarse") == file
    assert model.blend_shapes("coarse").glb() == file
    assert json.dumps(model.blend_shapes("coarse").error) == json.dumps(GLB(file).tree["asset"]["extras"]["error"])
