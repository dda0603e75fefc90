"""``decoder.onnx``: the whole way from a code to the vertices of a draft, as one graph for any ONNX runtime.

PyTorch exports the way from lengths and angles to vertices (`shapespace.torch`). The networks stay the nodes of their
own files, so their numbers are the same as the server's.
"""

from __future__ import annotations

import logging
import warnings
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.bundle.reader import Bundle
from shapespace.bundle.schema import DECODER, DecoderEntry
from shapespace.bundle.writer import ExportedDecoder
from shapespace.model.decoder import Decoder
from shapespace.model.latent_space import Codes, Distribution
from shapespace.model.shape import Quality
from shapespace.torch.layer import VerticesFromNRIC
from shapespace.training.learning import ExportError
from shapespace.training.learning.graph_storage import Narrowing, Trial, rename, tidy, wide_matrices

#: The operator set of exported files.
OPSET = 18
#: Names of input and outputs.
LATENT, VERTICES, MISFIT = "latent", "vertices", "misfit"
#: Number of random codes at which the graph is compared with drafts.
CODES = 150
#: Number of these codes at which each narrow array is tried.
TRIED = 12
#: Largest distance from a draft in diagonals. An export measures less, since other codes and runtimes differ more.
TOLERANCE, MEASURED = 2e-5, 1.4e-5
#: Share of this distance that narrow arrays may cause, and the factor by which it falls until the measured one is met.
NARROWING, FALL = 1.3e-5, 0.75
#: Size in bytes up to which a graph may be larger than the rest of its bundle.
SMALL = 8 * 2**20
#: Number of coarse vertices above which another limit holds, in bytes.
MANY_VERTICES, LARGEST = 3000, 64 * 2**20


def decoder_graph(bundle: Bundle, decoder: Decoder) -> ExportedDecoder:
    """Make the graph of a bundle, and compare it with drafts of its decoder. Raises ExportError if they differ."""
    codes, drafts = _drafts(decoder)
    size = decoder.manifest.scale * (bundle.fine.reference if bundle.fine else bundle.reference).diagonal
    model = _joined(bundle)
    tidy(model.graph)
    narrowing = Narrowing.of(model.graph, size, _trial(model.graph, codes[:TRIED])) if len(codes) else None
    allowed = NARROWING
    while True:
        content = _content(model, narrowing.within(allowed) if narrowing else model.graph)
        error = float(np.linalg.norm(_answer(content, codes)[0] - drafts, axis=2).max(initial=0)) / size
        if error <= MEASURED or not allowed:
            break
        allowed = FALL * allowed if allowed > NARROWING / 16 else 0.0
    if not error <= TOLERANCE:
        raise ExportError(f"{DECODER} is up to {error:.1e} of the diagonal away from drafts, not {TOLERANCE:.0e}")
    if absent := _too_large(bundle, len(content)):
        return ExportedDecoder(None, None, absent)
    return ExportedDecoder(
        content, DecoderEntry(file=DECODER, input=LATENT, vertices=VERTICES, misfit=MISFIT, error=error)
    )


def _too_large(bundle: Bundle, size: int) -> str | None:
    """Say why a graph of some bytes is left out; None if it is not."""
    rest = sum(file.bytes for name, file in bundle.manifest.files.items() if name != DECODER)
    if bundle.manifest.vertices > MANY_VERTICES:
        return f"{DECODER} would have {_mib(size)}, more than {_mib(LARGEST)}" if size > LARGEST else None
    if size > max(rest, SMALL):
        return f"{DECODER} would have {_mib(size)}, more than the rest of the bundle, which has {_mib(rest)}"
    return None


def _mib(size: int) -> str:
    return f"{size / 2**20:.1f} MiB"


def _content(model: onnx.ModelProto, graph: onnx.GraphProto) -> bytes:
    """Return the file with a graph in place of the model's."""
    other = helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)
    rename(other.graph)
    onnx.checker.check_model(other, full_check=True)
    return bytes(other.SerializeToString())


def _trial(graph: onnx.GraphProto, codes: Codes) -> Trial:
    """Make a session that computes the vertices of some codes with other matrices."""
    # An initialiser that is also an input can be overridden, so that one session tries all.
    trial = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=10)
    for tensor in wide_matrices(graph).values():
        trial.graph.input.append(helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims))
    session = _session(trial.SerializeToString())
    return lambda others: session.run([VERTICES], {LATENT: codes, **others})[0]


