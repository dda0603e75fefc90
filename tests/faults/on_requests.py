"""Requests that ask for too much: refused at once, without allocating the memory that they need."""

import contextlib
import json
import select
import socket

import httpx
import numpy as np

from tests.faults.catalogue import SEEDS, FaultTarget, fault
from tests.faults.serving import peak_memory
from tests.hostile import HOSTILE
from tests.service.truth import RecordedCall, post

MIB = 2**20
#: How many MiB of the two gigabytes are sent.
SENT = 2000 if SEEDS > 1 else 300
#: Frames; 10,000 take minutes.
FRAMES = 10_000 if SEEDS > 1 else 300
MODEL = "/v1/models/small"
PATH = '"keyframes": [[0, 0, 0], [1, 1, 1]], "frames": 3'


#: Memory that a server may take for an upload of 64 MiB: its bytes and what is read from them.
MOST = 160 * MIB
#: How many bodies of tests/hostile.py are sent in each try.
SAMPLE = 20


@fault("`encode` and `fit` are sent files made to need gigabytes or minutes")
def bomb(target: FaultTarget, rng: np.random.Generator) -> str:
    before = peak_memory(target.steady.server)
    for name in rng.choice(sorted(HOSTILE), SAMPLE, replace=False):
        said, body = HOSTILE[name](int(rng.integers(1, 65)) * MIB)
        form = "/" in said
        answer = target.steady.client.post(
            f"{MODEL}/{rng.choice(['encode', 'fit'])}",
            params={} if form else {"format": said},
            headers={"Content-Type": said} if form else {},
            content=body,
        )
        # Some are valid meshes, but not of this model.
        assert answer.status_code in {400, 415, 422}, (name, answer.text)
        kinds = ("malformed-request", "unsupported-media-type", "invalid-mesh")
        assert answer.json()["type"].rpartition(":")[2] in kinds
        assert len(answer.text) < 600
    assert peak_memory(target.steady.server) < before + MOST
    target.steady.check()
    return f"{SAMPLE} of {len(HOSTILE)} kinds, of 1 to 64 MiB, refused in one line, in less than {MOST // MIB} MiB"


@fault("`encode` is sent a body of 2 GB, announced or in chunks")
def huge_body(target: FaultTarget, rng: np.random.Generator) -> str:
    steady, block = target.steady, bytes(MIB)
    before = peak_memory(steady.server)
    told_after = []
    for length in (f"Content-Length: {2000 * MIB}", "Transfer-Encoding: chunked"):
        with socket.create_connection((steady.place.host, steady.place.port), timeout=120) as connection:
            head = f"POST {MODEL}/encode?format=obj HTTP/1.1\r\nHost: localhost\r\n{length}\r\n\r\n"
            connection.sendall(head.encode())
            piece = block if "Content" in length else b"100000\r\n" + block + b"\r\n"
            answer = b""
            with contextlib.suppress(ConnectionError):
                for sent in range(SENT):
                    if select.select([connection], [], [], 0)[0]:
                        if not answer:
                            told_after.append(sent)
                        answer += connection.recv(65536)
                    connection.sendall(piece)  # continues in spite of the answer
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.split()[1] == b"413"
        assert json.loads(body)["type"] == "urn:shapespace:problem:body-too-large"
    assert max(told_after) < 150, "hardly more than the limit of 64 MiB"
    assert peak_memory(steady.server) < before + MOST
    steady.check()
    return "413 at once, or after 64 MiB of chunks; closed after 4 MiB more, in less than 160 MiB of memory"


