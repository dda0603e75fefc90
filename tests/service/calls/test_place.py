"""``?place=``: meshes and positions after a similarity transformation."""

import io
import json
from typing import Any

import httpx
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from tests.service.glb import GLB

MODEL = "/v1/models/with-fine"
MESH = f"{MODEL}/mesh"
CODE = [0.1, 0.7, 0.4]
TURN = Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix()
PLACE = {"rotation": TURN.tolist(), "translation": [1, -2, 3], "scale": 2.5}


def there(vertices: Any) -> np.ndarray:
    moved: np.ndarray = 2.5 * np.array(vertices) @ TURN.T + [1, -2, 3]
    return moved


def get(client: httpx.Client, format: str, place: Any = None, **query: str) -> httpx.Response:
    params = {"latent": "0.1,0.7,0.4", "format": format, **query}
    return client.get(MESH, params=params if place is None else params | {"place": json.dumps(place)})


@pytest.mark.parametrize("format", ["glb", "gltf", "obj", "ply", "stl", "npz", "json"])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_every_format_is_answered_there(client: httpx.Client, format: str, method: str) -> None:
    where = np.array(get(client, "json").raise_for_status().json()["vertices"])
    if method == "GET":
        answer = get(client, format, PLACE)
    else:
        query = {"format": format, "place": json.dumps(PLACE)}
        answer = client.post(MESH, params=query, json={"latent": CODE})
    content = answer.raise_for_status().content
    if format == "json":
        found = np.array(json.loads(content)["vertices"])
    elif format == "npz":
        with np.load(io.BytesIO(content)) as arrays:
            found = arrays["vertices"]
    else:
        scene = trimesh.load(io.BytesIO(content), file_type=format, process=False, force="mesh")
        found = scene.vertices
    if format == "stl":
        plain = trimesh.load(io.BytesIO(get(client, "stl").content), file_type="stl", process=False)
        where = plain.vertices
    np.testing.assert_allclose(found, there(where), atol=2e-5)


def test_normals_turn_with_the_shape(client: httpx.Client) -> None:
    plain, placed = (GLB(get(client, "glb", place).raise_for_status().content) for place in (None, PLACE))
    normals, turned = (glb.array(glb.primitive["attributes"]["NORMAL"]).astype(float) for glb in (plain, placed))
    np.testing.assert_allclose(turned, normals @ TURN.T, atol=0.02)
    assert np.abs(turned - normals).max() > 0.5


def test_positions_of_many_and_exact_ones_are_placed_too(client: httpx.Client) -> None:
    body = {"latents": [[0.1] * 20, [-0.1] * 20], "mesh": "coarse", "exact": True}
    plain, placed = (
        client.post("/v1/models/figure/vertices", json=body, params=query).raise_for_status().json()
        for query in ({}, {"place": json.dumps(PLACE)})
    )
    for name in ("vertices", "exact"):
        np.testing.assert_allclose(placed[name], there(plain[name]), atol=2e-5)
    for a, b in zip(plain["distance"], placed["distance"], strict=True):
        assert b["max"] == pytest.approx(2.5 * a["max"])


def test_entity_tags_tell_places_apart_and_get_and_post_share_them(client: httpx.Client) -> None:
    places = [None, {}, PLACE, PLACE | {"scale": 1}, PLACE | {"translation": [1, -2, 4]}, {"rotation": TURN.T.tolist()}]
    tags = [get(client, "glb", place).raise_for_status().headers["ETag"] for place in places]
    assert len(set(tags)) == len(places)
    query = {"place": json.dumps(PLACE, indent=3)}
    assert client.post(MESH, params=query, json={"latent": CODE}).headers["ETag"] == tags[2]
    again = client.get(MESH, params={"latent": "0.1,0.7,0.4"} | query, headers={"If-None-Match": tags[2]})
    assert again.status_code == 304
    coloured = get(client, "glb", PLACE, color="stretch")
    assert coloured.headers["ETag"] not in tags
    values = [get(client, "json", place, color="stretch").json()["color"] for place in (None, PLACE)]
    assert values[0] == values[1]


def test_the_placement_of_an_edit_brings_its_shape_to_the_targets(client: httpx.Client) -> None:
    before = np.array(get(client, "json").json()["vertices"])
    target = before[40] + [0.1, 0.05, 0]
    body = {"latent": CODE, "targets": [{"vertex": 40, "position": target.tolist()}]}
    found = client.post(f"{MODEL}/edit", json=body).raise_for_status().json()
    query = {"place": json.dumps(found["placement"]), "format": "json"}
    now = np.array(client.post(MESH, params=query, json={"latent": found["latent"]}).json()["vertices"])
    assert np.linalg.norm(now[40] - target) == pytest.approx(found["residual"], abs=1e-5)


def test_bad_places_are_told_what_to_do(client: httpx.Client) -> None:
    for place, says in (
        ("{", "place is not JSON"),
        ("[]", "place"),
        ('{"rotation": [[1, 0, 0], [0, 1, 0]]}', "3 or more"),
        ('{"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]]}', "rotation is not a rotation"),
        ('{"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}', "rotation is not a rotation"),
        ('{"rotation": [[1, 0, 0], [0, 1, 0], [0, 1e308, -1e308]]}', "rotation is not a rotation"),
        ('{"translation": [0, 0]}', "3 or more"),
        ('{"translation": [0, 0, NaN]}', "finite"),
        ('{"translation": [0, 0, 1e300]}', "overflow"),
        ('{"scale": 0}', "scale"),
        ('{"scale": 1e300}', "overflow"),
        ('{"shift": [0, 0, 0]}', "shift"),
    ):
        for answer in (
            client.get(MESH, params={"place": place, "latent": "0.1,0.7,0.4"}),
            client.post(MESH, params={"place": place}, json={"latent": CODE}),
            client.post(f"{MODEL}/vertices", params={"place": place}, json={"latents": [CODE]}),
        ):
            assert answer.status_code == 422, (place, answer.text)
            assert says in answer.json()["detail"], (place, answer.json()["detail"])
