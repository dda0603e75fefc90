"""Malformed requests: each gets a status, a problem type, and a sentence that says what to do."""

from dataclasses import dataclass, field
from typing import Any

import httpx
import pytest

from tests.service.conftest import Server
from tests.service.wire import exchange

JSON = {"Content-Type": "application/json"}
MODEL = "/v1/models/small"
MESH, VERTICES, NRIC, PATHS = (f"{MODEL}/{call}" for call in ("mesh", "vertices", "nric", "interpolations"))
OK = [0.1, 0.2, 0.3]
LONG_PATH = [[round(x, 5) for x in (k / 7, k / 3, 1 / (k + 1))] for k in range(2000)]


@dataclass
class Bad:
    """A request and its expected answer."""

    method: str
    path: str
    status: int
    kind: str
    says: str
    body: Any = None
    headers: dict[str, str] = field(default_factory=dict)

    def send(self, client: httpx.Client) -> httpx.Response:
        raw = isinstance(self.body, (str, bytes)) or self.body is None
        content = {"content": self.body} if raw else {"json": self.body}
        return client.request(self.method, self.path, headers=self.headers, **content)


def post(path: str, body: Any, status: int, kind: str, says: str) -> Bad:
    return Bad("POST", path, status, kind, says, body, JSON if isinstance(body, (str, bytes)) else {})


def get(path: str, status: int, kind: str, says: str, **headers: str) -> Bad:
    return Bad("GET", path, status, kind, says, headers=headers)


