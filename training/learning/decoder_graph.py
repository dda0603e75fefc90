"""``decoder.onnx``: the whole way from a code to the vertices of a draft, as one graph for any ONNX runtime.

PyTorch exports the way from lengths and angles to vertices (`shapespace.torch`). The networks stay the nodes of their
own files, so their numbers are the same as the server's.
"""

from __future__ import annotations

import itertools
import logging
import string
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
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

#: The operator set of exported files.
OPSET = 18
#: Names of input and outputs.
LATENT, VERTICES, MISFIT = "latent", "vertices", "misfit"
#: Number of random codes at which the graph is compared with drafts.
CODES = 12
#: Number of these codes at which arrays of 16 bits are tried.
TRIED = 6
#: Largest distance from a draft, and share of it that arrays of 16 bits may cause; in diagonals.
TOLERANCE, NARROWING = 2e-5, 1.3e-5
#: Fewest entries of a matrix that is stored in 16 bits.
NARROWED_SIZE = 1024
#: Number of coarse vertices above which a graph may be left out, and the largest graph in bytes.
MANY_VERTICES, LARGEST = 3000, 64 * 2**20


def decoder_graph(bundle: Bundle, decoder: Decoder) -> ExportedDecoder:
    """Make the graph of a bundle, and compare it with drafts of its decoder. Raises ExportError if they differ."""
    codes, drafts = _drafts(decoder)
    size = decoder.manifest.scale * (bundle.fine.reference if bundle.fine else bundle.reference).diagonal
    model = _joined(bundle)
    _short_indices(model.graph)
    _share(model.graph)
    if len(codes):
        _narrow(model.graph, codes[:TRIED], size)
    _split_integers(model.graph)
    _rename(model.graph)
    onnx.checker.check_model(model, full_check=True)
    content = bytes(model.SerializeToString())
    if len(content) > LARGEST and len(bundle.reference.vertices) > MANY_VERTICES:
        return ExportedDecoder(None, None, f"{DECODER} would have {len(content) >> 20} MiB")
    error = float(np.linalg.norm(_answer(content, codes)[0] - drafts, axis=2).max(initial=0)) / size
    if not error <= TOLERANCE:
        raise ExportError(f"{DECODER} is up to {error:.1e} of the diagonal away from drafts, not {TOLERANCE:.0e}")
    return ExportedDecoder(
        content, DecoderEntry(file=DECODER, input=LATENT, vertices=VERTICES, misfit=MISFIT, error=error)
    )


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


def _short_indices(graph: onnx.GraphProto) -> None:
    """Store the indices of gathers in 16 bits where they are small, and in 32 bits elsewhere."""
    users: dict[str, set[tuple[str, int]]] = {}
    for node in reversed(graph.node):
        for k, name in enumerate(node.input):
            # A network may bring an index into another form before.
            through = users.get(node.output[0], set()) if (node.op_type, k) == ("Reshape", 0) else {(node.op_type, k)}
            users.setdefault(name, set()).update(through)
    for tensor in list(graph.initializer):
        if tensor.data_type != TensorProto.INT64 or users.get(tensor.name) != {("Gather", 1)}:
            continue
        name, values = tensor.name, numpy_helper.to_array(tensor)
        if values.size >= NARROWED_SIZE and np.abs(values).max() <= FixedPoint.MOST:
            graph.initializer.remove(tensor)
            for node in reversed(_from_bytes(graph, values, name, name, TensorProto.INT32)):
                graph.node.insert(0, node)
        elif np.abs(values).max(initial=0) < 2**31:
            tensor.CopyFrom(numpy_helper.from_array(values.astype(np.int32), name))


def _share(graph: onnx.GraphProto) -> None:
    """Keep one of several equal arrays: every network has the means and weights of all lengths and angles."""
    first: dict[tuple[int, tuple[int, ...], bytes], str] = {}
    same = {}
    for tensor in graph.initializer:
        key = (tensor.data_type, tuple(tensor.dims), numpy_helper.to_array(tensor).tobytes())
        same[tensor.name] = first.setdefault(key, tensor.name)
    for tensor in [tensor for tensor in graph.initializer if same[tensor.name] != tensor.name]:
        graph.initializer.remove(tensor)
    for node in graph.node:
        node.input[:] = [same.get(name, name) for name in node.input]


def _narrow(graph: onnx.GraphProto, codes: Codes, size: float) -> None:
    """Store matrices in 16 bits, as many as move no vertex by more than `NARROWING` together."""
    wide = {tensor.name: tensor for tensor in graph.initializer if _is_wide(tensor)}
    # An initialiser that is also an input can be overridden, so that one session tries all.
    trial = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=10)
    for tensor in wide.values():
        trial.graph.input.append(helper.make_tensor_value_info(tensor.name, tensor.data_type, tensor.dims))
    session = _session(trial.SerializeToString())
    exact = session.run([VERTICES], {LATENT: codes})[0]
    found, away = {}, {}
    for name, tensor in wide.items():
        found[name] = FixedPoint.of(numpy_helper.to_array(tensor))
        moved = session.run([VERTICES], {LATENT: codes, name: found[name].values})[0] - exact
        away[name] = float((np.linalg.norm(moved, axis=2).max() / size) ** 2)
    total = 0.0
    for name in sorted(wide, key=lambda name: away[name] / found[name].whole.size):
        if total + away[name] <= NARROWING**2:
            total += away[name]
            found[name].store(graph, wide[name])


