"""Networks of a bundle as sequences of array operations, which NumPy and PyTorch can run.

onnxruntime computes networks, but neither their derivatives nor on tensors of PyTorch. A program reads the nodes of an
ONNX file and applies them one after another.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import onnx
from numpy.typing import NDArray

from shapespace.bundle.reader import BundleError
from shapespace.bundle.schema import Network
from shapespace.model.network_operators import OPERATORS, NumPyOperations, Operations, OperatorNode, OperatorRun, Value


class _Folding(NumPyOperations):
    """Operations on constants, which keep the types of the file."""

    def cast(self, x: Value, to: int) -> Value:
        return x.astype(onnx.helper.tensor_dtype_to_np_dtype(to))


class NetworkProgram:
    """The nodes of one ONNX network of a bundle.

    Attributes:
        arrays: constants that are operands, real ones or indices, by name. A caller may pass them in another type.

    Raises BundleError if the network has an operator, or a use of one, that programs don't know.
    """

    def __init__(self, content: bytes, network: Network) -> None:
        model = onnx.load_model_from_string(content)
        self._file, self._input, self._output = network.file, network.input, network.output
        self._constants: dict[str, NDArray] = {
            tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in model.graph.initializer
        }
        self.arrays: dict[str, NDArray] = {}
        self._nodes: list[OperatorNode] = []
        for proto in model.graph.node:
            node = OperatorNode(proto)
            if node.kind not in OPERATORS or proto.domain:
                raise BundleError(
                    f"{network.file} has the operator {node.kind}, which only onnxruntime can compute here. Networks "
                    "that shapespace-train exports have derivatives and run in PyTorch"
                )
            if all(name in self._constants for name in node.inputs if name):
                self._fold(node)
            else:
                self._nodes.append(node)
                self.arrays |= {name: self._constants[name] for name in node.inputs if self._is_operand(name)}

    def _is_operand(self, name: str) -> bool:
        constant = self._constants.get(name)
        return constant is not None and constant.ndim > 0

    def _fold(self, node: OperatorNode) -> None:
        constants = {name: self._constants[name] for name in node.inputs if name}
        run = OperatorRun(_Folding(), constants, self._constants, self._file)
        results = run.apply(node)
        for name, value in zip(node.outputs, results, strict=False):
            self._constants[name] = np.asarray(value)

    def __call__(self, rows: Value, arrays: Mapping[str, Value], operations: Operations) -> Value:
        """Apply the network to rows (n, …), with `arrays` in the type of the rows."""
        run = OperatorRun(operations, {**arrays, self._input: rows}, self._constants, self._file)
        for node in self._nodes:
            for name, value in zip(node.outputs, run.apply(node), strict=False):
                run.values[name] = value
        return run.values[self._output]

    def derivatives(self, row: NDArray) -> tuple[NDArray, NDArray]:
        """Return the output (…) at one row (k,), and its derivatives (k, …) by the row, in double precision.

        A derivative is the imaginary part at ``x + ih``, divided by h: no differences, so no cancellation (Squire and
        Trapp 1998).
        """
        step = 1e-30
        moved = row.astype(np.float64) + 1j * step * np.eye(len(row))
        found = self(moved, self.arrays, NumPyOperations())
        return found[0].real, found.imag / step
