"""``?color=``: difference of a shape from the reference or from another code, at each vertex."""

import io
import json
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh

from shapespace.coordinates.nric import dihedral_angles, edge_lengths
from shapespace.mesh.triangle_mesh import Connectivity
from tests.service.glb import GLB

MODEL = "/v1/models/with-fine"
MESH = f"{MODEL}/mesh"
CODE, OTHER = [0.1, 0.7, 0.4], [-0.1, 1.5, 0.0]
QUANTITIES = ["stretch", "bending"]


def text(code: list[float]) -> str:
    return ",".join(map(str, code))


def mesh(client: httpx.Client, **params: Any) -> dict[str, Any]:
    content: dict[str, Any] = client.get(MESH, params={"format": "json", **params}).raise_for_status().json()
    return content


def expected(client: httpx.Client, quantity: str, choice: str, other: dict[str, str]) -> np.ndarray:
    """The values computed from the two meshes in the answers, in a plain loop over vertices."""
    shape, against = (mesh(client, mesh=choice, **which) for which in ({"latent": text(CODE)}, other))
    a, b = (np.array(m["vertices"]) for m in (shape, against))
    connectivity = Connectivity(np.array(shape["faces"]), len(a))
    lengths = edge_lengths(b, connectivity)
    if quantity == "stretch":
        change = np.log(edge_lengths(a, connectivity) / lengths)
    else:
        change = dihedral_angles(a, connectivity) - dihedral_angles(b, connectivity)
    touching = [np.flatnonzero((connectivity.edges == v).any(axis=1)) for v in range(len(a))]
    return np.array([np.average(change[e], weights=lengths[e]) for e in touching])


@pytest.mark.parametrize("quantity", QUANTITIES)
@pytest.mark.parametrize("choice", ["fine", "coarse"])
@pytest.mark.parametrize("against", [None, OTHER], ids=["reference", "code"])
def test_values_are_those_of_the_meshes_that_leave(
    client: httpx.Client, quantity: str, choice: str, against: list[float] | None
) -> None:
    asked = {"latent": text(CODE), "mesh": choice, "color": quantity}
    if against:
        asked["against"] = text(against)
    found = mesh(client, **asked)
    values = expected(client, quantity, choice, {"latent": text(against)} if against else {})
    np.testing.assert_allclose(found["color"]["values"], values, atol=2e-4)
    assert np.ptp(values) > 0.01, "the test needs a shape that differs"
    low, high = found["color"]["range"]
    assert -low == high >= np.quantile(np.abs(values), 0.97)
    assert found["vertices"] == mesh(client, latent=text(CODE), mesh=choice)["vertices"]
    assert found["color"]["quantity"] == quantity


def test_every_format_says_the_same(client: httpx.Client) -> None:
    asked = {"latent": text(CODE), "color": "bending"}
    values = mesh(client, **asked)["color"]["values"]

    def get(format: str) -> httpx.Response:
        answer = client.get(MESH, params={**asked, "format": format}).raise_for_status()
        legend = json.loads(answer.headers["Shape-Color"])
        assert legend == {"quantity": "bending", "range": legend["range"], "map": "coolwarm"}
        return answer

    with np.load(io.BytesIO(get("npz").content)) as arrays:
        assert np.array_equal(arrays["color_values"], np.float32(values))
        assert arrays["color_range"].tolist() == json.loads(get("npz").headers["Shape-Color"])["range"]
    animated = GLB(get("glb").content)
    assert animated.tree["meshes"][0]["extras"]["color"] == json.loads(get("glb").headers["Shape-Color"])
    linear = animated.array(animated.primitive["attributes"]["COLOR_0"]).astype(float)
    shown = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    for format in ("ply", "obj"):
        found = trimesh.load_mesh(io.BytesIO(get(format).content), file_type=format, process=False)
        np.testing.assert_allclose(found.visual.vertex_colors[:, :3] / 255, shown, atol=1.01 / 255)
    # Red where it became more convex, blue where less.
    ends = shown[[np.argmax(values), np.argmin(values)]]
    assert (np.sign(ends[:, 0] - ends[:, 2]) == [1, -1]).all()


