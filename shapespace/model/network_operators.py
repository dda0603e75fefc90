"""The ONNX operators of networks, written with operations that NumPy and PyTorch both have.

These are the operators that `shapespace-train` exports.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import onnx
from numpy.typing import NDArray

from shapespace.bundle.reader import BundleError

#: An array of NumPy or a tensor of PyTorch; or a shape, whose sizes may be symbols while PyTorch exports.
Value = Any


class Operations(Protocol):
    """Operations whose names differ between NumPy and PyTorch."""

    #: The functions with the same names: ``exp``, ``sqrt``, ``sin``, ``cos``, ``einsum``, ``broadcast_to``.
    @property
    def functions(self) -> Any: ...

    def cast(self, x: Value, to: int) -> Value:
        """Convert to a type of ONNX, if that matters."""

    def elu(self, x: Value, alpha: float) -> Value:
        """Compute ``x`` where it is positive, and ``alpha (eˣ − 1)`` elsewhere."""

    def clip(self, x: Value, least: float | None, most: float | None) -> Value:
        """Limit numbers to a range."""

    def sum(self, x: Value, axes: tuple[int, ...], keep: bool) -> Value:
        """Add along axes."""

    def product(self, x: Value, axis: int, keep: bool) -> Value:
        """Multiply along an axis."""

    def join(self, parts: Sequence[Value], axis: int) -> Value:
        """Concatenate along an axis."""

    def take(self, x: Value, index: Value, axis: int) -> Value:
        """Choose entries (k,) along an axis."""

    def transpose(self, x: Value, order: Sequence[int]) -> Value:
        """Permute axes."""

    def zeros(self, shape: Sequence[Any], like: Value) -> Value:
        """Make zeros of the type of another array."""


class NumPyOperations:
    """Operations on NumPy arrays, real or complex. A complex number with a tiny imaginary part carries a derivative:
    functions with a case distinction decide by the real part.
    """

    functions = np

    def cast(self, x: Value, to: int) -> Value:
        return x

    def elu(self, x: Value, alpha: float) -> Value:
        return np.where(x.real > 0, x, alpha * (np.exp(np.where(x.real > 0, 0, x)) - 1))

    def clip(self, x: Value, least: float | None, most: float | None) -> Value:
        x = x if least is None else np.where(x.real < least, least, x)
        return x if most is None else np.where(x.real > most, most, x)

    def sum(self, x: Value, axes: tuple[int, ...], keep: bool) -> Value:
        return x.sum(axis=axes, keepdims=keep)

    def product(self, x: Value, axis: int, keep: bool) -> Value:
        return x.prod(axis=axis, keepdims=keep)

    def join(self, parts: Sequence[Value], axis: int) -> Value:
        return np.concatenate(parts, axis)

    def take(self, x: Value, index: Value, axis: int) -> Value:
        return x.take(index, axis)

    def transpose(self, x: Value, order: Sequence[int]) -> Value:
        return x.transpose(order)

    def zeros(self, shape: Sequence[Any], like: Value) -> Value:
        return np.zeros(shape, like.dtype)


class OperatorNode:
    """A node of a graph: its operator, the names of its inputs and outputs, and its attributes."""

    def __init__(self, proto: onnx.NodeProto) -> None:
        self.kind: str = proto.op_type
        self.inputs, self.outputs = list(proto.input), list(proto.output)
        self.attributes = {each.name: onnx.helper.get_attribute_value(each) for each in proto.attribute}


class OperatorRun:
    """The values of one pass through a program."""

    def __init__(
        self, operations: Operations, values: dict[str, Value], constants: Mapping[str, NDArray], file: str
    ) -> None:
        self.operations, self.values, self._constants, self._file = operations, values, constants, file

    def apply(self, node: OperatorNode) -> Sequence[Value]:
        """Return the outputs of a node."""
        return OPERATORS[node.kind](self, node)

    def value(self, node: OperatorNode, index: int) -> Value:
        """Return an operand: an array, a number, or a shape."""
        name = node.inputs[index]
        if name in self.values:
            return self.values[name]
        return self._constants[name].item()

    def fixed(self, node: OperatorNode, index: int) -> Any:
        """Return an operand that doesn't depend on the rows, except for their number; None if it is left out."""
        if index >= len(node.inputs) or not node.inputs[index]:
            return None
        name = node.inputs[index]
        if isinstance(self.values.get(name), tuple):
            return list(self.values[name])
        if name not in self._constants:
            raise self.refusal(node, "depends on the input where it must be constant")
        return self._constants[name].tolist()

    def refusal(self, node: OperatorNode, why: str) -> BundleError:
        """Return the error of a use that is not known."""
        return BundleError(f"{self._file}: an operator {node.kind} {why}")


