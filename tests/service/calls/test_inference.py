"""The Open Inference Protocol, tested with Triton's client."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import tritonclient.http as triton
from tritonclient.utils import InferenceServerException

from shapespace import __version__
from shapespace.bundle.reader import read_bundle
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel
from shapespace.service.use_cases.many_shapes import (
    BYTES_PER_VERTEX,
    MOST_VERTICES,
    most_inferred,
    nric_size,
    shapes_size,
)
from tests.service.bundles import SCALE, expected_nric, reference, write_bundle
from tests.service.conftest import Server, Start
from tests.service.repository.test_bundles import flip_a_bit

CODES = np.array([[0.1, 0.7, 0.4], [0.0, -1.0, 0.2]], np.float32)
INFER = "/v2/models/small/infer"


@pytest.fixture
def inference(server: Server) -> Iterator[triton.InferenceServerClient]:
    client = triton.InferenceServerClient(server.url.removeprefix("http://"))
    yield client
    client.close()


def latent(codes: np.ndarray, *, binary: bool = True) -> triton.InferInput:
    tensor = triton.InferInput("latent", list(codes.shape), "FP32")
    tensor.set_data_from_numpy(codes, binary_data=binary)
    return tensor


def body(**changes: Any) -> dict[str, Any]:
    tensor = {"name": "latent", "shape": [2, 3], "datatype": "FP32", "data": CODES.ravel().tolist()}
    return {"inputs": [tensor | changes]}


def test_the_client_finds_server_and_models_as_they_are(inference: triton.InferenceServerClient) -> None:
    assert inference.is_server_live()
    assert inference.is_server_ready()
    assert inference.is_model_ready("small")
    assert inference.is_model_ready("small", "2")
    assert not inference.is_model_ready("small", "3")
    assert not inference.is_model_ready("large")
    assert inference.get_server_metadata() == {
        "name": "shapespace",
        "version": __version__,
        "extensions": ["binary_tensor_data", "model_configuration", "model_repository", "statistics"],
    }
    mesh = reference()
    expected = {
        "name": "small",
        "versions": ["1", "2", "10"],
        "platform": "shapespace",
        "inputs": [{"name": "latent", "datatype": "FP32", "shape": [-1, 3]}],
        "outputs": [
            {"name": "nric", "datatype": "FP32", "shape": [-1, 2 * len(mesh.edges)]},
            {"name": "vertices", "datatype": "FP32", "shape": [-1, len(mesh.vertices), 3]},
        ],
        "parameters": {"max_codes": 20, "max_body": 100_000, "deadline": 300},  # as the server's settings say
    }
    assert inference.get_model_metadata("small") == expected
    assert inference.get_model_metadata("small", "2") == expected


@pytest.mark.parametrize("binary_input", [True, False])
@pytest.mark.parametrize("binary_output", [True, False])
def test_it_infers_what_the_other_calls_answer(
    inference: triton.InferenceServerClient, client: httpx.Client, binary_input: bool, binary_output: bool
) -> None:
    outputs = [triton.InferRequestedOutput(name, binary_data=binary_output) for name in ("vertices", "nric")]
    answer = inference.infer(
        "small",
        [latent(CODES, binary=binary_input)],
        request_id="seven",
        outputs=outputs,
        request_compression_algorithm="gzip" if binary_input else "deflate",
        response_compression_algorithm="gzip",
    )
    response = answer.get_response()
    assert (response["model_name"], response["model_version"], response["id"]) == ("small", "10", "seven")
    assert [output["name"] for output in response["outputs"]] == ["vertices", "nric"]
    assert all(("data" not in output) is binary_output for output in response["outputs"])
    half = len(reference().edges)
    z = np.stack([expected_nric(code) for code in CODES])
    nric = answer.as_numpy("nric")
    assert nric.dtype == np.float32
    np.testing.assert_allclose(nric[:, :half], SCALE * z[:, :half], rtol=1e-5)
    np.testing.assert_allclose(nric[:, half:], z[:, half:], atol=1e-5)
    expected = client.post("/v1/models/small/vertices", json={"latents": CODES.tolist()}).json()["vertices"]
    np.testing.assert_array_equal(answer.as_numpy("vertices"), np.array(expected, np.float32))


def test_without_named_outputs_all_come_and_a_version_is_honoured(inference: triton.InferenceServerClient) -> None:
    answer = inference.infer("small", [latent(CODES)], model_version="2")
    assert answer.get_response()["model_version"] == "2"
    assert {output["name"] for output in answer.get_response()["outputs"]} == {"nric", "vertices"}
    only = inference.infer("small", [latent(CODES)], outputs=[triton.InferRequestedOutput("nric")])
    assert only.as_numpy("vertices") is None
    np.testing.assert_array_equal(only.as_numpy("nric"), answer.as_numpy("nric"))


def test_vertices_are_the_fine_meshs_unless_the_coarse_are_asked_for(
    inference: triton.InferenceServerClient, client: httpx.Client
) -> None:
    outputs = {output["name"]: output for output in inference.get_model_metadata("with-fine")["outputs"]}
    for mesh, parameters in (("fine", None), ("coarse", {"mesh": "coarse"})):
        found = inference.infer("with-fine", [latent(CODES)], parameters=parameters).as_numpy("vertices")
        asked = {"latents": CODES.tolist(), "mesh": mesh}
        expected = client.post("/v1/models/with-fine/vertices", json=asked).json()["vertices"]
        np.testing.assert_array_equal(found, np.array(expected, np.float32))
        assert (list(found.shape[1:]) == outputs["vertices"]["shape"][1:]) is (mesh == "fine")


def test_nested_rows_are_as_good_as_flat_ones(client: httpx.Client) -> None:
    flat = client.post(INFER, json=body()).raise_for_status()
    nested = client.post(INFER, json=body(data=CODES.tolist())).raise_for_status()
    assert flat.json() == nested.json()
    assert flat.headers["Content-Type"] == "application/json"
    assert "Inference-Header-Content-Length" not in flat.headers


def test_bounds_are_a_parameter(client: httpx.Client) -> None:
    outside = body(shape=[1, 3], data=[0.4, 0, 0.5])
    clamped = client.post(INFER, json=outside | {"parameters": {"bounds": "clamp"}}).raise_for_status().json()
    at_bound = client.post(INFER, json=body(shape=[1, 3], data=[0.2, 0, 0.5])).raise_for_status().json()
    assert clamped["outputs"] == at_bound["outputs"]
    refused = client.post(INFER, json=outside | {"parameters": {"bounds": "reject"}})
    assert refused.status_code == 422
    assert "Move it inside" in refused.json()["error"]


def test_its_exceptions_say_what_to_do(inference: triton.InferenceServerClient) -> None:
    with pytest.raises(InferenceServerException, match=r"\[422\].*Give exactly 3"):
        inference.infer("small", [latent(CODES[:, :2])])
    with pytest.raises(InferenceServerException, match=r"\[404\].*There is no model 'large'"):
        inference.infer("large", [latent(CODES)])
    with pytest.raises(InferenceServerException, match=r"\[422\].*finite"):
        inference.infer("small", [latent(CODES * np.nan)])
    with pytest.raises(InferenceServerException, match=r"\[422\].*limit is 20"):
        inference.infer("small", [latent(np.zeros((21, 3), np.float32))])
    with pytest.raises(InferenceServerException, match=r"\[404\].*has no version '3'"):
        inference.get_model_config("small", "3")


def test_the_client_finds_configuration_and_limits(inference: triton.InferenceServerClient) -> None:
    edges, vertices = len(reference().edges), len(reference().vertices)
    found = inference.get_model_config("small")
    assert found == inference.get_model_config("small", "1")
    assert found == {
        "name": "small",
        "platform": "shapespace",
        "version_policy": {"all": {}},
        "max_batch_size": 20,
        "input": [{"name": "latent", "data_type": "TYPE_FP32", "dims": [3]}],
        "output": [
            {"name": "nric", "data_type": "TYPE_FP32", "dims": [2 * edges]},
            {"name": "vertices", "data_type": "TYPE_FP32", "dims": [vertices, 3]},
        ],
    }


def test_the_most_codes_are_answered_and_one_more_is_not(small_models: Path, start: Start) -> None:
    url = start(small_models, max_codes=10**6, max_body=2**26).url
    with httpx.Client(base_url=url, timeout=120) as client:
        most = client.get("/v2/models/small").json()["parameters"]["max_codes"]
        model = ShapeModel(read_bundle(small_models / "small" / "10"), 1)
        assert most == most_inferred(model)
        both = nric_size(model, most) + shapes_size(model, most, MeshChoice.FINE)
        assert both <= BYTES_PER_VERTEX * MOST_VERTICES
        codes = np.zeros((most + 1, 3), np.float32)
        message = body(shape=[most + 1, 3], data=None, parameters={"binary_data_size": codes.nbytes})
        text = json.dumps(message).encode()
        headers = {"Inference-Header-Content-Length": str(len(text))}
        refused = client.post(INFER, content=text + codes.tobytes(), headers=headers)
        assert refused.status_code == 422
        assert refused.json()["type"] == "urn:shapespace:problem:too-many-codes"


def test_the_client_finds_what_is_in_the_folder_and_what_it_did(tmp_path: Path, start: Start) -> None:
    write_bundle(tmp_path, "small", "1")
    write_bundle(tmp_path, "small", "2")
    flip_a_bit(write_bundle(tmp_path, "broken", "7"))
    client = triton.InferenceServerClient(start(tmp_path).url.removeprefix("http://"))
    index = client.get_model_repository_index()
    assert [(model["name"], model["version"], model["state"]) for model in index] == [
        ("small", "1", "READY"),
        ("small", "2", "READY"),
        ("broken", "7", "UNAVAILABLE"),
    ]
    assert "refused" in index[2]["reason"]

    client.infer("small", [latent(CODES)])
    client.infer("small", [latent(CODES)], model_version="1")
    with pytest.raises(InferenceServerException, match="Give exactly 3"):
        client.infer("small", [latent(CODES[:, :2])], model_version="1")
    every = client.get_inference_statistics()["model_stats"]
    assert [(model["name"], model["version"]) for model in every] == [("small", "1"), ("small", "2")]
    assert client.get_inference_statistics("small")["model_stats"] == every
    (first,) = client.get_inference_statistics("small", "1")["model_stats"]
    assert first == every[0]
    assert (first["inference_count"], first["execution_count"]) == (2, 1)
    assert first["last_inference"] > 0
    times = first["inference_stats"]
    assert times["success"]["count"] == times["fail"]["count"] == times["compute_infer"]["count"] == 1
    assert times["compute_infer"]["ns"] > 0
    assert 0 < times["compute_output"]["ns"] < times["success"]["ns"]
    client.close()


def test_an_index_of_ready_models_leaves_refused_ones_out(client: httpx.Client) -> None:
    found = client.post("/v2/repository/index", json={"ready": True}).raise_for_status().json()
    assert {model["state"] for model in found} == {"READY"}
    assert client.post("/v2/repository/index", json={"ready": 1}).status_code == 422
    assert client.post("/v2/repository/index", content=b"{").status_code == 400


FAULTS: dict[str, tuple[Any, int, str]] = {
    "no JSON": ("{", 400, "Send one valid JSON object"),
    "NaN": ('{"inputs": [NaN]}', 422, "Send a JSON object for inputs[0]"),
    "two inputs": ({"inputs": 2 * body()["inputs"]}, 422, "1 or fewer entries for inputs, not 2"),
    "no input": ({"inputs": []}, 422, "1 or more entries for inputs"),
    "another input": (body(name="z"), 422, "Send 'latent' for inputs[0].name"),
    "doubles": (body(datatype="FP64"), 422, "Send 'FP32' for inputs[0].datatype"),
    "three dimensions": (body(shape=[2, 3, 1]), 422, "inputs[0].shape"),
    "a negative shape": (body(shape=[-2, -3]), 422, "at least 0 for inputs[0].shape[0]"),
    "too few numbers": (body(data=[1, 2, 3]), 422, "has 3 numbers, but its shape is [2, 3]. Send 6"),
    "many codes of no coordinate": (body(shape=[10**12, 0], data=[]), 422, "the limit is 20"),
    "an empty shape": (body(shape=[0, 3], data=[]), 422, "at least one code"),
    "rows of unequal length": (body(data=[[1, 2, 3, 4], [5, 6]]), 422, "2 rows of 2, 4 numbers, but the shape"),
    "one long row": (body(data=[[1, 2, 3, 4, 5, 6]]), 422, "1 rows of 6 numbers, but the shape of latent is [2, 3]"),
    "rows and columns exchanged": (body(data=[[1, 2], [3, 4], [5, 6]]), 422, "Send 2 rows of 3"),
    "rows beside numbers": (body(data=[1, 2, 3, [4, 5, 6]]), 422, "Send a number for inputs[0].data[3]"),
    "numbers as text": (body(data=["1", 2, 3, 4, 5, 6]), 422, "Send a number for inputs[0].data[0]"),
    "a boolean in shape": (body(shape=[True, 3], data=[1, 2, 3]), 422, "inputs[0].shape[0]"),
    "a text in shape": (body(shape=["2", 3]), 422, "whole number for inputs[0].shape[0]"),
    "NaN in data": (
        json.dumps(body(data=[[1, 2, 3], [4, 5, math.nan]])),
        422,
        "inputs[0].data[1][2] is NaN or infinite.",
    ),
    "a boolean in data": (body(data=[True, 2, 3, 4, 5, 6]), 422, "inputs[0].data"),
    "a boolean as a size": (body(data=None, parameters={"binary_data_size": True}), 422, "binary_data_size"),
    "no data": (body(data=None), 422, "either as data"),
    "an output twice": (body() | {"outputs": [{"name": "nric"}] * 2}, 400, "Name each output once"),
    "outputs without end": (body() | {"outputs": [{"name": "x"}] * 3}, 400, "Name each output once"),
    "another output": (body() | {"outputs": [{"name": "faces"}]}, 422, "'nric' or 'vertices' for outputs[0].name"),
    "another mesh": (body() | {"parameters": {"mesh": "both"}}, 422, "'fine' or 'coarse' for parameters.mesh"),
    "bytes that never come": (body(data=None, parameters={"binary_data_size": 24}), 422, "0 bytes follow"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_bad_requests_get_an_error_that_is_also_a_problem(client: httpx.Client, name: str) -> None:
    content, status, says = FAULTS[name]
    sent = {"content": content} if isinstance(content, str) else {"json": content}
    answer = client.post(INFER, **sent)
    assert answer.status_code == status
    assert says in answer.json()["error"]
    assert answer.json()["error"] == answer.json()["detail"]
    places = [error["pointer"] for error in answer.json().get("errors", ())]
    assert len(places) == len({*places}), "a fault is told once"
    assert answer.headers["Content-Type"] == "application/problem+json"


@pytest.mark.parametrize(
    ("length", "tail", "says"),
    [
        ("99999", b"", "Send the length of its JSON part"),
        ("-1", b"", "Send the length of its JSON part"),
        (None, b"\0" * 24, "one valid JSON object"),
        ("", b"\0" * 20, "20 bytes follow the JSON part, not 24"),
        ("", b"\0" * 28, "28 bytes follow the JSON part, not 24"),
    ],
)
def test_lengths_that_do_not_fit_are_refused(client: httpx.Client, length: str | None, tail: bytes, says: str) -> None:
    tensor = {"name": "latent", "shape": [2, 3], "datatype": "FP32", "parameters": {"binary_data_size": 24}}
    text = json.dumps({"inputs": [tensor]}).encode()
    headers = {} if length is None else {"Inference-Header-Content-Length": length or str(len(text))}
    answer = client.post(INFER, content=text + tail, headers=headers)
    assert answer.status_code in {400, 422}
    assert says in answer.json()["error"]
