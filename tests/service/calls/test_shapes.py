"""Codes to meshes, positions, lengths and angles."""

import json
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest

from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.mesh.rigid_motion import align
from tests.service.bundles import SCALE, expected_nric, reference

MESH = "/v1/models/small/mesh"
CODE = [0.1, 0.7, 0.4]


def positions(answer: httpx.Response) -> np.ndarray:
    return np.array(answer.raise_for_status().json()["vertices"])


def test_a_uniform_scaling_comes_out_exactly_in_the_users_units(client: httpx.Client) -> None:
    answer = client.post(MESH, json={"latent": [0.15, 0, 0]}, params={"format": "json"})
    # It grows about its centre, as every shape is aligned to the reference.
    x = SCALE * reference().vertices
    np.testing.assert_allclose(positions(answer), x.mean(axis=0) + 1.15 * (x - x.mean(axis=0)), atol=1e-5)
    diagnostics = json.loads(answer.headers["Shape-Diagnostics"])
    assert diagnostics["status"] == "converged"
    assert diagnostics["residual"] < 1e-6
    assert diagnostics["flipped_faces"] == 0
    assert diagnostics["inside_bounds"] is True
    assert diagnostics["model"] == client.get("/v1/models/small").json()["digest"]
    assert set(diagnostics) == {
        "status", "iterations", "residual", "flipped_faces", "integrability", "plausibility", "inside_bounds", "model",
        "quality",
    }  # fmt: skip


def test_the_residual_is_that_of_the_answered_shape(client: httpx.Client) -> None:
    answer = client.post(MESH, json={"latent": CODE}, params={"format": "json"})
    mesh, target = reference(), expected_nric(np.array(CODE))
    norm = WeightedNorm.of(mesh, 1e-2)
    misfit = norm.square(nric(positions(answer) / SCALE, mesh.connectivity) - target) / norm.square(target)
    reported = json.loads(answer.headers["Shape-Diagnostics"])["residual"]
    assert reported == pytest.approx(np.sqrt(misfit), rel=1e-3)
    assert reported > 1e-6, "the test needs a code whose lengths and angles are not integrable"


def test_every_mesh_is_rigidly_aligned_to_the_reference(client: httpx.Client) -> None:
    target = SCALE * reference().vertices
    for code in ([0.2, 1.5, 1.0], [-0.2, -3.0, 0.3], [0.5, 2.0, 2.0]):
        found = positions(client.post(MESH, json={"latent": code}, params={"format": "json"}))
        np.testing.assert_allclose(found, align(found, target), atol=2e-6)
    # Each mesh is aligned over its own vertices, whose density varies.
    for mesh in ("coarse", "fine"):
        answer = client.post(
            "/v1/models/figure/vertices", json={"latents": [[0.6] * 20], "mesh": mesh}
        ).raise_for_status()
        found = np.array(answer.json()["vertices"][0])
        rest = positions(client.get("/v1/models/figure/mesh", params={"format": "json", "mesh": mesh}))
        np.testing.assert_allclose(found, align(found, rest), atol=1e-5)


def test_head_is_answered_wherever_get_is_without_a_body(client: httpx.Client) -> None:
    for path in ("/v1/models", MESH, "/v2/health/live", "/openapi.json", "/metrics"):
        head, get = client.head(path), client.get(path)
        assert (head.status_code, head.content) == (200, b"")
        assert head.headers["Content-Type"] == get.headers["Content-Type"]
    assert client.head(MESH).headers["ETag"] == client.get(MESH).headers["ETag"]
    assert client.head("/v1/models/none").status_code == 404


def test_lengths_and_angles_are_those_of_the_networks(client: httpx.Client) -> None:
    codes = [CODE, [0.0, -1.0, 0.2]]
    answer = client.post("/v1/models/small/nric", json={"latents": codes, "factors": True}).json()
    half = len(reference().edges)
    for k, code in enumerate(codes):
        z = expected_nric(np.array(code))
        np.testing.assert_allclose(answer["lengths"][k], SCALE * z[:half], rtol=1e-5)
        np.testing.assert_allclose(answer["angles"][k], z[half:], atol=1e-5)
        alone = [expected_nric(np.array([code[0], 0, 0])), expected_nric(np.array([0, *code[1:]]))]
        for psi, expected in zip(answer["factors"][k], alone, strict=True):
            np.testing.assert_allclose(psi[:half], SCALE * expected[:half], rtol=1e-5)
            np.testing.assert_allclose(psi[half:], expected[half:], atol=1e-5)
    assert "factors" not in client.post("/v1/models/small/nric", json={"latents": codes}).json()


def test_a_start_network_changes_the_way_and_not_the_shape(client: httpx.Client) -> None:
    with_start, without = (
        client.post(MESH, json={"latent": [0.2, 0.3, 0.2]}, params={"format": "json", "version": version})
        for version in ("2", "1")
    )
    np.testing.assert_allclose(positions(with_start), positions(without), atol=1e-5)
    exact = client.post(MESH, json={"latent": [0.2, 0, 0]}, params={"format": "json", "version": "2"})
    assert json.loads(exact.headers["Shape-Diagnostics"])["iterations"] <= 2