REQUESTS = {
    "no JSON": post(MESH, '{"latent": [1, 2', 400, "malformed-request", "Send one valid JSON object"),
    "no UTF-8": post(MESH, b'{"latent": "\xff"}', 400, "malformed-request", "UTF-8"),
    "JSON too deep": post(MESH, "[" * 20_000 + "]" * 20_000, 400, "malformed-request", "nested too deeply"),
    "a number of 5000 digits": post(MESH, f'{{"latent": [{"9" * 5000}]}}', 400, "malformed-request", "JSON"),
    "empty body": post(MESH, "", 422, "invalid-request", "Send a JSON object"),
    "a list as body": post(MESH, [1, 2, 3], 422, "invalid-request", "Send a JSON object"),
    "a member twice": post(
        MESH, '{"latent": [0, 0, 0], "lat\\u0065nt": [1, 1, 1]}', 422, "invalid-request", "the member 'latent' twice"
    ),
    "JSON in UTF-16": post(MESH, '{"latent": [0, 0, 0]}'.encode("utf-16"), 400, "malformed-request", "no UTF-8"),
    "no latent": post(MESH, {}, 422, "invalid-request", "Add 'latent'"),
    "latent null": post(MESH, {"latent": None}, 422, "invalid-request", "Send a list for latent"),
    "code too short": post(MESH, {"latent": [0.1]}, 422, "wrong-length", "Give exactly 3"),
    "code too long": post(MESH, {"latent": [*OK, 1]}, 422, "wrong-length", "Give exactly 3"),
    "empty code": post(MESH, {"latent": []}, 422, "wrong-length", "Give exactly 3"),
    "NaN": post(MESH, '{"latent": [NaN, 0, 0]}', 422, "not-finite", "finite numbers only: latent[0]"),
    "infinity": post(MESH, '{"latent": [0, -Infinity, 0]}', 422, "not-finite", "finite numbers only: latent[1]"),
    "beyond doubles": post(MESH, '{"latent": [0, 0, 1e999]}', 422, "not-finite", "finite numbers only: latent[2]"),
    "beyond floats": post(MESH, {"latent": [0, 0, 1e39]}, 422, "not-finite", "Coordinate 2"),
    "text as number": post(MESH, {"latent": ["0.1", 0, 0]}, 422, "invalid-request", "Send a number for latent[0]"),
    "true as number": post(MESH, {"latent": [True, 0, 0]}, 422, "invalid-request", "Send a number for latent[0]"),
    "a nested code": post(MESH, {"latent": [OK]}, 422, "invalid-request", "Send a number for latent[0]"),
    "misspelt field": post(MESH, {"latent": OK, "bound": "clamp"}, 422, "invalid-request", "Remove 'bound'"),
    "unknown bounds": post(MESH, {"latent": OK, "bounds": "wrap"}, 422, "invalid-request", "'allow', 'clamp' or"),
    "unknown mesh": post(MESH, {"latent": OK, "mesh": "finest"}, 422, "invalid-request", "'fine' or 'coarse'"),
    "out of bounds": post(
        MESH, {"latent": [0.3, 0, 0], "bounds": "reject"}, 422, "out-of-bounds", "or choose clamp or allow for bounds"
    ),
    "text in a link": get(f"{MESH}?latent=a,b,c", 422, "invalid-request", "separated by commas"),
    "NaN in a link": get(f"{MESH}?latent=nan,0,0", 422, "not-finite", "Give finite numbers"),
    "short code in a link": get(f"{MESH}?latent=1,2", 422, "wrong-length", "Give exactly 3"),
    "digits of another kind in a link": get(f"{MESH}?latent=1_0,0,0", 422, "invalid-request", "separated by commas"),
    "empty code in a link": get(f"{MESH}?latent=", 422, "wrong-length", "Give exactly 3"),
    "no code": post(VERTICES, {"latents": []}, 422, "invalid-request", "Send at least one code"),
    "one code for many": post(VERTICES, {"latents": OK}, 422, "invalid-request", "Send a list for latents[0]"),
    "codes of two lengths": post(VERTICES, {"latents": [OK, [1]]}, 422, "wrong-length", "Code 1 has 1 number,"),
    "too many codes": post(VERTICES, {"latents": [OK] * 21}, 422, "too-many-codes", "Send several requests"),
    "too many codes for NRIC": post(NRIC, {"latents": [OK] * 21}, 422, "too-many-codes", "the limit is 20"),
    "factors as text": post(NRIC, {"latents": [OK], "factors": "yes"}, 422, "invalid-request", "true or false"),
    "one keyframe": post(PATHS, {"keyframes": [OK]}, 422, "invalid-request", "2 or more entries for keyframes"),
    "short keyframe": post(PATHS, {"keyframes": [OK, [1]]}, 422, "wrong-length", "Code 1 has 1 number,"),
    "times run back": post(
        PATHS, {"keyframes": [OK, OK, OK], "times": [0, 2, 1]}, 422, "invalid-request", "times must increase"
    ),
    "times stand still": post(PATHS, {"keyframes": [OK, OK], "times": [1, 1]}, 422, "invalid-request", "increase"),
    "times too few": post(PATHS, {"keyframes": [OK, OK], "times": [1]}, 422, "invalid-request", "send as many"),
    "a number as a name": post(PATHS, {"keyframes": [OK, OK], "name": 1}, 422, "invalid-request", "a text for name"),
    "an empty name": post(PATHS, {"keyframes": [OK, OK], "name": ""}, 422, "invalid-request", "1 or more characters"),
    "one frame": post(PATHS, {"keyframes": [OK, OK], "frames": 1}, 422, "invalid-request", "at least 2 for frames"),
    "half a frame": post(PATHS, {"keyframes": [OK, OK], "frames": 2.5}, 422, "invalid-request", "whole number"),
    "too many frames": post(PATHS, {"keyframes": [OK, OK], "frames": 201}, 422, "too-many-frames", "limit is 200"),
    "a path beyond floats": post(
        PATHS, {"keyframes": [OK, [0, 0, 0]], "stop": 1e300}, 422, "not-finite", "times, start or stop"
    ),
    "too long a path": post(PATHS, {"keyframes": LONG_PATH}, 422, "path-too-long", "Send fewer keyframes"),
    "a coordinate fixed twice": post(
        f"{MODEL}/edit", {"latent": OK, "targets": [{"vertex": 0, "position": OK}], "fixed": {"0": 1, "00": 2}},
        422, "invalid-request", "'00' is not an index",
    ),
    "samples without end": post(
        f"{MODEL}/edit", {"latent": OK, "targets": [{"vertex": 0, "position": OK}], "samples": 10**22},
        422, "too-many-codes", "the limit is 20",
    ),
    "a placement that says a thing twice": get(
        f'{MESH}?place={{"scale":1,"scale":2}}', 422, "invalid-request", "the member 'scale' twice"
    ),
    "unknown model": get("/v1/models/large", 404, "unknown-model", "/v1/models lists"),
    "unknown model's mesh": post("/v1/models/large/mesh", {"latent": OK}, 404, "unknown-model", "lists the models"),
    "a way out of the folder": get("/v1/models/..%2fsmall/mesh", 404, "not-found", "/openapi.json"),
    "unknown version": get(f"{MODEL}?version=3", 404, "unknown-version", "Choose one of 1, 2, 10"),
    "no version": get(f"{MODEL}?version=new", 404, "unknown-version", "Choose one of 1, 2, 10"),
    "unknown call": get(f"{MODEL}/volume", 404, "not-found", "/openapi.json lists every call"),
    "unknown interpolation": get("/v1/interpolations/abc", 404, "unknown-interpolation", "POST the keyframes"),
    "frame as text": get("/v1/interpolations/abc/frames/x", 422, "invalid-request", "Send a whole number for k"),
    "a frame in Python's spelling": get("/v1/interpolations/abc/frames/1_0", 422, "invalid-request", "number for k"),
    "frames per second in Python's spelling": get(
        "/v1/interpolations/abc?fps=2_4", 422, "invalid-request", "Send a number for fps"
    ),
    "a slash at the end": get(f"{MESH}/", 404, "not-found", "/openapi.json"),
    "wrong method": Bad("DELETE", MESH, 405, "method-not-allowed", "Use GET, POST"),
    "wrong method on a list": Bad("POST", "/v1/models", 405, "method-not-allowed", "Use GET"),
    "unknown format": get(f"{MESH}?format=fbx", 406, "not-acceptable", "obj (model/obj)"),
    "nothing acceptable": get(MESH, 406, "not-acceptable", "obj (model/obj)", Accept="image/png"),
    "colours in STL": get(f"{MESH}?color=stretch&format=stl", 406, "not-acceptable", "STL files can't carry colours"),
    "no coloured format": get(f"{MESH}?color=stretch", 406, "not-acceptable", "ply", Accept="model/stl"),
    "unknown colours": get(f"{MESH}?color=heat", 422, "invalid-request",  "'stretch', 'bending' or 'spread' for color"),
    "nothing to colour": get(f"{MESH}?against=0,0,0", 422, "invalid-request", "only for color=stretch"),
    "colours against text": get(f"{MESH}?color=bending&against=x", 422, "invalid-request", "?against=0.1,0.2"),
    "colours against a short code": post(
        f"{MESH}?color=bending&against=1", {"latent": OK}, 422, "wrong-length", "Give exactly 3"
    ),
    "colours against a code out of bounds": post(
        f"{MESH}?color=bending&against=0.3,0,0", {"latent": OK, "bounds": "reject"}, 422, "out-of-bounds", "Move it"
    ),
    "unknown animation": get("/v1/interpolations/abc?format=fbx", 406, "not-acceptable", "pc2"),
    "vertices as mesh": post(f"{VERTICES}?format=glb", {"latents": [OK]}, 406, "not-acceptable", "npz"),
    "body too large": post(MESH, " " * 100_001, 413, "body-too-large", "limit of 100000 bytes"),
    "form as body": Bad(
        "POST", MESH, 415, "unsupported-media-type", "Content-Type: application/json", "latent=1",
        {"Content-Type": "application/x-www-form-urlencoded"},
    ),
    "body of an unknown encoding": Bad(
        "POST", MESH, 415, "unsupported-media-type", "with gzip or deflate", "{}",
        {"Content-Type": "application/json", "Content-Encoding": "br"},
    ),
    "body that is not compressed as it says": Bad(
        "POST", MESH, 400, "malformed-request", "Content-Encoding", "{}",
        {"Content-Type": "application/json", "Content-Encoding": "gzip"},
    ),
    "body of no type": Bad("POST", MESH, 415, "unsupported-media-type", "Content-Type: application/json", "{}"),
}  # fmt: skip


