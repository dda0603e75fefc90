"""The committed nginx configuration in a real nginx, in front of real replicas."""

import http.client
import http.server
import itertools
import json
import os
import re
import select
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import numpy as np
import pytest

from shapespace.service.http.connections import IDLE_SECONDS
from shapespace.service.http.problems import TYPE_PREFIX
from shapespace.service.use_cases.animation import ID_LENGTH
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, starting
from tests.service.watching import admitted, eventually, free_port, samples, value

NGINX = shutil.which("nginx", path=os.environ.get("PATH", "") + ":/usr/sbin:/usr/local/sbin")
# Continuous integration installs nginx. Linux, as the tests need several addresses on loopback.
pytestmark = pytest.mark.skipif(not NGINX or sys.platform != "linux", reason="needs Linux and nginx (nginx-light)")

CONFIGURATION = ROOT / "deploy" / "nginx.conf"
MESH, VERTICES = "/v1/models/small/mesh", "/v1/models/small/vertices"
CODE = [0.1, 0.7, 0.4]
MAIN = """
daemon off; pid nginx.pid; error_log error.log; worker_processes 2; {user}
events {{ worker_connections 1024; }}
http {{
    access_log off; client_body_temp_path body; proxy_temp_path proxy;
    fastcgi_temp_path fastcgi; uwsgi_temp_path uwsgi; scgi_temp_path scgi;
    include server.conf;
}}
"""


def rendered(replicas: list[str], port: int) -> str:
    """The committed file with this test's addresses instead of Docker's, otherwise unchanged."""
    text = CONFIGURATION.read_text()
    servers = "".join(rf"server {httpx.URL(url).netloc.decode()}\1; " for url in replicas)
    for pattern, place in (
        (r"\n *resolver [^;]+;", ""),
        (r"server shapespace:8000 resolve([^;]*);", servers),
        (r"listen 8000;", f"listen 127.0.0.1:{port};"),
    ):
        text, count = re.subn(pattern, place, text)
        assert count == 1, pattern
    return text


@contextmanager
def proxying(folder: Path, *replicas: str) -> Iterator[str]:
    """An nginx in front of some replicas; yields its address."""
    port = free_port()
    folder.mkdir()
    (folder / "server.conf").write_text(rendered(list(replicas), port))
    (folder / "nginx.conf").write_text(MAIN.format(user="user root;" if os.geteuid() == 0 else ""))
    assert NGINX
    nginx = subprocess.Popen([NGINX, "-p", folder, "-c", "nginx.conf"], stderr=subprocess.PIPE, text=True)
    try:
        eventually(lambda: nginx.poll() is not None or answers(port))
        assert nginx.poll() is None, nginx.communicate()[1]
        yield f"http://127.0.0.1:{port}"
    finally:
        nginx.terminate()
        nginx.communicate(timeout=90)


