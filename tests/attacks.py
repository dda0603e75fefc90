"""Denial-of-service attacks on a server, to test it: ``python -m tests.attacks URL [--seconds 60]``.

Each attack lasts some seconds, from a few clients at once, while another client asks for health and for
ordinary shapes. This module needs only httpx. Use it on servers of your own only.
"""

import argparse
import contextlib
import itertools
import json
import os
import select
import socket
import ssl
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any
from urllib.parse import urlsplit

import httpx

#: Seconds within which health has to answer, whatever else happens.
PROMPT = 1.0
#: Timeouts in seconds of the calls for health and for a shape.
HEALTH_PATIENCE, SHAPE_PATIENCE = 10.0, 70.0
#: Most bytes that a connection of `f2` sends; streams of `f4`.
ENDLESS, READERS = 200 * 2**20, 34
#: Connections that one attack makes at most.
CONNECTIONS = 20_000
#: A node's matrix that is not the identity, so that no reader can skip it.
MATRIX = [0.8, 0.6, 0, 0, -0.6, 0.8, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]


@dataclass
class AttackOutcome:
    """The outcome of an attack.

    Attributes:
        answers: number of the attackers' answers by status, or by the reason why there was none.
        health: seconds of each call of health; infinite for one without an answer.
        shapes: number of ordinary shapes by status.
        slowest_shape: seconds of the slowest shape that was answered.
    """

    answers: Counter[str] = field(default_factory=Counter)
    health: list[float] = field(default_factory=list)
    shapes: Counter[str] = field(default_factory=Counter)
    slowest_shape: float = 0.0

    @property
    def worst_health(self) -> float:
        """Seconds of the slowest call of health; infinite if one had no answer."""
        return max(self.health, default=float("inf"))

    @property
    def held(self) -> bool:
        """Whether health always answered promptly, and most of the ordinary shapes were answered."""
        return self.worst_health < PROMPT and self.shapes["200"] > self.shapes.total() / 2

    def __str__(self) -> str:
        """One line."""
        answers, shapes = (
            ", ".join(f"{count} × {answer}" for answer, count in found.most_common())
            for found in (self.answers, self.shapes)
        )
        return (
            f"health {self.worst_health:.3f} s at worst of {len(self.health)}; shapes: {shapes or 'none'}, "
            f"{self.slowest_shape:.2f} s at most; attackers: {answers or 'no answer'}"
        )


@dataclass
class AttackTarget:
    """The server that is attacked, for how long, with which key, and from which local address.

    Attributes:
        stranger: whether the attackers lack the key that the other client sends.
        end: time.monotonic() when it is over, once it has begun.
    """

    url: str
    seconds: float
    key: str | None = None
    source: str | None = None
    stranger: bool = False
    end: float = float("inf")

    @property
    def going_on(self) -> bool:
        """Whether there is time left."""
        return time.monotonic() < self.end

    def client(self, *, attacks: bool = False) -> httpx.Client:
        """A client for whole requests; it ignores proxies that the environment names."""
        transport = httpx.HTTPTransport(local_address=self.source if attacks else None)
        headers = self._headers(attacks=attacks)
        return httpx.Client(base_url=self.url, headers=headers, timeout=SHAPE_PATIENCE, transport=transport)

    def _headers(self, *, attacks: bool) -> dict[str, str]:
        return {"X-API-Key": self.key} if self.key and not (attacks and self.stranger) else {}

    def connect(self, receive: int | None = None) -> socket.socket:
        """A connection for parts of requests; ``receive`` is the size of its receive buffer in bytes."""
        place = urlsplit(self.url)
        port = place.port or (443 if place.scheme == "https" else 80)
        connection = socket.socket(socket.AF_INET6 if ":" in (place.hostname or "") else socket.AF_INET)
        if receive:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive)
        connection.settimeout(10)
        if self.source:
            connection.bind((self.source, 0))
        connection.connect((place.hostname, port))
        if place.scheme == "https":
            return ssl.create_default_context().wrap_socket(connection, server_hostname=place.hostname)
        return connection

    def head(self, line: str) -> bytes:
        """A request's head, without the empty line that ends it."""
        lines = {"Host": urlsplit(self.url).netloc, **self._headers(attacks=True)}
        return "".join([line, "\r\n", *(f"{name}: {text}\r\n" for name, text in lines.items())]).encode()

    def model(self) -> tuple[str, int]:
        """Name and dimension of the first model."""
        with self.client() as client:
            first = client.get("/v1/models").raise_for_status().json()["models"][0]
        return first["name"], first["latent_dimension"]