@pytest.mark.parametrize("request_", [pytest.param(value, id=name) for name, value in REQUESTS.items()])
def test_bad_requests_are_told_what_to_do(client: httpx.Client, request_: Bad) -> None:
    answer = request_.send(client)
    problem = answer.json()
    assert answer.status_code == request_.status, problem
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert problem["type"] == f"urn:shapespace:problem:{request_.kind}"
    assert problem["status"] == request_.status
    assert problem["title"]
    assert request_.says in problem["detail"]


def test_a_body_over_the_limit_is_refused_without_an_announced_length(client: httpx.Client) -> None:
    def chunks() -> Any:
        for _ in range(30):
            yield b" " * 5000

    answer = client.post(MESH, content=chunks(), headers=JSON)
    assert answer.status_code == 413
    assert answer.json()["type"] == "urn:shapespace:problem:body-too-large"


def test_a_frame_beyond_the_end_is_not_found(client: httpx.Client) -> None:
    links = client.post(PATHS, json={"keyframes": [OK, [0, 0, 0]], "frames": 3}).json()["links"]
    for k in (3, -1):
        answer = client.get(f"{links['self']}/frames/{k}")
        assert (answer.status_code, answer.json()["type"]) == (404, "urn:shapespace:problem:unknown-frame")
        assert "from 0 to 2" in answer.json()["detail"]


