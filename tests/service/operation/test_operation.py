"""The server under load, at its limits, and with settings that make no sense."""

import asyncio
import socket
import time
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np
import pytest

import shapespace
from shapespace.bundle.reader import read_bundle
from shapespace.model.latent_space import Bounds
from shapespace.model.shape_model import ShapeModel
from shapespace.service.__main__ import _serve
from shapespace.service.http.app import create_app
from shapespace.service.http.connections import IDLE_SECONDS
from shapespace.service.limits.workers import Caller, Workers
from shapespace.service.refusals import RefusedError
from shapespace.service.repository.validation import BundleValidator
from shapespace.service.settings import Settings, cpu_quota
from shapespace.service.use_cases.many_shapes import nric_file
from tests.service.conftest import ROOT, Start, starting

CODE = {"latent": [0.1, 0.7, 0.4]}
MANY = {"latents": [[0.2, k / 100, 1.0] for k in range(200)]}


@pytest.fixture(scope="module")
def narrow(small_models: Path) -> Iterator[httpx.Client]:
    """A server with one worker and one place in the queue."""
    with starting() as start, httpx.Client(base_url=start(small_models, workers=1, queue=1).url, timeout=120) as client:
        yield client


def test_a_long_request_lets_health_and_a_short_one_pass(narrow: httpx.Client) -> None:
    with ThreadPoolExecutor(1) as pool:
        solving = pool.submit(narrow.post, "/v1/models/small/vertices", json=MANY)
        finished_before = 0
        while not solving.done():
            assert narrow.get("/v2/health/live").status_code == 200
            assert narrow.post("/v1/models/small/mesh", json=CODE).status_code == 200
            finished_before += not solving.done()
        assert solving.result().status_code == 200
    assert finished_before >= 1


def test_a_full_queue_is_busy_and_says_when_to_come_back(narrow: httpx.Client) -> None:
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: narrow.post("/v1/models/small/vertices", json=MANY), range(8)))
    refused = [answer for answer in answers if answer.status_code == 503]
    assert refused, "eight long requests at once must be too many for one worker and one in the queue"
    assert len(refused) < 8
    for answer in refused:
        assert answer.json()["type"] == "urn:shapespace:problem:busy"
        assert "Try again" in answer.json()["detail"]
        assert int(answer.headers["Retry-After"]) >= 1
    after = narrow.post("/v1/models/small/mesh", json=CODE)
    assert after.status_code == 200, "places in the queue are free again"


def test_a_passed_deadline_ends_the_work(small_models: Path, start: Start) -> None:
    with httpx.Client(base_url=start(small_models, deadline=1e-6).url, timeout=120) as client:
        for path, body in (("mesh", CODE), ("vertices", MANY), ("nric", {"latents": [CODE["latent"]]})):
            answer = client.post(f"/v1/models/small/{path}", json=body)
            assert answer.status_code == 504
            assert answer.json()["type"] == "urn:shapespace:problem:deadline-passed"
            assert "try again" in answer.json()["detail"]
        id = client.post("/v1/models/small/interpolations", json={"keyframes": [[0, 0, 0], CODE["latent"]]}).json()
        for name in ("glb", "jsonl"):
            assert client.get(id["links"][name]).status_code == 504, name
        # A search without a result, with advice for searches.
        mesh = {"vertices": np.random.default_rng(0).normal(size=(20, 3)).tolist()}
        for call, advice in (("fit", "coarser scan"), ("encode", "Try again")):
            answer = client.post(f"/v1/models/small/{call}", json=mesh, params={"format": "json"})
            assert (answer.status_code, answer.json()["type"]) == (504, "urn:shapespace:problem:deadline-passed")
            assert advice in answer.json()["detail"]
            assert "fewer shapes" not in answer.json()["detail"]
        assert client.get("/v2/health/ready").json() == {"ready": True}


def test_a_deadline_holds_between_codes_before_any_reconstruction_too(small_models: Path) -> None:
    model = ShapeModel(read_bundle(small_models / "small" / "10"), 1)

    async def ask() -> None:
        workers = Workers(1, 0, deadline=0.1)
        caller = Caller(workers, "", asyncio.Event().wait)
        try:
            await nric_file(caller, model, [CODE["latent"]] * 5000, Bounds.ALLOW, factors=False)
        finally:
            workers.close()

    with pytest.raises(RefusedError):
        asyncio.run(ask())


def test_a_mistake_of_the_server_shows_no_traceback(small_models: Path) -> None:
    # No request is known to cause an internal error, so a route that does is added to the real application.
    app = create_app(Settings(models_dir=small_models))

    @app.get("/broken")
    def broken() -> None:
        raise RuntimeError("a secret path")

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
        ):
            return await client.get("/broken")

    answer = asyncio.run(ask())
    assert answer.status_code == 500
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert "internal-error" in answer.text
    assert "secret" not in answer.text
    assert "Traceback" not in answer.text


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PORT", "http"),
        ("CORS_ORIGINS", "a.example"),
        ("CORS_ORIGINS", "https://a.example/page"),
        ("EMBED_ORIGINS", "a.example; x"),
        ("DEADLINE", "inf"),
        ("DEFAULT_VERSIONS", "figure=3:95,4:6"),
        ("DEFAULT_VERSIONS_FILE", "no such file"),
        ("DEFAULT_VERSIONS_FILE", "pyproject.toml"),
        # Keys that no header can carry.
        ("API_KEY", "line\nbreak"),
        ("API_KEY", "schlüssel"),
        ("API_KEY", " padded"),
    ],
)
def test_settings_that_make_no_sense_are_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str, value: str
) -> None:
    monkeypatch.setenv(f"SHAPESPACE_{name}", value)
    with pytest.raises(SystemExit) as end:
        _serve(BundleValidator())
    assert end.value.code == 2
    told = capsys.readouterr().err
    assert told.startswith(f"SHAPESPACE_{name}: ")
    assert name != "API_KEY" or value not in told


def test_the_version_is_that_of_the_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert shapespace.__version__ == project["version"]


def test_the_processors_of_a_container_are_those_of_its_quota(tmp_path: Path) -> None:
    everything = cpu_quota(tmp_path)
    for quota, expected in (("max", everything), ("100000", 1), ("20000", 1), ("99900000", everything)):
        (tmp_path / "cpu.max").write_text(f"{quota} 100000\n")
        assert cpu_quota(tmp_path) == expected


@pytest.mark.long
def test_an_answered_connection_is_kept_longer_than_clients_keep_it(narrow: httpx.Client) -> None:
    place = narrow.base_url
    with socket.create_connection((place.host, place.port or 80), timeout=120) as idle:
        idle.sendall(b"GET /v2/health/live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert idle.recv(12) == b"HTTP/1.1 200"
        answered = time.monotonic()
        while idle.recv(2**16):
            pass
    assert time.monotonic() - answered > IDLE_SECONDS - 1
