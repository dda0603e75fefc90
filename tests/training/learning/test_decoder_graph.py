"""``decoder.onnx`` is added to bundles, stores integers exactly, and is not too large."""

import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

import shapespace
from shapespace.bundle.reader import read_bundle
from shapespace.bundle.schema import MANIFEST
from shapespace.training.learning import decoder_graph as graphs
from shapespace.training.learning.graph_storage import FixedPoint, Narrowing, tidy
from tests.service.bundles import seal
from tests.shapespace.torch.conftest import tiny  # noqa: F401
from tests.shapespace.torch.test_layer import away
from tests.training.conftest import Said


def test_export_adds_the_graph_to_a_bundle_of_version_0_2(
    tiny: Path,  # noqa: F811
    tmp_path: Path,
    said: Said,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The bundle has two components, one with a boundary, and an attached rigid part."""
    folder = shutil.copytree(tiny, tmp_path / "models/tiny/1")
    facts = json.loads((folder / MANIFEST).read_text())
    new = ("decoder", "without_decoder", "exponential_first_step")
    (folder / MANIFEST).write_text(json.dumps({name: facts[name] for name in facts if name not in new}))
    (folder / "README.md").unlink()
    seal(folder)
    assert read_bundle(folder).manifest.decoder is None
    assert "has decoder.onnx now" in said("export", folder)
    model, bundle = shapespace.load(folder), read_bundle(folder)
    entry, codes = bundle.manifest.decoder, model.sample(4, seed=1)
    content = bundle.networks["decoder.onnx"]
    assert entry is not None
    assert entry.error <= 1.4e-5
    assert away(model, graphs._answer(content, codes)[0], codes) < 2e-5
    opset = [(each.domain, each.version) for each in onnx.load_model_from_string(content).opset_import]
    assert opset == [("", 18)]

    # A graph that is larger than the rest of the bundle is left out, unless both are small.
    size, rest = len(content), sum(file.bytes for file in bundle.manifest.files.values()) - len(content)
    assert graphs._too_large(bundle, size) is None
    monkeypatch.setattr(graphs, "SMALL", 0)
    assert graphs._too_large(bundle, rest) is None
    assert "more than the rest of the bundle" in graphs._too_large(bundle, rest + 1)
    monkeypatch.setattr(graphs, "MANY_VERTICES", 10)
    assert graphs._too_large(bundle, rest + 1) is None
    assert "more than 64.0 MiB" in graphs._too_large(bundle, 2**26 + 1)


@pytest.mark.parametrize("shape", [(37, 29), (40, 3)])
def test_matrices_of_16_and_20_bits_are_rounded_and_stored(shape: tuple[int, int]) -> None:
    matrix = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    for bits, bound in ((16, 2e-4), (20, 1.2e-5)):
        graph = product(np.zeros((1, 1), np.float32), "m")
        tensor = onnx.numpy_helper.from_array(matrix, "m")
        graph.initializer.append(tensor)
        rounded = FixedPoint.of(matrix, bits)
        rounded.store(graph, tensor)
        stored = sum(len(each.raw_data) for each in graph.initializer if each.data_type == TensorProto.INT8)
        assert stored == (bits * matrix.size + 7) // 8
        found = run(graph)
        assert np.array_equal(found, rounded.values)
        assert np.abs(found - matrix).max() < bound


def test_integers_of_networks_are_stored_in_bytes() -> None:
    whole = np.array([[-32768, -129, -128, 0, 127, 128, 32767]], np.int16)
    for kind in (TensorProto.FLOAT, TensorProto.DOUBLE):
        graph = product(whole, "wide", kind)
        graph.node.insert(0, helper.make_node("Cast", ["whole"], ["wide"], to=kind))
        graph.initializer[0].name = "whole"
        tidy(graph)
        assert {each.data_type for each in graph.initializer} == {TensorProto.INT8, kind}
        assert np.array_equal(run(graph), whole)


def test_fewer_bits_are_saved_where_less_is_allowed() -> None:
    graph = product(np.random.default_rng(0).normal(size=(40, 40)).astype(np.float32), "m")
    narrowing = Narrowing(graph, {"m": 1e-5})
    sizes = [len(narrowing.within(allowed).SerializeToString()) for allowed in (2e-5, 2e-6, 0)]
    assert sizes == sorted(sizes)
    assert len(set(sizes)) == 3
    assert {each.data_type for each in narrowing.within(0).initializer} == {TensorProto.FLOAT}


def product(array: np.ndarray, name: str, kind: int = TensorProto.FLOAT) -> onnx.GraphProto:
    """A graph whose output is an array."""
    output = helper.make_tensor_value_info("y", kind, ["r", "c"])
    array_of = [onnx.numpy_helper.from_array(array, name)] if array.size > 1 else []
    return helper.make_graph([helper.make_node("Identity", [name], ["y"])], "graph", [], [output], array_of)


def run(graph: onnx.GraphProto) -> np.ndarray:
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    return graphs._session(model.SerializeToString()).run(None, {})[0]
