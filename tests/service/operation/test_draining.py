"""Shutdown: readiness changes first, and no accepted request is lost."""

import fcntl
import json
import os
import pty
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from tests.service.conftest import ROOT, Server, Start
from tests.service.watching import SOON, admitted, eventually, samples, value

MODEL = "/v1/models/small"
MESH = f"{MODEL}/mesh"


class Patient(Server):
    """A server that waits long for running requests and open connections, as a busy machine needs it."""

    program = (
        "-c",
        """
from shapespace.service.http import server
server.LINGER, server.FINISH, server.EXIT = 60, 60, 60
from shapespace.service.__main__ import main
main()
""",
    )


@pytest.fixture
def patient(small_models: Path) -> Iterator[Callable[..., Server]]:
    servers: list[Server] = []

    def start(**settings: object) -> Server:
        servers.append(Patient(small_models, **settings))
        return servers[-1]

    yield start
    for server in servers:
        server.process.kill()
        server.process.communicate()


class Load:
    """Clients that send requests without a pause, each on a kept connection, until the port is closed."""

    def __init__(self, server: Server, clients: int) -> None:
        self.outcomes: Counter[str] = Counter()
        self._url = server.url
        self._threads = [threading.Thread(target=self._ask, args=[k]) for k in range(clients)]
        for thread in self._threads:
            thread.start()

    def _ask(self, k: int) -> None:
        with httpx.Client(base_url=self._url, timeout=60) as client:
            for i in range(100_000):
                try:
                    answer = client.post(MESH, json={"latent": [0.1, k, (i % 100) / 100]})
                except httpx.ConnectError:  # the port is closed: nothing was accepted
                    self.outcomes["refused"] += 1
                    return
                except httpx.HTTPError as error:
                    self.outcomes[f"lost: {error!r}"] += 1
                    continue
                good = answer.status_code == 200 and answer.content[:4] == b"glTF"
                self.outcomes["answered" if good else f"status {answer.status_code}"] += 1

    def wait(self) -> None:
        for thread in self._threads:
            thread.join(timeout=60)
            assert not thread.is_alive()


@pytest.mark.parametrize("drain", [0, 1])
def test_sigterm_under_load_loses_no_accepted_request(patient: Callable[..., Server], drain: float) -> None:
    server = patient(workers=2, drain=drain)
    load = Load(server, 6)
    while load.outcomes["answered"] < 30:
        time.sleep(0.05)
    server.process.send_signal(signal.SIGTERM)
    load.wait()
    assert set(load.outcomes) == {"answered", "refused"}, load.outcomes
    assert load.outcomes["refused"] == 6
    assert server.process.wait(60) == 0
    assert "Traceback" not in server.log


def test_readiness_turns_first_and_everything_is_still_answered(small_models: Path, start: Start) -> None:
    server = start(small_models, drain=60)  # the second signal skips it
    with httpx.Client(base_url=server.url) as kept:
        assert kept.get("/v2/health/ready").json() == {"ready": True}
        server.process.send_signal(signal.SIGTERM)
        while (ready := httpx.get(f"{server.url}/v2/health/ready")).status_code == 200:
            time.sleep(0.01)
        assert ready.status_code == 503
        assert ready.json()["ready"] is False
        assert "Send requests to another" in ready.json()["error"]
        assert httpx.get(f"{server.url}/v2/health/live").status_code == 200
        answer = kept.post(MESH, json={"latent": [0.1, 0.7, 0.4]})
        assert answer.status_code == 200
        assert answer.headers["Connection"] == "close", "so that the client connects to another replica"
    server.process.send_signal(signal.SIGTERM)  # the second signal skips the drain
    assert server.process.wait(60) == 0


def test_a_connection_opened_before_the_end_is_answered_after_it(patient: Callable[..., Server]) -> None:
    server = patient(drain=0)
    host, port = server.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as connection:
        # Once this is answered, the earlier connection has been accepted too.
        assert httpx.get(f"{server.url}/v2/health/live").status_code == 200
        server.process.send_signal(signal.SIGTERM)
        eventually(lambda: "no longer ready" in server.log)
        connection.sendall(b"GET /v1/models/small HTTP/1.1\r\nHost: localhost\r\n\r\n")
        with connection.makefile("rb") as answer:
            assert b"200" in answer.readline()
            assert b'"name":"small"' in answer.read()
    assert server.process.wait(60) == 0


