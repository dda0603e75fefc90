"""``fit``: from points in any pose to the code of their shape, for every way to send a file and options."""

import json
from pathlib import Path

import httpx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.client import Client, ClientError, Mesh
from shapespace.files.formats import MESH_FORMATS
from shapespace.files.npz import npz_bytes
from shapespace.model.shape_model import ShapeModel, load
from tests.service.conftest import ROOT

FIT = "/v1/models/figure/fit"
CODE = np.linspace(-0.4, 0.4, 20)
TURN = Rotation.random(random_state=1).as_matrix()


@pytest.fixture(scope="module")
def figure() -> ShapeModel:
    return load(ROOT / "models" / "figure")


@pytest.fixture(scope="module")
def points(figure: ShapeModel) -> np.ndarray:
    shape = figure.decode(CODE)
    turned = shape @ TURN.T + [2, 0, 1]
    return np.random.default_rng(0).permutation(turned)[:3000].astype(np.float32).astype(np.float64)


def as_xyz(points: np.ndarray) -> bytes:
    return b"# x y z\n" + "\n".join(" ".join(map(repr, row)) for row in points.tolist()).encode()


def as_json(points: np.ndarray) -> bytes:
    return json.dumps({"vertices": points.tolist()}).encode()


def as_ply(points: np.ndarray) -> bytes:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    return head.encode() + points.astype("<f4").tobytes()


def as_obj(points: np.ndarray) -> bytes:
    return "".join("v {!r} {!r} {!r}\n".format(*row) for row in points.tolist()).encode()


def as_off(points: np.ndarray) -> bytes:
    rows = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
    return f"OFF\n{len(points)} 0 0\n{rows}\n".encode()


def as_npz(points: np.ndarray) -> bytes:
    return npz_bytes({"vertices": points})


def as_pcd(points: np.ndarray) -> bytes:
    head = f"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {len(points)}\nHEIGHT 1\nDATA ascii\n"
    return head.encode() + as_xyz(points)


POINTS = {"xyz": as_xyz, "json": as_json, "ply": as_ply, "obj": as_obj, "off": as_off, "npz": as_npz, "pcd": as_pcd}
POINTS |= dict.fromkeys(("pts", "csv", "txt"), as_xyz)


@pytest.mark.parametrize("format", POINTS)
def test_points_in_every_format_give_what_the_library_gives(client: httpx.Client, models: Path, format: str) -> None:
    model = load(models / "with-fine")
    points = 1.5 * np.random.default_rng(0).permutation(model.decode([0.1, 0.7, 0.4])) @ TURN.T + [2, 0, 1]
    points = points.astype(np.float32).astype(np.float64)
    expected = model.fit_scan(points, scale="free")
    params = {"format": format, "scale": "free"}
    answer = client.post("/v1/models/with-fine/fit", content=POINTS[format](points), params=params)
    found = answer.raise_for_status().json()
    np.testing.assert_allclose(found["latent"], expected.code, atol=1e-6)
    np.testing.assert_allclose(found["covariance"], expected.covariance, rtol=1e-6, atol=1e-12)
    place = found["placement"]
    np.testing.assert_allclose(place["rotation"], expected.placement.rotation, atol=1e-9)
    np.testing.assert_allclose(place["translation"], expected.placement.translation, atol=1e-9)
    assert (found["status"], found["reason"]) == (expected.status, expected.reason)
    assert found["distances"]["scan"]["p95"] == pytest.approx(expected.scan.p95)
    assert "samples" not in found
    assert "used" not in found
    # The shape of the code found, placed on the scan.
    there = place["scale"] * model.decode(found["latent"]) @ np.array(place["rotation"]).T + place["translation"]
    assert np.linalg.norm(points[:, None] - there[None], axis=-1).min(axis=1).max() < 0.15


@pytest.mark.long
def test_meshes_are_read_in_every_format_that_encode_reads(client: httpx.Client, figure: ShapeModel) -> None:
    shape = figure.decode(CODE) + np.ones(3)
    for format in MESH_FORMATS:
        content = MESH_FORMATS[format].encode(shape, figure.faces)
        found = client.post(FIT, files={"file": (f"scan.{format}", content)}).raise_for_status().json()
        assert found["status"] == "converged"
        np.testing.assert_allclose(found["placement"]["translation"], [1, 1, 1], atol=0.01)


def test_options_come_by_query_or_with_the_form_which_wins(client: httpx.Client, points: np.ndarray) -> None:
    landmark = {"vertex": 5, "position": points[0].tolist(), "sigma": 10.0}
    asked = {"fixed": {"3": 0.25}, "samples": 2, "points": True, "scale": "free", "landmarks": [landmark], "seed": 4}
    query = asked | {"fixed": json.dumps(asked["fixed"]), "landmarks": json.dumps(asked["landmarks"]), "format": "xyz"}
    by_query = client.post(FIT, content=as_xyz(points), params=query).raise_for_status().json()
    file = {"file": ("scan.xyz", as_xyz(points))}
    form = {"options": json.dumps(asked)}
    by_form = client.post(FIT, files=file, data=form, params={"seed": 9}).raise_for_status().json()
    assert by_query == by_form
    assert by_form["latent"][3] == 0.25
    assert len(by_form["samples"]) == 2
    assert len(by_form["distances"]["scan"]["points"]) == len(points)
    assert by_form["placement"]["scale"] != 1


