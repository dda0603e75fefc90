"""Two servers with the same models: answers don't depend on which one is asked."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from shapespace.client import Client, Interpolation
from tests.service.conftest import Server, starting

CODES = [[0, 0, 0], [0.1, 0.7, 0.4]]
TENSOR = {"name": "latent", "shape": [1, 3], "datatype": "FP32", "data": CODES[1]}
REQUESTS: list[tuple[str, str, dict[str, Any] | None]] = [
    ("GET", "/v1/models", None),
    ("GET", "/v1/models/figure", None),
    ("GET", "/v1/models/freaky-torus/mesh?latent=1,2,3,4", None),
    ("POST", "/v1/models/figure/mesh", {"latent": [0.1] * 20}),
    ("POST", "/v1/models/small/vertices?format=npz", {"latents": CODES}),
    ("POST", "/v1/models/small/nric", {"latents": CODES[1:]}),
    ("POST", "/v1/models/small/interpolations", {"keyframes": CODES}),
    ("POST", "/v2/models/small/infer", {"inputs": [TENSOR]}),
]


@pytest.fixture(scope="module")
def replicas(models: Path) -> Iterator[list[Server]]:
    with starting() as start:
        yield [start(models, workers=workers) for workers in (1, 2)]


@pytest.mark.parametrize(("method", "path", "body"), REQUESTS)
def test_replicas_agree_on_ids_tags_and_bytes(
    replicas: list[Server], method: str, path: str, body: dict[str, Any] | None
) -> None:
    one, other = (httpx.request(method, f"{server.url}{path}", json=body, timeout=60) for server in replicas)
    assert one.is_success
    assert one.content == other.content
    assert one.headers.get("ETag") == other.headers.get("ETag")
    if tag := one.headers.get("ETag"):
        again = httpx.request(method, f"{replicas[1].url}{path}", json=body, headers={"If-None-Match": tag})
        assert again.status_code == 304


def test_an_animation_made_by_one_is_played_by_all(replicas: list[Server]) -> None:
    with ExitStack() as stack:
        one, other = (stack.enter_context(Client(server.url)) for server in replicas)
        made = one.interpolate("small", CODES, frames=5)
        elsewhere = Interpolation(other, made.id, made.frames)
        assert [made.frame(k) for k in range(5)] == [elsewhere.frame(k) for k in range(5)]
        assert made.file() == elsewhere.file()
