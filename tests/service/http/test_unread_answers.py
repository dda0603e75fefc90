"""Large answers: sent as fast as they are read, with a limit on the memory that they take."""

import asyncio
import json
from pathlib import Path

import httpx
import numpy as np
import pytest
from starlette.responses import Response
from starlette.types import Message, Receive, Scope, Send

from shapespace.service.http.middleware import memory
from shapespace.service.http.middleware.memory import PIECE_BYTES, LimitUnreadAnswers
from tests.service.conftest import Start

MIB = 2**20


async def large(scope: Scope, receive: Receive, send: Send) -> None:
    await Response(bytes(range(256)) * (MIB // 256))(scope, receive, send)


async def nothing() -> Message:
    await asyncio.Event().wait()
    raise AssertionError


def scope(client: str) -> Scope:
    return {"type": "http", "path": "/", "client": (client, 1), "headers": []}


def test_a_large_answer_leaves_in_pieces_each_after_the_last_was_taken() -> None:
    async def ask() -> list[Message]:
        sent: list[Message] = []

        async def send(message: Message) -> None:
            sent.append(message)

        await LimitUnreadAnswers(large)(scope("a"), nothing, send)
        return sent

    start, *pieces = asyncio.run(ask())
    assert dict(start["headers"])[b"content-length"] == str(MIB).encode()
    assert max(len(piece["body"]) for piece in pieces) == PIECE_BYTES
    assert b"".join(piece["body"] for piece in pieces) == bytes(range(256)) * (MIB // 256)
    assert [piece["more_body"] for piece in pieces] == [True] * (len(pieces) - 1) + [False]


def test_answers_that_nobody_reads_are_limited_together(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "UNREAD_BYTES", 8 * MIB)

    async def ask() -> list[int]:
        pace, statuses, go_on = LimitUnreadAnswers(large), [], asyncio.Event()

        async def send(message: Message) -> None:
            if message["type"] == "http.response.start":
                statuses.append(message["status"])
            elif len(message["body"]) == PIECE_BYTES:
                await go_on.wait()  # a client that doesn't read

        waiting = [asyncio.create_task(pace(scope(client), nothing, send)) for client in ["a"] * 8 + ["b"] * 2]
        await asyncio.sleep(0.1)
        assert sorted(statuses) == [200] * 8 + [503] * 2, "six of eight for one address"
        go_on.set()
        await asyncio.gather(*waiting)
        await pace(scope("a"), nothing, send)
        return statuses

    assert asyncio.run(ask())[-1] == 200


@pytest.mark.long
def test_answers_in_pieces_are_the_same_as_whole_ones(models: Path, start: Start) -> None:
    """More than four MiB of shapes are sent in pieces, less as a whole."""
    with httpx.Client(base_url=start(models, workers=2).url, timeout=120) as client:
        model = "/v1/models/figure"
        card = client.get(model).json()
        rng = np.random.default_rng(0)
        codes = rng.uniform(card["lower"], card["upper"], (3, card["latent_dimension"])).round(3).tolist()
        many = codes * 30
        whole, pieces = (
            client.post(f"{model}/nric", json={"latents": latents, "factors": True}) for latents in (codes, many)
        )
        assert "content-length" in whole.headers
        assert "content-length" not in pieces.headers
        assert "encode;dur=" in pieces.headers["Server-Timing"]
        few, lots = whole.json(), pieces.json()
        for name in ("lengths", "angles", "factors"):
            assert lots[name] == few[name] * 30
        asked = {
            "inputs": [{"name": "latent", "shape": [90, len(many[0])], "datatype": "FP32", "data": many}],
            "id": "x",
        }
        answer = client.post("/v2/models/figure/infer", json=asked | {"outputs": [{"name": "nric"}]}).json()
        (tensor,) = answer["outputs"]
        assert answer["id"] == "x"
        rows = np.float32(tensor["data"]).reshape(tensor["shape"])
        np.testing.assert_array_equal(rows[:3], np.float32(np.hstack([few["lengths"], few["angles"]])))
        binary = client.post(
            "/v2/models/figure/infer", json=asked | {"outputs": [{"name": "nric", "parameters": {"binary_data": True}}]}
        )
        length = int(binary.headers["Inference-Header-Content-Length"])
        assert json.loads(binary.content[:length])["outputs"][0]["parameters"]["binary_data_size"] == rows.nbytes
        assert binary.content[length:] == rows.tobytes()