@pytest.mark.parametrize(
    ("accept", "media_type"),
    [
        ("*/*", "model/gltf-binary"),
        ("model/obj", "model/obj"),
        ("application/json;q=0.9, model/obj;q=0.1", "application/json"),
        ("model/*;q=0.5, model/gltf-binary;q=0", "model/gltf+json"),
        ("text/html, application/xhtml+xml, */*;q=0.8", "model/gltf-binary"),
    ],
)
def test_accept_is_weighed(client: httpx.Client, accept: str, media_type: str) -> None:
    answer = client.get(MESH, headers={"Accept": accept}).raise_for_status()
    assert answer.headers["Content-Type"] == media_type
    assert "Accept" in answer.headers["Vary"].split(", ")
    assert client.get(MESH, headers={"Accept": accept}, params={"format": "stl"}).headers["Content-Type"] == (
        "model/stl"
    )


def test_bounds_allow_clamp_and_reject(client: httpx.Client) -> None:
    def ask(code: list[float], bounds: str) -> httpx.Response:
        return client.post(MESH, json={"latent": code, "bounds": bounds}, params={"format": "json"})

    outside, at_bound = [0.4, 0.0, 0.5], [0.2, 0.0, 0.5]
    allowed = ask(outside, "allow")
    assert json.loads(allowed.headers["Shape-Diagnostics"])["inside_bounds"] is False
    clamped = ask(outside, "clamp")
    assert json.loads(clamped.headers["Shape-Diagnostics"])["inside_bounds"] is True
    assert np.array_equal(positions(clamped), positions(ask(at_bound, "reject")))
    assert not np.allclose(positions(clamped), positions(allowed), atol=1e-3)
    assert ask(outside, "reject").status_code == 422


def test_an_angle_counts_modulo_its_period(client: httpx.Client) -> None:
    turned = [0.1, 0.7 + 2 * np.pi, 0.4]
    a = client.post(MESH, json={"latent": turned, "bounds": "reject"}, params={"format": "json"})
    b = client.post(MESH, json={"latent": CODE}, params={"format": "json"})
    np.testing.assert_allclose(positions(a), positions(b), atol=1e-5)


def test_get_and_post_share_a_strong_entity_tag(client: httpx.Client) -> None:
    link = client.get(MESH, params={"latent": "0.1,0.7,0.4"})
    post = client.post(MESH, json={"latent": CODE})
    tag = link.headers["ETag"]
    assert tag == post.headers["ETag"]
    assert not tag.startswith("W/")
    assert link.content == post.content
    for request in (
        client.build_request("GET", MESH, params={"latent": "0.1,0.7,0.4"}, headers={"If-None-Match": tag}),
        client.build_request("POST", MESH, json={"latent": CODE}, headers={"If-None-Match": f'"x", {tag}'}),
    ):
        answer = client.send(request)
        assert answer.status_code == 304
        assert answer.content == b""
        assert answer.headers["ETag"] == tag
        assert "Server-Timing" not in answer.headers, "a 304 needs no computation"
    assert client.post(MESH, json={"latent": CODE}, headers={"If-None-Match": '"else"'}).status_code == 200


def test_entity_tags_tell_different_answers_apart(client: httpx.Client) -> None:
    asked = [
        {},
        {"latent": "0,0,0"},
        {"latent": "0.1,0,0"},
        {"latent": "0.1,0,0", "format": "obj"},
        {"latent": "0.1,0,0", "version": "1"},
    ]
    tags = [client.get(MESH, params=params).headers["ETag"] for params in asked]
    assert len(set(tags)) == len(tags)
    # Other codes of the same shape: −0, and a code beyond the bounds that is clamped.
    assert client.get(MESH, params={"latent": "0,-0.0,0"}).headers["ETag"] == tags[1]
    clamped = client.get(MESH, params={"latent": "0.9,0,0", "bounds": "clamp"})
    assert clamped.headers["ETag"] == client.get(MESH, params={"latent": "0.2,0,0"}).headers["ETag"]


def test_timings_name_every_stage(client: httpx.Client) -> None:
    timing = client.post(MESH, json={"latent": [0.013, 0.7, 0.4]}).headers["Server-Timing"]
    stages = dict(part.split(";dur=") for part in timing.split(", "))
    assert list(stages) == ["network", "reconstruct", "encode"]
    assert all(float(duration) > 0 for duration in stages.values())


def test_side_by_side_gives_the_bytes_of_one_at_a_time(client: httpx.Client) -> None:
    codes = np.random.default_rng(5).uniform([-0.2, -3, 0], [0.2, 3, 1], (12, 3)).tolist()

    def ask(code: list[float]) -> bytes:  # by a call whose answers are not cached
        return client.post("/v1/models/small/vertices", json={"latents": [code]}).raise_for_status().content

    alone = [ask(code) for code in codes]
    with ThreadPoolExecutor(8) as pool:
        assert list(pool.map(ask, codes)) == alone


def test_far_out_the_answer_is_finite_or_a_problem(client: httpx.Client) -> None:
    answer = client.post(MESH, json={"latent": [0.1, 0.1, 30.0]}, params={"format": "json"})
    assert np.isfinite(positions(answer)).all()
    diagnostics = json.loads(answer.headers["Shape-Diagnostics"])
    assert diagnostics["residual"] > 0.01, "no surface has such lengths and angles"
    for code in ([-1.5, 1.0, 30.0], [3.4e38, 0.0, 0.0]):
        refused = client.post(MESH, json={"latent": code})
        assert refused.status_code == 422
        assert refused.json()["type"].endswith("not-finite")
