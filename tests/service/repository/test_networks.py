"""Networks that hang or fail at some codes: requests for these fail, all others are answered."""

import json
import logging
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np
import pytest

from shapespace.bundle.reader import read_bundle
from shapespace.model.networks import LEAST_PATIENCE, ModelFailedError, NetworkTimeError
from shapespace.model.shape_model import ShapeModel
from tests.service import hostile
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, Start, starting
from tests.service.hostile import BEYOND, HARMFUL
from tests.service.watching import SOON, eventually, samples, value

GOOD = [0.1, 0.7, 0.4]
TYPE = "urn:shapespace:problem:model-failed"
FAILED = "The model's networks failed at this code. Choose another code or model, and tell the operator of the server."
HARMS = {
    "loops": (hostile.loops, {}),
    "loops-if": (hostile.loops, {"nest": "if"}),
    "loops-scan": (hostile.loops, {"nest": "scan"}),
    "fails": (hostile.fails, {}),
    "changes": (hostile.changes_shape, {}),
    "not-finite": (hostile.not_finite, {}),
}


class Impatient(Server):
    """A server whose networks have two seconds for a code, because a hanging one computes all the time."""

    program = (
        "-c",
        """
from shapespace.model import networks
networks.PATIENCE = 2
from shapespace.service.__main__ import main
main()
""",
    )


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    models = tmp_path_factory.mktemp("harmful") / "models"
    write_bundle(models, "good")
    for name, (harm, options) in HARMS.items():
        hostile.hostile(models, name, harm, beyond=BEYOND, **options)
    with starting(Impatient) as start:
        yield start(models, workers=2)


@pytest.fixture
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=120) as client:
        yield client


def ask(client: httpx.Client, model: str, code: list[float]) -> httpx.Response:
    return client.post(f"/v1/models/{model}/vertices", json={"latents": [code]})


def test_they_are_served_where_they_do_no_harm(client: httpx.Client) -> None:
    for model in HARMS:
        assert ask(client, model, GOOD).json()["vertices"] == ask(client, "good", GOOD).json()["vertices"]


@pytest.mark.parametrize(
    "model", ["loops", *(pytest.param(name, marks=pytest.mark.long) for name in ("loops-if", "loops-scan"))]
)
def test_a_network_that_hangs_is_ended_and_the_others_go_on(client: httpx.Client, server: Server, model: str) -> None:
    answers: list[httpx.Response] = []
    threads = [threading.Thread(target=lambda: answers.append(ask(client, model, HARMFUL))) for _ in range(4)]
    for thread in threads:
        thread.start()
    right = ask(client, "good", GOOD)
    assert right.status_code == 200
    for thread in threads:
        thread.join()
    assert [answer.status_code for answer in answers] == [503] * 4
    assert {answer.json()["type"] for answer in answers} == {TYPE}
    details = {answer.json()["detail"] for answer in answers}
    assert any("did not answer within 2 s at this code" in detail for detail in details), details
    assert f"ERROR shapespace.model.networks: model {model}/1: factor-0.onnx does not answer in time" in server.log
    assert ask(client, model, GOOD).json()["vertices"] == right.json()["vertices"]


@pytest.mark.parametrize(("model", "reason"), [("fails", "out of data bounds"), ("changes", "gives (2, 384)")])
def test_a_network_that_fails_is_no_mistake_of_the_server(
    client: httpx.Client, server: Server, model: str, reason: str
) -> None:
    path = {"keyframes": [GOOD, HARMFUL], "frames": 5}
    links = client.post(f"/v1/models/{model}/interpolations", json=path).json()["links"]
    tensor = {"name": "latent", "shape": [1, 3], "datatype": "FP32", "data": HARMFUL}
    answers = [
        ask(client, model, HARMFUL),
        client.post(f"/v1/models/{model}/nric", json={"latents": [HARMFUL]}),
        client.get(f"/v1/models/{model}/mesh", params={"latent": ",".join(map(str, HARMFUL))}),
        client.post(f"/v2/models/{model}/infer", json={"inputs": [tensor]}),
        client.get(links["glb"]),
    ]
    for answer in answers:
        assert (answer.status_code, answer.json()["type"], answer.json()["detail"]) == (503, TYPE, FAILED)
    lines = [json.loads(line) for line in client.get(links["jsonl"]).text.splitlines()]
    assert lines[-1]["problem"]["type"] == TYPE
    assert 1 < len(lines) < 6
    assert reason in server.log
    assert "Traceback" not in server.log


def test_what_is_not_finite_is_told_as_ever(client: httpx.Client) -> None:
    answer = ask(client, "not-finite", HARMFUL)
    assert (answer.status_code, answer.json()["type"]) == (422, "urn:shapespace:problem:not-finite")