def _constant(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    return [onnx.numpy_helper.to_array(node.attributes["value"])]


def _cast(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    return [run.operations.cast(run.value(node, 0), node.attributes["to"])]


def _unary(name: str) -> Callable[[OperatorRun, OperatorNode], Sequence[Value]]:
    return lambda run, node: [getattr(run.operations.functions, name)(run.value(node, 0))]


def _binary(function: Callable[[Value, Value], Value]) -> Callable[[OperatorRun, OperatorNode], Sequence[Value]]:
    return lambda run, node: [function(run.value(node, 0), run.value(node, 1))]


def _sigmoid(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    return [1 / (1 + run.operations.functions.exp(-run.value(node, 0)))]


def _elu(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    return [run.operations.elu(run.value(node, 0), node.attributes.get("alpha", 1.0))]


def _clip(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    return [run.operations.clip(run.value(node, 0), run.fixed(node, 1), run.fixed(node, 2))]


def _gemm(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    a, b = run.value(node, 0), run.value(node, 1)
    a = a.T if node.attributes.get("transA") else a
    b = b.T if node.attributes.get("transB") else b
    found = a @ b
    if (alpha := node.attributes.get("alpha", 1.0)) != 1:
        found = alpha * found
    if len(node.inputs) > 2:
        c, beta = run.value(node, 2), node.attributes.get("beta", 1.0)
        found = found + (c if beta == 1 else beta * c)
    return [found]


def _batch_norm(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, scale, shift, mean, variance = (run.value(node, k) for k in range(5))
    if len(x.shape) != 2:
        raise run.refusal(node, "has more than two axes")
    spread = run.operations.functions.sqrt(variance + node.attributes.get("epsilon", 1e-5))
    return [(x - mean) / spread * scale + shift]


def _axes(run: OperatorRun, node: OperatorNode, x: Value) -> tuple[int, ...]:
    axes = run.fixed(node, 1) if len(node.inputs) > 1 else node.attributes.get("axes")
    if axes is None:
        return tuple(range(len(x.shape)))
    return tuple(axis % len(x.shape) for axis in axes)


def _reduce_sum(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x = run.value(node, 0)
    return [run.operations.sum(x, _axes(run, node, x), bool(node.attributes.get("keepdims", 1)))]


def _reduce_mean(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x = run.value(node, 0)
    count = math.prod(x.shape[axis] for axis in _axes(run, node, x))
    return [_reduce_sum(run, node)[0] / count]


def _reduce_product(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x = run.value(node, 0)
    keep = bool(node.attributes.get("keepdims", 1))
    for axis in sorted(_axes(run, node, x), reverse=True):
        x = run.operations.product(x, axis, keep)
    return [x]


def _shape(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    sizes = tuple(run.value(node, 0).shape)
    return [sizes[node.attributes.get("start", 0) : node.attributes.get("end", len(sizes))]]


def _reshape(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, shape = run.value(node, 0), run.fixed(node, 1)
    if not node.attributes.get("allowzero"):
        shape = [x.shape[k] if isinstance(size, int) and size == 0 else size for k, size in enumerate(shape)]
    return [x.reshape(tuple(shape))]


def _unsqueeze(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, axes = run.value(node, 0), run.fixed(node, 1)
    rank = len(x.shape) + len(axes)
    axes = {axis % rank for axis in axes}
    return [x[tuple(None if axis in axes else slice(None) for axis in range(rank))]]


def _squeeze(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, axes = run.value(node, 0), run.fixed(node, 1)
    if axes is None:
        raise run.refusal(node, "doesn't say which axes")
    axes = {axis % len(x.shape) for axis in axes}
    return [x[tuple(0 if axis in axes else slice(None) for axis in range(len(x.shape)))]]


def _transpose(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x = run.value(node, 0)
    return [run.operations.transpose(x, node.attributes.get("perm") or range(len(x.shape))[::-1])]


def _expand(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, shape = run.value(node, 0), run.fixed(node, 1)
    if not hasattr(x, "shape"):  # a number, where a network makes an array of ones or zeros
        return [run.operations.zeros(shape, next(iter(run.values.values()))) + x]
    own = (1,) * (len(shape) - len(x.shape)) + tuple(x.shape)
    wanted = (1,) * (len(own) - len(shape)) + tuple(shape)
    sizes = tuple(b if isinstance(a, int) and a == 1 else a for a, b in zip(own, wanted, strict=True))
    return [run.operations.functions.broadcast_to(x, sizes)]


def _concat(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    names = node.inputs
    if any(isinstance(run.values.get(name), tuple) for name in names):
        return [tuple(size for k in range(len(names)) for size in run.fixed(node, k))]
    parts = [run.value(node, k) for k in range(len(names))]
    return [run.operations.join(parts, node.attributes["axis"] % len(parts[0].shape))]


def _split(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, sizes = run.value(node, 0), run.fixed(node, 1)
    axis = node.attributes.get("axis", 0) % len(x.shape)
    if sizes is None:
        count = len(node.outputs)
        sizes = [x.shape[axis] // count] * count
    stops = np.cumsum([0, *sizes]).tolist()
    before = (slice(None),) * axis
    return [x[(*before, slice(a, b))] for a, b in itertools.pairwise(stops)]


def _slice(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, starts, ends = run.value(node, 0), run.fixed(node, 1), run.fixed(node, 2)
    axes, steps = run.fixed(node, 3) or range(len(starts)), run.fixed(node, 4) or [1] * len(starts)
    if isinstance(x, tuple):
        return [x[starts[0] : ends[0] : steps[0]]]
    where = [slice(None)] * len(x.shape)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        if step < 1:
            raise run.refusal(node, "runs backwards")
        where[axis] = slice(start, None if end > 2**31 else end, step)
    return [x[tuple(where)]]


def _gather(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, index = run.value(node, 0), run.value(node, 1)
    axis = node.attributes.get("axis", 0)
    if isinstance(x, tuple):
        chosen = run.fixed(node, 1)
        return [tuple(x[k] for k in chosen) if isinstance(chosen, list) else x[chosen]]
    axis %= len(x.shape)
    if isinstance(index, int):
        return [x[(*(slice(None),) * axis, index)]]
    found = run.operations.take(x, index.reshape(-1), axis)
    return [found.reshape((*x.shape[:axis], *index.shape, *x.shape[axis + 1 :]))]


def _gather_nd(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, index = run.value(node, 0), run.value(node, 1)
    if index.shape[-1] != 1 or node.attributes.get("batch_dims", 0):
        raise run.refusal(node, "chooses by more than one axis")
    found = run.operations.take(x, index.reshape(-1), 0)
    return [found.reshape((*index.shape[:-1], *x.shape[1:]))]


def _pad(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    x, pads, value, axes = (run.value(node, 0), *(run.fixed(node, k) for k in (1, 2, 3)))
    if node.attributes.get("mode", b"constant") != b"constant" or value or min(pads) < 0:
        raise run.refusal(node, "pads with something else than zeros")
    rank = len(x.shape)
    axes = [axis % rank for axis in axes] if axes else list(range(rank))
    for k, axis in enumerate(axes):
        parts = [x]
        for at, count in ((0, pads[k]), (len(parts), pads[k + len(axes)])):
            if count:
                shape = (*x.shape[:axis], count, *x.shape[axis + 1 :])
                parts.insert(at and len(parts), run.operations.zeros(shape, x))
        x = run.operations.join(parts, axis) if len(parts) > 1 else x
    return [x]


def _einsum(run: OperatorRun, node: OperatorNode) -> Sequence[Value]:
    equation = node.attributes["equation"].decode()
    return [run.operations.functions.einsum(equation, *(run.value(node, k) for k in range(len(node.inputs))))]


#: The operators by their ONNX names.
OPERATORS: dict[str, Callable[[OperatorRun, OperatorNode], Sequence[Value]]] = {
    "Add": _binary(lambda a, b: a + b),
    "Atan": _unary("arctan"),
    "BatchNormalization": _batch_norm,
    "Cast": _cast,
    "Clip": _clip,
    "Concat": _concat,
    "Constant": _constant,
    "Cos": _unary("cos"),
    "Div": _binary(lambda a, b: a / b),
    "Einsum": _einsum,
    "Elu": _elu,
    "Exp": _unary("exp"),
    "Expand": _expand,
    "Gather": _gather,
    "GatherND": _gather_nd,
    "Gemm": _gemm,
    "Identity": lambda run, node: [run.value(node, 0)],
    "MatMul": _binary(lambda a, b: a @ b),
    "Mul": _binary(lambda a, b: a * b),
    "Neg": lambda run, node: [-run.value(node, 0)],
    "Pad": _pad,
    "Pow": _binary(lambda a, b: a**b),
    "ReduceMean": _reduce_mean,
    "ReduceProd": _reduce_product,
    "ReduceSum": _reduce_sum,
    "Reshape": _reshape,
    "Shape": _shape,
    "Sigmoid": _sigmoid,
    "Sin": _unary("sin"),
    "Slice": _slice,
    "Split": _split,
    "Sqrt": _unary("sqrt"),
    "Squeeze": _squeeze,
    "Sub": _binary(lambda a, b: a - b),
    "Tanh": _unary("tanh"),
    "Transpose": _transpose,
    "Unsqueeze": _unsqueeze,
}
