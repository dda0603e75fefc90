"""Compressed requests and answers."""

import gzip
import io
import json
import zlib

import httpx
import numpy as np
import pytest

from shapespace.service.http.middleware.memory import MOST_MEMBERS

MESH = "/v1/models/small/mesh"
CODE = {"latent": [0.1, 0.2, 0.3]}


def fetch(client: httpx.Client, format: str, encoding: str, **headers: str) -> tuple[httpx.Response, bytes]:
    """Return an answer and its bytes as they were sent."""
    wanted = {"latent": "0.1,0.2,0.3", "format": format}
    with client.stream("GET", MESH, params=wanted, headers={"Accept-Encoding": encoding, **headers}) as answer:
        return answer, b"".join(answer.iter_raw())


@pytest.mark.parametrize("format", ["obj", "gltf", "json"])
def test_text_is_compressed_and_has_an_entity_tag_of_its_own(client: httpx.Client, format: str) -> None:
    plain, text = fetch(client, format, "identity")
    packed, data = fetch(client, format, "gzip")
    assert "Content-Encoding" not in plain.headers
    assert packed.headers["Content-Encoding"] == "gzip"
    assert gzip.decompress(data) == text
    assert len(data) < 0.8 * len(text)
    assert {name.strip() for name in packed.headers["Vary"].split(",")} == {"Accept", "Accept-Encoding"}
    tags = [answer.headers["ETag"] for answer in (plain, packed)]
    assert len(set(tags)) == 2
    assert not any(tag.startswith("W/") for tag in tags)
    for tag in tags:
        again, nothing = fetch(client, format, "gzip", **{"If-None-Match": tag})
        assert (again.status_code, again.headers["ETag"], nothing) == (304, tag, b"")


@pytest.mark.parametrize(("format", "encoding"), [("glb", "gzip"), ("npz", "gzip"), ("obj", "gzip;q=0"), ("obj", "br")])
def test_numbers_and_other_clients_get_the_plain_file(client: httpx.Client, format: str, encoding: str) -> None:
    answer, _ = fetch(client, format, encoding)
    assert answer.status_code == 200
    assert "Content-Encoding" not in answer.headers


@pytest.mark.parametrize("encoding", ["GZIP", "x-gzip", "br, gzip;q=0.1", "gzip ; q=0.0", "gzip;q=0, br"])
def test_every_answer_of_a_text_format_depends_on_accept_encoding(client: httpx.Client, encoding: str) -> None:
    answer, _ = fetch(client, "obj", encoding)
    assert ("Content-Encoding" in answer.headers) == ("q=0" not in encoding.replace("0.1", ""))
    assert "Accept-Encoding" in answer.headers["Vary"]


def test_lists_may_come_in_several_headers(client: httpx.Client) -> None:
    tag = fetch(client, "obj", "gzip")[0].headers["ETag"]
    for name, values, status in (
        ("If-None-Match", ['"a"', tag], 304),
        ("Accept-Encoding", ["br", "gzip"], 200),
        ("Accept", ["image/png", "model/obj"], 200),
    ):
        headers = {"Accept": "model/obj", "Accept-Encoding": "gzip"}
        headers.pop(name, None)
        several = [*headers.items(), *((name, value) for value in values)]
        answer = client.get(MESH, params={"latent": "0.1,0.2,0.3"}, headers=several)
        assert (answer.status_code, answer.headers["ETag"]) == (status, tag), name


def test_a_part_of_a_file_that_is_not_there_is_a_problem(client: httpx.Client) -> None:
    whole = client.get("/page/page.css").content
    assert client.get("/page/page.css", headers={"Range": "bytes=2-5"}).content == whole[2:6]
    for path in ("/page/page.css", "/v1/models/freaky-torus/decoder.onnx"):
        for wrong in ("bytes=999999999-", "bytes=5-1", "lines=1-2"):
            answer = client.get(path, headers={"Range": wrong})
            assert (answer.status_code, answer.json()["type"]) == (416, "urn:shapespace:problem:no-such-range")
            assert answer.headers["Content-Range"].startswith("bytes */")


@pytest.mark.parametrize(
    ("encoding", "pack"), [("gzip", gzip.compress), ("x-gzip", gzip.compress), ("deflate", zlib.compress)]
)
def test_compressed_requests_are_read(client: httpx.Client, encoding: str, pack) -> None:  # type: ignore[no-untyped-def]
    headers = {"Content-Type": "application/json", "Content-Encoding": encoding}
    plain = client.post(MESH, json=CODE).raise_for_status()
    body = json.dumps(CODE).encode()
    assert client.post(MESH, content=pack(body), headers=headers).content == plain.content

    def in_pieces():  # type: ignore[no-untyped-def]
        packed = pack(body)
        yield packed[:7]
        yield packed[7:]

    assert client.post(MESH, content=in_pieces(), headers=headers).content == plain.content
    members = pack(body[:9]) + pack(b"") + pack(body[9:])
    answer = client.post(MESH, content=members, headers=headers)
    if encoding == "deflate":
        assert answer.status_code == 400
    else:
        assert answer.content == plain.content
    for broken in (pack(body)[:-5], pack(body) + b"more", b"", pack(body) + pack(b"") * MOST_MEMBERS):
        answer = client.post(MESH, content=broken, headers=headers)
        assert answer.json()["type"] == "urn:shapespace:problem:malformed-request"


def test_a_large_file_is_unpacked_piece_by_piece(client: httpx.Client) -> None:
    with np.load(io.BytesIO(fetch(client, "npz", "identity")[1])) as found:
        mesh = {"vertices": found["vertices"].tolist(), "faces": found["faces"].tolist()}
    text = json.dumps(mesh).encode() + b" " * 2**20
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
    parts = [text[k : k + 100_000] for k in range(0, len(text), 100_000)]
    for body in (gzip.compress(text), b"".join(map(gzip.compress, parts))):
        packed = client.post("/v1/models/small/encode", content=body, headers=headers)
        assert packed.raise_for_status().json()["latent"] == pytest.approx(CODE["latent"], abs=1e-3)


def test_what_unpacks_to_more_than_a_body_may_have_is_refused(client: httpx.Client) -> None:
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
    answer = client.post(MESH, content=gzip.compress(bytes(2**26)), headers=headers)
    assert answer.json()["type"] == "urn:shapespace:problem:body-too-large"
