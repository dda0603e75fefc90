"""Requests that are too much: refused at once, without the memory that they ask for."""

from __future__ import annotations

import io
import json
import select
import socket
import struct
import zipfile

import httpx
import numpy as np

from tests.faults.catalogue import SEEDS, Arena, fault
from tests.faults.serving import Steady, peak_memory
from tests.service.bundles import reference
from tests.service.truth import Call, post

MIB = 2**20
#: MiB of the two gigabytes that are really sent.
SENT = 2000 if SEEDS > 1 else 300
#: All of them take minutes.
FRAMES = 10_000 if SEEDS > 1 else 300
MODEL = "/v1/models/small"
PATH = '"keyframes": [[0, 0, 0], [1, 1, 1]], "frames": 3'


def npz_of(member: bytes, name: str = "vertices.npy") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, member)
        archive.writestr("faces.npy", member)
    return buffer.getvalue()


def npy_header(shape: str) -> bytes:
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def zeros(rng: np.random.Generator) -> tuple[str, bytes]:
    """Sixty-four MiB of nothing, which deflate to sixty-four KiB."""
    return "npz", npz_of(npy_header("(2796202, 3)") + bytes(64 * MIB + int(rng.integers(100))))


def lying_entry(rng: np.random.Generator) -> tuple[str, bytes]:
    """The same, said to be of a few bytes in the archive's directory."""
    data = bytearray(zeros(rng)[1])
    place = data.find(b"PK\x01\x02")
    while place >= 0:
        struct.pack_into("<I", data, place + 24, 1000)
        place = data.find(b"PK\x01\x02", place + 4)
    return "npz", bytes(data)


def boundless_array(rng: np.random.Generator) -> tuple[str, bytes]:
    """An array whose head promises more numbers than there is memory."""
    return "npz", npz_of(npy_header(f"({10 ** int(rng.integers(9, 18))}, 3)") + bytes(24))


def glb(tree: object, data: bytes = b"") -> tuple[str, bytes]:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if data:
        chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return "glb", struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def a_mesh(count: int) -> dict[str, object]:
    """A glTF document with as many accessors as you like onto one small buffer."""
    vertices, faces = reference().vertices.astype("<f4"), reference().faces.astype("<u4")
    return {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": vertices.nbytes + faces.nbytes}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": vertices.nbytes},
            {"buffer": 0, "byteOffset": vertices.nbytes, "byteLength": faces.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": len(vertices)},
            {"bufferView": 1, "componentType": 5125, "type": "SCALAR", "count": faces.size},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * count}],
    }


def of_mesh() -> bytes:
    return reference().vertices.astype("<f4").tobytes() + reference().faces.astype("<u4").tobytes()


def many_instances(rng: np.random.Generator) -> tuple[str, bytes]:
    """One mesh at two hundred thousand places."""
    count = int(rng.integers(100_000, 200_000))
    tree = a_mesh(1) | {"nodes": [{"mesh": 0}] * count, "scenes": [{"nodes": list(range(count))}], "scene": 0}
    return glb(tree, of_mesh())