def answers(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    models = tmp_path_factory.mktemp("proxied") / "models"
    write_bundle(models, "small")
    write_bundle(models, "larger", fine=True)
    return models


@pytest.fixture(scope="module")
def pair(small: Path) -> Iterator[list[Server]]:
    """Two replicas with one worker and no queue, for tests that don't change their state."""
    with starting() as start:
        yield [start(small, workers=1, queue=0, cache=0, max_frames=50_000) for _ in range(2)]


@pytest.fixture(scope="module")
def proxy(pair: list[Server], tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with proxying(tmp_path_factory.mktemp("nginx") / "it", *(server.url for server in pair)) as address:
        yield address


def client(address: str, source: str = "127.0.0.1") -> httpx.Client:
    transport = httpx.HTTPTransport(local_address=source)
    return httpx.Client(base_url=address, transport=transport, timeout=90, trust_env=False)


def connect(address: str, source: str = "127.0.0.1", receive: int | None = None) -> socket.socket:
    url, connection = httpx.URL(address), socket.socket()
    if receive:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive)
    connection.settimeout(90)
    connection.bind((source, 0))
    connection.connect((url.host, url.port))
    return connection


def codes(count: int, first: int = 0) -> dict[str, list[list[float]]]:
    """A body for VERTICES, different for every ``first``."""
    return {"latents": [[0.1, 0.7, 0.4 + 1e-6 * (first + k)] for k in range(count)]}


def posts(server: Server) -> float:
    """Calls of VERTICES that a replica has answered."""
    with client(server.url) as asking:
        found = samples(asking)
    labels = {"route": "/v1/models/{name}/vertices", "method": "POST"}
    return sum(value(found, "shapespace_requests_total", status=status, **labels) for status in ("200", "499", "503"))


def test_a_burst_is_told_to_come_back_and_makes_nothing_unreachable(proxy: str) -> None:
    seen: Counter[int] = Counter()

    def burst(k: int) -> httpx.Response:
        # Ten addresses, as one may not have this many requests at once.
        with client(proxy, f"127.0.0.{10 + k % 10}") as own:
            return own.post(VERTICES, json=codes(20, 100 * k))

    with ThreadPoolExecutor(100) as pool, client(proxy) as other:
        sent = [pool.submit(burst, k) for k in range(100)]
        while not all(answer.done() for answer in sent):
            seen[other.get("/v1/models").status_code] += 1
        found = [answer.result() for answer in sent]
        for _ in range(20):
            seen[other.get("/v1/models").status_code] += 1
    statuses = Counter(answer.status_code for answer in found)
    assert statuses.keys() == {200, 503}
    assert statuses[503] > 10, "the burst must be too much for the replicas"
    assert all(answer.headers["Retry-After"] for answer in found if answer.status_code == 503)
    assert seen.keys() == {200}


def test_a_post_that_broke_a_replica_is_not_sent_to_the_next(small: Path, tmp_path: Path) -> None:
    with starting() as start, ThreadPoolExecutor(1) as pool, ExitStack() as stack:
        replicas = [start(small, workers=1, max_codes=100_000) for _ in range(2)]
        proxy = stack.enter_context(proxying(tmp_path / "nginx", *(replica.url for replica in replicas)))
        asking = [stack.enter_context(client(replica.url)) for replica in replicas]
        answer = pool.submit(lambda: httpx.post(proxy + VERTICES, json=codes(50_000), timeout=90))
        eventually(lambda: sum(map(admitted, asking)) == 1)
        broken = [admitted(replica) for replica in asking].index(1)
        replicas[broken].process.kill()
        assert answer.result().status_code == 502
        assert answer.result().headers["Content-Type"] == "application/problem+json"
        assert admitted(asking[1 - broken]) == posts(replicas[1 - broken]) == 0
        # If the replica can't be reached nothing was sent, so the next one is tried, whatever the method.
        for k in range(6):
            assert httpx.post(proxy + VERTICES, json=codes(1, k)).status_code == 200
            assert httpx.get(proxy + MESH).status_code == 200
        assert posts(replicas[1 - broken]) == 6


@pytest.mark.parametrize("ending", ["terminate", pytest.param("kill", marks=pytest.mark.long)])
def test_the_end_of_a_replica_under_load_loses_nothing(small: Path, tmp_path: Path, ending: str) -> None:
    with starting() as start, ExitStack() as stack:
        replicas = [start(small, workers=2, queue=100, drain=2) for _ in range(2)]
        proxy = stack.enter_context(proxying(tmp_path / "nginx", *(replica.url for replica in replicas)))
        outcomes: dict[str, Counter[str]] = {"GET": Counter(), "POST": Counter()}
        late: dict[str, Counter[str]] = {"GET": Counter(), "POST": Counter()}
        gone, over = threading.Event(), threading.Event()

        def load(method: str, first: int) -> None:
            with client(proxy, f"127.0.0.{first}") as own:
                for k in itertools.count():
                    if over.is_set():
                        break
                    code = [0.1, 0.7, 0.3 + 1e-6 * (1000 * first + k)]
                    counts = (late if gone.is_set() else outcomes)[method]
                    try:
                        if method == "GET":
                            answer = own.get(MESH, params={"latent": ",".join(map(str, code))})
                        else:
                            answer = own.post(MESH, json={"latent": code})
                        counts[str(answer.status_code)] += 1
                    except httpx.HTTPError as error:
                        counts["broken off" if "complete message body" in str(error) else repr(error)] += 1

        clients = [threading.Thread(target=load, args=(method, 20 + k)) for k, method in enumerate(["GET", "POST"] * 4)]
        for one in clients:
            one.start()
        eventually(lambda: all(counts["200"] > 20 for counts in outcomes.values()))
        getattr(replicas[0].process, ending)()
        replicas[0].process.wait(60)
        gone.set()
        eventually(lambda: all(counts["200"] > 20 for counts in late.values()))
        over.set()
        for one in clients:
            one.join()
    assert late["GET"].keys() == late["POST"].keys() == {"200"}
    # An answer that a killed replica had begun can't be given by another. POSTs that it was working on, or that the
    # kernel had accepted for it, are lost: nobody can know whether they were carried out.
    broken = {"broken off"} if ending == "kill" else set()
    assert outcomes["GET"].keys() <= {"200"} | broken
    assert outcomes["POST"].keys() <= ({"200"} if ending == "terminate" else {"200", "502"}) | broken
    assert sum(counts["broken off"] for counts in outcomes.values()) <= len(clients), "each client once at most"


def test_clients_and_the_proxy_end_idle_connections_before_the_server_does() -> None:
    seconds = re.search(r"upstream shapespace {[^}]*keepalive_timeout (\d+)s;", CONFIGURATION.read_text())
    assert seconds
    assert max(int(seconds[1]), httpx.Limits().keepalive_expiry or 0) < IDLE_SECONDS


def test_a_client_has_so_many_requests_at_once_and_others_go_on(pair: list[Server], tmp_path: Path) -> None:
    half = f"POST {MESH} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 100\r\n\r\n{{"
    with ExitStack() as stack:
        # A new proxy, whose counters are zero.
        proxy = stack.enter_context(proxying(tmp_path / "it", *(server.url for server in pair)))
        same, other = (stack.enter_context(client(proxy, f"127.0.0.{k}")) for k in (3, 4))
        holding: list[socket.socket] = []
        while (refused := same.get("/v1/models")).status_code != 503:
            assert len(holding) < 30
            holding.append(stack.enter_context(connect(proxy, "127.0.0.3")))
            holding[-1].sendall(half.encode())
        assert len(holding) >= 16
        assert refused.headers["Retry-After"]
        assert refused.headers["Content-Type"] == "application/problem+json"
        assert refused.json()["type"] == TYPE_PREFIX + "busy"
        assert other.get("/v1/models").status_code == 200
        for connection in holding:
            connection.close()
        eventually(lambda: same.get("/v1/models").status_code == 200)


@pytest.mark.long
def test_a_client_that_never_stops_asking_is_slowed_down_alone(proxy: str) -> None:
    requests = 100 * b"GET /v2/health/live HTTP/1.1\r\nHost: x\r\n\r\n"
    slowed, over = threading.Event(), threading.Event()

    def flood() -> Counter[int]:
        found: Counter[int] = Counter()
        while not over.is_set():
            # All are sent at once: an HTTP client that waits for each answer is too slow on some machines.
            with connect(proxy, "127.0.0.5") as connection, connection.makefile("rb") as answers:
                connection.sendall(requests)
                for _ in range(100):
                    found[int(answers.readline().split()[1])] += 1
                    answers.read(int(http.client.parse_headers(answers)["Content-Length"]))
            if found[503]:
                slowed.set()
        return found

    with ThreadPoolExecutor(8) as pool, client(proxy, "127.0.0.6") as other:
        began = time.monotonic()
        floods = [pool.submit(flood) for _ in range(8)]
        try:
            statuses = {other.get("/v1/models").status_code for _ in range(60)}
            eventually(slowed.is_set)
        finally:
            over.set()
        found = sum((one.result() for one in floods), Counter[int]())
        passed = time.monotonic() - began
    assert statuses == {200}
    assert found.keys() == {200, 503}
    assert found[200] <= 200 + 100 * passed + 1


@pytest.mark.long
def test_who_sends_or_reads_nothing_is_closed(proxy: str) -> None:
    with client(proxy) as asking:
        made = asking.post(
            "/v1/models/larger/interpolations", json={"keyframes": [[0.0] * 3, [0.4] * 3], "frames": 50_000}
        )
        link = httpx.URL(made.raise_for_status().json()["links"]["jsonl"])
    # Each with the seconds after which it must have been closed.
    kinds = {
        b"GET /v1/models HTTP/1.1\r\nHost: x\r\nX-Slow: a": 25,
        b"POST %s HTTP/1.1\r\nHost: x\r\nContent-Length: 100\r\n\r\n{" % MESH.encode(): 25,
        b"GET %s HTTP/1.1\r\nHost: x\r\n\r\n" % link.raw_path: 60,
    }
    with ExitStack() as stack:
        began = time.monotonic()
        waiting = {}
        gone = select.poll()
        for text, most in kinds.items():
            connection = stack.enter_context(connect(proxy, receive=4096))
            connection.sendall(text)
            gone.register(connection, select.POLLRDHUP)
            waiting[connection.fileno()] = text, most
        while waiting:
            for number, _ in gone.poll(1000):
                gone.unregister(number)
                waiting.pop(number)
            late = [text for text, most in waiting.values() if time.monotonic() > began + most]
            assert not late


@contextmanager
def listening(answer: Callable[[http.server.BaseHTTPRequestHandler], bytes]) -> Iterator[str]:
    """A replica that records and answers what it was sent."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            content = answer(self)
            self.send_response(200)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_replicas_are_told_the_address_that_a_client_has_not_what_it_says(tmp_path: Path) -> None:
    forged = {"X-Forwarded-For": "10.9.8.7", "X-Forwarded-Proto": "https", "Forwarded": "for=10.9.8.7"}
    with (
        listening(lambda request: json.dumps(list(request.headers.items())).encode()) as replica,
        proxying(tmp_path / "nginx", replica) as proxy,
        client(proxy, "127.0.0.7") as own,
    ):
        sent: list[tuple[str, str]] = own.get("/v1/models", headers={**forged, "X-Request-ID": "mine"}).json()
        named = [tuple(pair) for pair in own.get("/v1/models").json()]
    said = [(name.lower(), text) for name, text in sent if "forwarded" in name.lower()]
    assert sorted(said) == [("x-forwarded-for", "127.0.0.7"), ("x-forwarded-proto", "http")]
    assert ["Host", httpx.URL(proxy).netloc.decode()] in sent
    # The client's own request id is passed on; without one the proxy makes one.
    assert ["X-Request-ID", "mine"] in sent
    assert re.fullmatch(r"[0-9a-f]{32}", dict(named)["X-Request-ID"])


def test_long_ids_pass(proxy: str) -> None:
    most = re.search(r"large_client_header_buffers \d+ (\d+)k;", CONFIGURATION.read_text())
    assert most
    assert int(most[1]) * 2**10 > ID_LENGTH + 1000, "the request's line has to fit"
    with client(proxy) as own:
        body = {"keyframes": np.random.default_rng(7).random((600, 3)).tolist(), "frames": 10}
        made = own.post("/v1/models/small/interpolations", json=body).raise_for_status()
        assert len(made.json()["id"]) > 10_000
        frame = own.get(f"{httpx.URL(made.headers['Location']).path}/frames/9", params={"format": "glb"})
        assert frame.status_code == 200


def test_uploads_pass_up_to_the_servers_own_limit(proxy: str) -> None:
    encode = "/v1/models/small/encode?format=glb"
    with client(proxy) as own:
        assert own.post(encode, content=b"x" * (64 * 2**20)).status_code == 422
        refused = own.post(encode, content=b"x" * (64 * 2**20 + 1))
        assert refused.status_code == 413
        assert str(64 * 2**20) in refused.json()["detail"]
    with connect(proxy) as connection:
        connection.sendall(f"POST {encode} HTTP/1.1\r\nHost: x\r\nContent-Length: {70 * 2**20}\r\n\r\n".encode())
        head = connection.recv(10_000).decode()
    assert head.startswith("HTTP/1.1 413")
    assert "application/problem+json" in head
