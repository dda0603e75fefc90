"""How searches for codes end: meshes that are no shapes of the model, and searches that have no time left."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.client import Client, Mesh
from shapespace.files.formats import MESH_FORMATS
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel, load
from tests.service.conftest import ROOT, Server, starting

CODE = np.linspace(-0.4, 0.4, 20)


@pytest.fixture(scope="module")
def figure() -> ShapeModel:
    return load(ROOT / "models" / "figure")


@pytest.fixture(scope="module")
def shape(figure: ShapeModel) -> np.ndarray:
    """A pose of the figure on the coarse mesh."""
    return figure.decode(CODE, mesh="coarse")


def exchange(shape: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    found = shape.copy()
    found[pairs] = shape[pairs[:, ::-1]]
    return found


def encode(client: httpx.Client, figure: ShapeModel, vertices: np.ndarray) -> dict[str, Any]:
    content = MESH_FORMATS["obj"].encode(vertices, figure.decoder.mesh(MeshChoice.COARSE).faces)
    answer = client.post("/v1/models/figure/encode", content=content, params={"format": "obj"})
    return answer.raise_for_status().json()


def test_vertices_in_another_order_are_poor_with_their_number(
    client: httpx.Client, figure: ShapeModel, shape: np.ndarray, rng: np.random.Generator
) -> None:
    found = encode(client, figure, rng.permutation(shape))
    assert (found["status"], found["cause"]) == ("poor", "order")
    assert "another order" in found["reason"]
    assert f"{len(found['misplaced'])} of 1000" in found["reason"]
    assert len(found["misplaced"]) > 900


@pytest.mark.parametrize("near", [True, False])
def test_exchanged_vertices_are_poor_and_named(
    client: httpx.Client, figure: ShapeModel, shape: np.ndarray, rng: np.random.Generator, near: bool
) -> None:
    edges = figure.decoder.mesh(MeshChoice.COARSE).connectivity.edges
    pairs = edges[::109] if near else rng.choice(len(shape), (30, 2), replace=False)
    assert len(np.unique(pairs)) == pairs.size
    found = encode(client, figure, exchange(shape, pairs))
    assert (found["status"], found["cause"]) == ("poor", "exchanged")
    assert set(found["misplaced"]) <= set(pairs.ravel().tolist())
    assert len(found["misplaced"]) >= 0.9 * pairs.size
    assert f"{len(found['misplaced'])} of 1000 vertices" in found["reason"]


def test_a_mirror_image_is_poor(client: httpx.Client, figure: ShapeModel, shape: np.ndarray) -> None:
    found = encode(client, figure, shape * [1, 1, -1])
    assert (found["status"], found["cause"], found["misplaced"]) == ("poor", "mirrored", [])
    assert "mirror image" in found["reason"]


def test_a_vertex_far_off_is_poor_and_named(client: httpx.Client, figure: ShapeModel, shape: np.ndarray) -> None:
    stray = shape.copy()
    stray[321] += 0.2 * np.linalg.norm(np.ptp(shape, axis=0))
    found = encode(client, figure, stray)
    assert (found["status"], found["cause"], found["misplaced"]) == ("poor", "outliers", [321])
    assert "Vertex 321 " in found["reason"]


def test_the_client_and_the_library_tell_the_same(client: httpx.Client, models: Path, rng: np.random.Generator) -> None:
    model = load(models / "with-fine")
    vertices = model.decode([0.1, 0.7, 0.4]).astype(np.float32)
    good, wrong = vertices, rng.permutation(vertices)
    with Client(str(client.base_url)) as caller:
        for mesh, status in ((good, "converged"), (wrong, "poor")):
            found = caller.encode("with-fine", Mesh(mesh, model.faces))
            expected = model.encode(mesh)
            assert found["status"] == expected.status == status
            assert (found["reason"], found["cause"]) == (expected.reason, expected.cause)
            assert found["misplaced"] == expected.misplaced.tolist()


class Hurried(Server):
    """A server whose searches are late as soon as they begin, although their requests have time."""

    program = (
        "-c",
        """
from shapespace.solve import deadline
deadline.COMPLETING_SHARE, deadline.COMPLETING_SECONDS = 1, 1e9
from shapespace.service.__main__ import main
main()
""",
    )


@pytest.fixture(scope="module")
def hurried(models: Path) -> Iterator[httpx.Client]:
    with starting(Hurried) as start, httpx.Client(base_url=start(models, deadline=300).url, timeout=300) as client:
        yield client


def test_a_late_search_answers_its_best_result_so_far(hurried: httpx.Client, figure: ShapeModel) -> None:
    shape = figure.decode(CODE)
    body = json.dumps({"vertices": shape.tolist()})
    targets = [{"vertex": 10, "position": (shape[10] + 0.1).tolist()}]
    for answer in (
        hurried.post("/v1/models/figure/fit", content=body, params={"format": "json"}),
        hurried.post("/v1/models/figure/encode", content=body, params={"format": "json"}),
        hurried.post("/v1/models/figure/edit", json={"latent": CODE.tolist(), "targets": targets}),
    ):
        found = answer.raise_for_status().json()
        assert found["status"] == "deadline"
        assert np.isfinite(found["latent"]).all()
        assert np.shape(found["covariance"]) == (20, 20)
        assert found["diagnostics"]["status"] == "converged"  # the result itself is complete
        assert "time ended" in found.get("reason", "time ended")
