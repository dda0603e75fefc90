"""``quality=draft``: shapes from face frames, faster than solved ones and nearly equal; omitted faces."""

import io
import json
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.bundle.schema import MANIFEST
from shapespace.client import Client
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.model.shape_model import load
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, Start

MODEL = "/v1/models/figure"
CODE = [0.3, -0.2] * 10
LATENT = ",".join(map(str, CODE))
#: A code so far outside the bounds that face frames give a bad shape.
FAR = [3.0, -3.0] * 10


def quality(answer: httpx.Response) -> str:
    return str(json.loads(answer.raise_for_status().headers["Shape-Diagnostics"])["quality"])


def positions(answer: httpx.Response) -> np.ndarray:
    with np.load(io.BytesIO(answer.raise_for_status().content)) as arrays:
        found: np.ndarray = arrays["vertices"]
        return found


def test_a_draft_is_near_the_shape_and_is_none_of_it(client: httpx.Client) -> None:
    card = client.get(MODEL).json()
    by_quality = {
        name: client.get(f"{MODEL}/mesh", params={"latent": LATENT, "format": "npz", "quality": name})
        for name in ("full", "draft")
    }
    assert {name: quality(answer) for name, answer in by_quality.items()} == {"full": "full", "draft": "draft"}
    assert by_quality["draft"].headers["ETag"] != by_quality["full"].headers["ETag"]
    full, draft = (positions(answer).astype(float) for answer in by_quality.values())
    away = np.linalg.norm(full - draft, axis=1) / diagonal(full)
    assert 0 < away.mean() < 5e-3
    assert 0 < card["draft_error"]["mean"] < card["draft_error"]["p95"] < 0.01
    diagnostics = json.loads(by_quality["draft"].headers["Shape-Diagnostics"])
    assert (diagnostics["iterations"], diagnostics["status"]) == (0, "converged")
    assert diagnostics["residual"] > json.loads(by_quality["full"].headers["Shape-Diagnostics"])["residual"]


def test_every_call_answers_the_same_draft(client: httpx.Client) -> None:
    get = client.get(f"{MODEL}/mesh", params={"latent": LATENT, "format": "npz", "quality": "draft"})
    expected = positions(get)
    body: dict[str, Any] = {"latent": CODE, "quality": "draft"}
    posted = client.post(f"{MODEL}/mesh?format=npz", json=body)
    assert (posted.content, posted.headers["ETag"]) == (get.content, get.headers["ETag"])
    by_query = client.post(f"{MODEL}/mesh?format=npz&quality=draft", json={"latent": CODE})
    assert by_query.headers["ETag"] == get.headers["ETag"]
    again = client.get(
        f"{MODEL}/mesh",
        params={"latent": LATENT, "format": "npz", "quality": "draft"},
        headers={"If-None-Match": get.headers["ETag"]},
    )
    assert again.status_code == 304

    many = client.post(f"{MODEL}/vertices", json={"latents": [CODE], "quality": "draft"}).raise_for_status().json()
    np.testing.assert_array_equal(np.float32(many["vertices"][0]), expected)
    assert many["diagnostics"][0]["quality"] == "draft"

    links = client.post(f"{MODEL}/interpolations", json={"keyframes": [CODE, [0.0] * 20], "frames": 2}).json()["links"]
    frame = links["frames"].replace("{k}", "0")
    np.testing.assert_array_equal(positions(client.get(f"{frame}?format=npz&quality=draft")), expected)
    npz = client.get(f"{links['self']}?format=npz&quality=draft")
    # Networks run for several frames at once, with sums in another order.
    np.testing.assert_allclose(positions(npz)[0], expected, atol=1e-6)
    assert quality(npz) == "draft"
    assert npz.headers["ETag"] != client.get(f"{links['self']}?format=npz").headers["ETag"]
    line = client.get(f"{links['self']}?format=jsonl&quality=draft").text.splitlines()[0]
    np.testing.assert_array_equal(np.float32(json.loads(line)["vertices"]), expected)

    tensor = {"name": "latent", "shape": [1, 20], "datatype": "FP32", "data": CODE}
    asked = {"inputs": [tensor], "outputs": [{"name": "vertices"}], "parameters": {"quality": "draft"}}
    inferred = client.post("/v2/models/figure/infer", json=asked)
    np.testing.assert_array_equal(np.float32(inferred.json()["outputs"][0]["data"]), expected.ravel())
    assert quality(inferred) == "draft"


def test_where_frames_go_astray_the_shape_is_solved(client: httpx.Client) -> None:
    full, draft = (
        client.post(f"{MODEL}/mesh?format=npz", json={"latent": FAR, "quality": name}) for name in ("full", "draft")
    )
    assert quality(draft) == "full"
    assert full.content == draft.content
    many = client.post(f"{MODEL}/vertices", json={"latents": [CODE, FAR], "quality": "draft"}).json()["diagnostics"]
    assert [each["quality"] for each in many] == ["draft", "full"]