def test_get_and_post_and_frames_share_bytes_and_tags(client: httpx.Client) -> None:
    query = {"color": "stretch", "against": text(OTHER)}
    link = client.get(MESH, params={"latent": text(CODE), **query}).raise_for_status()
    post = client.post(MESH, params=query, json={"latent": CODE}).raise_for_status()
    created = client.post(f"{MODEL}/interpolations", json={"keyframes": [OTHER, CODE], "frames": 2}).json()
    frame = client.get(created["links"]["frames"].format(k=1), params=query).raise_for_status()
    for answer in (post, frame):
        assert answer.content == link.content
        assert answer.headers["ETag"] == link.headers["ETag"]
        assert answer.headers["Shape-Color"] == link.headers["Shape-Color"]
    again = client.get(MESH, params={"latent": text(CODE), **query}, headers={"If-None-Match": link.headers["ETag"]})
    assert again.status_code == 304


@pytest.mark.parametrize("format", ["glb", "usdz"])
def test_a_coloured_animation_has_one_legend(client: httpx.Client, format: str) -> None:
    created = client.post(f"{MODEL}/interpolations", json={"keyframes": [CODE, OTHER], "frames": 3}).json()
    query = {"color": "stretch", "format": format}
    answer = client.get(created["links"]["self"], params=query).raise_for_status()
    legend = json.loads(answer.headers["Shape-Color"])
    frames = [client.get(created["links"]["frames"].format(k=k), params={"color": "stretch"}) for k in range(3)]
    alone = [json.loads(frame.raise_for_status().headers["Shape-Color"]) for frame in frames]
    assert legend == max(alone, key=lambda each: each["range"][1])


def test_entity_tags_tell_colours_apart(client: httpx.Client) -> None:
    asked = [{}, *({"color": q, **a} for q in QUANTITIES for a in ({}, {"against": text(OTHER)}))]
    answers = [client.get(MESH, params={"latent": text(CODE), **query}) for query in asked]
    assert len({answer.headers["ETag"] for answer in answers}) == len(asked)
    assert len({answer.content for answer in answers}) == len(asked)
    assert "Shape-Color" not in answers[0].headers
    assert "COLOR_0" not in GLB(answers[0].content).primitive["attributes"]


def test_the_other_code_keeps_the_bounds_too(client: httpx.Client) -> None:
    outside, bound = [0.4, 0.7, 0.4], [0.2, 0.7, 0.4]

    def values(against: list[float], **body: Any) -> list[float]:
        params = {"color": "stretch", "against": text(against), "format": "json"}
        answer = client.post(MESH, params=params, json={"latent": CODE, **body}).raise_for_status()
        found: list[float] = answer.json()["color"]["values"]
        return found

    assert values(outside, bounds="clamp") == values(bound)
    assert np.abs(np.subtract(values(outside), values(bound))).max() > 0.05


def test_a_shape_against_itself_is_grey(client: httpx.Client) -> None:
    for query in ({"latent": text(CODE), "against": text(CODE)}, {}):
        for quantity in QUANTITIES:
            found = mesh(client, color=quantity, **query)["color"]
            np.testing.assert_allclose(found["values"], 0, atol=1e-9)
            assert found["range"] == [-0.01, 0.01]


def test_a_browser_that_takes_anything_gets_a_coloured_format(client: httpx.Client) -> None:
    answer = client.get(MESH, params={"color": "stretch"}, headers={"Accept": "model/stl, model/obj;q=0.2"})
    assert answer.raise_for_status().headers["Content-Type"] == "model/obj"


