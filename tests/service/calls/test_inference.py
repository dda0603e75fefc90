"""The Open Inference Protocol, tested with Triton's client."""

import json
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
import tritonclient.http as triton
from tritonclient.utils import InferenceServerException

from shapespace import __version__
from tests.service.bundles import SCALE, expected_nric, reference
from tests.service.conftest import Server

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
        "extensions": ["binary_tensor_data"],
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
    with pytest.raises(InferenceServerException, match=r"\[422\].*Send exactly 3"):
        inference.infer("small", [latent(CODES[:, :2])])
    with pytest.raises(InferenceServerException, match=r"\[404\].*There is no model 'large'"):
        inference.infer("large", [latent(CODES)])
    with pytest.raises(InferenceServerException, match=r"\[422\].*finite"):
        inference.infer("small", [latent(CODES * np.nan)])
    with pytest.raises(InferenceServerException, match=r"\[422\].*limit is 20"):
        inference.infer("small", [latent(np.zeros((21, 3), np.float32))])
    with pytest.raises(InferenceServerException, match=r"\[404\].*Nothing answers at /v2/models/small/config"):
        inference.get_model_config("small")


FAULTS: dict[str, tuple[Any, int, str]] = {
    "no JSON": ("{", 400, "Send one valid JSON object"),
    "NaN": ('{"inputs": [NaN]}', 422, "Send a JSON object for inputs[0]"),
    "no input": ({"inputs": []}, 422, "at least 1 entries for inputs"),
    "another input": (body(name="z"), 422, "Send 'latent' for inputs[0].name"),
    "doubles": (body(datatype="FP64"), 422, "Send 'FP32' for inputs[0].datatype"),
    "three dimensions": (body(shape=[2, 3, 1]), 422, "inputs[0].shape"),
    "a negative shape": (body(shape=[-2, -3]), 422, "at least 0 for inputs[0].shape[0]"),
    "too few numbers": (body(data=[1, 2, 3]), 422, "has 3 numbers, but its shape is [2, 3]. Send 6"),
    "many codes of no coordinate": (body(shape=[10**12, 0], data=[]), 422, "the limit is 20"),
    "an empty shape": (body(shape=[0, 3], data=[]), 422, "at least one code"),
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
