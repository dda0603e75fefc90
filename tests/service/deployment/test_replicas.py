"""Two servers behind a round-robin proxy: answers don't depend on which one is asked."""

import itertools
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest

from shapespace.client import Client
from tests.service.conftest import Server, Start, starting

HOP = {"connection", "transfer-encoding", "keep-alive", "host", "content-length"}


@contextmanager
def round_robin(servers: list[Server]) -> Iterator[str]:
    """A proxy that sends each request to the next server, and names that server in a header."""
    turns = itertools.cycle(range(len(servers)))
    lock = threading.Lock()

    class Proxy(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            with lock:
                turn = next(turns)
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            headers = {name: text for name, text in self.headers.items() if name.lower() not in HOP}
            answer = httpx.request(
                self.command, servers[turn].url + self.path, headers=headers, content=body, timeout=60
            )
            self.send_response(answer.status_code)
            for name, text in answer.headers.items():
                if name.lower() not in HOP:
                    self.send_header(name, text)
            self.send_header("Content-Length", str(len(answer.content)))
            self.send_header("Replica", str(turn))
            self.end_headers()
            self.wfile.write(answer.content)

        do_POST = do_GET  # noqa: N815 - the library's names

        def log_message(self, format: str, *args: object) -> None:
            pass

    proxy = ThreadingHTTPServer(("127.0.0.1", 0), Proxy)
    thread = threading.Thread(target=proxy.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{proxy.server_address[1]}"
    finally:
        proxy.shutdown()
        thread.join()
        proxy.server_close()


@pytest.fixture(scope="module")
def address(models: Path) -> Iterator[str]:
    with starting() as start, round_robin([start(models, workers=1), start(models, workers=2)]) as address:
        yield address


def test_replicas_agree_on_ids_tags_and_bytes(address: str) -> None:
    with httpx.Client(base_url=address, timeout=60) as client:
        requests: list[tuple[str, str, dict[str, object] | None]] = [
            ("GET", "/v1/models", None),
            ("GET", "/v1/models/figure", None),
            ("GET", "/v1/models/freaky-torus/mesh?latent=1,2,3,4", None),
            ("POST", "/v1/models/figure/mesh", {"latent": [0.1] * 20}),
            ("POST", "/v1/models/small/vertices?format=npz", {"latents": [[0.1, 0.7, 0.4], [0, 0, 0]]}),
            ("POST", "/v1/models/small/nric", {"latents": [[0.1, 0.7, 0.4]]}),
            ("POST", "/v1/models/small/interpolations", {"keyframes": [[0, 0, 0], [0.1, 0.7, 0.4]]}),
            ("POST", "/v2/models/small/infer", {"inputs": [
                {"name": "latent", "shape": [1, 3], "datatype": "FP32", "data": [0.1, 0.7, 0.4]}
            ]}),
        ]  # fmt: skip
        for method, path, body in requests:
            one, other = (client.request(method, path, json=body) for _ in range(2))
            assert {one.headers["Replica"], other.headers["Replica"]} == {"0", "1"}
            assert one.is_success
            assert one.content == other.content, path
            assert one.headers.get("ETag") == other.headers.get("ETag")
            if tag := one.headers.get("ETag"):
                again = [client.request(method, path, json=body, headers={"If-None-Match": tag}) for _ in range(2)]
                assert [answer.status_code for answer in again] == [304, 304]


def test_an_animation_made_by_one_is_played_by_all(address: str) -> None:
    with Client(address) as client:
        path = client.interpolate("small", [[0, 0, 0], [0.1, 0.7, 0.4]], frames=5)
        frames = [path.frame(k) for k in range(5)]
        assert frames == [path.frame(k) for k in (*range(1, 5), 0)][-1:] + frames[1:]
        wholes = [path.file() for _ in range(4)]
        assert len(set(wholes)) == 1


def test_an_animation_outlives_the_server_that_made_it(models: Path, start: Start) -> None:
    first = start(models)
    with Client(first.url) as client:
        path = client.interpolate("small", [[0, 0, 0], [0.1, 0.7, 0.4]], frames=3)
        expected = path.file()
    first.stop()
    with httpx.Client(base_url=start(models).url, timeout=60) as client:
        assert client.get(f"/v1/interpolations/{path.id}").content == expected