def spread(
    client: httpx.Client, covariance: Any, format: str = "json", latent: Any = CODE, **query: str
) -> httpx.Response:
    body = {"latent": latent, "covariance": np.asarray(covariance).tolist()}
    return client.post(MESH, params={"color": "spread", "format": format} | query, json=body)


@pytest.mark.parametrize("choice", ["fine", "coarse"])
def test_spread_is_how_far_the_vertices_of_random_codes_are(client: httpx.Client, choice: str) -> None:
    root = np.array([[0.01, 0, 0], [0.01, 0.03, 0], [-0.005, 0.01, 0.02]])
    found = spread(client, root @ root.T, mesh=choice).raise_for_status().json()["color"]
    codes = CODE + np.random.default_rng(0).standard_normal((400, 3)) @ root.T
    drawn = []
    for some in np.split(codes, 20):
        body = {"latents": some.tolist(), "mesh": choice}
        drawn.append(client.post(f"{MODEL}/vertices", json=body).raise_for_status().json()["vertices"])
    deviation = np.sqrt(np.concatenate(drawn).var(axis=0).sum(axis=1))
    np.testing.assert_allclose(found["values"], deviation, rtol=0.2, atol=2e-3)
    assert np.ptp(deviation) > 0.005, "the test needs deviations that differ"
    assert found["quantity"] == "spread"
    assert found["range"][0] == 0
    assert found["range"][1] >= np.quantile(found["values"], 0.97)
    doubled = spread(client, 4 * root @ root.T, mesh=choice).json()["color"]["values"]
    np.testing.assert_allclose(doubled, 2 * np.array(found["values"]), rtol=1e-3)


def test_a_shape_is_red_where_it_is_unsure(client: httpx.Client) -> None:
    answers = [spread(client, np.diag([s, 0, 0]), "npz").raise_for_status() for s in (1e-4, 1e-4, 2e-4)]
    assert answers[0].headers["ETag"] == answers[1].headers["ETag"] != answers[2].headers["ETag"]
    with np.load(io.BytesIO(answers[0].content)) as arrays:
        assert arrays["color_range"].tolist() == json.loads(answers[0].headers["Shape-Color"])["range"]
    obj = spread(client, np.diag([1e-4, 0, 1e-3]), "obj").raise_for_status()
    found = trimesh.load_mesh(io.BytesIO(obj.content), file_type="obj", process=False)
    colours = found.visual.vertex_colors.astype(float)
    values = np.array(spread(client, np.diag([1e-4, 0, 1e-3])).json()["color"]["values"])
    assert colours[values.argmax(), 0] > colours[values.argmin(), 0]
    assert colours[values.argmax(), 2] < colours[values.argmin(), 2]
    sure = spread(client, np.zeros((3, 3))).raise_for_status().json()["color"]["values"]
    assert not np.any(sure)


def test_a_spread_needs_a_covariance(client: httpx.Client) -> None:
    for covariance, says in (
        (np.eye(2), "3 rows of 3 numbers"),
        ([[1, 0, 0], [0, 1, 0]], "3 rows of 3 numbers"),
        (-np.eye(3), "eigenvalues"),
        (np.triu(np.ones((3, 3))), "symmetric"),
        (1e300 * np.eye(3), "too large"),
    ):
        answer = spread(client, covariance)
        assert answer.status_code == 422
        assert says in answer.json()["detail"]
    for answer, says in (
        (client.get(MESH, params={"latent": text(CODE), "color": "spread"}), "POST the code and its covariance"),
        (client.post(MESH, params={"color": "spread"}, json={"latent": CODE}), "POST the code and its covariance"),
        (client.post(MESH, json={"latent": CODE, "covariance": np.eye(3).tolist()}), "Add ?color=spread"),
        (client.get(MESH, params={"color": "spread", "against": text(CODE)}), "only for color=stretch"),
        (client.post(MESH, json={"latent": CODE, "covariance": [[1], 2]}), "covariance[1]"),
    ):
        assert answer.status_code == 422
        assert says in answer.json()["detail"]
