"""The memory of training shapes: left out by ``examples=false``, and without jerks on paths between training shapes."""

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import httpx
import numpy as np
import onnx
import pytest

from shapespace.bundle.reader import read_bundle
from shapespace.coordinates.nric import WeightedNorm
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.shape import Quality
from shapespace.model.shape_model import ShapeModel, load
from shapespace.service.use_cases.animation import Animation
from tests.service.conftest import ROOT

MODEL = "/v1/models/figure"


@pytest.fixture(scope="module")
def figure() -> ShapeModel:
    return load(ROOT / "models" / "figure")


def training_codes(model: ShapeModel | Decoder) -> np.ndarray:
    decoder = model.decoder if isinstance(model, ShapeModel) else model
    assert decoder.training_codes is not None
    return decoder.training_codes.astype(np.float32)


def get(client: httpx.Client, link: str, **query: Any) -> tuple[np.ndarray, str]:
    answer = client.get(link, params={"format": "json", **query}).raise_for_status()
    return np.float32(answer.json()["vertices"]), answer.headers["ETag"]


def test_a_shape_comes_without_the_memory_of_training_shapes(client: httpx.Client, figure: ShapeModel) -> None:
    code = training_codes(figure)[1]
    latent = ",".join(map(str, code.tolist()))
    whole, tag = get(client, f"{MODEL}/mesh", latent=latent, mesh="coarse")
    plain, other = get(client, f"{MODEL}/mesh", latent=latent, mesh="coarse", examples="false")
    assert tag != other
    assert np.abs(whole - plain).max() > 1e-3
    assert np.array_equal(plain, np.float32(figure.decode(code, "coarse", examples=False)))
    for body, query in (({"examples": False}, {}), ({"examples": True}, {"examples": "false"})):
        sent = {"latent": code.tolist(), "mesh": "coarse", **body}
        answer = client.post(f"{MODEL}/mesh", json=sent, params={"format": "json", **query})
        assert np.array_equal(np.float32(answer.raise_for_status().json()["vertices"]), plain)
    assert client.get(f"{MODEL}/mesh", params={"examples": "some"}).status_code == 422


def test_a_model_that_remembers_nothing_answers_the_same(client: httpx.Client) -> None:
    answers = [get(client, "/v1/models/small/mesh", latent="0.1,0.5,0", examples=each) for each in ("true", "false")]
    assert np.array_equal(answers[0][0], answers[1][0])
    assert answers[0][1] == answers[1][1]


def test_frames_come_without_the_memory_of_training_shapes(client: httpx.Client, figure: ShapeModel) -> None:
    a, b = training_codes(figure)[[1, 2]].tolist()
    body = {"keyframes": [a, b], "frames": 3, "mesh": "coarse"}
    made = [client.post(f"{MODEL}/interpolations", json={**body, "examples": each}).json() for each in (True, False)]
    assert made[0]["id"] == client.post(f"{MODEL}/interpolations", json=body).json()["id"] != made[1]["id"]
    found, tags = [], set()
    for link, query in ((made[0], {}), (made[1], {}), (made[0], {"examples": "false"})):
        whole = client.get(link["links"]["self"], params={"format": "npz", **query}).raise_for_status()
        tags.add(whole.headers["ETag"])
        with np.load(io.BytesIO(whole.content)) as arrays:
            packed, codes = arrays["vertices"], arrays["latents"]
        alone = [get(client, link["links"]["frames"].format(k=k), **query) for k in range(3)]
        assert np.array_equal([vertices for vertices, _ in alone], packed)
        tags |= {tag for _, tag in alone}
        found.append(packed)
    whole, plain, same = found
    assert len(tags) == 3 + 3 + 3, "frames without the memory have one tag, wherever the choice was made"
    assert np.array_equal(plain, same)
    for k, code in enumerate(codes):
        assert np.array_equal(np.float32(figure.decode(code, "coarse", examples=False)), plain[k])
    # Keyframes are as single shapes.
    for k in (0, 2):
        assert np.array_equal(np.float32(figure.decode(codes[k], "coarse")), whole[k])
    assert np.abs(whole[1] - plain[1]).max() > 1e-4


