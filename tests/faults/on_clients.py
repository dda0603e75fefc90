"""Clients that are slow or disconnect: they occupy a connection, and no other client waits for them."""

import contextlib
import json
import socket
import time

import numpy as np

from tests.faults.catalogue import FaultTarget, fault
from tests.faults.serving import Steady
from tests.service.watching import admitted, eventually

MODEL = "/v1/models/small"
CODE = b'{"latent": [0.1, 0.7, 0.4]}'
REQUEST = b"POST %s/mesh HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n" % MODEL.encode()
REQUEST += b"Content-Length: %d\r\n\r\n%s" % (len(CODE), CODE)


def connect(steady: Steady) -> socket.socket:
    return socket.create_connection((steady.place.host, steady.place.port), timeout=120)


def stream_link(steady: Steady, frames: int) -> str:
    body = {"keyframes": [[0, 0, 0], [0.1, 0.7, 0.4]], "frames": frames}
    answer = steady.client.post(f"{MODEL}/interpolations", json=body).raise_for_status()
    return str(answer.json()["links"]["jsonl"])


@fault("40 clients send a byte at a time, or read one")
def slow(target: FaultTarget, rng: np.random.Generator) -> str:
    steady = target.steady
    link = stream_link(steady, 600)
    with contextlib.ExitStack() as stack:
        writers = [stack.enter_context(connect(steady)) for _ in range(36)]
        readers = [stack.enter_context(connect(steady)) for _ in range(4)]
        for reader in readers:
            reader.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            reader.sendall(f"GET {link} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        # Each has stopped at another byte after its head, which has to arrive within ten seconds.
        places = [int(rng.integers(len(REQUEST) - len(CODE), len(REQUEST) - 1)) for _ in writers]
        for writer, place in zip(writers, places, strict=True):
            writer.sendall(REQUEST[:place])
        others = 0
        for _ in range(3):
            assert steady.truth.differing() == []
            others += len(steady.truth.answers)
            for k, writer in enumerate(writers):
                if places[k] < len(REQUEST) - 1:
                    writer.sendall(REQUEST[places[k] : places[k] + 1])
                    places[k] += 1
            for reader in readers:
                assert reader.recv(1)
        # In the end all slow clients get their answers.
        for writer, place in zip(writers, places, strict=True):
            writer.sendall(REQUEST[place:])
            assert writer.recv(12) == b"HTTP/1.1 200"
        with readers[0].makefile("rb") as rest:
            while b'"frame":599' not in rest.readline():
                pass
    eventually(lambda: admitted(steady.client) == 0)
    steady.check()
    return f"{others} other requests answered right meanwhile, and the slow ones in the end"


@fault("clients vanish while they send, wait or read")
def vanishing(target: FaultTarget, rng: np.random.Generator) -> str:
    steady = target.steady
    link = stream_link(steady, 600)
    many = json.dumps({"latents": rng.uniform(0, 0.2, (200, 3)).tolist()}).encode()
    long = REQUEST.replace(b"/mesh", b"/vertices").replace(b"%d" % len(CODE), b"%d" % len(many), 1).replace(CODE, many)
    for k in range(40):
        with connect(steady) as client:
            if k % 4 == 0:  # in the middle of its request
                client.sendall(long[: rng.integers(1, len(long))])
            elif k % 4 == 1:  # while it waits for the answer
                client.sendall(long)
            elif k % 4 == 2:  # after a part of a stream
                client.sendall(f"GET {link} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
                client.recv(int(rng.integers(1, 10_000)))
            else:  # with further requests in the pipeline
                client.sendall(REQUEST * 3)
            time.sleep(rng.uniform(0, 0.05))
            if rng.random() < 0.5:  # with a TCP reset, as from a machine that restarted
                client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")
    steady.check()
    return "40 at a time: every place and file handle given back"
