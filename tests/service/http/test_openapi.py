"""The OpenAPI document: complete, with examples that work, and tested on the server by schemathesis."""

import json
import os
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import jsonschema
import pytest

from shapespace.service.http.openapi import TARGET, document
from tests.service.bundles import write_bundle
from tests.service.conftest import ROOT, Server, starting

DOCUMENT = json.loads(TARGET.read_text(encoding="utf-8"))
CALLS = {
    f"{method.upper()} {path}": call for path, calls in DOCUMENT["paths"].items() for method, call in calls.items()
}


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server of a model on which the examples work and that takes milliseconds a shape."""
    folder = tmp_path_factory.mktemp("described") / "models"
    write_bundle(folder, "freaky-torus", idle=1)
    with starting() as start:
        yield start(folder, workers=2)


def test_the_committed_description_is_what_the_application_generates(client: httpx.Client) -> None:
    assert TARGET.read_text(encoding="utf-8") == document(), "run `make openapi` and commit the result"
    assert client.get("/openapi.json").json() == DOCUMENT
    assert DOCUMENT["openapi"].startswith("3.1")


@pytest.mark.parametrize("name", CALLS)
def test_every_call_is_described_whole(name: str) -> None:
    call = CALLS[name]
    assert call["description"]
    assert call["tags"]
    for parameter in call.get("parameters", []):
        assert parameter["description"], parameter["name"]
    answers = call["responses"]
    assert [status for status in answers if status.startswith("2")]
    for status, answer in answers.items():
        if int(status) >= 400:
            assert list(answer["content"]) == ["application/problem+json"]
        elif status != "304":
            assert answer["content"]
            for media_type, content in answer["content"].items():
                assert content, f"{media_type} needs a schema"
    if "requestBody" in call:
        assert {"413", "422"} <= answers.keys()
        for media_type, content in call["requestBody"]["content"].items():
            if media_type == "application/json" and not name.endswith(("/encode", "/fit")):  # which take files
                assert examples(content), "a body in JSON needs an example"


def resolve(schema: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        found: dict[str, Any] = DOCUMENT["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
        return found
    return schema


def examples(content: dict[str, Any]) -> list[Any]:
    """The examples of a whole body, or one composed of examples of its members."""
    schema = resolve(content["schema"])
    named = [example["value"] for example in content.get("examples", {}).values()]
    parts = {name: part["examples"][0] for name, part in schema.get("properties", {}).items() if "examples" in part}
    return named or schema.get("examples") or ([parts] if parts else [])


def example(parameter: dict[str, Any]) -> Any:
    named = [example["value"] for example in parameter.get("examples", {}).values()]
    return (named or parameter["schema"].get("examples", []) or [None])[0]


def validator(schema: dict[str, Any]) -> jsonschema.Draft202012Validator:
    whole = json.loads(json.dumps(schema).replace("#/components/schemas/", "#/$defs/"))
    definitions = json.loads(json.dumps(DOCUMENT["components"]["schemas"]).replace("#/components/schemas/", "#/$defs/"))
    return jsonschema.Draft202012Validator(whole | {"$defs": definitions})


@pytest.mark.parametrize("name", CALLS)
def test_examples_are_as_described_and_answered_as_described(served: Server, name: str) -> None:
    call, (method, path) = CALLS[name], name.split(" ")
    parameters = call.get("parameters", [])
    with httpx.Client(base_url=served.url, timeout=120) as client:
        if path.startswith("/v1/interpolations/"):
            body = {"keyframes": [[0, 0, 0, 0], [0.1, 0.2, 0.3, 0.4]], "frames": 3}
            id = client.post("/v1/models/freaky-torus/interpolations", json=body).json()["id"]
            path = path.format(id=id, k=1)
        given = {parameter["name"]: example(parameter) for parameter in parameters if parameter["in"] == "path"}
        path = path if "interpolations/" in path else path.format(**given)
        contents = call.get("requestBody", {}).get("content", {})
        bodies = examples(contents["application/json"]) if "application/json" in contents else [None]
        if path.endswith(("/encode", "/fit")):
            bodies = [client.get("/v1/models/freaky-torus/mesh?latent=0.1,0.2,0.3,0.4&format=json").json()]
        for body in bodies:
            if body is not None:
                validator(contents["application/json"]["schema"]).validate(body)
            answer = client.request(method, path, json=body)
            described = call["responses"][str(answer.status_code)]
            # The model of the examples has an angle and no decoder: 422 and 404. Other tests use the figure.
            assert answer.is_success or path.endswith(("/blendshapes", "/decoder.onnx")), answer.text
            media_type = answer.headers["Content-Type"].partition(";")[0]
            if media_type == "application/json":
                validator(described["content"][media_type]["schema"]).validate(answer.json())
            assert media_type in described["content"]


def test_schemathesis_finds_nothing(served: Server, tmp_path: Path) -> None:
    """All checks of schemathesis on every call; `make long fuzz-api` uses more examples, each time new ones."""
    count = os.environ.get("FUZZ_EXAMPLES")
    share = ["--max-examples", count or "10"]
    if not count:
        share += ["--phases", "examples,fuzzing,stateful", "--generation-deterministic"]
    found = subprocess.run(
        ["schemathesis", "run", f"{served.url}/openapi.json", "--no-color", *share],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(ROOT), "HYPOTHESIS_STORAGE_DIRECTORY": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert found.returncode == 0, found.stdout + found.stderr
    cases = re.search(r"(\d+) generated", found.stdout)
    assert cases, found.stdout
    assert int(cases[1]) >= (1000 if count else 200)
