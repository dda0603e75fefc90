"""Valid requests that ask for as much as is allowed, and forged ids of animations."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from tests.fuzz.cost import MIB, Request
from tests.fuzz.kinds.requests import (
    Make,
    Rng,
    World,
    calls,
    forged,
    get,
    kind,
    link,
    pick,
    post,
    repeated,
    size,
    spliced,
)


@kind("edit with a target at every vertex", limit=True)
def every_vertex(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    mesh = pick(rng, "fine", "coarse")
    vertices = np.array(json.loads(model.files["json"])["vertices"])
    count = model.counts[mesh]
    places = vertices[:count] + rng.normal(0, 0.01 * np.ptp(vertices), (min(count, len(vertices)), 3))
    targets = [{"vertex": k, "position": place} for k, place in enumerate(places.tolist())]
    if rng.random() < 0.3:  # as many as allowed, all equal
        targets = targets[:1] * count
    body = {"latent": model.code(rng), "targets": targets, "mesh": mesh, "prior": float(rng.uniform(0, 1e-3))}
    return post(f"/v1/models/{model.name}/edit", json.dumps(body).encode())


@kind("infer with as many codes as may be", limit=True)
def many_codes_inferred(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    codes = np.array(model.codes(rng, 256))
    outputs = [{"name": name, "parameters": {"binary_data": bool(rng.random() < 0.5)}} for name in ("nric", "vertices")]
    tensor = {"name": "latent", "shape": list(codes.shape), "datatype": "FP32"}
    headers, tail = {"Content-Type": "application/octet-stream"}, b""
    if rng.random() < 0.5:
        tail = codes.astype("<f4").tobytes()
        tensor["parameters"] = {"binary_data_size": len(tail)}
    else:
        tensor["data"] = codes.tolist()
    text = json.dumps({"inputs": [tensor], "outputs": outputs[: int(rng.integers(3))]}).encode()
    headers["Inference-Header-Content-Length"] = str(len(text))
    return post(f"/v2/models/{model.name}/infer", text + tail, headers)


@kind("infer with outputs named again and again", long=True)
def repeated_outputs(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    target, body = calls(model, rng)["infer"]
    count = int(10 ** rng.uniform(0.5, 5))
    return post(target, json.dumps({**body, "outputs": [{"name": pick(rng, "nric", "vertices")}] * count}).encode())


@kind("infer with megabytes of bytes")
def many_bytes_inferred(rng: Rng, world: World) -> Request:
    model = world.quick(rng)
    length = max(0, size(rng) - 500)
    length -= length % (4 * model.dimension)
    shape = [length // 4 // model.dimension, model.dimension]
    tensor = {"name": "latent", "shape": pick(rng, shape, shape[::-1], [1, length // 4]), "datatype": "FP32"}
    tensor["parameters"] = {"binary_data_size": length}
    text = json.dumps({"inputs": [tensor]}).encode()
    headers = {"Content-Type": "application/octet-stream", "Inference-Header-Content-Length": str(len(text))}
    return post(f"/v2/models/{model.name}/infer", text + bytes(length), headers)


@kind("infer with a length of the JSON part that can't be")
def odd_parts(rng: Rng, world: World) -> Request:
    target, body = calls(world.quick(rng), rng)["infer"]
    text = json.dumps(body).encode()
    length = pick(
        rng, "9" * int(rng.integers(1, 30_000)), "-1", "\u0663", "1e3", "0", str(len(text) - 1), "", " 5", "0x5"
    )
    return post(target, text + bytes(int(10 ** rng.uniform(0, 6))), {"Inference-Header-Content-Length": length})


def all_allowed(name: str, call: str, **more: Any) -> None:
    """Add a kind: a call that takes codes, with as many as may be."""

    @kind(f"{name} of as many codes as may be", limit=True)
    def make(rng: Rng, world: World) -> Request:
        model = world.any(rng)
        return post(f"/v1/models/{model.name}/{call}", json.dumps({"latents": model.codes(rng, 256), **more}).encode())


for _format in ("json", "npz"):
    all_allowed(f"vertices, as {_format},", f"vertices?format={_format}")
    all_allowed(f"exact vertices, as {_format},", f"vertices?format={_format}", exact=True)
all_allowed("nric", "nric", factors=True)


@kind("sample as many codes as may be")
def many_samples(rng: Rng, world: World) -> Request:
    body = {"count": 256, "seed": int(rng.integers(2**62)), "distribution": pick(rng, "uniform", "gaussian")}
    return post(f"/v1/models/{world.any(rng).name}/sample", json.dumps(body).encode())


@kind("interpolation with thousands of keyframes")
def many_keyframes(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    most = size(rng) - 300
    codes = [json.dumps(code).encode() for code in model.codes(rng, 1 if rng.random() < 0.3 else 1000)]
    count = max(2, most // (len(codes[0]) + 20))
    body: dict[str, Any] = {"frames": pick(rng, 2, 600), "loop": bool(rng.random() < 0.5)}
    if rng.random() < 0.5:
        body["times"] = list(range(count))
    keyframes = b"[" + b",".join(codes[k % len(codes)] for k in range(count)) + b"]"
    return post(f"/v1/models/{model.name}/interpolations", spliced(body, "keyframes", keyframes))


@kind("animation with a forged id")
def forged_id(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    most = MIB - 200 if rng.random() < 0.5 else int(10 ** rng.uniform(3, 6))
    code = json.dumps(model.code(rng)).encode()
    zero = json.dumps([0] * model.dimension).encode()
    facts = {"frames": 2, "keyframes": [], "loop": False, "mesh": "fine", "start": 0.0, "stop": 1.0}
    facts |= {"model": model.card["digest"][:32], "times": []}
    variants = [
        ("keyframes", repeated(pick(rng, b"[]", code, zero, b"[0]", b'""', b"{}", b"[[]]", b"null"), most)),
        ("times", repeated(pick(rng, b"0", b'""', b"[]", b"1e9"), most)),
        ("frames", pick(rng, b"600", b"1000000000", b"1" * min(most, 10**6), b"1e400", b"-1")),
        ("loop", b"[" * (most // 2) + b"]" * (most // 2)),
        ("start", b"1" * most),
        ("mesh", b'"' + b"a" * most + b'"'),
        ("model", b'"' + b"a" * most + b'"'),
    ]
    member, text = variants[0 if rng.random() < 0.5 else int(rng.integers(len(variants)))]
    facts["keyframes"] = [model.code(rng)] * 2
    if member == "times" or rng.random() < 0.7:
        del facts["times"]
    target = f"/v1/interpolations/{forged(spliced(facts, member, text))}"
    return get(target + pick(rng, "", "/frames/0", "?format=jsonl", "?format=npz"))


def many_frames(format: str) -> Make:
    def make(rng: Rng, world: World) -> Request:
        model = world.any(rng)
        return get(f"{link(model, 600, model.codes(rng, 2))}?format={format}")

    return make


for _format in ("glb", "npz", "zip", "pc2", "usd", "jsonl"):
    kind(f"animation of as many frames as may be, as {_format}", limit=True)(many_frames(_format))


@kind("mesh in any format and colour")
def a_mesh(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    query = f"latent={','.join(map(str, model.code(rng)))}"
    format = pick(rng, "glb", "gltf", "obj", "ply", "stl", "npz", "json")
    query += f"&format={format}&mesh={pick(rng, 'fine', 'coarse')}"
    if rng.random() < 0.5:
        query += f"&color={pick(rng, 'stretch', 'bending')}&against={','.join(map(str, model.code(rng)))}"
    return get(f"/v1/models/{model.name}/mesh?{query}")
