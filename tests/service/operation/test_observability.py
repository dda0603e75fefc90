"""Metrics, log lines, request ids, keys and origins."""

import asyncio
import contextlib
import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest
import yaml
from opentelemetry import trace
from opentelemetry.sdk.trace import ReadableSpan, TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter
from opentelemetry.trace import SpanKind
from prometheus_client.parser import text_string_to_metric_families

from shapespace.service.http.app import create_app
from shapespace.service.http.server import STARTUP_FAILURE
from shapespace.service.settings import Settings
from tests.service.conftest import ROOT, Server, starting
from tests.service.watching import eventually, samples, value
from tests.service.wire import connect

MESH = "/v1/models/small/mesh"
CODE = {"latent": [0.1, 0.7, 0.4]}
KEY = {"X-API-Key": "open sesame"}


@pytest.fixture(scope="module")
def plain(small_models: Path) -> Iterator[Server]:
    """A server that logs for people, with a setting that there is not."""
    with starting() as start:
        yield start(small_models, colour="blue")


@pytest.fixture(scope="module")
def guarded(small_models: Path) -> Iterator[Server]:
    """A server with a key and some origins, which logs JSON."""
    settings = {"api_key": KEY["X-API-Key"], "metrics_port": 0, "log_format": "json"}
    with starting() as start:
        yield start(small_models, cors_origins="https://a.example, https://b.example", **settings)


def test_requests_are_counted_by_route_method_and_status(plain: Server) -> None:
    with httpx.Client(base_url=plain.url, timeout=60) as client:
        for _ in range(3):
            answer = client.post(MESH, json=CODE).raise_for_status()
        # As a client asks that has a compressed answer.
        tag = answer.headers["ETag"][:-1] + '-gzip"'
        assert client.post(MESH, json=CODE, headers={"If-None-Match": tag}).status_code == 304
        target = {"vertex": 0, "position": [0, 0, 0]}
        edited = client.post("/v1/models/small/edit", json=CODE | {"targets": [target]})
        assert edited.headers["Server-Timing"].startswith("search;dur=")
        client.post(MESH, json={"latent": [1]})
        client.get("/v1/models/large")
        found = samples(client)
        digest = client.get("/v1/models/small").json()["digest"]
    route = "/v1/models/{name}/mesh"
    assert value(found, "shapespace_requests_total", route=route, method="POST", status="200") == 3
    assert value(found, "shapespace_requests_total", route=route, method="POST", status="422") == 1
    assert value(found, "shapespace_requests_total", route="/v1/models/{name}", method="GET", status="404") == 1
    for status, count in (("200", 3), ("304", 1), ("422", 1)):
        labels = {"route": route, "method": "POST", "status": status}
        assert value(found, "shapespace_request_seconds_count", **labels, model="small") == count
    labels = {"route": "/v1/models/{name}", "method": "GET", "status": "404"}
    assert value(found, "shapespace_request_seconds_count", **labels, model="") == 1
    assert value(found, "shapespace_version_requests_total", model="small", version="10", status="422") == 1
    assert value(found, "shapespace_version_share", model="small", version="10") == 1
    # The second and the third answer came from the cache, and 304 asked for none.
    assert value(found, "shapespace_cache_hits_total") == 2
    assert value(found, "shapespace_cache_misses_total") == 1
    assert not [name for name, _ in found if name.endswith("_created")]
    for stage in ("network", "reconstruct", "encode"):
        assert value(found, "shapespace_stage_seconds_count", stage=stage) == 1
        assert value(found, "shapespace_stage_seconds_sum", stage=stage) > 0
    assert value(found, "shapespace_stage_seconds_count", stage="search") == 1
    assert value(found, "shapespace_stage_seconds_count", stage="read") == 0
    assert value(found, "shapespace_model_info", model="small", version="10", digest=digest) == 1
    assert value(found, "shapespace_admitted") == 0
    assert value(found, "shapespace_admitted_limit") > value(found, "shapespace_workers") > 0
    assert value(found, "process_resident_memory_bytes") > 0


