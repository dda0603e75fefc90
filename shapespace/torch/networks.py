"""Networks of a bundle as PyTorch modules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from onnx import TensorProto
from torch import Tensor
from torch.nn import functional

from shapespace.bundle.schema import Network
from shapespace.model.network_program import NetworkProgram
from shapespace.torch.arrays import ArrayModule


class TorchOperations:
    """Operations on tensors; see network_operators.Operations."""

    functions = torch

    def __init__(self, dtype: torch.dtype) -> None:
        self._dtype = dtype

    def cast(self, x: Tensor, to: int) -> Tensor:
        """Compute in double precision where the network does, and elsewhere in the type of the module."""
        return x.double() if to == TensorProto.DOUBLE else x.to(self._dtype)

    def elu(self, x: Tensor, alpha: float) -> Tensor:
        return functional.elu(x, alpha)

    def clip(self, x: Tensor, least: float | None, most: float | None) -> Tensor:
        return torch.clamp(x, least, most)

    def sum(self, x: Tensor, axes: tuple[int, ...], keep: bool) -> Tensor:
        return x.sum(dim=axes, keepdim=keep)

    def product(self, x: Tensor, axis: int, keep: bool) -> Tensor:
        return x.prod(dim=axis, keepdim=keep)

    def join(self, parts: Sequence[Tensor], axis: int) -> Tensor:
        return torch.cat(list(parts), dim=axis)

    def take(self, x: Tensor, index: Tensor, axis: int) -> Tensor:
        return x.index_select(axis, index)

    def transpose(self, x: Tensor, order: Sequence[int]) -> Tensor:
        return x.permute(tuple(order))

    def zeros(self, shape: Sequence[Any], like: Tensor) -> Tensor:
        return torch.zeros(tuple(shape), dtype=like.dtype, device=like.device)


class TorchNetwork(ArrayModule):
    """One network of a bundle, (n, …) → (n, …). Raises BundleError if it has operators that are not known.

    Constants that the network uses in double precision stay in double precision: weights of kernels are large and have
    both signs, so that sums in single precision would be rounding errors.
    """

    def __init__(self, content: bytes, network: Network, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        self._program = NetworkProgram(content, network)
        self._names = {name: f"array{k}" for k, name in enumerate(self._program.arrays)}
        for name, array in self._program.arrays.items():
            self.keep(self._names[name], array, torch.float64 if array.dtype == np.float64 else None)
        self._wide = [self._names[name] for name, array in self._program.arrays.items() if array.dtype == np.float64]
        self._program.arrays = {}

    def _apply(self, function: Callable[[Tensor], Tensor], recurse: bool = True) -> TorchNetwork:
        wide = {own: self.get_buffer(own) for own in self._wide}
        super()._apply(function, recurse)
        for own, buffer in wide.items():
            self._buffers[own] = buffer.to(self.get_buffer(own).device)
        return self

    def forward(self, rows: Tensor) -> Tensor:
        """Apply the network to rows."""
        arrays = {name: self.get_buffer(own) for name, own in self._names.items()}
        return self._program(rows, arrays, TorchOperations(rows.dtype))