def test_what_a_path_allows_is_said_in_the_header_too(client: httpx.Client) -> None:
    for path, allowed in {
        MESH: "GET, POST, HEAD, OPTIONS", PATHS: "POST, OPTIONS", "/page/page.css": "GET, HEAD, OPTIONS"
    }.items():  # fmt: skip
        assert client.put(path).headers["Allow"] == allowed
        asked = client.options(path)
        assert (asked.status_code, asked.headers["Allow"], asked.content) == (204, allowed, b"")


def test_refusals_list_the_choices(client: httpx.Client) -> None:
    answer = client.get(MESH, params={"format": "fbx"})
    assert "Accept" in answer.headers["Vary"].split(", ")
    choices = answer.json()["choices"]
    assert {"format": "glb", "media_type": "model/gltf-binary"} in choices


def test_every_fault_of_a_body_is_listed(client: httpx.Client) -> None:
    problem = client.post(MESH, json={"latent": ["a", 0, None], "extra": 1}).json()
    assert [error["pointer"] for error in problem["errors"]] == ["#/latent/0", "#/extra"], "one for each list"
    pointers = [
        client.post(MESH, json=body).json()["errors"][-1]["pointer"] for body in ([], {"latent": OK, "a/b~": 1})
    ]
    assert pointers == ["#", "#/a~1b~0"]