@pytest.mark.parametrize(
    ("query", "options", "says"),
    [
        ({"nosie": 1}, None, "nosie"),
        ({}, {"nosie": 1}, "nosie"),
        ({"scale": "big"}, None, "scale"),
        ({}, {"scale": "big"}, "fixed"),
        ({"noise": -1}, None, "noise"),
        ({"fixed": '{"20": 0}'}, None, "coordinate 20"),
        ({"fixed": '{"x": 0}'}, None, "not an index"),
        ({"fixed": "{"}, None, "JSON"),
        ({"landmarks": '[{"vertex": 9999, "position": [0, 0, 0]}]'}, None, "9999"),
        ({"landmarks": '[{"vertex": 1, "place": [0, 0, 0]}]'}, None, "place"),
        ({}, {"samples": 1001}, "1000"),
    ],
)
def test_wrong_options_are_named(
    client: httpx.Client, points: np.ndarray, query: dict, options: dict | None, says: str
) -> None:
    data = {} if options is None else {"options": json.dumps(options)}
    answer = client.post(FIT, files={"file": ("scan.xyz", as_xyz(points))}, data=data, params=query)
    assert answer.status_code in (400, 422), answer.text
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert says in answer.text


@pytest.mark.parametrize(
    ("content", "format", "kind"),
    [
        (b"0 0 0\n1 1 1\n", "xyz", "invalid-scan"),
        (b"# nothing\n", "xyz", "invalid-mesh"),
        (b"0 0\n1 1\n", "xyz", "invalid-mesh"),
        (b"", "xyz", "invalid-mesh"),
        (b"nan 0 0\n" * 20, "xyz", "invalid-mesh"),
        (b"inf 0 0\n" * 20, "xyz", "invalid-scan"),
        (b"".join(b"%d %d 0\n" % (k % 7, k // 7) for k in range(40)), "xyz", "invalid-scan"),
        (b"0 0 0\n", "fbx", "unsupported-media-type"),
    ],
)
def test_what_is_no_scan_is_refused(client: httpx.Client, content: bytes, format: str, kind: str) -> None:
    answer = client.post(FIT, content=content, params={"format": format})
    assert answer.json()["type"] == f"urn:shapespace:problem:{kind}", answer.text


def test_who_wants_events_is_told_how_far_the_fit_is(client: httpx.Client, points: np.ndarray) -> None:
    wanted = {"Accept": "text/event-stream"}
    body = as_xyz(points[::3])
    with client.stream("POST", FIT, params={"format": "xyz"}, content=body, headers=wanted) as answer:
        assert answer.headers["Content-Type"].startswith("text/event-stream")
        pieces = [*answer.iter_text()]
    assert len(pieces) > 3, "each event is sent at once"
    *told, found = (json.loads(event.removeprefix("data: ")) for event in "".join(pieces).split("\n\n")[:-1])
    shares = [event["progress"] for event in told]
    assert shares == sorted({*shares})
    assert 0 < shares[0] < shares[-1] < 1
    whole = client.post(FIT, params={"format": "xyz"}, content=body).json()
    assert found.keys() == whole.keys()
    assert found["status"] == whole["status"]
    assert found["latent"] == pytest.approx(whole["latent"], abs=1e-6)
    # What is refused before the search begins has its own status.
    refused = client.post(FIT, params={"format": "xyz"}, content=as_xyz(1e3 * points), headers=wanted)
    assert refused.status_code == 422
    assert refused.json()["type"].endswith("invalid-scan")


def test_encode_still_wants_a_mesh(client: httpx.Client, points: np.ndarray) -> None:
    for format in ("xyz", "npz"):
        answer = client.post("/v1/models/figure/encode", content=POINTS[format](points), params={"format": format})
        assert answer.status_code in (415, 422), answer.text


def test_the_client_fits_points_meshes_and_files(
    client: httpx.Client, figure: ShapeModel, points: np.ndarray, tmp_path
) -> None:
    file = tmp_path / "scan.xyz"
    file.write_bytes(as_xyz(points))
    shape = Mesh(figure.decode(CODE).astype(np.float32), figure.faces)
    with Client(str(client.base_url)) as caller:
        by_points = caller.fit("figure", points, fixed={2: 0.1}, samples=1)
        assert by_points["latent"][2] == pytest.approx(0.1)
        assert len(by_points["samples"]) == 1
        assert caller.fit("figure", file, fixed={2: 0.1}, samples=1) == by_points
        assert caller.fit("figure", shape)["status"] == "converged"
        with pytest.raises(ClientError, match="scale=free"):
            caller.fit("figure", 100 * points)


def test_a_million_points_are_sampled_and_a_large_file_is_no_larger_than_others(
    client: httpx.Client, points: np.ndarray
) -> None:
    many = np.repeat(points, 334, axis=0)[:1_000_000]
    found = client.post(FIT, content=as_ply(many), params={"format": "ply"}).raise_for_status().json()
    assert found["sampled"]
    assert "1000000 points" in found["reason"]
    too_many = np.repeat(points, 700, axis=0)
    answer = client.post(FIT, content=as_ply(too_many), params={"format": "ply"})
    assert answer.status_code == 422
    assert "2097152 vertices" in answer.json()["detail"]


def test_the_points_that_stood_for_the_scan_are_answered_where_asked_for(
    client: httpx.Client, figure: ShapeModel, points: np.ndarray
) -> None:
    found = client.post(FIT, content=as_xyz(points), params={"format": "xyz", "used": True}).raise_for_status().json()
    used, distances = (np.array(found["used"][name]) for name in ("positions", "distances"))
    assert len(used) == len(distances) == len(points)
    assert np.abs(used[:, None] - points[None]).max(axis=2).min(axis=1).max() < 1e-5
    assert distances.mean() == pytest.approx(found["distances"]["scan"]["mean"], rel=1e-4)
