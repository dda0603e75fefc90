"""Calls whose answers are recorded first, so that later answers can be compared byte for byte."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import httpx
import numpy as np

#: Formats of a shape, and of an animation, that every server can write.
SHAPES = ("glb", "gltf", "obj", "ply", "stl", "npz", "json")
ANIMATIONS = ("glb", "npz", "zip", "pc2", "jsonl")


@dataclass(frozen=True)
class RecordedCall:
    """One request."""

    method: str
    path: str
    content: bytes | None = None
    type: str | None = None

    def send(self, client: httpx.Client) -> httpx.Response:
        headers = {"Content-Type": self.type} if self.type else {}
        return client.request(self.method, self.path, content=self.content, headers=headers)


def post(path: str, body: Any) -> RecordedCall:
    return RecordedCall(
        "POST", path, body if isinstance(body, bytes) else json.dumps(body).encode(), "application/json"
    )


def good_calls(client: httpx.Client, name: str, rng: np.random.Generator, count: int) -> list[RecordedCall]:
    """Calls of every kind about one model, as a user would send them."""
    card = client.get(f"/v1/models/{name}").raise_for_status().json()
    lower, upper = np.array(card["lower"]), np.array(card["upper"])
    model = f"/v1/models/{name}"
    calls = [RecordedCall("GET", "/v1/models"), RecordedCall("GET", model)]
    for k in range(count):
        a, b = (rng.uniform(lower, upper).round(4).tolist() for _ in range(2))
        text = ",".join(map(str, a))
        calls += [
            RecordedCall("GET", f"{model}/mesh?latent={text}&format={SHAPES[k % len(SHAPES)]}"),
            post(f"{model}/mesh?format=npz", {"latent": a, "mesh": "coarse"}),
            post(f"{model}/vertices", {"latents": [a, b]}),
            post(f"{model}/nric", {"latents": [a], "factors": True}),
            post(f"{model}/sample", {"count": 3, "seed": k, "distribution": "gaussian"}),
            post(f"{model}/edit", {"latent": a, "targets": [{"vertex": 1, "position": [0.1, 0.2, 0.3]}]}),
            post(
                f"/v2{model.removeprefix('/v1')}/infer",
                {"inputs": [{"name": "latent", "shape": [1, len(a)], "datatype": "FP32", "data": a}]},
            ),
        ]
        mesh = client.get(f"{model}/mesh", params={"latent": text, "format": "obj"}).raise_for_status().content
        calls.append(RecordedCall("POST", f"{model}/encode", mesh, "model/obj"))
        path = client.post(f"{model}/interpolations", json={"keyframes": [a, b], "frames": 4}).raise_for_status().json()
        calls.append(RecordedCall("GET", path["links"][ANIMATIONS[k % len(ANIMATIONS)]]))
        calls.append(RecordedCall("GET", path["links"]["frames"].replace("{k}", "1")))
    return calls


def bad_calls(name: str) -> list[RecordedCall]:
    """Calls that must be refused."""
    model = f"/v1/models/{name}"
    return [
        post(f"{model}/mesh", b'{"latent": [1, 2'),
        post(f"{model}/mesh", {"latent": [1]}),
        post(f"{model}/vertices", b'{"latents": [[NaN]]}'),
        post(f"{model}/vertices", {"latents": [[0.0]] * 300}),
        post(f"{model}/interpolations", {"keyframes": [[0.0]], "frames": 10_000}),
        post(f"{model}/sample", {"count": -1}),
        post(f"{model}/edit", {"latent": [], "targets": []}),
        RecordedCall("POST", f"{model}/encode", b"\x93no mesh" * 500, "model/gltf-binary"),
        RecordedCall("POST", f"{model}/encode", b"v 1 2 nan\nf 1 1 1\n", "model/obj"),
        RecordedCall("POST", f"{model}/mesh", b"latent=1", "application/x-www-form-urlencoded"),
        RecordedCall("GET", f"{model}/mesh?latent=nan,inf"),
        RecordedCall("GET", f"{model}/mesh?format=fbx"),
        RecordedCall("GET", "/v1/models/nobody"),
        RecordedCall("GET", "/v1/interpolations/AAAA"),
        RecordedCall("GET", "/page/%2e%2e/%2e%2e/settings.py"),
        RecordedCall("DELETE", model),
    ]


Fingerprint = tuple[int, str, str, str]


def fingerprint(answer: httpx.Response) -> Fingerprint:
    """Status, media type, entity tag and digest of the body."""
    head = answer.headers
    return (
        answer.status_code,
        head.get("content-type", ""),
        head.get("etag", ""),
        hashlib.sha256(answer.content).hexdigest(),
    )


class Truth:
    """The answers of calls while nothing disturbs the server."""

    def __init__(self, client: httpx.Client, calls: Iterable[RecordedCall]) -> None:
        self._client = client
        self.answers: dict[RecordedCall, Fingerprint] = {call: fingerprint(call.send(client)) for call in calls}

    def differing(self, client: httpx.Client | None = None) -> list[RecordedCall]:
        """Calls whose answers now differ from the recorded ones."""
        client = client or self._client
        return [call for call, then in self.answers.items() if fingerprint(call.send(client)) != then]
