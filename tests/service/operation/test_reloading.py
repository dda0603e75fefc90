"""Bundles that are added, changed and removed while requests run."""

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest
from prometheus_client import CollectorRegistry

from shapespace.service.limits.quota import Quota
from shapespace.service.limits.workers import Workers
from shapespace.service.operation.metrics import Metrics
from shapespace.service.operation.reloading import Reloader
from shapespace.service.repository.repository import Changes, ModelRepository
from tests.faults.serving import peak_memory
from tests.service import hostile
from tests.service.bundles import SCALE, reference, rescale, write_bundle
from tests.service.conftest import ROOT, Server, Start, starting
from tests.service.repository.test_bundles import flip_a_bit
from tests.service.watching import eventually, samples, value

CODES = [[0.1, 0.7, 0.4], [0.0, 0.0, 0.0], [0.05, 1.0, 0.2]]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_bundle(tmp_path / "models", "small", "1")
    return tmp_path / "models"


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, Server]]:
    folder = tmp_path_factory.mktemp("reloading") / "models"
    write_bundle(folder, "small", "1")
    with starting() as start:
        yield folder, start(folder, workers=2)


@pytest.fixture
def shared(served: tuple[Path, Server]) -> tuple[Path, Server]:
    """A folder with one bundle and a server of it, for one test after the other."""
    folder, server = served
    if "reloaded:" in server.log:
        shutil.rmtree(folder)
        write_bundle(folder, "small", "1")
        reload(server)
    return served


@contextmanager
def connected(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=60) as client:
        yield client


def reload(server: Server) -> None:
    """Send SIGHUP and wait for the log line that says that the reload is done."""
    before = server.log.count("reloaded:")
    server.process.send_signal(signal.SIGHUP)
    eventually(lambda: server.log.count("reloaded:") > before)


def test_sighup_takes_up_new_changed_and_removed_bundles(shared: tuple[Path, Server]) -> None:
    folder, server = shared
    write_bundle(folder, "other")
    reload(server)
    with connected(server) as client:
        digest = client.get("/v1/models/small").json()["digest"]
        shutil.rmtree(folder / "other")
        write_bundle(folder, "small", "2")
        rescale(folder / "small" / "1", 2 * SCALE)
        assert len(client.get("/v1/models").json()["models"]) == 2, "nothing changes without SIGHUP"
        reload(server)
        assert [model["name"] for model in client.get("/v1/models").json()["models"]] == ["small"]
        assert client.get("/v1/models/small").json()["versions"] == ["1", "2"]
        changed = client.get("/v1/models/small", params={"version": "1"}).json()
        assert changed["digest"] != digest
        assert changed["scale"] == 2 * SCALE
        assert client.get("/v1/models/other").status_code == 404
    assert "reloaded: 2 bundles loaded, 1 removed, 0 refused" in server.log


def test_a_bad_bundle_is_refused_and_what_was_loaded_stays(shared: tuple[Path, Server]) -> None:
    folder, server = shared
    with connected(server) as client:
        before = client.get("/v1/models/small/mesh", params={"latent": "0.1,0.7,0.4"})
        flip_a_bit(folder / "small" / "1")
        flip_a_bit(write_bundle(folder, "small", "2"))
        reload(server)
        after = client.get("/v1/models/small/mesh", params={"latent": "0.1,0.7,0.4"})
        assert after.content == before.content
        assert after.headers["ETag"] == before.headers["ETag"]
        assert client.get("/v1/models/small").json()["versions"] == ["1"]
        found = samples(client)
    refusals = [line for line in server.log.splitlines() if "factor-0.onnx does not have the digest" in line]
    assert len(refusals) == 2
    assert "bundle small/1 is refused, and the bundle loaded before stays" in refusals[0]
    assert "bundle small/2 is not served" in refusals[1]
    assert value(found, "shapespace_bundles_refused") == 2


def test_models_out_of_reach_stay_loaded(shared: tuple[Path, Server]) -> None:
    folder, server = shared
    folder.rename(folder.with_name("elsewhere"))
    with connected(server) as client:
        reload(server)
        assert client.get("/v1/models/small/mesh").status_code == 200
        assert value(samples(client), "shapespace_reloaded_bundles_total", result="failed") == 1
        folder.with_name("elsewhere").rename(folder)
        reload(server)
        assert value(samples(client), "shapespace_reloaded_bundles_total", result="failed") == 1
    assert "can't be read, so nothing changes" in server.log
    assert "Errno" not in server.log


