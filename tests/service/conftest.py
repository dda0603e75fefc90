"""A real server process for the tests: uvicorn on a free port, real bundles, real ONNX files."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

import httpx
import pytest

from tests.service.bundles import write_bundle

ROOT = Path(__file__).parents[2]


class Server:
    """A running ``python -m shapespace.service``."""

    #: Arguments of Python.
    program: tuple[str, ...] = ("-m", "shapespace.service")

    def __init__(self, models: Path, **settings: object) -> None:
        self._log = Path(tempfile.gettempdir(), f"shapespace-{uuid4().hex}.log")  # a pipe would fill up
        weakref.finalize(self, self._log.unlink, missing_ok=True)
        environment = {key: value for key, value in os.environ.items() if not key.startswith("SHAPESPACE_")}
        settings = {"drain": 0, "watch": 0} | settings  # no wait at the end, and no reload without SIGHUP
        environment |= {"SHAPESPACE_MODELS_DIR": str(models), "SHAPESPACE_PORT": "0"}
        environment |= {f"SHAPESPACE_{key.upper()}": str(value) for key, value in settings.items()}
        with self._log.open("w") as log:
            self.process = subprocess.Popen(
                [sys.executable, *self.program],
                cwd=ROOT,
                env=environment,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        assert self.process.stdout
        announced = re.search(r"http://\S+", self.process.stdout.readline())
        assert announced, self.stop()
        self.url = announced.group().rstrip("/")

    def stop(self) -> str:
        """End it by SIGTERM, as an orchestrator does, and return its log."""
        self.process.send_signal(signal.SIGTERM)
        self.process.communicate(timeout=60)
        return self.log

    @property
    def log(self) -> str:
        """What it has logged so far."""
        return self._log.read_text()


Start = Callable[..., Server]


@contextmanager
def starting(kind: type[Server] = Server) -> Iterator[Start]:
    servers: list[Server] = []

    def start(models: Path, **settings: object) -> Server:
        servers.append(kind(models, **settings))
        return servers[-1]

    try:
        yield start
    finally:
        for server in servers:
            if server.process.poll() is None:
                server.stop()
            assert server.process.stdout
            server.process.stdout.close()


@pytest.fixture
def start() -> Iterator[Start]:
    """Start servers that end with the test."""
    with starting() as start:
        yield start


@pytest.fixture(scope="session")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled models, a small one in versions 1, 2 and 10, and one with a fine mesh."""
    folder = tmp_path_factory.mktemp("served") / "models"
    shutil.copytree(ROOT / "models", folder)
    write_bundle(folder, "small", "1")
    write_bundle(folder, "small", "2", start=True)
    write_bundle(folder, "small", "10")
    write_bundle(folder, "with-fine", fine=True)
    return folder


@pytest.fixture(scope="session")
def small_models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small model alone, with which a server starts seconds faster."""
    folder = tmp_path_factory.mktemp("small") / "models"
    write_bundle(folder, "small", "10")
    return folder


@pytest.fixture(scope="session")
def server(models: Path) -> Iterator[Server]:
    """A server shared by all tests that don't change its state."""
    with starting() as start:
        yield start(models, workers=2, max_codes=20, max_frames=200, max_body=100_000, deadline=300)


@pytest.fixture(scope="session")
def client(server: Server) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=server.url, timeout=120) as client:
        yield client
