"""The server under load, at its limits, and at shutdown."""

import signal
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

import shapespace
from shapespace.service.settings import cpu_quota
from tests.service.conftest import ROOT, Start

CODE = {"latent": [0.1, 0.7, 0.4]}
MANY = {"latents": [[0.2, k / 100, 1.0] for k in range(200)]}


def test_health_answers_while_every_worker_is_busy(small_models: Path, start: Start) -> None:
    with (
        httpx.Client(base_url=start(small_models, workers=1).url, timeout=120) as client,
        ThreadPoolExecutor(1) as pool,
    ):
        solving = pool.submit(client.post, "/v1/models/small/vertices", json=MANY)
        while_solving = 0
        while not solving.done():
            assert client.get("/v2/health/live").status_code == 200
            while_solving += not solving.done()
        assert solving.result().status_code == 200
    assert while_solving >= 3


def test_a_long_request_lets_a_short_one_pass(small_models: Path, start: Start) -> None:
    with (
        httpx.Client(base_url=start(small_models, workers=1).url, timeout=120) as client,
        ThreadPoolExecutor(1) as pool,
    ):
        solving = pool.submit(client.post, "/v1/models/small/vertices", json=MANY)
        finished_before = 0
        while not solving.done():
            assert client.post("/v1/models/small/mesh", json=CODE).status_code == 200
            finished_before += not solving.done()
    assert finished_before >= 3


def test_a_full_queue_is_busy_and_says_when_to_come_back(small_models: Path, start: Start) -> None:
    with (
        httpx.Client(base_url=start(small_models, workers=1, queue=1).url, timeout=120) as client,
        ThreadPoolExecutor(8) as pool,
    ):
        answers = list(pool.map(lambda _: client.post("/v1/models/small/vertices", json=MANY), range(8)))
        after = client.post("/v1/models/small/mesh", json=CODE)
    refused = [answer for answer in answers if answer.status_code == 503]
    assert refused, "eight long requests at once must be too many for one worker and one in the queue"
    assert len(refused) < 8
    for answer in refused:
        assert answer.json()["type"] == "urn:shapespace:problem:busy"
        assert "Try again" in answer.json()["detail"]
        assert int(answer.headers["Retry-After"]) >= 1
    assert after.status_code == 200, "places in the queue are free again"


def test_a_mesh_file_has_a_limit_of_its_own(small_models: Path, start: Start) -> None:
    with httpx.Client(base_url=start(small_models, max_body=1000, max_upload=2000).url) as client:
        for path, most in (("mesh", 1000), ("encode?format=obj", 2000)):
            for size in (most, most + 1):
                answer = client.post(
                    f"/v1/models/small/{path}", content=b" " * size, headers={"Content-Type": "application/json"}
                )
                assert (answer.status_code == 413) is (size > most), answer.text
        assert f"limit of {most} bytes" in answer.json()["detail"]


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


def test_a_deadline_holds_between_codes_before_any_reconstruction_too(small_models: Path, start: Start) -> None:
    many = [CODE["latent"]] * 5000
    with httpx.Client(base_url=start(small_models, deadline=0.1, max_codes=len(many)).url, timeout=120) as client:
        tensor = {"name": "latent", "shape": [len(many), 3], "datatype": "FP32", "data": many}
        for path, body in (
            ("/v1/models/small/nric", {"latents": many}),
            ("/v2/models/small/infer", {"inputs": [tensor], "outputs": [{"name": "nric"}]}),
        ):
            assert client.post(path, json=body).status_code == 504


def test_sigterm_ends_it_cleanly_after_the_running_request(small_models: Path, start: Start) -> None:
    server = start(small_models, workers=1)
    with httpx.Client(base_url=server.url, timeout=120) as client:
        path = {"keyframes": [[0, 0, 0], [0.2, 3.0, 1.0]], "frames": 40}
        links = client.post("/v1/models/small/interpolations", json=path).json()["links"]
        with client.stream("GET", links["jsonl"]) as stream:
            lines = stream.iter_lines()
            next(lines)
            server.process.send_signal(signal.SIGTERM)
            assert sum(1 for _ in lines) == 39
    server.process.communicate(timeout=60)
    assert server.process.returncode == 0
    assert "Traceback" not in server.log


def test_a_mistake_of_the_server_shows_no_traceback(small_models: Path, tmp_path: Path) -> None:
    # No request is known to cause an internal error, so a route that does is added to the real application.
    program = """
import sys, httpx, asyncio
from shapespace.service.http.app import create_app
from shapespace.service.settings import Settings
app = create_app(Settings())
@app.get("/broken")
def broken(): raise RuntimeError("a secret path")
async def main():
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    client = httpx.AsyncClient(transport=transport, base_url="http://localhost")
    async with app.router.lifespan_context(app), client:
        answer = await client.get("/broken")
        print(answer.status_code, answer.headers["content-type"], answer.text)
asyncio.run(main())
"""
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.startswith("500 application/problem+json")
    assert "internal-error" in found.stdout
    assert "secret" not in found.stdout
    assert "Traceback" not in found.stdout


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("PORT", "http"),
        ("CORS_ORIGINS", "a.example"),
        ("CORS_ORIGINS", "https://a.example/page"),
        ("EMBED_ORIGINS", "a.example; x"),
        ("DEADLINE", "inf"),
    ],
)
def test_settings_that_make_no_sense_are_named(small_models: Path, name: str, value: str) -> None:
    found = subprocess.run(
        [sys.executable, "-m", "shapespace.service"],
        cwd=ROOT,
        env={f"SHAPESPACE_{name}": value, "SHAPESPACE_MODELS_DIR": str(small_models)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 2
    assert found.stderr.startswith(f"SHAPESPACE_{name}: ")
    assert "Traceback" not in found.stderr


def test_serving_needs_no_torch_and_no_training() -> None:
    modules = "shapespace.service.http.app, shapespace.service.http.server"
    program = f"import sys, {modules}; print([m for m in ('torch', 'shapespace.training') if m in sys.modules])"
    found = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "[]"


def test_the_version_is_that_of_the_distribution() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert shapespace.__version__ == project["version"]


def test_the_processors_of_a_container_are_those_of_its_quota(tmp_path: Path) -> None:
    everything = cpu_quota(tmp_path)
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert cpu_quota(tmp_path) == everything
    (tmp_path / "cpu.max").write_text("100000 100000\n")
    assert cpu_quota(tmp_path) == 1
    (tmp_path / "cpu.max").write_text("20000 100000\n")
    assert cpu_quota(tmp_path) == 1
    (tmp_path / "cpu.max").write_text("99900000 100000\n")
    assert cpu_quota(tmp_path) == everything
    old = tmp_path / "old" / "cpu"
    old.mkdir(parents=True)
    (old / "cpu.cfs_quota_us").write_text("100000\n")
    (old / "cpu.cfs_period_us").write_text("100000\n")
    assert cpu_quota(tmp_path / "old") == 1