@pytest.mark.parametrize(
    ("target", "status"),
    [
        ("http://localhost:1/v1/models/small/mesh?format=stl", b"200"),
        ("HTTPS://127.0.0.1/v1/models/%73mall", b"200"),
        ("http://localhost", b"200"),
        ("http://localhost/v1/models?a=b", b"422"),
        ("http://a.example/v1/models/small", b"421"),  # although the header names this server
    ],
)
def test_a_target_may_be_a_whole_address(target: str, status: bytes, server: Server) -> None:
    answer = exchange(server, f"GET {target} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
    assert answer.split()[1] == status, answer[:500]


@pytest.mark.parametrize(
    ("method", "path"),
    [
        ("GET", f"{MODEL}/mesh?formt=obj"),
        ("POST", f"{MODEL}/mesh?latent=1,2,3"),
        ("POST", f"{MODEL}/nric?mesh=coarse"),
        ("GET", "/v1/models?page=2"),
        ("POST", "/v2/models/small/infer?x"),
        ("GET", "/metrics?name=a"),
        ("HEAD", f"{MODEL}?versoin=1"),
    ],
)
def test_unknown_query_parameters_are_named(client: httpx.Client, method: str, path: str) -> None:
    answer = client.request(method, path, json={} if method == "POST" else None)
    assert answer.status_code == 422
    if method != "HEAD":
        unknown = path.partition("?")[2].partition("=")[0]
        assert f"no query parameter {unknown!r}" in answer.json()["detail"]


def test_a_query_parameter_stands_there_once(client: httpx.Client) -> None:
    answer = client.get(f"{MODEL}/mesh?format=obj&latent=0.1,0.7,0.4&format=ply")
    assert answer.status_code == 422
    assert "'format' 2 times" in answer.json()["detail"]


def test_the_mesh_of_a_post_may_stand_in_the_query(client: httpx.Client) -> None:
    model = "/v1/models/with-fine"
    for path, body in (("mesh", {"latent": OK}), ("vertices", {"latents": [OK]})):
        asked = client.post(
            f"{model}/{path}?mesh=coarse&format=json" if path == "mesh" else f"{model}/{path}?mesh=coarse", json=body
        )
        told = client.post(f"{model}/{path}", params={"format": "json"}, json=body | {"mesh": "coarse"})
        assert asked.json() == told.json()
    answer = client.post(f"{model}/interpolations?mesh=coarse", json={"keyframes": [OK, OK], "frames": 2})
    assert len(client.get(answer.json()["links"]["jsonl"]).text.splitlines()) == 2
    coarse = client.get(f"{answer.json()['links']['self']}/frames/0?format=json").json()["vertices"]
    assert len(coarse) < len(client.get(f"{model}/mesh?format=json").json()["vertices"])
    edit = {"latent": OK, "targets": [{"vertex": len(coarse), "position": [0, 0, 0]}]}
    assert client.post(f"{model}/edit", json=edit).status_code == 200
    assert client.post(f"{model}/edit?mesh=coarse", json=edit).status_code == 422


def test_any_star_matches_nothing(client: httpx.Client) -> None:
    star = {"If-None-Match": "*"}
    assert client.post(f"{MODEL}/mesh", json={"latent": OK}, headers=star).status_code == 200
    assert client.get(f"{MODEL}/mesh?latent=0.1,1e30,0.4", headers=star).status_code in {200, 422}
    assert client.get(f"{MODEL}/mesh?latent=3.4e38,0,0", headers=star).status_code == 422


def test_answers_are_what_they_say(client: httpx.Client) -> None:
    for path in ("/", "/page/page.css", "/v1/models", "/nothing", f"{MODEL}/mesh"):
        assert client.get(path).headers["X-Content-Type-Options"] == "nosniff"


def test_a_problem_does_not_repeat_what_it_was_sent(client: httpx.Client) -> None:
    long = "x/" + "y" * 20_000
    for answer in (
        client.get(f"{MODEL}/mesh", headers={"Accept": long}),
        client.get(f"{MODEL}/mesh", params={"format": long}),
        client.get(f"{MODEL}/mesh", params={long: "1"}),
        client.get(f"/v1/models/{'y' * 20_000}"),
        client.post(f"{MODEL}/mesh", content=b"{}", headers={"Content-Type": long}),
        client.post(f"{MODEL}/mesh", json={"latent": OK, long: 1}),
        client.post(f"{MODEL}/mesh", content=b'{"latent":[1],"\\ud800":1}', headers=JSON),
    ):
        assert 400 <= answer.status_code < 500
        assert len(answer.content) < 6000


def test_an_accept_of_thousands_of_ranges_is_read_in_part(client: httpx.Client) -> None:
    many = ",".join(["a/b;q=0.1"] * 2500)
    assert client.get(f"{MODEL}/mesh", headers={"Accept": f"model/obj,{many}"}).headers["Content-Type"] == "model/obj"
    assert client.get(f"{MODEL}/mesh", headers={"Accept": f"{many},model/obj"}).status_code == 406
