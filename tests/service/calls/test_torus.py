"""The bundled Freaky Torus over HTTP, compared with the formula it was learned from."""

from pathlib import Path

import httpx
import numpy as np

from shapespace.mesh.rigid_motion import align
from shapespace.training.collection.generators import freaky_torus
from tests.service.glb import GLB, khronos_report

MODEL = "/v1/models/freaky-torus"


def distances(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """(…, V) distances between vertices after rigid alignment."""
    aligned: list[np.ndarray] = [align(x, y) for x, y in zip(found, expected, strict=True)]
    return np.linalg.norm(np.array(aligned) - expected, axis=-1)


def test_one_call_gives_a_valid_glb_with_the_bump_where_it_was_asked_for(client: httpx.Client, tmp_path: Path) -> None:
    answer = client.post(f"{MODEL}/mesh", json={"latent": [1, 2, 3, 4]}).raise_for_status()
    path = tmp_path / "torus.glb"
    path.write_bytes(answer.content)
    report = khronos_report(path)
    assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0, report["issues"]
    assert report["info"]["totalVertexCount"] == 2048
    shape = GLB(answer.content)
    assert np.array_equal(shape.faces, freaky_torus.connectivity().faces)
    # The same surface with its bump on the other side of the ring.
    elsewhere = freaky_torus.vertices(np.array([[1, 2, 3 + np.pi, 4]]))
    moved = distances(shape.positions[None].astype(float), elsewhere)[0].reshape(64, 32)
    here = slice(31 - 12, 31 + 12)  # u = 3 is column 30.6
    i, j = np.unravel_index(moved[here].argmax(), moved[here].shape)
    assert abs(19 + i - 3 * 64 / (2 * np.pi)) < 1.5
    assert abs(j - 4 * 32 / (2 * np.pi)) < 1.5
    assert moved[here].max() > 0.5 * freaky_torus.PAPER.bump_height


def test_the_reference_is_the_generators(client: httpx.Client) -> None:
    vertices = client.get(f"{MODEL}/mesh", params={"format": "json"}).raise_for_status().json()["vertices"]
    np.testing.assert_allclose(vertices, freaky_torus.reference().vertices, atol=1e-6)
    card = client.get(MODEL).json()
    assert [(f["start"], f["stop"]) for f in card["factors"]] == [(0, 1), (1, 2), (2, 4)]
    assert card["period"] == [freaky_torus.PERIOD] * 4
    assert card["figures"]["r2"]["composite"]["total"] >= 0.99