def _drafts(decoder: Decoder) -> tuple[Codes, FloatArray]:
    """Return random codes that have drafts, and the vertices of these."""
    codes = decoder.latents.sample(CODES, 1, Distribution.UNIFORM)
    shapes = [decoder.shape(code, quality=Quality.DRAFT) for code in codes]
    found = [k for k, shape in enumerate(shapes) if shape.diagnostics.quality is Quality.DRAFT]
    empty = np.zeros((0, *decoder.reference_shape().vertices.shape))
    return codes[found], np.stack([shapes[k].vertices for k in found]) if found else empty


def exported(module: nn.Module, example: Tensor, inputs: list[str], outputs: list[str]) -> onnx.ModelProto:
    """Export a module by PyTorch, with a free batch size, and without facts about this machine."""
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    # Without gradients, networks compute by plain gathers and sums, which exist in ONNX.
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program: Any = torch.onnx.export(
            module.eval(),
            (example,),
            input_names=inputs,
            output_names=outputs,
            dynamic_shapes=({0: torch.export.Dim("n", min=1)},),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    model: onnx.ModelProto = program.model_proto
    # The metadata of every node contain paths of the exporting machine's source files.
    for node in model.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    for value in (*model.graph.input, *model.graph.output, *model.graph.value_info):
        value.ClearField("metadata_props")
    model.ClearField("metadata_props")
    return model


def _joined(bundle: Bundle) -> onnx.ModelProto:
    """Join the networks of a bundle with the way from lengths and angles to vertices."""
    manifest = bundle.manifest
    example = torch.zeros(2, 2 * manifest.edges)
    geometry = exported(VerticesFromNRIC(bundle, torch.float32), example, ["nric"], [VERTICES, MISFIT])
    nodes: list[onnx.NodeProto] = []
    tensors = [numpy_helper.from_array(np.array([1]), "one")]
    for j, factor in enumerate(manifest.factors):
        bounds = {f"{j}.start": factor.start, f"{j}.stop": factor.stop}
        tensors += [numpy_helper.from_array(np.array([value]), name) for name, value in bounds.items()]
        nodes.append(helper.make_node("Slice", [LATENT, *bounds, "one"], [f"{j}.part"]))
        _append(
            nodes,
            tensors,
            bundle.networks[factor.file],
            f"{j}/",
            {factor.input: f"{j}.part"},
            {factor.output: f"{j}.z"},
        )
        nodes.append(helper.make_node("Unsqueeze", [f"{j}.z", "one"], [f"{j}.row"]))
    rows = [f"{j}.row" for j in range(len(manifest.factors))]
    nodes.append(helper.make_node("Concat", rows, ["factors"], axis=1))
    combiner = manifest.combiner
    content = bundle.networks[combiner.file]
    _append(nodes, tensors, content, "combiner/", {combiner.input: "factors"}, {combiner.output: "z"})
    names = {VERTICES: VERTICES, MISFIT: MISFIT}
    _append(nodes, tensors, geometry.SerializeToString(), "geometry/", {"nric": "z"}, names)
    finest = bundle.fine.reference if bundle.fine else bundle.reference
    graph = helper.make_graph(
        nodes,
        "decoder",
        [helper.make_tensor_value_info(LATENT, TensorProto.FLOAT, ["n", manifest.latent_dimension])],
        [
            helper.make_tensor_value_info(VERTICES, TensorProto.FLOAT, ["n", len(finest.vertices), 3]),
            helper.make_tensor_value_info(MISFIT, TensorProto.FLOAT, ["n"]),
        ],
        tensors,
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=geometry.ir_version)


def _append(
    nodes: list[onnx.NodeProto],
    tensors: list[TensorProto],
    content: bytes,
    prefix: str,
    inputs: dict[str, str],
    outputs: dict[str, str],
) -> None:
    """Append the nodes and tensors of a model, whose names get a prefix except for inputs and outputs."""
    model = onnx.load_model_from_string(content)
    if [(each.domain, each.version) for each in model.opset_import] != [("", OPSET)]:
        model = onnx.version_converter.convert_version(model, OPSET)
    names = inputs | outputs

    def renamed(name: str) -> str:
        return names.get(name, prefix + name) if name else name

    for tensor in model.graph.initializer:
        tensor.name = renamed(tensor.name)
        tensors.append(tensor)
    for node in model.graph.node:
        node.input[:] = map(renamed, node.input)
        node.output[:] = map(renamed, node.output)
        node.name = ""
        nodes.append(node)


def _session(content: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])


def _answer(content: bytes, codes: Codes) -> list[NDArray]:
    session = _session(content)
    if not len(codes):
        return [np.zeros((0, 1, 3)), np.zeros(0)]
    # One code at a time takes less memory.
    found = [session.run([VERTICES, MISFIT], {LATENT: code[None]}) for code in codes]
    return [np.concatenate(parts) for parts in zip(*found, strict=True)]
