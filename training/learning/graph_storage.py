"""Arrays of an ONNX graph in fewer bytes: matrices of 16 and 20 bits, small indices, and equal arrays once."""

from __future__ import annotations

import itertools
import string
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from shapespace.arrays import FloatArray

#: Fewest entries of an array that is stored in fewer bytes.
FEWEST = 1024
#: Numbers of bits of an entry that are tried, the fewest first.
BITS = (16, 20)

#: Runs a graph with some of its arrays replaced, and returns the vertices (n, V, 3).
Trial = Callable[[dict[str, NDArray]], FloatArray]


def tidy(graph: onnx.GraphProto) -> None:
    """Store indices and integers in the fewest bytes, and equal arrays once; all results stay."""
    _short_indices(graph)
    _share(graph)
    _split_integers(graph)


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
        if values.size >= FEWEST and np.abs(values).max() <= _most(16):
            graph.initializer.remove(tensor)
            _insert(graph, 0, _from_bytes(graph, values, 16, name, name, TensorProto.INT32))
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


def _split_integers(graph: onnx.GraphProto) -> None:
    """Store the integers of 16 bits of a bundle's networks as two of 8 bits."""
    for tensor in [tensor for tensor in graph.initializer if tensor.data_type == TensorProto.INT16]:
        whole, name = numpy_helper.to_array(tensor).astype(np.int32), tensor.name
        users = [node for node in graph.node if name in node.input]
        if any(node.op_type != "Cast" for node in users):
            continue
        graph.initializer.remove(tensor)
        for user in users:
            place = list(graph.node).index(user)
            graph.node.remove(user)
            _insert(graph, place, _from_bytes(graph, whole, 16, name, user.output[0], user.attribute[0].i))


@dataclass(frozen=True)
class Narrowing:
    """Matrices of a graph that may be stored in 16 or 20 bits.

    Attributes:
        moved: by name, how far 16 bits move a vertex at most, as a share of the diagonal.
    """

    graph: onnx.GraphProto
    moved: dict[str, float]

    @classmethod
    def of(cls, graph: onnx.GraphProto, size: float, trial: Trial) -> Narrowing:
        """Measure what each matrix does; ``size`` is the diagonal."""
        exact, moved = trial({}), {}
        for name, tensor in wide_matrices(graph).items():
            there = trial({name: FixedPoint.of(numpy_helper.to_array(tensor), BITS[0]).values})
            moved[name] = float(np.linalg.norm(there - exact, axis=2).max()) / size
        return cls(graph, moved)

    def within(self, allowed: float) -> onnx.GraphProto:
        """Return the graph with as many bytes saved as move no vertex by more than ``allowed`` together."""
        graph = onnx.GraphProto()
        graph.CopyFrom(self.graph)
        wide, spent = wide_matrices(graph), 0.0
        for bits in BITS:
            # Each further bit halves the error.
            away = {name: (self.moved[name] / 2 ** (bits - BITS[0])) ** 2 for name in wide}
            for name in sorted(wide, key=lambda name: away[name] / np.prod(wide[name].dims)):
                if spent + away[name] <= allowed**2:
                    spent += away[name]
                    tensor = wide.pop(name)
                    FixedPoint.of(numpy_helper.to_array(tensor), bits).store(graph, tensor)
        return graph


def wide_matrices(graph: onnx.GraphProto) -> dict[str, TensorProto]:
    """Return the matrices that may be stored in fewer bytes, by name."""
    return {
        tensor.name: tensor
        for tensor in graph.initializer
        if tensor.data_type == TensorProto.FLOAT and len(tensor.dims) > 1 and np.prod(tensor.dims) >= FEWEST
    }


