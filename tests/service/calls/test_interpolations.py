"""Paths through latent space as animations."""

import io
import json
import os
import select
import socket
import struct
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from pxr import UsdGeom

from shapespace.bundle.reader import read_bundle
from shapespace.files.reading import read_arrays
from shapespace.model.latent_space import LatentSpace
from shapespace.service.use_cases.animation import Animation
from tests.sequences import read_point_cache, read_usd
from tests.service.conftest import Server, Start, starting
from tests.service.glb import GLB, khronos_report
from tests.service.watching import admitted

A, B, C = [-0.1, 0.5, 0.0], [0.1, 1.5, 1.0], [0.2, -2.0, 0.5]


def create(client: httpx.Client, **body: Any) -> dict[str, Any]:
    answer = client.post("/v1/models/small/interpolations", json=body)
    assert answer.status_code == 201, answer.text
    created: dict[str, Any] = answer.json()
    assert answer.headers["Location"] == created["links"]["self"] == f"/v1/interpolations/{created['id']}"
    return created


def codes(client: httpx.Client, **body: Any) -> np.ndarray:
    created = create(client, **body)
    found = client.get(created["links"]["npz"]).raise_for_status()
    with np.load(io.BytesIO(found.content)) as arrays:
        assert len(arrays["vertices"]) == len(arrays["t"]) == created["frames"]
        latents: np.ndarray = arrays["latents"]
    return latents


def frame(client: httpx.Client, id: str, k: int) -> np.ndarray:
    answer = client.get(f"/v1/interpolations/{id}/frames/{k}", params={"format": "json"}).raise_for_status()
    return np.array(answer.json()["vertices"])


def test_both_ends_are_keyframes_and_steps_are_equal(client: httpx.Client) -> None:
    found = codes(client, keyframes=[A, B], frames=5.0)  # JSON has one kind of number
    expected = np.linspace(A, B, 5)
    np.testing.assert_allclose(found, expected, atol=1e-7)
    assert np.array_equal(found[[0, -1]], np.array([A, B], np.float32))


def test_the_path_is_linear_between_keyframes(client: httpx.Client) -> None:
    found = codes(client, keyframes=[A, B, C], frames=9)
    # The angle of C is reached the shorter way: −2 − 1.5 = −3.5 is longer than 2.78.
    assert np.array_equal(found[4], np.array(B, np.float32))
    np.testing.assert_allclose(found[:5], np.linspace(A, B, 5), atol=1e-7)
    plain = found[:, [0, 2]]
    np.testing.assert_allclose(plain[4:], np.linspace(B, C, 5)[:, [0, 2]], atol=1e-7)
    np.testing.assert_allclose(np.diff(np.unwrap(found[4:, 1].astype(float))), (2 * np.pi - 3.5) / 4, atol=1e-6)


def test_times_place_the_keyframes(client: httpx.Client) -> None:
    found = codes(client, keyframes=[A, B, C], times=[10, 11, 14], frames=5)
    assert np.array_equal(found[1], np.array(B, np.float32))
    np.testing.assert_allclose(found[2][[0, 2]], (2 * np.array(B) + np.array(C))[[0, 2]] / 3, atol=1e-7)


def test_start_and_stop_cut_and_extrapolate(client: httpx.Client) -> None:
    a, b = np.array(A), np.array(B)
    found = codes(client, keyframes=[A, B], frames=4, start=-0.5, stop=1.5)
    np.testing.assert_allclose(found, a + np.linspace(-0.5, 1.5, 4)[:, None] * (b - a), atol=1e-6)
    backwards = codes(client, keyframes=[A, B], frames=3, start=1, stop=0)
    np.testing.assert_allclose(backwards, np.linspace(B, A, 3), atol=1e-7)


def test_an_angle_takes_the_shorter_arc(client: httpx.Client) -> None:
    found = codes(client, keyframes=[[0, 3.0, 0], [0, -3.0, 0]], frames=3)[:, 1]
    assert abs(found[1]) == pytest.approx(np.pi, abs=1e-6)
    extrapolated = codes(client, keyframes=[[0, 3.0, 0], [0, -3.0, 0]], frames=2, stop=2)[:, 1]
    assert extrapolated[1] == pytest.approx(3 + 2 * (2 * np.pi - 6) - 2 * np.pi, abs=1e-6)


