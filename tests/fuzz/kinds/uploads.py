"""Files and forms."""

from __future__ import annotations

import json

import numpy as np

from tests.fuzz.cost import MIB, Request
from tests.fuzz.kinds.requests import (
    UPLOAD,
    Rng,
    World,
    chunks,
    form,
    head,
    kind,
    pick,
    post,
    repeated,
    size,
)
from tests.hostile import HOSTILE, archive


def upload(world: World, rng: Rng, format: str, data: bytes) -> Request:
    """An upload of a file to `encode` or `fit`, in one of the ways to send it."""
    target = searching(world, rng, format)
    data = data[:UPLOAD]
    way = rng.random()
    if way < 0.6:
        return post(f"{target}?format={format}", data, {"Content-Type": "application/octet-stream"})
    if way < 0.8:
        start = head("POST", f"{target}?format={format}", {"Transfer-Encoding": "chunked"})
        return Request([start, *chunks(data, 2**16)])
    boundary = "b" * 30
    return post(
        target, form(boundary, f"x.{format}", data), {"Content-Type": f"multipart/form-data; boundary={boundary}"}
    )


def searching(world: World, rng: Rng, format: str = "") -> str:
    """The path of a call that takes files; of a quick model if many shapes may be computed."""
    if format not in POINTS and rng.random() < 0.5:
        return f"/v1/models/{world.any(rng).name}/encode"
    return f"/v1/models/{world.quick(rng).name}/fit"


#: Pieces of files that readers may treat as something else than a row.
WORDS = (
    b"v 1e999 nan -\n", b"\\\n", b"usemtl x\n", b"mtllib /etc/passwd\n", b"f -1 -2 -3\n", b"f 1/1/1 2/2/2 3/3/3\n",
    b"v 0 0 0 1 1 1\n", b"property float x\n", b"element vertex 9\n", b"comment x\n", b"facet normal 0 0 0\n",
    b"[[[]]],", b'{"":[]},', b'{"children":[0]},', b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY", b"BIN\0",
    b"1 2 3 0 0 1\n",
)  # fmt: skip
#: Formats of points for `fit`, with the beginning of a file.
POINTS = {"xyz": b"1 2 3\n", "off": b"OFF\n8000000 8000000 0\n1 2 3\n"}


@kind("an upload in which a piece is repeated")
def repeated_piece(rng: Rng, world: World) -> Request:
    files = world.any(rng).files | POINTS
    format = pick(rng, *files)
    sound = files[format]
    place = int(rng.integers(pick(rng, min(200, len(sound)), len(sound))))
    piece = pick(rng, sound[place : place + int(rng.integers(1, 100))], pick(rng, *WORDS))
    whole = sound[:place] + piece * (size(rng, UPLOAD) // len(piece)) + sound[place:]
    return upload(world, rng, format, whole)


@kind("a file made to need gigabytes or minutes", long=True)
def hostile_upload(rng: Rng, world: World) -> Request:
    """A file of up to 24 MiB; tests/faults/on_requests.py sends larger ones, for which it allows more memory."""
    said, body = HOSTILE[pick(rng, *HOSTILE)](8 * MIB + size(rng, 16 * MIB))
    if "/" not in said:
        return upload(world, rng, said, body)
    return post(searching(world, rng), body, {"Content-Type": said})


@kind("an upload with more than its mesh")
def padded_upload(rng: Rng, world: World) -> Request:
    """A mesh in correspondence, padded with data that a parser doesn't need."""
    model = world.any(rng)
    format = pick(rng, "obj", "ply", "stl", "npz", "glb", "gltf", "json")
    data, most = model.files[format], size(rng, UPLOAD)
    if format == "json":
        data = data.rstrip()[:-1] + b',"x":' + repeated(pick(rng, b"0", b'""', b"[]"), most) + b"}"
    elif format == "npz":
        data = archive({"x.npy": bytes(most)}, before=data)
    elif format == "gltf":
        data = data.rstrip()[:-1] + b',"extras":' + repeated(pick(rng, b"0", b'""', b"[]", b"{}"), most) + b"}"
    else:
        data += {"obj": b"#\n", "ply": b"\n", "stl": b"\0", "glb": b"\0"}[format] * most
    return upload(world, rng, format, data)


@kind("encode of a sound mesh", long=True)
def sound_upload(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    format = pick(rng, "obj", "ply", "stl", "npz", "glb", "gltf", "json")
    return post(f"/v1/models/{model.name}/encode?format={format}", model.files[format], {"Content-Type": "x/y"})


@kind("fit of points that lie anywhere", long=True)
def any_points(rng: Rng, world: World) -> Request:
    """Random points of a model's size, with options that may be as large or as many as allowed."""
    model = world.any(rng)
    vertices = np.array(json.loads(model.files["json"])["vertices"])
    size = float(vertices.std()) * 10.0 ** pick(rng, 0, 0, 0, rng.uniform(-300, 300))
    points = size * rng.normal(size=(int(10 ** rng.uniform(1, 6)), 3))
    if rng.random() < 0.1:
        points[:, int(rng.integers(3))] = 0
    text = b"".join(b"%g %g %g\n" % (x, y, z) for x, y, z in points.tolist())
    places = size * rng.normal(size=(pick(rng, 0, 3, 999), 3))
    rare = {
        "noise": float(10.0 ** rng.uniform(-300, 300)),
        "landmarks": [{"vertex": k, "position": place} for k, place in enumerate(places.tolist())],
        "fixed": {"0": float(10.0 ** rng.uniform(-3, 38))},
        "partial": True,
        "points": True,
        "samples": 1000,
    }
    options = {"scale": pick(rng, "fixed", "free", "free")}
    options |= {name: value for name, value in rare.items() if rng.random() < 0.3}
    boundary = "b" * 30
    body = form(boundary, "x.xyz", text[:UPLOAD], json.dumps(options).encode())
    type = {"Content-Type": f"multipart/form-data; boundary={boundary}"}
    return post(f"/v1/models/{model.name}/fit", body, type)


@kind("a form whose type is hard to take apart")
def odd_form_type(rng: Rng, world: World) -> Request:
    unit = pick(rng, ";", "; boundary=b", ";a=b", '; boundary="', "\\", '"', ";boundary*0=", " ", "; charset=utf-7")
    target = searching(world, rng)
    type = "multipart/form-data" + unit * (30_000 // len(unit))
    return post(target, form("b", "x.obj", b"v 0 0 0\n"), {"Content-Type": type})
