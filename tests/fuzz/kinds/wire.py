"""Chunks, pipelines, cut-off requests, and bytes that are not HTTP."""

from __future__ import annotations

import json

from tests.fuzz.cost import Request
from tests.fuzz.kinds.requests import (
    JSON_TYPE,
    Rng,
    World,
    a_call,
    head,
    kind,
    pick,
)


@kind("a body in chunks of a byte")
def tiny_chunks(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    most = int(10 ** rng.uniform(2, 6.3))
    content = json.dumps(body).encode().ljust(most)
    extension = pick(rng, b"", b"", b";a=b", b";" + b"a" * 50)
    pieces = b"".join(b"1%b\r\n%b\r\n" % (extension, content[k : k + 1]) for k in range(len(content)))
    trailers = pick(rng, b"", b"A: b\r\n", b"A: b\r\n" * 50, b"A: " + b"b" * 10_000 + b"\r\n")
    start = head("POST", target, {**JSON_TYPE, "Transfer-Encoding": "chunked"})
    return Request([start, pieces, b"0\r\n" + trailers + b"\r\n"], broken=len(trailers) > 1000)


@kind("chunks, trailers or extensions without end")
def endless_chunks(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    most = int(10 ** rng.uniform(4, 7.3))
    unit, before = pick(
        rng, (b"A: b\r\n", b"0\r\n"), (b"a", b"1;"), (b"0", b""), (b"a" * 100 + b": b\r\n", b"0\r\n"),
        (b"b", b"0\r\nA: "), (b"f", b""), (b";a", b"1"),
    )  # fmt: skip
    start = head("POST", target, {**JSON_TYPE, "Transfer-Encoding": "chunked"})
    return Request([start, before, unit * (most // len(unit)), b"\r\n\r\n"], broken=True, half_closed=True)


@kind("very many requests in one go")
def pipelined(rng: Rng, world: World) -> Request:
    """Pipelined requests, some of which may be left unanswered."""
    targets = ("/v2/health/live", "/nowhere", "/v2", "/metrics", "/v1/models", f"/v1/models/{world.models[0].name}")
    one, count = f"GET {pick(rng, *targets)} HTTP/1.1\r\n", pick(rng, 14_000, 10, 100, 300)
    return Request([(one + "Host: x\r\n\r\n").encode() * count, head("GET", "/v2/health/live")], broken=True)


@kind("a request a byte at a time")
def byte_by_byte(rng: Rng, world: World) -> Request:
    target, body = a_call(world, rng)
    content = json.dumps(body).encode()
    whole = head("POST", target, {**JSON_TYPE, "Content-Length": str(len(content))}) + content
    return Request(part for k in range(len(whole)) for part in (whole[k : k + 1], 0.001))


@kind("a request, or a part of it, and the end")
def cut_short(rng: Rng, world: World) -> Request:
    """The server treats the end of one direction as that of the connection."""
    target, body = a_call(world, rng)
    content = json.dumps(body).encode().ljust(int(10 ** rng.uniform(2, 6)))
    start = head("POST", target, {**JSON_TYPE, "Content-Length": str(len(content)), "Accept": "a" * 1000})
    whole = start + content
    part = pick(rng, whole, whole[: int(rng.integers(1, len(whole)))], start[: int(rng.integers(1, len(start)))])
    return Request([part], broken=True, half_closed=True)


@kind("not HTTP at all")
def not_http(rng: Rng, world: World) -> Request:
    most = int(10 ** rng.uniform(0, 6))
    data = pick(
        rng, rng.bytes(most), b"\r\n" * most, b"GET " + b"a" * most, b"\x16\x03\x01" + rng.bytes(most), b"\0" * most,
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + rng.bytes(most), b"GET / HTTP/1.1\n\n" * (most // 16 + 1),
        b"GET / HTTP/9.9\r\n\r\n",
    )  # fmt: skip
    return Request([data], broken=True, half_closed=True)


@kind("a length that can't be")
def odd_lengths(rng: Rng, world: World) -> Request:
    target, _ = a_call(world, rng)
    pairs = [("Content-Type", "application/json")]
    for _ in range(int(rng.integers(1, 3))):
        length = pick(rng, "-1", "1" * 5000, "+5", "5, 5", "5;", "0x5", "\u0665", "1e3", "", "18446744073709551616")
        pairs.append(("Content-Length", length))
    if rng.random() < 0.3:
        pairs.append(("Transfer-Encoding", pick(rng, "chunked", "chunked, chunked", "gzip, chunked", "identity", "x")))
    return Request([head("POST", target, pairs), b"{}"], broken=True, half_closed=True)