@pytest.mark.parametrize("quality", ["auto", "draft", "full"])
def test_a_frame_has_the_same_bytes_alone_and_beside_others(
    client: httpx.Client, figure: ShapeModel, quality: str
) -> None:
    a, b, c = training_codes(figure)[[1, 2, 3]].tolist()
    body = {"keyframes": [a, b, c], "frames": 14, "mesh": "coarse"}
    links = client.post(f"{MODEL}/interpolations", json=body).json()["links"]
    whole = client.get(links["self"], params={"format": "npz", "quality": quality}).raise_for_status()
    with np.load(io.BytesIO(whole.content)) as arrays:
        packed = arrays["vertices"]
    with client.stream("GET", links["self"], params={"format": "jsonl", "quality": quality}) as stream:
        lines = [np.float32(json.loads(line)["vertices"]) for line in stream.iter_lines()]
    assert np.array_equal(lines, packed)
    alone = [get(client, links["frames"].format(k=k), quality=quality) for k in range(14)]
    assert np.array_equal([vertices for vertices, _ in alone], packed)


def test_frames_at_one_place_in_other_rows_have_tags_of_their_own(client: httpx.Client, figure: ShapeModel) -> None:
    a, b = training_codes(figure)[[1, 2]].tolist()
    tags: dict[str, list[str]] = {"auto": [], "full": []}
    for frames, k in ((3, 1), (5, 2)):
        links = client.post(f"{MODEL}/interpolations", json={"keyframes": [a, b], "frames": frames}).json()["links"]
        for quality, found in tags.items():
            found.append(get(client, links["frames"].format(k=k), quality=quality)[1])
    assert tags["auto"][0] != tags["auto"][1]
    assert tags["full"][0] == tags["full"][1]


def strengthened(factor: float) -> Decoder:
    """The figure with a memory that corrects so many times as much."""
    bundle = read_bundle(ROOT / "models/figure/4")
    file = bundle.manifest.combiner.file
    model = onnx.load_model_from_string(bundle.networks[file])
    graph = model.graph
    (product,) = (node for node in graph.node if node.op_type == "MatMul" and node.input[1] == "weights")
    larger = onnx.helper.make_node("Mul", [product.input[0], "test.factor"], ["test.larger"])
    graph.initializer.append(onnx.numpy_helper.from_array(np.float32([[factor]]), "test.factor"))
    graph.node.insert([*graph.node].index(product), larger)
    product.input[0] = "test.larger"
    return Decoder(replace(bundle, networks={**bundle.networks, file: model.SerializeToString()}))


def pairs(decoder: Decoder, count: int) -> Iterator[Animation]:
    """Paths of 30 frames between training shapes."""
    codes, rng = training_codes(decoder), np.random.default_rng(0)
    for _ in range(count):
        yield Animation(keyframes=codes[rng.choice(len(codes), 2, replace=False)].tolist(), frames=30)


def jerk(steps: np.ndarray) -> float:
    """Largest change of the speed from a frame to the next, as a share of its mean."""
    speeds = np.linalg.norm(steps, axis=-1)
    speeds = speeds.mean(axis=1) if speeds.ndim == 2 else speeds
    return float(np.abs(np.diff(speeds)).max() / speeds.mean())


def test_paths_between_training_shapes_have_an_even_speed(figure: ShapeModel) -> None:
    decoder = figure.decoder
    for path in pairs(decoder, 20):
        codes, inside = decoder.latents.codes(path.codes(decoder.latents))
        memory = path.memory(decoder.latents)
        shapes = decoder.shapes(codes, inside, MeshChoice.COARSE, None, Quality.DRAFT, memory)
        assert jerk(np.diff([shape.vertices for shape in shapes], axis=0)) < 0.04


def test_a_strong_memory_fades_evenly() -> None:
    decoder = strengthened(4)
    weights = np.sqrt(WeightedNorm.of(decoder.reference, 1e-2).squared)
    plain, fading = [], []
    for path in pairs(decoder, 6):
        codes, _ = decoder.latents.codes(path.codes(decoder.latents))
        for memory, found in ((True, plain), (path.memory(decoder.latents), fading)):
            found.append(jerk(np.diff(decoder.targets(codes, memory) * weights, axis=0)))
    assert max(plain) > 0.2, "the test needs a memory that jerks"
    assert max(fading) < 0.04
