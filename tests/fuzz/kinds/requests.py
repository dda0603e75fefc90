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

import httpx
import numpy as np

from tests.fuzz.cost import MIB, Request
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


# Parts of requests.


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


def forged(content: bytes) -> str:
    """An id with a correct checksum, in the format of version 0.1."""
    packed = hashlib.sha256(content).digest()[:9] + zlib.compress(content, 9)
    return base64.urlsafe_b64encode(packed).rstrip(b"=").decode()


def link(model: Model, frames: int, codes: list[list[float]], mesh: str = "fine") -> str:
    """The address of an animation."""
    facts = {
        "frames": frames, "keyframes": codes, "loop": False, "mesh": mesh, "model": model.card["digest"][:32],
        "start": 0.0, "stop": 1.0,
    }  # fmt: skip
    return f"/v1/interpolations/{forged(json.dumps(facts, separators=(',', ':')).encode())}"


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


def made(name: str, seed: int, world: World) -> Request:
    """The request generated for a kind and a seed."""
    return KINDS[name].make(np.random.default_rng([seed, zlib.crc32(name.encode())]), world)


def shares(examples: int, names: list[str]) -> dict[str, int]:
    """How many examples to take of each kind for a total; of kinds that take long a quarter as many."""
    weights = {name: 0.25 if KINDS[name].long else 1.0 for name in names}
    return {name: math.ceil(examples / sum(weights.values()) * weight) for name, weight in weights.items()}
