"""A bundle's ``decoder.onnx`` is checked when the bundle is read: file, names, axes, then values."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import DECODER, DecoderEntry
from shapespace.bundle.writer import ExportedDecoder, amend_bundle
from tests.service.bundles import reference, seal, write_bundle


def linear() -> onnx.ModelProto:
    """A graph from codes to vertices and a misfit, by one product."""
    count = len(reference().vertices)
    nodes = [
        helper.make_node("MatMul", ["latent", "weights"], ["flat"]),
        helper.make_node("Reshape", ["flat", "shape"], ["vertices"]),
        helper.make_node("ReduceMax", ["flat", "axes"], ["misfit"], keepdims=0),
    ]
    arrays = {
        "weights": np.ones((3, 3 * count), np.float32),
        "shape": np.array([-1, count, 3]),
        "axes": np.array([1]),
    }
    graph = helper.make_graph(
        nodes,
        "decoder",
        [helper.make_tensor_value_info("latent", TensorProto.FLOAT, ["n", 3])],
        [
            helper.make_tensor_value_info("vertices", TensorProto.FLOAT, ["n", count, 3]),
            helper.make_tensor_value_info("misfit", TensorProto.FLOAT, ["n"]),
        ],
        [numpy_helper.from_array(array, name) for name, array in arrays.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.checker.check_model(model, full_check=True)
    return model


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A bundle with this graph."""
    path = write_bundle(tmp_path / "models")
    assert read_bundle(path).manifest.decoder is None
    entry = DecoderEntry(file=DECODER, input="latent", vertices="vertices", misfit="misfit", error=1e-5)
    amend_bundle(path, ExportedDecoder(linear().SerializeToString(), entry))
    assert read_bundle(path).manifest.decoder == entry
    return path


def other_output(model: onnx.ModelProto) -> None:
    model.graph.node[1].output[0] = model.graph.output[0].name = "points"


def other_axes(model: onnx.ModelProto) -> None:
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value += 1


def other_latents(model: onnx.ModelProto) -> None:
    model.graph.input[0].type.tensor_type.shape.dim[1].dim_value = 4


def not_finite(model: onnx.ModelProto) -> None:
    weights = numpy_helper.to_array(model.graph.initializer[0]).copy()
    weights[0, 0] = np.nan
    model.graph.initializer[0].CopyFrom(numpy_helper.from_array(weights, "weights"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (other_output, r"decoder\.onnx must have the outputs vertices, misfit, not points, misfit"),
        (other_axes, r"decoder\.onnx: vertices must be float32 \['n', 64, 3\]"),
        (other_latents, r"decoder\.onnx: latent must be float32 \['n', 3\]"),
        (not_finite, r"decoder\.onnx"),
    ],
)
def test_a_bad_decoder_is_refused(folder: Path, change: Callable[[onnx.ModelProto], None], message: str) -> None:
    model = linear()
    change(model)
    (folder / DECODER).write_bytes(model.SerializeToString())
    seal(folder)
    with pytest.raises(BundleError, match=message):
        read_bundle(folder)


@pytest.mark.parametrize("content", [b"", b"no graph"])
def test_a_damaged_or_missing_decoder_is_refused(folder: Path, content: bytes) -> None:
    (folder / DECODER).write_bytes(content) if content else (folder / DECODER).unlink()
    with pytest.raises((BundleError, FileNotFoundError), match=r"decoder\.onnx"):
        read_bundle(folder)
    if content:
        seal(folder)
        with pytest.raises(BundleError, match=r"decoder\.onnx is not a readable ONNX file"):
            read_bundle(folder)