def test_a_loop_comes_back_and_leaves_the_repeated_frame_out(client: httpx.Client) -> None:
    created = create(client, keyframes=[A, B], frames=9, loop=True)
    assert created["frames"] == 8
    found = codes(client, keyframes=[A, B], frames=9, loop=True)
    np.testing.assert_allclose(found, np.concatenate([np.linspace(A, B, 5), np.linspace(B, A, 5)[1:-1]]), atol=1e-7)


def test_frames_are_the_same_alone_and_in_every_whole(client: httpx.Client, tmp_path: Path) -> None:
    created = create(client, keyframes=[A, B, C], frames=6)
    links = created["links"]
    animated = GLB(client.get(links["self"]).raise_for_status().content)
    with np.load(io.BytesIO(client.get(links["npz"]).content)) as arrays:
        packed, faces = arrays["vertices"], arrays["faces"]
    with zipfile.ZipFile(io.BytesIO(client.get(links["zip"]).content)) as archive:
        names = sorted(archive.namelist())
        zipped = [archive.read(name) for name in names]
    assert len(names) == 6
    cached = read_point_cache(client.get(links["pc2"]).raise_for_status().content)
    assert np.array_equal(cached, packed)
    usd = tmp_path / "animation.usdc"
    usd.write_bytes(client.get(links["usd"]).raise_for_status().content)
    assert np.array_equal(read_usd(usd)[0], packed)
    with client.stream("GET", links["jsonl"]) as stream:
        lines = [json.loads(line) for line in stream.iter_lines()]
    assert animated.key_count == len(packed) == len(lines) == 6
    assert np.array_equal(animated.faces, faces)
    assert lines[0]["faces"] == faces.tolist()
    backwards = {k: frame(client, created["id"], k) for k in reversed(range(6))}
    for k, alone in backwards.items():
        assert np.array_equal(np.float32(alone), packed[k]), k
        assert np.array_equal(np.float32(lines[k]["vertices"]), packed[k]), k
        still = client.get(links["frames"].format(k=k), params={"format": "obj"})
        assert zipped[k] == still.raise_for_status().content
        np.testing.assert_allclose(read_arrays(zipped[k], "obj")[0], packed[k], rtol=1e-7)
        np.testing.assert_allclose(animated.key(k), packed[k], atol=3e-7)
    assert np.abs(packed[0] - packed[5]).max() > 0.05, "the test needs a shape that moves"
    code = client.post("/v1/models/small/mesh", json={"latent": B}, params={"format": "json"}).json()["vertices"]
    middle = create(client, keyframes=[A, B], frames=3)["id"]
    assert np.array_equal(code, frame(client, middle, 2))


def test_long_animations_are_spanned_by_few_targets_with_a_stated_error(client: httpx.Client, tmp_path: Path) -> None:
    created = create(client, keyframes=[A, B, C], frames=70)
    answer = client.get(created["links"]["glb"]).raise_for_status()
    animated = GLB(answer.content)
    with np.load(io.BytesIO(client.get(created["links"]["npz"]).content)) as arrays:
        packed = arrays["vertices"]
    stated = animated.tree["asset"]["extras"]
    error = max(np.linalg.norm(animated.key(k) - packed[k], axis=1).max() for k in range(70))
    assert stated["max_vertex_error"] == pytest.approx(error, rel=1e-3)
    assert json.loads(answer.headers["Shape-Diagnostics"])["max_vertex_error"] == stated["max_vertex_error"]
    assert error < 2e-4 * np.linalg.norm(np.ptp(packed[0], axis=0))
    assert stated["targets"] == len(animated.primitive["targets"]) < 30
    (tmp_path / "long.glb").write_bytes(answer.content)
    report = khronos_report(tmp_path / "long.glb")
    assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0, report["issues"]
    assert report["info"]["hasMorphTargets"]
    assert report["info"]["animationCount"] == 1