def doubling(rng: np.random.Generator) -> tuple[str, bytes]:
    """Nodes that hold the next one twice, thirty deep: a thousand million places in a kilobyte."""
    deep = int(rng.integers(25, 35))
    nodes: list[dict[str, object]] = [{"children": [k + 1, k + 1]} for k in range(deep)]
    tree = a_mesh(1) | {"nodes": [*nodes, {"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}
    return glb(tree, of_mesh())


def ring(rng: np.random.Generator) -> tuple[str, bytes]:
    """A node among its own descendants."""
    tree = a_mesh(1) | {
        "nodes": [{"children": [1], "mesh": 0}, {"children": [0]}], "scenes": [{"nodes": [0]}], "scene": 0,
    }  # fmt: skip
    return glb(tree, of_mesh())


def many_primitives(rng: np.random.Generator) -> tuple[str, bytes]:
    """One mesh of a hundred thousand parts that are all the same."""
    return glb(a_mesh(100_000) | {"nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}], "scene": 0}, of_mesh())


def hollow(rng: np.random.Generator) -> tuple[str, bytes]:
    """Matrices without any data behind them, as many as the file has bytes, and spaces to have many."""
    tree = a_mesh(1)
    size = int(rng.integers(20, 40)) * MIB
    tree["accessors"] = [{"componentType": 5126, "type": "MAT4", "count": size}] * 2
    return glb(tree, bytes(size))


def boasting_ply(rng: np.random.Generator) -> tuple[str, bytes]:
    """A head that announces thousands of millions of vertices."""
    kind = str(rng.choice(["ascii", "binary_little_endian"]))
    rows = 10 ** int(rng.integers(9, 15))
    head = f"ply\nformat {kind} 1.0\nelement vertex {rows}\nproperty float x\nproperty float y\nproperty float z\n"
    head += f"element face {rows}\nproperty list uchar int vertex_indices\nend_header\n"
    return "ply", head.encode() + bytes(99)


def boasting_stl(rng: np.random.Generator) -> tuple[str, bytes]:
    return "stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(5000)


def long_obj(rng: np.random.Generator) -> tuple[str, bytes]:
    """As many vertices as fit into an upload."""
    return "obj", b"v 1 2 3\n" * (30 * MIB // 8) + b"f 1 2 3\n"


def long_face(rng: np.random.Generator) -> tuple[str, bytes]:
    """One polygon with as many corners as fit into an upload."""
    return "obj", b"v 1 2 3\n" * 3 + b"f" + b" 1" * (30 * MIB // 2)


def long_json(rng: np.random.Generator) -> tuple[str, bytes]:
    return "json", b'{"vertices": [' + b"[1,2,3]," * (30 * MIB // 8) + b"[1,2,3]]}"


def deep_json(rng: np.random.Generator) -> tuple[str, bytes]:
    return str(rng.choice(["json", "gltf"])), b"[" * 30 * MIB


BOMBS = (
    zeros, lying_entry, boundless_array, many_instances, doubling, ring, many_primitives, hollow, boasting_ply,
    boasting_stl, long_obj, long_face, long_json, deep_json,
)  # fmt: skip
#: Memory that a server may take for an upload of 64 MiB, twice as it comes, and for what it makes of it.
MOST = 256 * MIB


def cheap(steady: Steady, format: str, data: bytes, readable: bool) -> None:
    answer = steady.client.post(f"{MODEL}/encode", params={"format": format}, content=data)
    if readable and answer.status_code == 200:
        return
    assert answer.status_code == 422, answer.text
    assert answer.json()["type"] == "urn:shapespace:problem:invalid-mesh"
    assert len(answer.text) < 600


@fault("`encode` is sent archives and files that would unpack to gigabytes")
def bomb(arena: Arena, rng: np.random.Generator) -> str:
    before = peak_memory(arena.steady.server)
    for make in BOMBS:
        cheap(arena.steady, *make(rng), make in (doubling, ring))
    assert peak_memory(arena.steady.server) < before + MOST
    arena.steady.check()
    return "12 kinds refused with 422, 2 read as the single mesh that they hold, in less than 256 MiB of memory"


@fault("`encode` is sent a body of 2 GB, announced or in chunks")
def huge_body(arena: Arena, rng: np.random.Generator) -> str:
    steady, block = arena.steady, bytes(MIB)
    before = peak_memory(steady.server)
    told_after = []
    for length in (f"Content-Length: {2000 * MIB}", "Transfer-Encoding: chunked"):
        with socket.create_connection((steady.place.host, steady.place.port), timeout=120) as connection:
            head = f"POST {MODEL}/encode?format=obj HTTP/1.1\r\nHost: x\r\n{length}\r\n\r\n"
            connection.sendall(head.encode())
            piece = block if "Content" in length else b"100000\r\n" + block + b"\r\n"
            answer = b""
            for sent in range(SENT):
                if select.select([connection], [], [], 0)[0]:
                    if not answer:
                        told_after.append(sent)
                    answer += connection.recv(65536)
                connection.sendall(piece)  # and goes on in spite of the answer
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.split()[1] == b"413"
        assert json.loads(body)["type"] == "urn:shapespace:problem:body-too-large"
    assert max(told_after) < 150, "hardly more than the limit of 64 MiB"
    assert peak_memory(steady.server) < before + MOST
    steady.check()
    return "413 at once, or after 64 MiB of chunks; what still comes is dropped, in less than 256 MiB of memory"


def bodies(number: str) -> list[Call]:
    """Every call that takes a number, with that one in it."""
    code = f"[0.1, {number}, 0.2]"
    return [
        Call("GET", f"{MODEL}/mesh?latent=0.1,{number},0.2"),
        Call("GET", f"{MODEL}/mesh?latent=0,0,0&color=stretch&against=0.1,{number},0.2&format=ply"),
        post(f"{MODEL}/mesh", f'{{"latent": {code}}}'.encode()),
        post(f"{MODEL}/vertices", f'{{"latents": [{code}]}}'.encode()),
        post(f"{MODEL}/nric", f'{{"latents": [{code}], "factors": true}}'.encode()),
        post(f"{MODEL}/interpolations", f'{{"keyframes": [{code}, [0, 0, 0]], "frames": 3}}'.encode()),
        post(
            f"{MODEL}/interpolations",
            f'{{{PATH}, "stop": {number}}}'.encode(),
        ),
        post(
            f"{MODEL}/interpolations",
            f'{{{PATH}, "times": [0, {number}]}}'.encode(),
        ),
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
        Call("POST", f"{MODEL}/encode", f"v {number} 0 0\n".encode() * 64 + b"f 1 2 3\n", "model/obj"),
    ]


@fault("codes and positions are NaN, infinite, 1e30 or 1e308")
def numbers(arena: Arena, rng: np.random.Generator) -> str:
    told: dict[str, set[int]] = {}
    for number in ("NaN", "Infinity", "-1e999", "1e30", "-1e30", "1e308", "3.4e38", "1e-320"):
        for call in bodies(number):
            answer = call.send(arena.steady.client)
            told.setdefault(number, set()).add(answer.status_code)
            assert answer.status_code < 500, (call, answer.text)
            if number in {"NaN", "Infinity", "-1e999"}:
                assert answer.status_code in {400, 422}, (call, answer.text)
            if answer.status_code == 201:
                link = answer.json()["links"]["frames"].replace("{k}", "1")
                followed = arena.steady.client.get(link)
                assert followed.status_code in {200, 422}, (call, link, followed.text)
    assert 200 in told["1e30"], "beyond the bounds is extrapolated"
    arena.steady.check()
    return "NaN and infinities 400 or 422; large ones 422 or an answer with its diagnostics"


@fault("10,000 frames are asked for")
def frames(arena: Arena, rng: np.random.Generator) -> str:
    steady = arena.steady
    body = {"keyframes": rng.uniform(0, 0.2, (3, 3)).tolist(), "frames": 10_000, "mesh": "coarse"}
    answer = steady.client.post(f"{MODEL}/interpolations", json=body)
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:shapespace:problem:too-many-frames")
    # An id that another server gave out, which allowed as many.
    generous = arena.start(steady.models, max_frames=10_000, workers=2)
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