@dataclass(frozen=True, eq=False)
class FixedPoint:
    """A matrix (…, r, c) as integers of 16 or 20 bits, with a factor for each row and each column.

    Entries of one matrix have about the same size. Integers then are ten times as accurate as 16-bit floating point.
    """

    bits: int  # of an integer
    whole: NDArray[np.int32]
    rows: NDArray[np.float32]  # (…, r, 1), or (1,) for short rows
    columns: NDArray[np.float32]  # (…, 1, c)

    #: Fewest columns with which each row has a factor.
    LONG = 8

    @classmethod
    def of(cls, matrix: NDArray, bits: int) -> FixedPoint:
        """Round a matrix."""
        x, most = matrix.astype(np.float64), _most(bits)
        rows: NDArray = np.ones(1)
        if x.shape[-1] >= cls.LONG:
            rows = _positive(np.abs(x).max(axis=-1, keepdims=True))
        columns = _positive(np.abs(x / rows).max(axis=-2, keepdims=True))
        rows, columns = (rows / most).astype(np.float32), columns.astype(np.float32)
        return cls(bits, np.rint(x / rows / columns).clip(-most, most).astype(np.int32), rows, columns)

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
        whole = f"{name}.whole"
        nodes = [
            *_from_bytes(graph, self.whole, self.bits, whole, whole, TensorProto.FLOAT),
            helper.make_node("Mul", [whole, f"{name}.columns"], [f"{name}.scaled"]),
            helper.make_node("Mul", [f"{name}.scaled", f"{name}.rows"], [name]),
        ]
        _insert(graph, 0, nodes)


def _most(bits: int) -> int:
    """Return the largest integer of some bits."""
    return int(2 ** (bits - 1)) - 1


def _positive(sizes: NDArray) -> NDArray:
    return np.where(sizes > 0, sizes, 1)


def _from_bytes(
    graph: onnx.GraphProto, whole: NDArray, bits: int, store: str, target: str, kind: int
) -> list[onnx.NodeProto]:
    """Store integers of 16 or 20 bits as bytes, since TensorRT has no such integers; return nodes that join them.

    A byte with the last 4 bits of two integers makes 20 bits. TensorRT's bytes have a sign, so all but the highest are
    stored minus 128.
    """
    kept = {tensor.name for tensor in graph.initializer}
    nodes: list[onnx.NodeProto] = []

    def keep(name: str, values: NDArray) -> str:
        if f"{store}.{name}" not in kept:
            graph.initializer.append(numpy_helper.from_array(values, f"{store}.{name}"))
            kept.add(f"{store}.{name}")
        return f"{store}.{name}"

    def number(value: int) -> str:
        return keep(f"{value}.{kind}", np.array(value, helper.tensor_dtype_to_np_dtype(kind)))

    def node(operator: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        name = output or f"{target}.step{len(nodes)}"
        nodes.append(helper.make_node(operator, inputs, [name], **attributes))
        return name

    def byte(name: str, values: NDArray) -> str:
        stored = keep(name, (values - 128).astype(np.int8))
        return node("Add", node("Cast", stored, to=kind), number(128))

    pairs = whole >> (bits - 16)
    high = node("Cast", keep("high", (pairs >> 8).astype(np.int8)), to=kind)
    joined = [node("Mul", high, number(256)), byte("low", pairs & 255)]
    if bits == 16:
        node("Add", *joined, output=target)
        return nodes
    rest = (whole & 15).ravel()
    half = (rest.size + 1) // 2
    packed = byte("rest", 16 * rest[:half] + np.pad(rest[half:], (0, 2 * half - rest.size)))
    first = node("Floor", node("Div", packed, number(16)))
    last = node("Concat", first, node("Sub", packed, node("Mul", first, number(16))), axis=0)
    last = node("Slice", last, keep("begin", np.array([0])), keep("end", np.array([rest.size])))
    last = node("Reshape", last, keep("shape", np.array(whole.shape)))
    node("Add", node("Mul", node("Add", *joined), number(16)), last, output=target)
    return nodes


def _insert(graph: onnx.GraphProto, place: int, nodes: list[onnx.NodeProto]) -> None:
    for node in reversed(nodes):
        graph.node.insert(place, node)


def rename(graph: onnx.GraphProto) -> None:
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