def bodies(number: str) -> list[RecordedCall]:
    """Every call that has a number, with this one in its place."""
    code = f"[0.1, {number}, 0.2]"
    return [
        RecordedCall("GET", f"{MODEL}/mesh?latent=0.1,{number},0.2"),
        RecordedCall("GET", f"{MODEL}/mesh?latent=0,0,0&color=stretch&against=0.1,{number},0.2&format=ply"),
        post(f"{MODEL}/mesh", f'{{"latent": {code}}}'.encode()),
        post(f"{MODEL}/vertices", f'{{"latents": [{code}]}}'.encode()),
        post(f"{MODEL}/nric", f'{{"latents": [{code}], "factors": true}}'.encode()),
        post(f"{MODEL}/interpolations", f'{{"keyframes": [{code}, [0, 0, 0]], "frames": 3}}'.encode()),
        post(f"{MODEL}/interpolations", f'{{{PATH}, "stop": {number}}}'.encode()),
        post(f"{MODEL}/interpolations", f'{{{PATH}, "times": [0, {number}]}}'.encode()),
        post(f"{MODEL}/edit", f'{{"latent": {code}, "targets": [{{"vertex": 0, "position": [0,0,0]}}]}}'.encode()),
        post(
            f"{MODEL}/edit",
            f'{{"latent": [0, 0, 0], "targets": [{{"vertex": 0, "position": [{number}, 0, 0]}}]}}'.encode(),
        ),
        post(f"{MODEL}/edit", f'{{"latent": [0, 0, 0], "prior": {number}, "targets": []}}'.encode()),
        post(
            "/v2/models/small/infer",
            f'{{"inputs": [{{"name": "latent", "shape": [1, 3], "datatype": "FP32", "data": {code}}}]}}'.encode(),
        ),
        RecordedCall("POST", f"{MODEL}/encode", f"v {number} 0 0\n".encode() * 64 + b"f 1 2 3\n", "model/obj"),
        RecordedCall("POST", f"{MODEL}/fit?format=xyz", f"{number} 0 0\n0 1 0\n0 0 1\n".encode() * 64, "text/plain"),
        RecordedCall(
            "POST", f"{MODEL}/fit?noise={number}&format=xyz", b"0 0 0\n0 1 0\n0 0 1\n1 0 0\n" * 64, "text/plain"
        ),
    ]


@fault("codes and positions are NaN, infinite, 1e30 or 1e308")
def numbers(target: FaultTarget, rng: np.random.Generator) -> str:
    told: dict[str, set[int]] = {}
    for number in ("NaN", "Infinity", "-1e999", "1e30", "-1e30", "1e308", "3.4e38", "1e-320"):
        for call in bodies(number):
            answer = call.send(target.steady.client)
            told.setdefault(number, set()).add(answer.status_code)
            assert answer.status_code < 500, (call, answer.text)
            if number in {"NaN", "Infinity", "-1e999"}:
                assert answer.status_code in {400, 422}, (call, answer.text)
            if answer.status_code == 201:
                link = answer.json()["links"]["frames"].replace("{k}", "1")
                followed = target.steady.client.get(link)
                assert followed.status_code in {200, 422}, (call, link, followed.text)
    assert 200 in told["1e30"], "codes beyond the bounds are extrapolated"
    target.steady.check()
    return "NaN and infinities 400 or 422; large ones 422 or an answer with its diagnostics"


@fault("10,000 frames are asked for")
def frames(target: FaultTarget, rng: np.random.Generator) -> str:
    steady = target.steady
    body = {"keyframes": rng.uniform(0, 0.2, (3, 3)).tolist(), "frames": 10_000, "mesh": "coarse"}
    answer = steady.client.post(f"{MODEL}/interpolations", json=body)
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:shapespace:problem:too-many-frames")
    # An id from another server with a higher limit.
    generous = target.start(steady.models, max_frames=10_000, workers=2)
    with httpx.Client(base_url=generous.url, timeout=300) as client:
        links = client.post(f"{MODEL}/interpolations", json=body).raise_for_status().json()["links"]
        for name in ("glb", "zip", "jsonl"):
            assert steady.client.get(links[name]).status_code == 422
        before, count = peak_memory(generous), 0
        with client.stream("GET", links["jsonl"]) as stream:
            for line in stream.iter_lines():
                assert json.loads(line)["frame"] == count
                count += 1
                if count == FRAMES:
                    break
        grown = peak_memory(generous) - before
    assert grown < 64 * MIB, "a stream holds a few frames at a time"
    steady.check()
    return f"422 by default; where they are allowed, {FRAMES} streamed in order in 64 MiB"
