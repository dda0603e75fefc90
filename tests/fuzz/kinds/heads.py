"""Heads of requests: long, odd, or very many lines."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any
from urllib.parse import quote

from tests.fuzz.cost import Request
from tests.fuzz.kinds.requests import (
    LARGEST,
    UPLOAD,
    Rng,
    World,
    get,
    head,
    kind,
    link,
    pick,
    size,
)


def a_get(world: World, rng: Rng) -> str:
    model = world.quick(rng)
    path = f"/v1/models/{model.name}"
    address = link(model, 2, model.codes(rng, 2))
    return str(
        pick(
            rng, "/", "/page/js/main.js", "/openapi.json", "/metrics", "/v1/models", path, f"{path}/mesh", address,
            f"{address}/frames/1", "/v2", "/v2/health/live", "/v2/health/ready", f"/v2/models/{model.name}",
            f"/v2/models/{model.name}/ready", "/nowhere",
        )
    )  # fmt: skip


HEADERS = (
    "Accept", "If-None-Match", "Cookie", "Range", "Expect", "Authorization", "Origin", "X-Request-ID", "Content-Type",
    "Accept-Encoding", "Content-Encoding", "Inference-Header-Content-Length", "X-API-Key", "Forwarded", "X", "Upgrade",
    "Access-Control-Request-Headers", "If-Range", "If-Modified-Since", "Content-Length", "Transfer-Encoding",
)  # fmt: skip
VALUES = (
    "a/b,", "*/*;q=0.1,", "model/obj;q=0,", ",", '"x",', 'W/"0123456789abcdef0123456789abcdef",', "a=b; ", "0-0,", ";",
    "bytes=0-,", " ", "a", "é", "100-continue,", "gzip;q=0.001,", "9", "\t", "(", "%41", "=", "a;a=",
)  # fmt: skip


Headers = dict[str, str]


def long_text(name: str, *units: str, valid: bool = False) -> Callable[[Any], Any]:
    """A decorator that adds a kind: a unit is repeated up to the longest head or far beyond.

    The function places the text: it returns the target and the headers of the request. A valid request has
    to be answered if its head is not too long.
    """

    def enter(place: Callable[[Rng, World, str], tuple[str, Headers]]) -> Any:
        @kind(name)
        def make(rng: Rng, world: World) -> Request:
            most, unit = pick(rng, 30_000, 30_000, 300_000, 4_000_000), pick(rng, *units)
            target, headers = place(rng, world, unit * (most // len(unit)))
            method = "GET" if valid else pick(rng, "GET", "GET", "HEAD", "OPTIONS", "POST")
            return Request([head(method, target, headers)], broken=not valid or most > 30_000)

        return place

    return enter


def a_shape(rng: Rng, world: World) -> str:
    """The address of a mesh or of an animation."""
    model = world.quick(rng)
    return str(pick(rng, f"/v1/models/{model.name}/mesh", link(model, 2, model.codes(rng, 2))))


@long_text("a head with long values", *VALUES)
def long_headers(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    names = rng.choice(HEADERS, int(rng.integers(1, 4)), replace=False)
    return a_get(world, rng), {str(name): text[: len(text) // len(names)] for name in names}


@long_text(
    "Accept with ten thousand ranges",
    "a/b,", "*/*;q=0,", "a;q=1,", ",", "model/gltf-binary;a=b;c=d;q=0.001,", "a/b;;;;;;;;;;;;", valid=True,
)  # fmt: skip
def long_accept(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    return a_shape(rng, world), {"Accept": text}


@long_text(
    "If-None-Match with thousands of tags",
    '"x",', ",", 'W/"a",', "W/" * 50 + ",", '"0123456789abcdef0123456789abcdef", ', valid=True,
)  # fmt: skip
def long_match(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    return pick(rng, a_shape(rng, world), "/", "/page/page.css"), {"If-None-Match": text}


@long_text(
    "a path with very many percent escapes",
    "%41", "%2e%2e%2f", "%00", "/", "%ff", "a", "../", "%25", "%", "é", "//", "{k}", "%f0%9f%94%ba", ".",
)  # fmt: skip
def long_paths(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    places = (
        "/v1/models/{}", "/v1/models/{}/mesh", f"/v1/models/{world.quick(rng).name}/{{}}", "/page/{}", "/{}",
        "/v1/interpolations/{}", "/v1/interpolations/{}/frames/1", "/v2/models/{0}/versions/{0}/ready",
        "/v1/interpolations/x/frames/{}", "http://{}/", "{}",
    )  # fmt: skip
    return str(pick(rng, *places)).format(text), {}


@long_text(
    "a query with very many members",
    "a=b&", "&", "=", "latent=1&", "a;", "%41=%41&", "format=obj&", "+", "a&", "mesh=coarse&", "é=",
)  # fmt: skip
def long_queries(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    model = f"/v1/models/{world.any(rng).name}"
    return f"{pick(rng, f'{model}/mesh', model, '/', '/v1/models', '/metrics')}?{text}", {}


@long_text(
    "a latent of very many numbers in the query",
    "0,", "1e9,", ",", "nan,", "-", "1", "9" * 400 + ",", "0.1,", "%30%2c", " ", "1_0,", "٣,",
)  # fmt: skip
def long_latent(rng: Rng, world: World, text: str) -> tuple[str, Headers]:
    name = pick(rng, "latent", "color=stretch&against")
    return f"/v1/models/{world.any(rng).name}/mesh?{name}={quote(text, safe=',%')[: len(text)]}", {}


@kind("a head with very many lines")
def many_headers(rng: Rng, world: World) -> Request:
    count = int(10 ** rng.uniform(1, 6))
    line = (
        pick(rng, b"a:", b"a: bbbbbbbbbbbbbbbb", b"Cookie: a=b", b"Host: x", b"Accept: */*", b"X-Request-ID: a")
        + b"\r\n"
    )
    return Request([head("GET", a_get(world, rng))[:-2], line * count, b"\r\n"], broken=count > 50)


@kind("Range with thousands of ranges")
def many_ranges(rng: Rng, world: World) -> Request:
    target = pick(rng, "/", LARGEST, "/openapi.json", f"/v1/models/{world.quick(rng).name}/mesh?format=json")
    part = pick(rng, "{0}-{0}", "{}-", "0-", "-1", "")
    ranges = ",".join(part.format(2 * k) for k in range(pick(rng, 300_000, 30_000, 30_000) // (len(part) + 4)))
    return Request([head("GET", target, {"Range": f"bytes={ranges}"})], broken=len(ranges) > 30_000)


@kind("the page's largest file, compressed")
def largest_asset(rng: Rng, world: World) -> Request:
    return get(LARGEST, {"Accept-Encoding": "gzip"})


@kind("a body that nobody asked for")
def unasked(rng: Rng, world: World) -> Request:
    body = bytes(size(rng, UPLOAD))
    return Request(
        [head(pick(rng, "GET", "HEAD", "DELETE"), a_get(world, rng), {"Content-Length": str(len(body))}), body]
    )


@kind("small odd headers")
def odd_headers(rng: Rng, world: World) -> Request:
    pairs = [
        pick(
            rng, ("Host", ""), ("Host", "a b"), ("Host", "[::1"), ("Host", "x" * 300), ("Range", "bytes=0-0"),
            ("Range", "bytes=" + ",".join(f"{k}-{k}" for k in range(500))), ("Expect", "100-continue"),
            ("Upgrade", "websocket"), ("Connection", "Upgrade"), ("Origin", "null"), ("Origin", "http://x" * 99),
            ("Authorization", "Bearer " + "a" * 9999), ("Authorization", "Basic \xff"), ("X-Request-ID", "a" * 64),
            ("Accept-Encoding", "gzip"), ("If-None-Match", "*"), ("Content-Length", "0"), ("TE", "trailers"),
            ("Forwarded", "for=" + '"[::1]"' * 500), ("X-Forwarded-For", "1," * 5000), ("Content-Encoding", "gzip"),
        )
        for _ in range(int(rng.integers(1, 6)))
    ]  # fmt: skip
    method = pick(rng, "GET", "GET", "HEAD", "POST", "OPTIONS", "DELETE", "PATCH", "TRACE", "CONNECT", "GETT")
    return Request([head(method, a_get(world, rng), pairs)], broken=True)