def _is_wide(tensor: TensorProto) -> bool:
    return tensor.data_type == TensorProto.FLOAT and len(tensor.dims) > 1 and np.prod(tensor.dims) >= NARROWED_SIZE


@dataclass(frozen=True, eq=False)
class FixedPoint:
    """A matrix (…, r, c) as integers of 16 bits, with a factor for each row and each column.

    Entries of one matrix have about the same size. Integers then are ten times as accurate as 16-bit floating point.
    """

    whole: NDArray[np.int32]  # integers, at most `MOST` in size
    rows: NDArray[np.float32]  # (…, r, 1), or (1,) for short rows
    columns: NDArray[np.float32]  # (…, 1, c)

    #: The largest integer, which two signed bytes hold.
    MOST = 127 * 256
    #: Fewest columns with which each row has a factor.
    WIDE = 8

    @classmethod
    def of(cls, matrix: NDArray) -> FixedPoint:
        """Round a matrix."""
        x = matrix.astype(np.float64)
        rows = np.ones(1)
        if x.shape[-1] >= cls.WIDE:
            rows = _positive(np.abs(x).max(axis=-1, keepdims=True))
        columns = _positive(np.abs(x / rows).max(axis=-2, keepdims=True))
        rows, columns = (rows / cls.MOST).astype(np.float32), columns.astype(np.float32)
        return cls(np.rint(x / rows / columns).clip(-cls.MOST, cls.MOST).astype(np.int32), rows, columns)

    @property
    def values(self) -> NDArray[np.float32]:
        """The rounded matrix."""
        return self.whole.astype(np.float32) * self.columns * self.rows

    def store(self, graph: onnx.GraphProto, tensor: TensorProto) -> None:
        """Replace a tensor of a graph."""
        name = tensor.name
        graph.initializer.remove(tensor)
        graph.initializer.append(numpy_helper.from_array(self.rows, f"{name}.rows"))
        graph.initializer.append(numpy_helper.from_array(self.columns, f"{name}.columns"))
        nodes = [
            *_from_bytes(graph, self.whole, f"{name}.whole", f"{name}.whole"),
            helper.make_node("Mul", [f"{name}.whole", f"{name}.columns"], [f"{name}.scaled"]),
            helper.make_node("Mul", [f"{name}.scaled", f"{name}.rows"], [name]),
        ]
        for node in reversed(nodes):
            graph.node.insert(0, node)


def _positive(sizes: NDArray) -> NDArray:
    return np.where(sizes > 0, sizes, 1)


def _from_bytes(
    graph: onnx.GraphProto, whole: NDArray, store: str, target: str, kind: int = TensorProto.FLOAT
) -> list[onnx.NodeProto]:
    """Store integers of 16 bits as two of 8 bits, since TensorRT has none of 16 bits; return nodes that join them."""
    high = (whole + 128) // 256
    if f"{store}.high" not in {tensor.name for tensor in graph.initializer}:
        for part, values in {"high": high, "low": whole - 256 * high}.items():
            graph.initializer.append(numpy_helper.from_array(values.astype(np.int8), f"{store}.{part}"))
        unit = np.array(256, helper.tensor_dtype_to_np_dtype(kind))
        graph.initializer.append(numpy_helper.from_array(unit, f"{store}.256"))
    return [
        *(
            helper.make_node("Cast", [f"{store}.{part}"], [f"{target}.{part}.wide"], to=kind)
            for part in ("high", "low")
        ),
        helper.make_node("Mul", [f"{target}.high.wide", f"{store}.256"], [f"{target}.large"]),
        helper.make_node("Add", [f"{target}.large", f"{target}.low.wide"], [target]),
    ]


def _split_integers(graph: onnx.GraphProto) -> None:
    """Store the integers of 16 bits of a bundle's networks as two of 8 bits."""
    for tensor in [tensor for tensor in graph.initializer if tensor.data_type == TensorProto.INT16]:
        whole, name = numpy_helper.to_array(tensor).astype(np.int32), tensor.name
        users = [node for node in graph.node if name in node.input]
        if np.abs(whole).max() > FixedPoint.MOST or any(
            node.op_type != "Cast" or node.attribute[0].i != TensorProto.FLOAT for node in users
        ):
            continue
        graph.initializer.remove(tensor)
        for user in users:
            place = list(graph.node).index(user)
            graph.node.remove(user)
            for node in reversed(_from_bytes(graph, whole, name, user.output[0])):
                graph.node.insert(place, node)


def _rename(graph: onnx.GraphProto) -> None:
    """Give all values short names, which take a tenth of the file otherwise."""
    kept = {value.name for value in (*graph.input, *graph.output)} | {""}
    short = _short_names()
    names: dict[str, str] = {name: name for name in kept}

    def renamed(name: str) -> str:
        if name not in names:
            names[name] = next(short)
        return names[name]

    for tensor in graph.initializer:
        tensor.name = renamed(tensor.name)
    for node in graph.node:
        node.input[:] = map(renamed, node.input)
        node.output[:] = map(renamed, node.output)


def _short_names() -> Iterator[str]:
    for length in itertools.count(1):
        yield from map("".join, itertools.product(string.ascii_lowercase, repeat=length))


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
