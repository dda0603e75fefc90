"""Generators of requests that are expensive for a server, by kind.

Each kind is a function of a random generator and of what is known of the server, registered by ``kind``;
the same seed always gives the same bytes.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import quote

import httpx
import numpy as np

from tests.fuzz.cost import MIB, Request
from tests.hostile import HOSTILE, archive
from tests.service.conftest import ROOT

#: Most bytes of a body in JSON, and of an upload.
BODY, UPLOAD = 8 * MIB, 64 * MIB
JSON_TYPE = {"Content-Type": "application/json"}
#: The page's largest file, by its address.
LARGEST = max(
    ("/" + path.relative_to(ROOT / "service").as_posix() for path in (ROOT / "service" / "page").rglob("*.*")),
    key=lambda address: (ROOT / "service" / address[1:]).stat().st_size,
)
Rng = np.random.Generator


@dataclass(frozen=True)
class Model:
    """What is known of a model.

    Attributes:
        card: the server's model card.
        counts: vertices of the fine and of the coarse mesh.
        files: its fine mesh by format.
    """

    card: dict[str, Any] = field(repr=False)
    counts: dict[str, int]
    files: dict[str, bytes] = field(repr=False)

    @property
    def name(self) -> str:
        return str(self.card["name"])

    @property
    def dimension(self) -> int:
        return int(self.card["latent_dimension"])

    def code(self, rng: Rng) -> list[float]:
        code: list[float] = rng.uniform(self.card["lower"], self.card["upper"]).round(5).tolist()
        return code

    def codes(self, rng: Rng, count: int) -> list[list[float]]:
        return [self.code(rng) for _ in range(count)]


@dataclass(frozen=True)
class World:
    """What is known of a server.

    Attributes:
        models: those whose shapes take milliseconds first.
    """

    models: list[Model]

    @classmethod
    def of(cls, url: str) -> World:
        """Ask a server."""
        with httpx.Client(base_url=url, timeout=120) as client:
            models = []
            for summary in client.get("/v1/models").raise_for_status().json()["models"]:
                path = f"/v1/models/{summary['name']}"
                files = {
                    format: client.get(f"{path}/mesh", params={"format": format}).raise_for_status().content
                    for format in ("glb", "gltf", "obj", "ply", "stl", "npz", "json")
                }
                fine = len(json.loads(files["json"])["vertices"])
                card = client.get(path).raise_for_status().json()
                models.append(Model(card, {"fine": fine, "coarse": card["vertices"]}, files))
        return cls(sorted(models, key=lambda model: model.counts["fine"]))

    def quick(self, rng: Rng) -> Model:
        """One of the models whose shapes take milliseconds."""
        return self.models[int(rng.integers(len(self.models) // 2))]

    def any(self, rng: Rng) -> Model:
        return self.models[int(rng.integers(len(self.models)))]

    @property
    def largest(self) -> Model:
        return self.models[-1]


Make = Callable[[Rng, World], Request]


@dataclass(frozen=True)
class RequestKind:
    """A kind of request.

    Attributes:
        make: generates a request.
        long: whether it may take the server its whole deadline, or the client seconds to send.
        limit: whether it asks for as much as is allowed.
    """

    make: Make
    long: bool = False
    limit: bool = False


KINDS: dict[str, RequestKind] = {}


def kind(name: str, *, long: bool = False, limit: bool = False) -> Callable[[Make], Make]:
    """A decorator that adds a kind to the list."""

    def enter(make: Make) -> Make:
        KINDS[name] = RequestKind(make, long or limit, limit)
        return make

    return enter


def head(method: str, target: str, headers: Iterable[tuple[str, str]] | dict[str, str] = ()) -> bytes:
    """The head of a request that is the last of its connection."""
    pairs = headers.items() if isinstance(headers, dict) else headers
    lines = [f"{method} {target} HTTP/1.1", "Host: localhost", "Connection: close", *(f"{k}: {v}" for k, v in pairs)]
    return "\r\n".join([*lines, "", ""]).encode("utf-8", "surrogateescape")


def get(target: str, headers: Iterable[tuple[str, str]] | dict[str, str] = ()) -> Request:
    return Request([head("GET", target, headers)])


def post(target: str, body: bytes, headers: dict[str, str] = JSON_TYPE) -> Request:
    return Request([head("POST", target, {**headers, "Content-Length": str(len(body))}), body])


def size(rng: Rng, most: int = BODY) -> int:
    """A random size between a hundred bytes and the limit; the limit itself every third time."""
    return most if rng.random() < 1 / 3 else int(math.exp(rng.uniform(math.log(100), math.log(most))))


def pick(rng: Rng, *choices: Any) -> Any:
    return choices[int(rng.integers(len(choices)))]


# Bodies in JSON.


def calls(model: Model, rng: Rng) -> dict[str, tuple[str, dict[str, Any]]]:
    """Every call that takes JSON: its target, and a small valid body."""
    path, code = f"/v1/models/{model.name}", model.code(rng)
    infer = {"inputs": [{"name": "latent", "shape": [1, len(code)], "datatype": "FP32", "data": code}]}
    version = model.card["version"]
    return {
        "mesh": (f"{path}/mesh", {"latent": code, "mesh": "coarse", "bounds": "allow"}),
        "vertices": (f"{path}/vertices", {"latents": [code], "exact": False, "mesh": "coarse", "bounds": "allow"}),
        "nric": (f"{path}/nric", {"latents": [code], "factors": True, "bounds": "allow"}),
        "interpolations": (
            f"{path}/interpolations",
            {"keyframes": [code, code], "times": [0, 1], "frames": 2, "start": 0, "stop": 1, "loop": False},
        ),
        "edit": (f"{path}/edit", {"latent": code, "targets": [{"vertex": 0, "position": [0, 0, 0]}], "prior": 1e-4}),
        "sample": (f"{path}/sample", {"count": 1, "seed": 1, "distribution": "uniform"}),
        "encode": (f"{path}/encode", {"vertices": [[0, 0, 0]], "faces": [[0, 0, 0]]}),
        "infer": (f"/v2/models/{model.name}/infer", {**infer, "id": "x", "outputs": [], "parameters": {}}),
        "infer-version": (f"/v2/models/{model.name}/versions/{version}/infer", infer),
    }


def a_call(world: World, rng: Rng) -> tuple[str, dict[str, Any]]:
    found = calls(world.quick(rng), rng)
    return found[list(found)[int(rng.integers(len(found)))]]


_PLACE = "\ue000"


def spliced(body: dict[str, Any], member: str, text: bytes) -> bytes:
    """A body as JSON in which one member is replaced by raw text."""
    whole = json.dumps({**body, member: _PLACE}, ensure_ascii=False).encode()
    return whole.replace(f'"{_PLACE}"'.encode(), text, 1)


def a_member(rng: Rng, body: dict[str, Any]) -> str:
    return str(rng.choice(list(body)))


def repeated(element: bytes, size: int, before: bytes = b"[", after: bytes = b"]") -> bytes:
    """A list of equal elements of about a given size in bytes."""
    count = max(1, (size - len(before) - len(after)) // (len(element) + 1))
    return before + b",".join([element] * count) + after


#: Elements that are invalid in every list, valid in some, or as short as possible.
ELEMENTS = (
    b'""', b"null", b"true", b"{}", b"[]", b"0", b"-1", b"1e400", b"0.1", b"NaN", b"Infinity", b'"\\ud800"', b'"a"',
    b"[0]", b"[0,0,0]", b'{"a":0}', b"[[]]", b"1e-400", b"9007199254740993", b'"\\u0000"', b"[null]", b'{"":{}}',
    b'{"vertex":0,"position":[0,0,0]}', b'{"vertex":"","position":["","",""]}', b"{\"name\":\"vertices\"}",
)  # fmt: skip


@kind("JSON: the list that the call takes, with very many elements")
def many_right_elements(rng: Rng, world: World) -> Request:
    """Long lists of valid elements, which pass the first checks."""
    model = world.quick(rng)
    found = calls(model, rng)
    code = json.dumps(model.code(rng)).encode()
    numbers, wrong = pick(rng, b"0", b"0.5", b"1e9", b"-0.0"), pick(rng, b'""', b"null", b"{}", b"[]", b"[[]]", b"true")
    element = {
        "mesh latent": numbers, "edit latent": numbers, "vertices latents": code, "nric latents": code,
        "interpolations keyframes": code, "interpolations times": numbers, "encode vertices": b"[0,0,0]",
        "encode faces": b"[0,0,0]", "edit targets": b'{"vertex":0,"position":[0,0,0]}',
        "infer outputs": b'{"name":"nric"}',
    }  # fmt: skip
    place = pick(rng, *element)
    call, member = place.split()
    target, body = found[call]
    text = repeated(element[place] if rng.random() < 0.5 else wrong, size(rng) - 300)
    return post(target, spliced(body, member, text))


@kind("JSON: infer with very much data")
def much_data(rng: Rng, world: World) -> Request:
    model = world.quick(rng)
    target, body = calls(model, rng)["infer"]
    code = json.dumps(model.code(rng)).encode()
    text = repeated(pick(rng, b"0", b"0.25", b'""', b"[0]", b"null", b"[]", code, b"[[0]]"), size(rng) - 300)
    count = int(rng.integers(1, 10**7))
    tensor = {**body["inputs"][0], "shape": [count, model.dimension]}
    inner = spliced(tensor, "data", text)
    return post(target, spliced(body, "inputs", b"[" + inner + b"]"))


def grown(name: str) -> Callable[[Callable[[Rng, int], bytes]], Callable[[Rng, int], bytes]]:
    """A decorator that adds a kind: the generated text of some size is one member of a body, or the body."""

    def enter(text: Callable[[Rng, int], bytes]) -> Callable[[Rng, int], bytes]:
        @kind(f"JSON: {name}")
        def make(rng: Rng, world: World) -> Request:
            target, body = a_call(world, rng)
            long = text(rng, size(rng) - 300)
            return post(target, long if rng.random() < 0.3 else spliced(body, a_member(rng, body), long))

        return text

    return enter


@grown("a member with very many elements")
def many_elements(rng: Rng, most: int) -> bytes:
    return repeated(pick(rng, *ELEMENTS), most)


@grown("depth")
def deep(rng: Rng, most: int) -> bytes:
    open, close = pick(rng, (b"[", b"]"), (b'{"a":', b"}"), (b'[{"latent":', b"}]"), (b'{"inputs":[', b"]}"))
    count = most // (len(open) + len(close))
    return bytes(open * count + b"0" + (close * count if rng.random() < 0.7 else b""))


@grown("very many members")
def many_members(rng: Rng, most: int) -> bytes:
    value = pick(rng, b"0", b"[]", b'""', b"{}")
    if rng.random() < 0.5:
        return repeated(pick(rng, b'"x":', b'"latent":', b'"inputs":') + value, most, b"{", b"}")
    return b"{" + b",".join(b'"%x":' % k + value for k in range(most // (9 + len(value)))) + b"}"


@grown("numbers of a million digits")
def long_numbers(rng: Rng, most: int) -> bytes:
    digits = pick(rng, b"1", b"9", b"0") * min(most, 2 * 10**6)
    number = pick(rng, digits, b"1" + digits, b"-1" + digits, b"0." + digits, b"1e" + digits, b"1e-" + digits,
                  b"1." + digits + b"e5", b"1" + digits + b".0")  # fmt: skip
    return bytes(pick(rng, number, repeated(number[: len(number) // 3 + 2], most)))


@grown("long strings")
def long_strings(rng: Rng, most: int) -> bytes:
    unit = pick(rng, b"a", b"\\u00e9", b"\\ud800", b"\\ud83d\\ude00", b"\\n", b"\\\\", "é".encode(), "🔺".encode(),
                b"\\u0000", b"\xff", b"\xed\xa0\x80", b"%s", b"\x01")  # fmt: skip
    text = b'"' + unit * (most // len(unit)) + pick(rng, b'"', b"", b"\\")
    return b"{" + text + b":0}" if rng.random() < 0.3 else text


@kind("JSON: other encodings, marks and spaces")
def other_text(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    text, most = json.dumps(body), size(rng) - 300
    space = pick(rng, " ", "\n", "\t", "\r\n", "\u00a0", "\ufeff")
    long = pick(rng, space * most + text, text + space * most, text[:1] + space * most + text[1:])[:most]
    name = pick(rng, "utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-32", "utf-16-be")
    content = long.encode(name)[:BODY]
    return post(target, content, {"Content-Type": f"application/json; charset={name}"})


@kind("JSON: cut off, or with more behind it")
def cut_off(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    whole = spliced(body, a_member(rng, body), repeated(pick(rng, *ELEMENTS), size(rng) - 300))
    cut = whole[: int(rng.integers(len(whole)))]
    return post(target, pick(rng, cut, whole + b"}", (whole + b"\n") * max(1, BODY // 2 // len(whole)))[:BODY])


@kind("JSON: over the limit")
def over_the_limit(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    content = b" " * (BODY + int(rng.integers(1, 4 * MIB)))
    if rng.random() < 0.5:
        return Request([head("POST", target, {**JSON_TYPE, "Transfer-Encoding": "chunked"}), *chunks(content, 2**16)])
    return post(target, content)


@kind("JSON: noise")
def noise(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    return post(target, rng.bytes(size(rng)))


# Valid requests that are as large as allowed.


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


# Forged ids of interpolations.


def forged(content: bytes) -> str:
    """An id with a correct checksum, in the format of version 0.1."""
    packed = hashlib.sha256(content).digest()[:9] + zlib.compress(content, 9)
    return base64.urlsafe_b64encode(packed).rstrip(b"=").decode()


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


def link(model: Model, frames: int, codes: list[list[float]], mesh: str = "fine") -> str:
    """The address of an animation."""
    facts = {
        "frames": frames, "keyframes": codes, "loop": False, "mesh": mesh, "model": model.card["digest"][:32],
        "start": 0.0, "stop": 1.0,
    }  # fmt: skip
    return f"/v1/interpolations/{forged(json.dumps(facts, separators=(',', ':')).encode())}"


def many_frames(format: str) -> Make:
    def make(rng: Rng, world: World) -> Request:
        model = world.any(rng)
        return get(f"{link(model, 600, model.codes(rng, 2))}?format={format}")

    return make


for _format in ("glb", "npz", "zip", "pc2", "usd", "jsonl"):
    kind(f"animation of as many frames as may be, as {_format}", limit=True)(many_frames(_format))


# Shapes.


@kind("mesh in any format and colour")
def a_mesh(rng: Rng, world: World) -> Request:
    model = world.any(rng)
    query = f"latent={','.join(map(str, model.code(rng)))}"
    format = pick(rng, "glb", "gltf", "obj", "ply", "stl", "npz", "json")
    query += f"&format={format}&mesh={pick(rng, 'fine', 'coarse')}"
    if rng.random() < 0.5:
        query += f"&color={pick(rng, 'stretch', 'bending')}&against={','.join(map(str, model.code(rng)))}"
    return get(f"/v1/models/{model.name}/mesh?{query}")


# Heads.


def a_get(world: World, rng: Rng) -> str:
    model = world.quick(rng)
    path = f"/v1/models/{model.name}"
    address = link(model, 2, model.codes(rng, 2))
    return str(
        pick(
            rng, "/", "/page/js/main.js", "/openapi.json", "/metrics", "/v1/models", path, f"{path}/mesh", address,
            f"{address}/frames/1", "/v2", "/v2/health/live", "/v2/health/ready", f"/v2/models/{model.name}",
            f"/v2/models/{model.name}/ready", "/nowhere",
        )
    )  # fmt: skip


HEADERS = (
    "Accept", "If-None-Match", "Cookie", "Range", "Expect", "Authorization", "Origin", "X-Request-ID", "Content-Type",
    "Accept-Encoding", "Content-Encoding", "Inference-Header-Content-Length", "X-API-Key", "Forwarded", "X", "Upgrade",
    "Access-Control-Request-Headers", "If-Range", "If-Modified-Since", "Content-Length", "Transfer-Encoding",
)  # fmt: skip
VALUES = (
    "a/b,", "*/*;q=0.1,", "model/obj;q=0,", ",", '"x",', 'W/"0123456789abcdef0123456789abcdef",', "a=b; ", "0-0,", ";",
    "bytes=0-,", " ", "a", "é", "100-continue,", "gzip;q=0.001,", "9", "\t", "(", "%41", "=", "a;a=",
)  # fmt: skip


Headers = dict[str, str]


def long_text(name: str, *units: str, valid: bool = False) -> Callable[[Any], Any]:
    """A decorator that adds a kind: a unit is repeated up to the longest head or far beyond.

    The function places the text: it returns the target and the headers of the request. A valid request has
    to be answered if its head is not too long.
    """

    def enter(place: Callable[[Rng, World, str], tuple[str, Headers]]) -> Any:
        @kind(name)
        def make(rng: Rng, world: World) -> Request:
            most, unit = pick(rng, 30_000, 30_000, 300_000, 4_000_000), pick(rng, *units)
            target, headers = place(rng, world, unit * (most // len(unit)))
            method = "GET" if valid else pick(rng, "GET", "GET", "HEAD", "OPTIONS", "POST")
            return Request([head(method, target, headers)], broken=not valid or most > 30_000)

        return place

    return enter


def a_shape(rng: Rng, world: World) -> str:
    """The address of a mesh or of an animation."""
    model = world.quick(rng)
    return str(pick(rng, f"/v1/models/{model.name}/mesh", link(model, 2, model.codes(rng, 2))))


@long_text("a head with long values", *VALUES)
def long_headers(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    names = rng.choice(HEADERS, int(rng.integers(1, 4)), replace=False)
    return a_get(world, rng), {str(name): text[: len(text) // len(names)] for name in names}


@long_text(
    "Accept with ten thousand ranges",
    "a/b,", "*/*;q=0,", "a;q=1,", ",", "model/gltf-binary;a=b;c=d;q=0.001,", "a/b;;;;;;;;;;;;", valid=True,
)  # fmt: skip
def long_accept(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    return a_shape(rng, world), {"Accept": text}


@long_text(
    "If-None-Match with thousands of tags",
    '"x",', ",", 'W/"a",', "W/" * 50 + ",", '"0123456789abcdef0123456789abcdef", ', valid=True,
)  # fmt: skip
def long_match(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    return pick(rng, a_shape(rng, world), "/", "/page/page.css"), {"If-None-Match": text}


@long_text(
    "a path with very many percent escapes",
    "%41", "%2e%2e%2f", "%00", "/", "%ff", "a", "../", "%25", "%", "é", "//", "{k}", "%f0%9f%94%ba", ".",
)  # fmt: skip
def long_paths(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    places = (
        "/v1/models/{}", "/v1/models/{}/mesh", f"/v1/models/{world.quick(rng).name}/{{}}", "/page/{}", "/{}",
        "/v1/interpolations/{}", "/v1/interpolations/{}/frames/1", "/v2/models/{0}/versions/{0}/ready",
        "/v1/interpolations/x/frames/{}", "http://{}/", "{}",
    )  # fmt: skip
    return str(pick(rng, *places)).format(text), {}


@long_text(
    "a query with very many members",
    "a=b&", "&", "=", "latent=1&", "a;", "%41=%41&", "format=obj&", "+", "a&", "mesh=coarse&", "é=",
)  # fmt: skip
def long_queries(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    model = f"/v1/models/{world.any(rng).name}"
    return f"{pick(rng, f'{model}/mesh', model, '/', '/v1/models', '/metrics')}?{text}", {}


@long_text(
    "a latent of very many numbers in the query",
    "0,", "1e9,", ",", "nan,", "-", "1", "9" * 400 + ",", "0.1,", "%30%2c", " ", "1_0,", "٣,",
)  # fmt: skip
def long_latent(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    name = pick(rng, "latent", "color=stretch&against")
    return f"/v1/models/{world.any(rng).name}/mesh?{name}={quote(text, safe=',%')[: len(text)]}", {}


@kind("a head with very many lines")
def many_headers(rng: Rng, world: World) -> Request:
    count = int(10 ** rng.uniform(1, 6))
    line = (
        pick(rng, b"a:", b"a: bbbbbbbbbbbbbbbb", b"Cookie: a=b", b"Host: x", b"Accept: */*", b"X-Request-ID: a")
        + b"\r\n"
    )
    return Request([head("GET", a_get(world, rng))[:-2], line * count, b"\r\n"], broken=count > 50)


@kind("Range with thousands of ranges")
def many_ranges(rng: Rng, world: World) -> Request:
    target = pick(rng, "/", LARGEST, "/openapi.json", f"/v1/models/{world.quick(rng).name}/mesh?format=json")
    part = pick(rng, "{0}-{0}", "{}-", "0-", "-1", "")
    ranges = ",".join(part.format(2 * k) for k in range(pick(rng, 300_000, 30_000, 30_000) // (len(part) + 4)))
    return Request([head("GET", target, {"Range": f"bytes={ranges}"})], broken=len(ranges) > 30_000)


@kind("the page's largest file, compressed")
def largest_asset(rng: Rng, world: World) -> Request:
    return get(LARGEST, {"Accept-Encoding": "gzip"})


@kind("a body that nobody asked for")
def unasked(rng: Rng, world: World) -> Request:
    body = bytes(size(rng, UPLOAD))
    return Request(
        [head(pick(rng, "GET", "HEAD", "DELETE"), a_get(world, rng), {"Content-Length": str(len(body))}), body]
    )


@kind("small odd headers")
def odd_headers(rng: Rng, world: World) -> Request:
    pairs = [
        pick(
            rng, ("Host", ""), ("Host", "a b"), ("Host", "[::1"), ("Host", "x" * 300), ("Range", "bytes=0-0"),
            ("Range", "bytes=" + ",".join(f"{k}-{k}" for k in range(500))), ("Expect", "100-continue"),
            ("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Origin", "null"), ("Origin", "http://x" * 99),
            ("Authorization", "Bearer " + "a" * 9999), ("Authorization", "Basic \xff"), ("X-Request-ID", "a" * 64),
            ("Accept-Encoding", "gzip"), ("If-None-Match", "*"), ("Content-Length", "0"), ("TE", "trailers"),
            ("Forwarded", "for=" + '"[::1]"' * 500), ("X-Forwarded-For", "1," * 5000), ("Content-Encoding", "gzip"),
        )
        for _ in range(int(rng.integers(1, 6)))
    ]  # fmt: skip
    method = pick(rng, "GET", "GET", "HEAD", "POST", "OPTIONS", "DELETE", "PATCH", "TRACE", "CONNECT", "GETT")
    return Request([head(method, a_get(world, rng), pairs)], broken=True)


# Uploads.


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


def chunks(data: bytes, each: int) -> Iterator[bytes]:
    """A body in chunked transfer encoding."""
    view = memoryview(data)
    for start in range(0, len(view), each):
        piece = view[start : start + each]
        yield b"%x\r\n%b\r\n" % (len(piece), piece)
    yield b"0\r\n\r\n"


def form(boundary: str, name: str, data: bytes, options: bytes = b"") -> bytes:
    part = f"--{boundary}\r\nContent-Disposition: form-data; name="
    said = f'{part}"options"\r\n\r\n'.encode() + options + b"\r\n" if options else b""
    return said + f'{part}"file"; filename="{name}"\r\n\r\n'.encode() + data + f"\r\n--{boundary}--\r\n".encode()


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


# Forms.


@kind("a form whose type is hard to take apart")
def odd_form_type(rng: Rng, world: World) -> Request:
    unit = pick(rng, ";", "; boundary=b", ";a=b", '; boundary="', "\\", '"', ";boundary*0=", " ", "; charset=utf-7")
    target = searching(world, rng)
    type = "multipart/form-data" + unit * (30_000 // len(unit))
    return post(target, form("b", "x.obj", b"v 0 0 0\n"), {"Content-Type": type})


# The wire.


@kind("a body in chunks of a byte")
def tiny_chunks(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    most = int(10 ** rng.uniform(2, 6.3))
    content = json.dumps(body).encode().ljust(most)
    extension = pick(rng, b"", b"", b";a=b", b";" + b"a" * 50)
    pieces = b"".join(b"1%b\r\n%b\r\n" % (extension, content[k : k + 1]) for k in range(len(content)))
    trailers = pick(rng, b"", b"A: b\r\n", b"A: b\r\n" * 50, b"A: " + b"b" * 10_000 + b"\r\n")
    start = head("POST", target, {**JSON_TYPE, "Transfer-Encoding": "chunked"})
    return Request([start, pieces, b"0\r\n" + trailers + b"\r\n"], broken=len(trailers) > 1000)


@kind("chunks, trailers or extensions without end")
def endless_chunks(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    most = int(10 ** rng.uniform(4, 7.3))
    unit, before = pick(
        rng, (b"A: b\r\n", b"0\r\n"), (b"a", b"1;"), (b"0", b""), (b"a" * 100 + b": b\r\n", b"0\r\n"),
        (b"b", b"0\r\nA: "), (b"f", b""), (b";a", b"1"),
    )  # fmt: skip
    start = head("POST", target, {**JSON_TYPE, "Transfer-Encoding": "chunked"})
    return Request([start, before, unit * (most // len(unit)), b"\r\n\r\n"], broken=True, half_closed=True)


@kind("very many requests in one go")
def pipelined(rng: Rng, world: World) -> Request:
    """Pipelined requests, some of which may be left unanswered."""
    targets = ("/v2/health/live", "/nowhere", "/v2", "/metrics", "/v1/models", f"/v1/models/{world.models[0].name}")
    one, count = f"GET {pick(rng, *targets)} HTTP/1.1\r\n", pick(rng, 14_000, 10, 100, 300)
    return Request([(one + "Host: x\r\n\r\n").encode() * count, head("GET", "/v2/health/live")], broken=True)


@kind("a request a byte at a time")
def byte_by_byte(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    content = json.dumps(body).encode()
    whole = head("POST", target, {**JSON_TYPE, "Content-Length": str(len(content))}) + content
    return Request(part for k in range(len(whole)) for part in (whole[k : k + 1], 0.001))


@kind("a request, or a part of it, and the end")
def cut_short(rng: Rng, world: World) -> Request:
    """The server treats the end of one direction as that of the connection."""
    target, body = a_call(world, rng)
    content = json.dumps(body).encode().ljust(int(10 ** rng.uniform(2, 6)))
    start = head("POST", target, {**JSON_TYPE, "Content-Length": str(len(content)), "Accept": "a" * 1000})
    whole = start + content
    part = pick(rng, whole, whole[: int(rng.integers(1, len(whole)))], start[: int(rng.integers(1, len(start)))])
    return Request([part], broken=True, half_closed=True)


@kind("not HTTP at all")
def not_http(rng: Rng, world: World) -> Request:
    most = int(10 ** rng.uniform(0, 6))
    data = pick(
        rng, rng.bytes(most), b"\r\n" * most, b"GET " + b"a" * most, b"\x16\x03\x01" + rng.bytes(most), b"\0" * most,
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + rng.bytes(most), b"GET / HTTP/1.1\n\n" * (most // 16 + 1),
        b"GET / HTTP/9.9\r\n\r\n",
    )  # fmt: skip
    return Request([data], broken=True, half_closed=True)


@kind("a length that can't be")
def odd_lengths(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    pairs = [("Content-Type", "application/json")]
    for _ in range(int(rng.integers(1, 3))):
        length = pick(rng, "-1", "1" * 5000, "+5", "5, 5", "5;", "0x5", "\u0665", "1e3", "", "18446744073709551616")
        pairs.append(("Content-Length", length))
    if rng.random() < 0.3:
        pairs.append(("Transfer-Encoding", pick(rng, "chunked", "chunked, chunked", "gzip, chunked", "identity", "x")))
    return Request([head("POST", target, pairs), b"{}"], broken=True, half_closed=True)


def made(name: str, seed: int, world: World) -> Request:
    """The request generated for a kind and a seed."""
    return KINDS[name].make(np.random.default_rng([seed, zlib.crc32(name.encode())]), world)


def shares(examples: int, names: list[str]) -> dict[str, int]:
    """How many examples to take of each kind for a total; of kinds that take long a quarter as many."""
    weights = {name: 0.25 if KINDS[name].long else 1.0 for name in names}
    return {name: math.ceil(examples / sum(weights.values()) * weight) for name, weight in weights.items()}