def test_a_metrics_port_that_is_taken_stops_the_start(small_models: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        settings = {"SHAPESPACE_MODELS_DIR": str(small_models), "SHAPESPACE_PORT": "0"}
        ended = subprocess.run(
            [sys.executable, "-m", "shapespace.service"],
            cwd=ROOT,
            env=os.environ | settings | {"SHAPESPACE_METRICS_PORT": str(port)},
            capture_output=True,
            text=True,
            check=False,
        )
    assert ended.returncode == STARTUP_FAILURE
    assert f"can't listen on 127.0.0.1, port {port}: Address already in use; another program" in ended.stderr
    assert "set SHAPESPACE_METRICS_PORT to another port" in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_folder_without_models_is_told(tmp_path: Path) -> None:
    with starting() as start:
        log = start(tmp_path).stop()
    assert f"no model is served: {tmp_path} has no folder NAME/VERSION with a model; SHAPESPACE_MODELS_DIR" in log


def test_spans_follow_the_callers_trace_and_name_the_stages(small_models: Path) -> None:
    exporter, provider = InMemorySpanExporter(), TracerProvider(shutdown_on_exit=False)
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    trace.set_tracer_provider(provider)  # as an operator's program does
    app = create_app(Settings(models_dir=small_models))
    caller, parent = "4bf92f3577b34da6a3ce929d0e0e4736", "00f067aa0ba902b7"

    async def ask() -> None:
        transport = httpx.ASGITransport(app)
        async with (
            app.router.lifespan_context(app),
            httpx.AsyncClient(transport=transport, base_url="http://localhost") as client,
        ):
            for _ in range(2):  # the second answer comes from the cache
                headers = {"traceparent": f"00-{caller}-{parent}-01"}
                (await client.post(MESH, json=CODE, headers=headers)).raise_for_status()
            await client.get("/v2/health/live")
            (await client.post("/v1/models/small/vertices", json={"latents": [CODE["latent"]] * 2})).raise_for_status()

    asyncio.run(ask())
    spans = exporter.get_finished_spans()
    first, second, third = (span for span in spans if span.kind is SpanKind.SERVER)
    assert first.name == second.name == "POST /v1/models/{name}/mesh"
    for request in (first, second):
        assert request.parent
        assert (request.context.trace_id, request.parent.span_id) == (int(caller, 16), int(parent, 16))
    assert third.context.trace_id != int(caller, 16)

    def stages(request: ReadableSpan) -> list[str]:
        return [span.name for span in inside if span.parent and span.parent.span_id == request.context.span_id]

    inside = sorted((span for span in spans if span.kind is SpanKind.INTERNAL), key=lambda span: span.start_time or 0)
    assert stages(first) == ["network", "reconstruct", "encode"]
    assert stages(second) == []
    assert sorted(stages(third)) == ["encode", "network", "network", "reconstruct", "reconstruct"]
    for span in inside:
        assert first.start_time <= span.start_time <= span.end_time


def test_no_request_can_lengthen_the_list_of_labels(plain: Server) -> None:
    with httpx.Client(base_url=plain.url, timeout=60) as client:

        def ask(i: int) -> None:
            for path in (f"/x{i}", f"/v1/models/m{i}", f"/page/p{i}", f"/v1/interpolations/i{i}", f"/v2/models/m{i}"):
                client.get(path)
            client.request(("PROPFIND", "MKCOL", "SEARCH", "REPORT")[i % 4], "/v1/models")
            client.get("/v1/models", headers={"Host": f"h{i}", "X-Request-ID": f"r{i}"})

        ask(0)
        samples(client)
        before = set(samples(client))
        for i in range(1, 8):
            ask(i)
        after = set(samples(client))
    assert after == before
    assert {dict(found).get("method") for _, found in after} == {"GET", "POST", "other", None}


@pytest.mark.parametrize("given", ["abc-123._X", "", "two words", "x" * 65, 'quote"'])
def test_a_request_has_an_id_of_its_own_or_a_good_one_that_it_brings(client: httpx.Client, given: str) -> None:
    answers = [client.get(path, headers={"X-Request-ID": given}) for path in ("/v1/models", "/nothing", MESH)]
    for answer in answers:
        id = answer.headers["X-Request-ID"]
        assert (id == given) is (given == "abc-123._X")
        assert re.fullmatch(r"[A-Za-z0-9._-]{1,64}", id)
    if given != "abc-123._X":
        assert len({answer.headers["X-Request-ID"] for answer in answers}) == 3


def test_a_log_in_json_has_one_object_a_line(guarded: Server) -> None:
    with httpx.Client(base_url=guarded.url, headers=KEY) as client:
        client.post(MESH, json=CODE, headers={"X-Request-ID": "mine"})
        client.get("/v2/health/live")
        client.get("/v1/models/la%0Arge?version=1")
    eventually(lambda: "la%0Arge" in guarded.log)
    lines = [json.loads(line) for line in guarded.log.splitlines()]
    assert all({"time", "level", "logger", "message"} <= line.keys() for line in lines)
    requests = [line for line in lines if line["logger"] == "shapespace.service.http.middleware"]
    assert [line["path"] for line in requests] == [MESH, "/v1/models/la%0Arge"], "no health checks"
    assert requests[0]["request_id"] == "mine"
    assert (requests[0]["method"], requests[0]["status"]) == ("POST", 200)
    assert requests[0]["route"] == "/v1/models/{name}/mesh"
    assert requests[0]["seconds"] > 0
    assert requests[1]["status"] == 404


def test_a_log_for_people_names_the_request_too(plain: Server) -> None:
    httpx.get(f"{plain.url}/v1/models", headers={"X-Request-ID": "mine"})
    eventually(lambda: "[mine]" in plain.log)
    lines = plain.log.splitlines()
    assert [line for line in lines if re.fullmatch(r"INFO \S+ GET /v1/models 200 in [0-9.]+ s \[mine\]", line)]
    assert any("SHAPESPACE_COLOUR is not a setting" in line for line in lines)


def test_a_key_opens_all_but_what_is_open(guarded: Server) -> None:
    with httpx.Client(base_url=guarded.url, timeout=60) as client:
        for path in ("/v2/health/live", "/v2/health/ready", "/", "/page/page.css", "/openapi.json"):
            assert client.get(path).status_code == 200, path
        keys: list[dict[str, str]] = [
            {},
            {"X-API-Key": ""},
            {"X-API-Key": "open sesam"},
            {"X-API-Key": "open sesame!"},
            {"Authorization": "open sesame"},
            {"Authorization": "Basic open sesame"},
        ]
        for headers in keys:
            paths = ("/v2", "/v2/health/live/", "/metrics", "/page", "/nothing") if not headers else ()
            for path in ("/v1/models", *paths):
                answer = client.get(path, headers=headers)
                assert answer.status_code == 401, (path, headers)
                assert answer.json()["type"] == "urn:shapespace:problem:unauthorized"
                assert "Send the server's API key" in answer.json()["detail"]
                assert answer.headers["WWW-Authenticate"] == "Bearer"
        for headers in (KEY, {"Authorization": "bearer open sesame"}):
            for path in ("/v1/models", "/v2", "/metrics"):
                assert client.get(path, headers=headers).status_code == 200


def test_pages_of_named_origins_may_call(guarded: Server) -> None:
    ask = {"Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "content-type, x-api-key"}
    with httpx.Client(base_url=guarded.url) as client:
        for origin, allowed in (("https://a.example", True), ("https://b.example", True), ("https://c.example", False)):
            preflight = client.options(MESH, headers={"Origin": origin, **ask})
            assert preflight.is_success is allowed
            assert preflight.headers["X-Content-Type-Options"] == "nosniff"
            assert len(preflight.headers["X-Request-ID"]) == 32
            if not allowed:
                assert preflight.headers["Content-Type"] == "application/problem+json"
                assert preflight.json()["type"] == "urn:shapespace:problem:cross-origin"
                assert "origin is not allowed" in preflight.json()["detail"]
            answer = client.get("/v1/models", headers={"Origin": origin})
            assert (answer.headers.get("Access-Control-Allow-Origin") == origin) is allowed
            assert answer.status_code == 401, "an allowed origin does not replace the key"
        exposed = answer.headers["Access-Control-Expose-Headers"]
        assert {"ETag", "Shape-Diagnostics", "X-Request-ID"} <= set(exposed.split(", "))


def test_by_default_no_other_origin_may_call(client: httpx.Client) -> None:
    answer = client.get("/v1/models", headers={"Origin": "https://a.example"})
    assert not [name for name in answer.headers if name.lower().startswith("access-control")]


FORGERY = "a name\nINFO shapespace.service.http.app: forged\r\x1b[31m\u2028\u202e \udcff é"
QUOTING = f"""
import logging, sys
from shapespace.service import logs
from shapespace.service.settings import LogFormat
logs.configure(LogFormat(sys.argv[1]))
text = {FORGERY!r}
logging.getLogger(text).error("refused: %s", text)
try:
    raise ValueError(text)
except ValueError:
    logging.getLogger("service").exception("a mistake: %s", text)
"""


@pytest.mark.parametrize("format", ["text", "json"])
def test_nothing_that_is_quoted_makes_a_line_of_the_log(format: str) -> None:
    found = subprocess.run(
        [sys.executable, "-c", QUOTING, format], cwd=ROOT, capture_output=True, encoding="utf-8", check=True
    ).stderr
    lines = found.rstrip("\n").split("\n")
    if format == "json":
        first, second = map(json.loads, lines)
        assert first["message"] == "refused: " + FORGERY.replace("\udcff", "\\udcff")
        assert "Traceback" in second["exc_info"]
        return
    assert not set(found) & set("\r\x1b\u2028\u202e\udcff")
    escaped = r"a name\nINFO shapespace.service.http.app: forged\r\x1b[31m\u2028\u202e \udcff é"
    assert lines[0] == f"ERROR {escaped}: refused: {escaped}"
    assert lines[1] == f"ERROR service: a mistake: {escaped}"
    assert lines[2] == "    Traceback (most recent call last):"
    assert all(line.startswith("    ") for line in lines[2:])


def test_metrics_have_a_port_of_their_own_without_a_key(guarded: Server) -> None:
    port = re.search(r"/metrics is at port (\d+)", guarded.log)
    assert port
    with httpx.Client(base_url=f"http://127.0.0.1:{port[1]}") as own, httpx.Client(base_url=guarded.url) as client:
        before = samples(own)
        assert client.get("/v1/models").status_code == client.get("/metrics").status_code == 401
        asked = {"route": "unmatched", "method": "GET", "status": "401"}
        assert value(samples(own), "shapespace_requests_total", **asked) >= 2
        assert before.keys() <= {*samples(own)}
        with_key = client.get("/metrics", headers=KEY)
        assert {name for name, _ in before} <= {line.split("{")[0].split(" ")[0] for line in with_key.text.splitlines()}


def test_the_dashboard_and_the_alerts_ask_for_metrics_that_there_are(plain: Server) -> None:
    board = json.loads((ROOT / "deploy" / "grafana.json").read_text())
    rules = yaml.safe_load((ROOT / "deploy" / "alerts.yaml").read_text())["groups"]
    asked = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    asked += [rule["expr"] for group in rules for rule in group["rules"]]
    with httpx.Client(base_url=plain.url, timeout=60) as client:
        client.post(MESH, json=CODE).raise_for_status()
        families = list(text_string_to_metric_families(client.get("/metrics").text))
    labels: dict[str, set[str]] = {}
    for family in families:
        endings = {"counter": ["_total"], "histogram": ["_bucket", "_count", "_sum"]}.get(family.type, [""])
        labels |= {family.name + ending: set() for ending in endings}
        for sample in family.samples:
            labels.setdefault(sample.name, set()).update(sample.labels)
    assert len(asked) > 20
    for text in asked:
        names = set(re.findall(r"\b(?:shapespace|process)_[a-z_]+", text))
        assert names
        assert names <= labels.keys(), text
        known = set.union(*(labels[name] for name in names)) | {"job", "instance"}
        wanted = set(re.findall(r"(\w+)(?:=|!=|=~)\"", text)) | {
            label for group in re.findall(r"by \(([^)]*)\)", text) for label in group.replace(" ", "").split(",")
        }
        if known - {"job", "instance"}:  # those of a family without samples are not known
            assert wanted <= known, text
    for rule in (rule for group in rules for rule in group["rules"]):
        assert {"summary", "description"} == rule["annotations"].keys()


def test_the_call_printed_at_the_start_gives_a_shape(guarded: Server, tmp_path: Path) -> None:
    assert guarded.process.stdout
    call = guarded.process.stdout.readline().partition(": ")[2]
    environment = os.environ | {"SHAPESPACE_API_KEY": KEY["X-API-Key"]}
    subprocess.run(["bash", "-ec", call], cwd=tmp_path, env=environment, check=True, timeout=60)
    assert (tmp_path / "small.glb").read_bytes()[:4] == b"glTF"


def test_with_a_key_any_name_will_do(guarded: Server) -> None:
    headers = {"Host": "a.example"} | KEY
    assert httpx.get(f"{guarded.url}/v1/models", headers=headers).status_code == 200


def test_wrong_keys_wait_and_the_right_one_never_does(guarded: Server) -> None:
    def ask(key: str) -> int:
        return client.get("/v1/models", headers={"X-API-Key": key}).status_code

    # One client for all: a busy machine makes fewer than ten in a second.
    with httpx.Client(base_url=guarded.url, timeout=60) as client, ThreadPoolExecutor(40) as pool:
        began = time.monotonic()
        found = list(pool.map(ask, [f"guess {k}" for k in range(100)]))
        seconds = time.monotonic() - began
    assert set(found) == {401, 503}
    assert found.count(401) < 10 * seconds + 15, "ten a second, after the first second's allowance"
    with httpx.Client(base_url=guarded.url, timeout=60) as client, contextlib.ExitStack() as stack:
        for key in (b"guess",) * 12:  # these wait for their answers, or have got 503
            waiting = stack.enter_context(connect(guarded))
            waiting.sendall(b"GET /v1/models HTTP/1.1\r\nHost: localhost\r\nX-API-Key: %s\r\n\r\n" % key)
        assert [ask("open sesame") for _ in range(20)] == [200] * 20
        assert ask("") == 401