def test_drafts_are_coloured_and_placed_as_shapes_are(client: httpx.Client) -> None:
    query = {"latent": LATENT, "format": "json", "mesh": "coarse", "color": "stretch", "against": LATENT}
    answer = client.get(f"{MODEL}/mesh", params={**query, "quality": "draft"})
    assert quality(answer) == "draft"
    assert np.abs(answer.json()["color"]["values"]).max() == 0, "both are drafts"
    place = json.dumps({"translation": [1, 2, 3]})
    moved, still = (
        client.post(f"{MODEL}/vertices", params=params, json={"latents": [CODE], "quality": "draft"}).json()["vertices"]
        for params in ({"place": place}, {})
    )
    np.testing.assert_allclose(moved, np.array(still) + np.array([1, 2, 3]), atol=1e-5)


@pytest.mark.parametrize("call", ["mesh", "vertices"])
def test_another_quality_is_refused(client: httpx.Client, call: str) -> None:
    latent = {"mesh": {"latent": CODE}, "vertices": {"latents": [CODE]}}[call]
    for answer in (
        client.post(f"{MODEL}/{call}", json={**latent, "quality": "best"}),
        client.post(f"{MODEL}/{call}?quality=best", json=latent),
    ):
        assert answer.status_code == 422
        assert "quality" in answer.json()["detail"]


def test_positions_come_without_faces_where_these_are_known(client: httpx.Client) -> None:
    body = {"latents": [CODE], "mesh": "coarse"}
    files = [client.post(f"{MODEL}/vertices?format=npz", json=body | more) for more in ({}, {"faces": False})]
    names = [set(np.load(io.BytesIO(answer.raise_for_status().content)).files) for answer in files]
    assert names[0] - names[1] == {"faces"}
    assert names[1] <= names[0]
    np.testing.assert_array_equal(*map(positions, files))


def test_library_and_client_answer_drafts(server: Server) -> None:
    model = load(ROOT / "models" / "figure")
    draft = model.decode(CODE, quality="draft")
    with Client(server.url) as client:
        (found,) = client.vertices("figure", [CODE], quality="draft")
        np.testing.assert_array_equal(found, draft.astype(np.float32))
        np.testing.assert_array_equal(client.shape("figure", CODE, quality="draft").vertices, found)
        path = client.interpolate("figure", [CODE, [0.0] * 20], frames=2, quality="draft")
        np.testing.assert_array_equal(next(iter(path)), found)
        np.testing.assert_allclose(path.vertices()[0], found, atol=1e-6)
    assert np.abs(draft - model.decode(CODE)).max() > 0


def test_the_card_tells_how_near_it_comes_to_shapes_that_it_has_not_seen(client: httpx.Client) -> None:
    card = client.get(MODEL).json()
    unseen, measured = card["generalisation"], card["figures"]["generalisation"]
    assert (unseen["mean"], unseen["p95"]) == tuple(measured["modes"][-1].values())
    assert unseen["components"] == measured["components"][-1]
    assert (unseen["shapes"], unseen["modes"]) == (measured["held_out"], measured["counts"][-1])
    torus = client.get("/v1/models/freaky-torus").json()
    assert torus["generalisation"] is None, "a product by design has no shapes to hold out"


def test_the_card_tells_what_the_space_spans(tmp_path: Path, start: Start) -> None:
    write_bundle(tmp_path, "small")
    card = httpx.get(f"{start(tmp_path).url}/v1/models/small").raise_for_status().json()
    for name in ("compactness", "specificity"):
        assert card[name] == card["figures"][name]
        assert card[name]["modes"] > 0


def test_cards_of_bundles_that_do_not_tell_how_near_they_come(tmp_path: Path, start: Start) -> None:
    figures = [
        None,
        {},
        {"failed": "no mean"},
        {"held_out": 1, "counts": [1], "modes": [{}], "components": [{}]},
        "1 %",
    ]
    for k, unseen in enumerate(figures):
        manifest = write_bundle(tmp_path, f"older-{k}") / MANIFEST
        facts = json.loads(manifest.read_text()) | {"figures": {"generalisation": unseen, "specificity": unseen}}
        facts.pop("draft_error")
        manifest.write_text(json.dumps(facts))
    server = start(tmp_path)
    for k in range(len(figures)):
        card = httpx.get(f"{server.url}/v1/models/older-{k}").raise_for_status().json()
        names = "draft_error", "generalisation", "compactness", "specificity"
        assert [card[name] for name in names] == [None] * 4