def test_bundles_that_do_harm_are_refused_while_the_others_are_served(shared: tuple[Path, Server]) -> None:
    folder, server = shared
    log = len(server.log)
    for harm in (hostile.loops, hostile.fails, hostile.allocates, hostile.changes_shape, hostile.no_codes):
        hostile.hostile(folder, harm.__name__.replace("_", "-"), harm)
    write_bundle(folder, "small", "2")
    with connected(server) as client:
        before = samples(client)
        server.process.send_signal(signal.SIGHUP)
        while "reloaded:" not in server.log[log:]:
            assert client.get("/v1/models/small/mesh", params={"latent": "0.1,0.7,0.4"}).status_code == 200
        assert [model["name"] for model in client.get("/v1/models").json()["models"]] == ["small"]
        assert client.get("/v1/models/small").json()["versions"] == ["1", "2"]
        found = samples(client)
        assert value(found, "shapespace_bundles_refused") == 5
        for result, count in (("refused", 5), ("loaded", 1)):
            counted = (value(each, "shapespace_reloaded_bundles_total", result=result) for each in (before, found))
            assert next(counted) + count == next(counted)
        # The next reload works too.
        shutil.rmtree(folder / "loops")
        write_bundle(folder, "small", "3")
        reload(server)
        assert client.get("/v1/models/small").json()["versions"] == ["1", "2", "3"]
        assert value(samples(client), "shapespace_bundles_refused") == 4
    assert peak_memory(server) < 300 * 2**20
    assert len(children(server)) <= 1, "only the process that waits for uploads"
    assert "Traceback" not in server.log


def test_a_reload_that_fails_whole_is_counted(tmp_path: Path) -> None:
    # No request or bundle is known to cause this.
    repository = ModelRepository(tmp_path)  # of no bundles
    registry = CollectorRegistry()
    metrics = Metrics(registry, repository, Workers(1, 0, 1), Quota(10, "full"))

    def broken() -> Changes:
        raise RuntimeError

    repository.reload = broken  # type: ignore[method-assign]
    asyncio.run(Reloader(repository, metrics).reload())
    assert registry.get_sample_value("shapespace_reloaded_bundles_total", {"result": "failed"}) == 1


def test_requests_for_a_reload_before_it_begins_are_one(tmp_path: Path) -> None:
    repository, reloads = ModelRepository(tmp_path), 0

    def count() -> Changes:
        nonlocal reloads
        reloads += 1
        return Changes()

    repository.reload = count  # type: ignore[method-assign]
    reloader = Reloader(repository, Metrics(CollectorRegistry(), repository, Workers(1, 0, 1), Quota(10, "full")))

    async def ask(times: int) -> None:
        await asyncio.gather(*(reloader.reload() for _ in range(times)))

    asyncio.run(ask(20))
    assert reloads == 1
    asyncio.run(ask(1))
    assert reloads == 2


#: What ends the children of a killed server is tested in test_sandbox.py too.
ENDS = [signal.SIGTERM, pytest.param(signal.SIGKILL, marks=pytest.mark.long)]


@pytest.mark.parametrize("number", ENDS)
def test_the_end_of_a_server_ends_the_trial_of_a_bundle(folder: Path, start: Start, number: signal.Signals) -> None:
    server = start(folder)
    hostile.hostile(folder, "endless", hostile.doubles)
    server.process.send_signal(signal.SIGHUP)
    eventually(lambda: len(children(server)) == 2)  # one of them waits for uploads
    pids = children(server)
    server.process.send_signal(number)
    assert server.process.wait(60) == (0 if number == signal.SIGTERM else -number)
    eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))
    assert "is not served" not in server.log
    assert "Traceback" not in server.log