def test_ids_are_deterministic_and_name_the_path_and_the_model(client: httpx.Client) -> None:
    body: dict[str, Any] = {"keyframes": [A, B], "frames": 4}
    same = {"keyframes": [[*map(float, A)], B], "frames": 4, "start": 0, "stop": 1.0, "loop": False, "mesh": "fine"}
    assert create(client, **body)["id"] == create(client, **same)["id"]
    ids = [create(client, **body | change)["id"] for change in ({}, {"frames": 5}, {"loop": True}, {"stop": 2})]
    other = client.post("/v1/models/small/interpolations", params={"version": "1"}, json=body).json()["id"]
    assert len({*ids, other}) == 5


def test_damaged_ids_are_not_found(client: httpx.Client) -> None:
    id = create(client, keyframes=[A, B], frames=3)["id"]
    assert client.get(f"/v1/interpolations/{id}").status_code == 200
    flipped = [id[:k] + ("A" if id[k] != "A" else "B") + id[k + 1 :] for k in range(0, len(id), 7)]
    for damaged in [*flipped, id[:-1], id + "A", id + "=", "x", "-" * 40_000]:
        answer = client.get(f"/v1/interpolations/{damaged}")
        assert (answer.status_code, answer.json()["type"]) == (404, "urn:shapespace:problem:unknown-interpolation")
        assert "POST" in answer.json()["detail"]


def test_an_id_of_a_model_that_is_gone_is_not_found(client: httpx.Client, models: Path) -> None:
    latents = LatentSpace(read_bundle(models / "small" / "1").manifest)
    answer = client.get(f"/v1/interpolations/{Animation(keyframes=[A, B]).to_id('f' * 64, latents)}")
    assert answer.status_code == 404
    assert "/v1/models" in answer.json()["detail"]


def test_an_animation_has_an_entity_tag(client: httpx.Client) -> None:
    links = create(client, keyframes=[A, B], frames=3)["links"]
    formats = ("glb", "npz", "zip", "pc2", "usd", "usdz", "jsonl")
    assert set(links) == {"self", "frames", *formats}
    tags = {name: client.get(links[name]).headers["ETag"] for name in formats}
    assert len(set(tags.values())) == len(formats)
    for name, tag in tags.items():
        assert client.get(links[name], headers={"If-None-Match": tag}).status_code == 304


@pytest.fixture(scope="module")
def narrow(small_models: Path) -> Iterator[Server]:
    """A server for one request at a time."""
    with starting() as start:
        yield start(small_models, workers=1, queue=0)


def test_frames_arrive_as_they_get_ready(narrow: Server) -> None:
    # A stream counts among streams; it occupies the worker only while it computes a frame.
    with httpx.Client(base_url=narrow.url, timeout=60) as client:
        links = create(client, keyframes=[A, B, C], frames=400)["links"]
        with client.stream("GET", links["jsonl"]) as stream:
            assert stream.headers["Content-Type"] == "application/jsonl"
            lines = stream.iter_lines()
            assert json.loads(next(lines))["frame"] == 0
            assert client.get("/v1/models/small/mesh").status_code == 200
            assert client.get(links["jsonl"]).status_code == 503
            assert [json.loads(line)["frame"] for line in lines] == list(range(1, 400))
        assert client.get(links["jsonl"]).status_code == 200


def test_a_stream_that_can_not_go_on_ends_with_the_problem(client: httpx.Client) -> None:
    links = create(client, keyframes=[[0, 0, 0], [3.4e38, 0, 0]], frames=3)["links"]
    *frames, last = [json.loads(line) for line in client.get(links["jsonl"]).raise_for_status().iter_lines()]
    assert [frame["frame"] for frame in frames] in ([0], [0, 1])
    whole = client.get(links["npz"])
    assert last == {"problem": whole.json()}
    assert (whole.status_code, whole.json()["type"]) == (422, "urn:shapespace:problem:not-finite")


def test_a_reader_who_leaves_gives_the_place_back(narrow: Server) -> None:
    with httpx.Client(base_url=narrow.url, timeout=60) as client:
        links = create(client, keyframes=[A, B, C], frames=600)["links"]
        with client.stream("GET", links["jsonl"]) as stream:
            next(stream.iter_lines())
        while_waiting = 0
        while status(client, links["jsonl"]) == 503:
            while_waiting += 1
            assert while_waiting < 200, "all of the frames would take that long"