def f1(url: str, seconds: float, key: str | None = None, **of_target: Any) -> AttackOutcome:
    """Scene graphs that cost more than their size suggests: long chains, and few nodes with many edges."""
    target = AttackTarget(url, seconds, key, **of_target)
    name, _ = target.model()
    with target.client() as client:
        mesh = client.get(f"/v1/models/{name}/mesh", params={"format": "gltf"}).raise_for_status().json()
    chains = [[{"matrix": MATRIX, "children": [k + 1]} for k in range(length)] for length in (3000, 9990)]
    dense = [{"children": [*range(k + 1, min(k + 160, 9001))]} for k in range(9000)]
    doubled = [{"children": [k + 1, k + 1]} for k in range(40)]
    scenes = [
        mesh | {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [*n, {"mesh": 0}]} for n in (*chains, dense, doubled)
    ]
    bodies = [json.dumps(scene, separators=(",", ":")).encode() for scene in scenes]

    def post(outcome: AttackOutcome, first: int) -> None:
        path = f"/v1/models/{name}/encode?format=gltf"
        _post(target, outcome, path, itertools.cycle(bodies[first:] + bodies[:first]))

    return _meanwhile(target, [partial(post, first=k) for k in range(len(bodies))])


def f2(url: str, seconds: float, key: str | None = None, **of_target: Any) -> AttackOutcome:
    """Endless heads and trailers: with many lines, and with one."""
    target = AttackTarget(url, seconds, key, **of_target)
    get = target.head("GET /v1/models HTTP/1.1")
    chunked = target.head("POST /v1/models/x/mesh HTTP/1.1") + b"Transfer-Encoding: chunked\r\n"
    trailers = chunked + b"Content-Type: application/json\r\n\r\n2\r\n{}\r\n0\r\n"
    line = b"X-%d: " + b"a" * 100 + b"\r\n"
    kinds = [
        (get, b"".join(line % k for k in range(9000))),
        (trailers, b"".join(line % k for k in range(9000))),
        (get + b"X-Endless: ", b"a" * 2**20),
        (b"GET /", b"a" * 2**20),
    ]

    def endless(outcome: AttackOutcome, begin: bytes, more: bytes) -> None:
        while target.going_on and outcome.answers.total() < CONNECTIONS:
            with _counted(outcome) as answered, target.connect() as connection:
                connection.sendall(begin)
                for _ in range(ENDLESS // len(more)):
                    connection.sendall(more)
                    if not target.going_on or select.select([connection], [], [], 0)[0]:
                        break
                answered(connection.recv(12)[9:12].decode() or "closed")

    return _meanwhile(target, [partial(endless, begin=begin, more=more) for begin, more in kinds])


def f3(url: str, seconds: float, key: str | None = None, **of_target: Any) -> AttackOutcome:
    """JSON of 1 and 8 MiB in which every element is invalid, or none."""
    target = AttackTarget(url, seconds, key, **of_target)
    name, dimension = target.model()
    mesh, infer = f"/v1/models/{name}/mesh", f"/v2/models/{name}/infer"
    calls = []
    for size in (8 * 2**20 - 1000, 2**20):
        calls.append((mesh, b'{"latent":[%s""]}' % (b'"",' * (size // 3))))
        count = size // 2 // dimension
        tensor = {"name": "latent", "shape": [count, dimension], "datatype": "FP32"}
        data = b"[%s0]" % (b"0," * (count * dimension - 1))
        calls.append((infer, b'{"inputs":[%s,"data":%s}]}' % (json.dumps(tensor).encode()[:-1], data)))

    def post(outcome: AttackOutcome, path: str, body: bytes) -> None:
        _post(target, outcome, path, itertools.repeat(body))

    return _meanwhile(target, [partial(post, path=path, body=body) for path, body in calls])


def f4(url: str, seconds: float, key: str | None = None, **of_target: Any) -> AttackOutcome:
    """Clients that request a stream of frames and read nothing."""
    target = AttackTarget(url, seconds, key, **of_target)
    name, dimension = target.model()
    with target.client() as client:
        made = client.post(
            f"/v1/models/{name}/interpolations",
            json={"keyframes": [[0.0] * dimension, [0.5] * dimension], "frames": 600},
        )
        link = urlsplit(made.raise_for_status().json()["links"]["jsonl"])
    request = target.head(f"GET {link.path}?{link.query} HTTP/1.1") + b"\r\n"

    def read_nothing(outcome: AttackOutcome) -> None:
        hung_up = select.poll()
        readers: dict[int, socket.socket] = {}
        try:
            while target.going_on:
                while len(readers) < READERS and outcome.answers["streams asked for"] < CONNECTIONS:
                    try:
                        reader = target.connect(receive=4096)
                        reader.sendall(request)
                    except OSError as error:
                        outcome.answers[type(error).__name__] += 1
                        break
                    outcome.answers["streams asked for"] += 1
                    readers[reader.fileno()] = reader
                    hung_up.register(reader, select.POLLRDHUP if hasattr(select, "POLLRDHUP") else select.POLLHUP)
                for number, _ in hung_up.poll(200):
                    hung_up.unregister(number)
                    reader = readers.pop(number)
                    with reader, contextlib.suppress(OSError):
                        outcome.answers[f"closed after {reader.recv(12)[9:12].decode() or 'nothing'}"] += 1
        finally:
            for reader in readers.values():
                reader.close()

    return _meanwhile(target, [read_nothing])


ATTACKS: dict[str, Callable[..., AttackOutcome]] = {"f1": f1, "f2": f2, "f3": f3, "f4": f4}


def _post(target: AttackTarget, outcome: AttackOutcome, path: str, bodies: Iterator[bytes]) -> None:
    with target.client(attacks=True) as client:
        while target.going_on and outcome.answers.total() < CONNECTIONS:
            with _counted(outcome) as answered:
                left = max(1.0, target.end - time.monotonic())
                answered(str(client.post(path, content=next(bodies), headers=_JSON, timeout=left).status_code))


_JSON = {"Content-Type": "application/json"}


@contextlib.contextmanager
def _counted(outcome: AttackOutcome) -> Iterator[Callable[[str], None]]:
    """Count one answer, or the kind of failure."""
    found: list[str] = []
    try:
        yield found.append
    except (httpx.HTTPError, OSError) as error:
        found.append(type(error).__name__)
        time.sleep(0.05)
    outcome.answers.update(found[:1])


def _meanwhile(target: AttackTarget, attackers: list[Callable[[AttackOutcome], None]]) -> AttackOutcome:
    """Run attackers until the time is over while others ask, each on a new connection, for health and for shapes."""
    outcome = AttackOutcome()
    name, dimension = target.model()
    target.end = time.monotonic() + target.seconds
    threads = [threading.Thread(target=attack, args=(outcome,), daemon=True) for attack in attackers]
    threads.append(threading.Thread(target=_ask_health, args=(target, outcome), daemon=True))
    threads.append(threading.Thread(target=_ask_shapes, args=(target, outcome, name, dimension), daemon=True))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return outcome


def _ask_health(target: AttackTarget, outcome: AttackOutcome) -> None:
    while target.going_on:
        began = time.monotonic()
        took = float("inf")
        with contextlib.suppress(httpx.HTTPError), target.client() as client:
            if client.get("/v2/health/live", timeout=HEALTH_PATIENCE).status_code == httpx.codes.OK:
                took = time.monotonic() - began
        outcome.health.append(took)
        time.sleep(0.1)


def _ask_shapes(target: AttackTarget, outcome: AttackOutcome, name: str, dimension: int) -> None:
    for k in itertools.count():
        if not target.going_on:
            break
        began = time.monotonic()
        try:
            with target.client() as client:
                code = [0.2 + k % 1000 / 2000] * dimension
                answer = client.post(f"/v1/models/{name}/mesh", json={"latent": code})
            outcome.shapes[str(answer.status_code)] += 1
            if answer.status_code == httpx.codes.OK:
                outcome.slowest_shape = max(outcome.slowest_shape, time.monotonic() - began)
        except httpx.HTTPError as error:
            outcome.shapes[type(error).__name__] += 1
        time.sleep(0.5)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("url")
    parser.add_argument("--only", nargs="+", choices=ATTACKS, default=list(ATTACKS), metavar="NAME", help="f1 to f4")
    parser.add_argument("--seconds", type=float, default=60, help="of each attack")
    parser.add_argument("--source", help="address of this machine that the attackers come from")
    parser.add_argument("--stranger", action="store_true", help="the attackers don't know the key")
    given = parser.parse_args()
    # The key is not an argument, as all users of a machine can read arguments.
    key = os.environ.get("SHAPESPACE_API_KEY")
    held = True
    for name in given.only:
        outcome = ATTACKS[name](given.url, given.seconds, key, source=given.source, stranger=given.stranger)
        print(f"{name}: {'held' if outcome.held else 'FELL'}: {outcome}", flush=True)
        held = held and outcome.held
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