@pytest.mark.parametrize("number", ENDS)
def test_a_server_can_be_ended_before_it_has_started(folder: Path, number: signal.Signals) -> None:
    hostile.hostile(folder, "endless", hostile.doubles)
    environment = os.environ | {"SHAPESPACE_MODELS_DIR": str(folder), "SHAPESPACE_PORT": "0", "SHAPESPACE_DRAIN": "0"}
    with subprocess.Popen(
        [sys.executable, "-m", "shapespace.service"], cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr
        while "Waiting for application startup" not in process.stderr.readline():
            pass
        pids = children_of(process.pid)
        assert len(pids) == 1
        process.send_signal(number)
        assert process.wait(60) == (0 if number == signal.SIGTERM else -number)
    eventually(lambda: not any(Path(f"/proc/{pid}").exists() for pid in pids))


def children(server: Server) -> list[int]:
    return children_of(server.process.pid)


def children_of(pid: int) -> list[int]:
    """Ids of a process's children, zombies included."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return [int(child) for task in tasks for child in (task / "children").read_text().split()]


def test_watching_takes_up_a_bundle_once_it_is_whole(folder: Path, start: Start, tmp_path: Path) -> None:
    server = start(folder, watch=1)
    source = write_bundle(tmp_path / "source", "small", "2")
    target = folder / "small" / "2"
    target.mkdir()
    with connected(server) as client:
        for k in range(40):  # a slow copy, during several checks
            (target / "geometry.npz").write_bytes(bytes(k))
            time.sleep(0.05)
        for file in source.iterdir():
            shutil.copy(file, target / file.name)
        eventually(lambda: client.get("/v1/models/small").json()["versions"] == ["1", "2"])
        shutil.rmtree(target)
        eventually(lambda: client.get("/v1/models/small").json()["versions"] == ["1"])
    assert "is not served" not in server.log, "an incomplete bundle must not be loaded"


def test_a_reload_under_load_mixes_no_versions(shared: tuple[Path, Server]) -> None:
    folder, server = shared
    answers: dict[str, set[str]] = {}
    statuses: set[int] = set()
    stop = threading.Event()

    def ask() -> None:
        with connected(server) as client:
            while not stop.is_set():
                answer = client.post("/v1/models/small/vertices", json={"latents": CODES})
                statuses.add(answer.status_code)
                models = {diagnostics["model"] for diagnostics in answer.json()["diagnostics"]}
                assert len(models) == 1
                # To check that each digest has one answer, and each answer one digest.
                answers.setdefault(models.pop(), set()).add(json.dumps(answer.json()["vertices"]))

    threads = [threading.Thread(target=ask) for _ in range(4)]
    for thread in threads:
        thread.start()
    scales = [SCALE * (1 + k) for k in range(1, 3)]
    try:
        for k, scale in enumerate(scales):
            eventually(lambda k=k: len(answers) > k)
            rescale(folder / "small" / "1", scale)
            reload(server)
        eventually(lambda: len(answers) > len(scales))
    finally:
        stop.set()
    for thread in threads:
        thread.join(timeout=60)
    assert statuses == {200}, "no request may fail because of a reload"
    assert len(answers) == 3, "requests must have reached all three bundles"
    assert all(len(found) == 1 for found in answers.values())
    sizes = sorted(np.ptp(np.array(json.loads(next(iter(found))))[1]) for found in answers.values())
    expected = np.ptp(reference().vertices) * np.array([SCALE, *scales])
    np.testing.assert_allclose(sizes, expected, rtol=1e-5)


def test_a_running_stream_keeps_the_model_it_began_with(shared: tuple[Path, Server]) -> None:
    folder, server = shared
    with connected(server) as client:
        path = {"keyframes": CODES, "frames": 60}
        links = client.post("/v1/models/small/interpolations", json=path).json()["links"]
        digest = client.get("/v1/models/small").json()["digest"]
        with client.stream("GET", links["jsonl"]) as stream:
            lines = stream.iter_lines()
            first = json.loads(next(lines))
            shutil.rmtree(folder / "small")
            reload(server)
            rest = [json.loads(line) for line in lines]
        assert {frame["diagnostics"]["model"] for frame in [first, *rest]} == {digest}
        assert len(rest) == 59
        gone = client.get(links["jsonl"])
        assert gone.status_code == 404
        assert "not served here any more" in gone.json()["detail"]


def resident(server: Server) -> float:
    """Bytes of memory in use by a server."""
    with connected(server) as client:
        return samples(client)["process_resident_memory_bytes", frozenset()]


@pytest.mark.long
def test_reloads_leave_no_memory_behind(folder: Path, start: Start) -> None:
    server = start(folder, workers=2)
    sizes = []
    with connected(server) as client:
        for k in range(24):
            rescale(folder / "small" / "1", SCALE + k)
            reload(server)
            client.post("/v1/models/small/vertices", json={"latents": CODES}).raise_for_status()
            sizes.append(resident(server))
    # The first reloads fill caches and the allocator's pools.
    growth = (np.mean(sizes[-4:]) - np.mean(sizes[8:12])) / 14
    assert growth < 100_000, f"{growth:.0f} bytes a reload"
