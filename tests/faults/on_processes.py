"""Faults of the server's machine: signals under load, a clock that jumps, a full or read-only disk."""

import os
import resource
import shutil
import signal
import threading
import time
from collections import Counter

import httpx
import numpy as np
import pytest

from tests.faults.catalogue import FaultTarget, fault
from tests.faults.clock import YEAR, jumping_clock
from tests.faults.on_training import read_only
from tests.service.bundles import SCALE, rescale, write_bundle
from tests.service.truth import Truth, fingerprint, good_calls
from tests.service.watching import eventually


class Askers:
    """Clients that repeat the same calls, compare the answers, and reconnect when a connection breaks."""

    def __init__(self, truth: Truth, urls: list[str], count: int) -> None:
        self.outcomes: Counter[str] = Counter()
        self._truth, self._urls, self._stop = truth, urls, threading.Event()
        self._threads = [threading.Thread(target=self._ask, args=[k]) for k in range(count)]
        for thread in self._threads:
            thread.start()

    def _ask(self, k: int) -> None:
        calls = list(self._truth.answers.items())
        while not self._stop.is_set():
            with httpx.Client(base_url=self._urls[-1], timeout=60) as client:
                try:
                    for call, then in calls[k:] + calls[:k]:
                        self.outcomes["right" if fingerprint(call.send(client)) == then else f"wrong: {call}"] += 1
                except httpx.TransportError:
                    self.outcomes["broken off"] += 1
                    time.sleep(0.05)

    def end(self) -> None:
        self._stop.set()
        for thread in self._threads:
            thread.join(60)
            assert not thread.is_alive()


@fault("the server is killed (SIGKILL) under load, and started again")
def killed(target: FaultTarget, rng: np.random.Generator) -> str:
    server = target.start(target.steady.models, workers=2)
    askers = Askers(target.steady.truth, [server.url], 4)
    try:
        time.sleep(rng.uniform(0.5, 2))
        server.process.kill()
        server.process.wait(60)
        right = askers.outcomes["right"]
        askers._urls.append(target.start(target.steady.models, workers=2).url)
        eventually(lambda: askers.outcomes["right"] > right + 20)
    finally:
        askers.end()
    assert right
    assert askers.outcomes.keys() == {"right", "broken off"}, askers.outcomes
    return "connections broke; every answer before and after it equal byte for byte, ids of animations included"


@fault("the clock jumps while serving")
def clock(target: FaultTarget, rng: np.random.Generator) -> str:
    folder = target.folder / "models"
    bundle = write_bundle(folder, "small")
    with jumping_clock(target.folder) as clock:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in clock.environment.items():
                patch.setenv(name, value)
            server = target.start(folder, workers=2, watch=0.1, deadline=30)
        with httpx.Client(base_url=server.url, timeout=60) as client:
            truth = Truth(client, good_calls(client, "small", np.random.default_rng(0), 2))
            askers = Askers(truth, [server.url], 2)
            try:
                for years in rng.uniform(-30, 10, 8):
                    clock.jump(years)
                    time.sleep(0.1)
            finally:
                askers.end()
            assert askers.outcomes.keys() == {"right"}, askers.outcomes
            # The server must have seen the jump; uvicorn reads the clock once a second.
            year = str(time.gmtime(time.time() + years * YEAR).tm_year)
            eventually(lambda: year in client.get("/v2/health/live").headers["date"])
            # A bundle with file times in the past or the future is loaded like any other.
            rescale(bundle, 2 * SCALE)
            for file in bundle.iterdir():
                os.utime(file, (1e9, time.time() + years * YEAR))
            eventually(lambda: client.get("/v1/models/small").json()["scale"] == 2 * SCALE)
    assert "Traceback" not in server.log
    return "back and forth by decades: no deadline passed, no answer changed, a new bundle taken up"


@fault("the server's disk is full")
def full_disk(target: FaultTarget, rng: np.random.Generator) -> str:
    # No file can grow, not even the log; the limit applies to root too.
    server = target.start(target.steady.models, workers=2, log_format=rng.choice(["text", "json"]))
    with httpx.Client(base_url=server.url, timeout=60) as client:
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
        for _ in range(2):
            assert target.steady.truth.differing(client) == []
        usd_without_disk(client)
        resource.prlimit(server.process.pid, resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        assert client.get(usd_link(client)).content[:8] == b"PXR-USDC"
    target.steady.check()
    return "answers as before, uploads too; USD, which needs a temporary file, 507 until there is room again"


def usd_link(client: httpx.Client) -> str:
    body = {"keyframes": [[0, 0, 0], [0.1, 0.2, 0.3]], "frames": 3}
    return str(client.post("/v1/models/small/interpolations", json=body).json()["links"]["usd"])


def usd_without_disk(client: httpx.Client) -> None:
    answer = client.get(usd_link(client))
    assert (answer.status_code, answer.json()["type"]) == (507, "urn:shapespace:problem:no-room"), answer.text


@fault("the server's folders are read-only")
def read_only_folders(target: FaultTarget, rng: np.random.Generator) -> str:
    models = target.folder / "models"
    shutil.copytree(target.steady.models, models)
    server = target.start(models, workers=2)
    with read_only(models) as reason, httpx.Client(base_url=server.url, timeout=60) as client:
        server.process.send_signal(signal.SIGHUP)
        assert target.steady.truth.differing(client) == []
        if reason != "Not a directory":  # otherwise the folder is a file, which no server can read
            with httpx.Client(base_url=target.start(models, workers=2).url, timeout=60) as other:
                assert target.steady.truth.differing(other) == []
    assert server.process.poll() is None
    assert "Traceback" not in server.log
    return "nothing is written: answers as before"