def test_it_ends_with_its_terminal(small_models: Path, tmp_path: Path) -> None:
    terminal, shell = pty.openpty()
    log = tmp_path / "log"
    with log.open("w") as lines:
        process = subprocess.Popen(
            [sys.executable, "-m", "shapespace.service"],
            cwd=ROOT,
            env=os.environ | {"SHAPESPACE_MODELS_DIR": str(small_models), "SHAPESPACE_PORT": "0"},
            stdin=shell,
            stdout=subprocess.PIPE,
            stderr=lines,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),  # noqa: PLW1509 - what a login does
        )
    os.close(shell)
    with process:
        assert process.stdout
        assert b"http://" in process.stdout.readline()
        os.kill(process.pid, signal.SIGHUP)  # while the terminal exists, SIGHUP means reload
        eventually(lambda: "reloaded:" in log.read_text())
        os.close(terminal)
        assert process.wait(60) == 0


def test_a_running_stream_is_finished_after_sigterm(small_models: Path, start: Start) -> None:
    server = start(small_models, drain=60)
    with httpx.Client(base_url=server.url, timeout=60) as client:
        path = {"keyframes": [[0, 0, 0], [0.1, 0.7, 0.4]], "frames": 600}
        link = client.post("/v1/models/small/interpolations", json=path).json()["links"]["jsonl"]
        with client.stream("GET", link) as stream:
            lines = stream.iter_lines()
            frames = [json.loads(next(lines))["frame"]]
            server.process.send_signal(signal.SIGTERM)
            eventually(lambda: "no longer ready" in server.log)
            frames += [json.loads(line)["frame"] for line in lines]
    assert frames == list(range(600))
    server.process.send_signal(signal.SIGTERM)  # ends the drain
    assert server.process.wait(60) == 0
    assert "Traceback" not in server.log


def test_an_interrupt_ends_it_at_once_and_answers_what_runs(small_models: Path, start: Start) -> None:
    server = start(small_models, max_codes=10_000, drain=60)
    with ThreadPoolExecutor(1) as pool, httpx.Client(base_url=server.url, timeout=60) as client:
        body = {"latents": [[0.1, 0.7, k / 10_000] for k in range(10_000)]}
        answer = pool.submit(httpx.post, f"{server.url}/v1/models/small/vertices", json=body, timeout=60)
        eventually(lambda: admitted(client) == 1)
        server.process.send_signal(signal.SIGINT)
        assert answer.result().status_code == 503
        assert answer.result().json()["type"] == "urn:shapespace:problem:not-ready"
        assert server.process.wait(60) == 0
    assert "Traceback" not in server.log


@pytest.mark.parametrize(
    "busy", ["shapes", *(pytest.param(busy, marks=pytest.mark.long) for busy in ("streams", "nothing"))]
)
def test_sigterm_ends_it_soon_whatever_it_is_doing(small_models: Path, start: Start, busy: str) -> None:
    server = start(small_models, workers=2, max_codes=10_000, max_frames=20_000)
    calls: list[Callable[[], object]] = []
    if busy == "shapes":
        body = {"latents": [[0.1, 0.7, 0.4]] * 10_000}
        calls = [lambda: httpx.post(f"{server.url}{MODEL}/vertices", json=body, timeout=60)] * 4
    elif busy == "streams":
        path = {"keyframes": [[0.1, 0.7, 0.4], [0, 0, 0]], "frames": 20_000}
        answer = httpx.post(f"{server.url}{MODEL}/interpolations", json=path)
        link = server.url + answer.json()["links"]["jsonl"]
        calls = [lambda: httpx.get(link, timeout=60)] * 4
    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(call) for call in calls]
        if calls:
            at_work = {"shapes": "shapespace_admitted", "streams": "shapespace_streams"}[busy]
            with httpx.Client(base_url=server.url) as client:
                eventually(lambda: value(samples(client), at_work) == len(calls))
        began = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(60) == 0
        assert time.monotonic() - began < SOON, "without a drain"
        for call in asked:
            answer = call.result()
            assert isinstance(answer, httpx.Response)
            if busy == "shapes":
                assert (answer.status_code, answer.json()["type"]) == (503, "urn:shapespace:problem:not-ready")
                assert "Retry-After" in answer.headers
            else:
                assert json.loads(answer.text.splitlines()[-1])["problem"]["status"] == 503
    assert "Traceback" not in server.log