def status(client: httpx.Client, link: str) -> int:
    """Status of an answer whose body isn't read."""
    with client.stream("GET", link) as answer:
        return answer.status_code


def test_work_ends_when_nobody_waits_for_it(narrow: Server) -> None:
    with httpx.Client(base_url=narrow.url, timeout=60) as client:
        link = create(client, keyframes=[A, B, C], frames=600)["links"]["glb"]
        place = httpx.URL(narrow.url)
        with socket.create_connection((place.host, place.port)) as impatient:
            impatient.sendall(f"GET {link} HTTP/1.1\r\nHost: {place.host}\r\n\r\n".encode())
            while not admitted(client):
                assert not select.select([impatient], [], [], 0)[0], "answered before it was seen running"
        while_waiting = 0
        while admitted(client):
            while_waiting += 1
            assert while_waiting < 200, "all of the frames would take that long"
    assert "Traceback" not in narrow.log


def test_an_animation_has_the_name_that_is_asked_for(client: httpx.Client) -> None:
    plain, named = (create(client, keyframes=[A, B], frames=5, **name) for name in ({}, {"name": "Wave, left"}))
    assert plain["id"] != named["id"]
    glb = GLB(client.get(named["links"]["glb"]).raise_for_status().content)
    assert [animation["name"] for animation in glb.tree["animations"]] == ["Wave, left"]
    glb = GLB(client.get(plain["links"]["glb"]).raise_for_status().content)
    assert [animation["name"] for animation in glb.tree["animations"]] == ["animation"]
    np.testing.assert_array_equal(frame(client, plain["id"], 2), frame(client, named["id"], 2))
    for name in ("", "x" * 61):
        body = {"keyframes": [A, B], "name": name}
        assert client.post("/v1/models/small/interpolations", json=body).status_code == 422


def test_frames_a_second_are_those_that_are_asked_for(client: httpx.Client, tmp_path: Path) -> None:
    from pxr import Usd

    links = create(client, keyframes=[A, B], frames=5)["links"]
    plain = client.get(links["glb"]).raise_for_status()
    for fps, rate in ((None, 30), (12.5, 12.5), (240, 240)):
        query = {} if fps is None else {"fps": fps}
        answer = client.get(links["self"], params={"format": "glb", **query}).raise_for_status()
        glb = GLB(answer.content)
        times = glb.array(glb.tree["animations"][0]["samplers"][0]["input"])
        np.testing.assert_allclose(times, np.arange(5) / rate, rtol=1e-6)
        assert (answer.headers["ETag"] == plain.headers["ETag"]) == (fps is None)
        path = tmp_path / "animation.usdc"
        path.write_bytes(client.get(links["self"], params={"format": "usd", **query}).raise_for_status().content)
        assert Usd.Stage.Open(str(path)).GetTimeCodesPerSecond() == rate
    for query in ({"format": "npz", "fps": 10}, {"fps": 0}, {"fps": 1e9}, {"fps": "fast"}):
        answer = client.get(links["self"], params=query)
        assert answer.status_code == 422, query
        assert "fps" in answer.json()["detail"]


def test_a_whole_animation_is_coloured_as_its_frames_are(client: httpx.Client, tmp_path: Path) -> None:
    links = create(client, keyframes=[A, B], frames=4)["links"]
    plain = client.get(links["glb"]).raise_for_status()
    legends, tags = set(), {plain.headers["ETag"]}
    for query in ({"color": "stretch"}, {"color": "stretch", "against": ",".join(map(str, A))}, {"color": "bending"}):
        answer = client.get(links["self"], params={"format": "glb", **query}).raise_for_status()
        tags.add(answer.headers["ETag"])
        (tmp_path / "animation.glb").write_bytes(answer.content)
        assert not khronos_report(tmp_path / "animation.glb")["issues"]["numErrors"]
        glb = GLB(answer.content)
        rest = glb.array(glb.primitive["attributes"]["COLOR_0"])
        changes = [glb.array(target["COLOR_0"]) for target in glb.primitive["targets"]]
        legend = glb.tree["meshes"][0]["extras"]["color"]
        legends.add((legend["quantity"], *legend["range"]))
        path = tmp_path / "animation.usdc"
        path.write_bytes(client.get(links["self"], params={"format": "usd", **query}).raise_for_status().content)
        _, stage = read_usd(path)
        shown = UsdGeom.Mesh(stage.GetDefaultPrim()).GetDisplayColorPrimvar()
        for k in range(4):
            frame = client.get(links["frames"].replace("{k}", str(k)), params={"format": "glb", **query})
            still = GLB(frame.raise_for_status().content)
            own = still.array(still.primitive["attributes"]["COLOR_0"])
            found = rest + changes[k - 1] if k else rest
            np.testing.assert_allclose(found, np.array(shown.Get(k)), atol=1e-6)
            # All frames of an animation have one legend; a single frame may have a narrower one.
            if still.tree["meshes"][0]["extras"]["color"] == legend:
                np.testing.assert_allclose(found, own, atol=1e-6)
    assert len(tags) == 4
    assert len(legends) >= 2
    for format in ("npz", "zip", "pc2", "jsonl"):
        answer = client.get(links["self"], params={"format": format, "color": "stretch"})
        assert answer.status_code == 406
        assert "carry no colours" in answer.json()["detail"]
    assert client.get(links["self"], params={"color": "spread"}).status_code == 422