def test_a_request_has_no_longer_than_its_deadline(tmp_path: Path, start: Start) -> None:
    hostile.hostile(tmp_path / "models", "loops", hostile.loops, beyond=BEYOND)
    server = start(tmp_path / "models", workers=1, deadline=1)
    with httpx.Client(base_url=server.url, timeout=60) as client:
        answer = ask(client, "loops", HARMFUL)
        assert (answer.status_code, answer.json()["type"]) == (504, "urn:shapespace:problem:deadline-passed")
        eventually(lambda: ask(client, "loops", GOOD).status_code == 200)  # once the thread is free or given up


def test_sigterm_ends_a_server_whose_networks_hang(tmp_path: Path, start: Start) -> None:
    hostile.hostile(tmp_path / "models", "loops", hostile.loops, beyond=BEYOND)
    server = start(tmp_path / "models", workers=2)
    with httpx.Client(base_url=server.url, timeout=60) as client, ThreadPoolExecutor(4) as threads:
        asked = [threads.submit(ask, client, "loops", HARMFUL) for _ in range(4)]
        eventually(lambda: value(samples(client), "shapespace_admitted") == 4)
        assert ends(server) < SOON, "without a drain"
        assert {answer.result().json()["type"] for answer in asked} == {"urn:shapespace:problem:not-ready"}


def ends(server: Server) -> float:
    """Seconds from SIGTERM to the end, with status 0."""
    began = time.monotonic()
    server.process.send_signal(signal.SIGTERM)
    assert server.process.wait(60) == 0
    return time.monotonic() - began


def model(folder: Path, harm: object = None, **options: object) -> ShapeModel:
    return ShapeModel(read_bundle(hostile.hostile(folder, "harmful", harm, beyond=BEYOND, **options)))


def test_a_model_that_has_hung_gets_less_time(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    loops = model(tmp_path, hostile.loops)
    code, _ = loops.latents.code(HARMFUL)
    times, loops.decoder._patience.seconds = [], 1.25
    for _ in range(4):
        began = time.monotonic()
        with pytest.raises(NetworkTimeError):
            loops.shape(code)
        times.append(time.monotonic() - began)
    # Only lower limits are tested; how much longer each takes depends on the machine.
    assert all(took >= least for took, least in zip(times, (1.25, 0.625, 0.5, 0.5), strict=True)), times
    assert loops.decoder._patience.seconds == LEAST_PATIENCE
    assert loops.shape(loops.latents.code(GOOD)[0]).diagnostics.status == "converged"


def test_what_went_wrong_is_in_the_log_and_not_in_the_answer(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    fails = model(tmp_path, hostile.fails)
    with caplog.at_level(logging.ERROR), pytest.raises(ModelFailedError) as found:
        fails.decoder.nric(fails.latents.code(HARMFUL)[0])
    assert "Gather" not in str(found.value)
    assert "Gather" in caplog.text


def test_solvers_are_made_when_they_are_needed(tmp_path: Path) -> None:
    bundle = read_bundle(write_bundle(tmp_path))
    many, one = ShapeModel(bundle, 200), ShapeModel(bundle, 1)
    assert many.decoder._solvers.qsize() == 1
    codes = many.latents.sample(4, 0, "uniform")
    expected = [one.shape(code) for code in codes]
    with many.decoder.solver() as first, many.decoder.solver() as second, many.decoder.solver() as third:
        assert len({id(first), id(second), id(third)}) == 3
        found = [many.shape(code) for code in codes]  # by a fourth solver
    assert many.decoder._solvers.qsize() == 4
    for a, b in zip(expected, found, strict=True):
        assert np.array_equal(a.vertices, b.vertices)
        assert a.diagnostics == b.diagnostics


def test_no_more_solvers_than_shapes_at_once(tmp_path: Path) -> None:
    two = ShapeModel(read_bundle(write_bundle(tmp_path)), 2)
    code = two.latents.sample(1, 0, "uniform")[0]
    shapes = []
    waiting = threading.Thread(target=lambda: shapes.append(two.shape(code)))
    with two.decoder.solver():
        with two.decoder.solver():
            waiting.start()
            waiting.join(0.5)
            assert shapes == []
        waiting.join(60)
        assert len(shapes) == 1


@pytest.mark.long
def test_many_workers_take_neither_time_nor_memory_before_they_work(start: Start) -> None:
    few, many = (start(ROOT / "models", workers=workers) for workers in (1, 200))
    with httpx.Client(base_url=few.url, timeout=120) as one, httpx.Client(base_url=many.url, timeout=120) as other:
        memory = [_resident(client) for client in (one, other)]
        assert memory[1] < 1.2 * memory[0], memory
        for name in ("figure", "freaky-torus"):
            code = [0.3] * one.get(f"/v1/models/{name}").json()["latent_dimension"]
            bodies = [
                client.post(f"/v1/models/{name}/mesh", json={"latent": code}).raise_for_status().content
                for client in (one, other)
            ]
            assert bodies[0] == bodies[1]
    assert ends(many) < SOON


def _resident(client: httpx.Client) -> float:
    return samples(client)["process_resident_memory_bytes", frozenset()]