def test_usdz_holds_the_layer_as_phones_want_it(client: httpx.Client, tmp_path: Path) -> None:
    links = create(client, keyframes=[A, B], frames=4)["links"]
    answer = client.get(links["usdz"]).raise_for_status()
    assert answer.headers["Content-Type"] == "model/vnd.usdz+zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        (layer,) = archive.infolist()
        assert layer.compress_type == zipfile.ZIP_STORED
        named, more = struct.unpack_from("<HH", answer.content, layer.header_offset + 26)
        assert (layer.header_offset + 30 + named + more) % 64 == 0, "USDZ aligns contents to 64 bytes"
    path = tmp_path / "animation.usdz"
    path.write_bytes(answer.content)
    with np.load(io.BytesIO(client.get(links["npz"]).content)) as arrays:
        assert np.array_equal(read_usd(path)[0], arrays["vertices"])


def test_a_server_without_usd_says_how_to_get_it(
    small_models: Path, start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['pxr'] = None\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    with httpx.Client(base_url=start(small_models).url, timeout=60) as client:
        links = create(client, keyframes=[A, B], frames=3)["links"]
        assert "usd" not in links
        answer = client.get(links["self"], params={"format": "usd"})
        assert (answer.status_code, answer.json()["type"]) == (406, "urn:shapespace:problem:not-acceptable")
        assert "pip install usd-core" in answer.json()["detail"]
        choices = [choice["format"] for choice in answer.json()["choices"]]
        assert choices == ["glb", "npz", "zip", "pc2", "jsonl"]
        still = client.get("/v1/models/small/mesh", params={"format": "usdz"})
        assert still.status_code == 406
        assert "pip install usd-core" in still.json()["detail"]
        assert not {"usd", "usdz"} & {choice["format"] for choice in still.json()["choices"]}


def test_of_two_formats_with_one_media_type_accept_gets_the_first(client: httpx.Client) -> None:
    links = create(client, keyframes=[A, B], frames=3)["links"]
    for accept, name in (("application/octet-stream", "npz"), ("application/zip;q=0.4, application/jsonl", "jsonl")):
        answer = client.get(links["self"], headers={"Accept": accept}).raise_for_status()
        assert answer.headers["ETag"] == client.get(links[name]).headers["ETag"]
        assert answer.headers["Vary"].split(", ")[0] == "Accept"
    cache = client.get(links["pc2"], headers={"Accept": accept}).raise_for_status()
    assert cache.headers["Content-Type"] == "application/octet-stream"
    assert "animation.pc2" in cache.headers["Content-Disposition"]


def test_moving_normals_follow_the_shape(client: httpx.Client) -> None:
    created = create(client, keyframes=[A, B], frames=4)
    animated = GLB(client.get(created["links"]["glb"]).content)
    for k in range(4):
        still = GLB(client.get(f"/v1/interpolations/{created['id']}/frames/{k}").content)
        expected = still.array(still.primitive["attributes"]["NORMAL"])
        np.testing.assert_allclose(animated.key(k, "NORMAL"), expected, atol=1e-5)
