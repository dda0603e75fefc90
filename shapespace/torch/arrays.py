"""Modules that hold arrays, and products with sparse matrices as gathers."""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from torch import Tensor, nn

from shapespace.arrays import IntArray

#: Largest number of groups of rows in a sparse product. Rows of a group are padded to its longest row.
GROUPS = 4


class ArrayModule(nn.Module):
    """A module without parameters, whose arrays are buffers: real ones in a given type, and indices."""

    def __init__(self, dtype: torch.dtype) -> None:
        super().__init__()
        self._dtype = dtype

    def keep(self, name: str, array: NDArray, real: torch.dtype | None = None) -> None:
        """Register an array as the buffer ``name``; real numbers in the type of the module, or in another one."""
        dense = np.ascontiguousarray(array)
        kind = (real or self._dtype) if dense.dtype.kind == "f" else torch.int64
        self.register_buffer(name, torch.tensor(dense, dtype=kind))


class SparseProduct(ArrayModule):
    """Product of a constant sparse matrix (r, k) with rows (n, k, c): gathers, multiplications and sums.

    Rows with about the same number of entries form a group, so that padding takes little.
    """

    order: Tensor

    def __init__(self, matrix: sparse.csr_array, dtype: torch.dtype) -> None:
        super().__init__(dtype)
        matrix = sparse.csr_array(matrix)
        matrix.eliminate_zeros()
        lengths = np.diff(matrix.indptr)
        by_length: IntArray = np.argsort(lengths, kind="stable")
        groups = _groups(lengths[by_length])
        self.count = len(groups)
        for k, (start, stop) in enumerate(groups):
            rows = by_length[start:stop]
            places = matrix.indptr[rows][:, None] + np.arange(max(lengths[rows].max(), 1))
            there = places < matrix.indptr[rows + 1][:, None]
            places = np.where(there, places, 0)
            index, weights = np.zeros(places.shape, int), np.zeros(places.shape)
            if len(matrix.data):
                index, weights = np.where(there, matrix.indices[places], 0), np.where(there, matrix.data[places], 0.0)
            self.keep(f"index{k}", index.ravel())
            self.keep(f"weights{k}", weights)
        if self.count > 1:
            self.keep("order", np.argsort(by_length, kind="stable"))

    def forward(self, rows: Tensor) -> Tensor:
        """Multiply rows (n, k, c) to (n, r, c)."""
        parts = []
        for k in range(self.count):
            index, weights = self.get_buffer(f"index{k}"), self.get_buffer(f"weights{k}")
            taken = rows.index_select(1, index).unflatten(1, weights.shape)
            parts.append((taken * weights[:, :, None]).sum(dim=2))
        if self.count == 1:
            return parts[0]
        return torch.cat(parts, dim=1).index_select(1, self.order)


def _groups(lengths: IntArray) -> list[tuple[int, int]]:
    """Split rows, sorted by length, into at most `GROUPS` ranges with little padding."""
    bounds = [0, len(lengths)]
    while len(bounds) <= GROUPS:
        # Cut where it saves most: a cut before row k saves k times the difference to the longest row of its range.
        best, cut = 0.1 * len(lengths), 0
        for start, stop in itertools.pairwise(bounds):
            own = lengths[start:stop]
            saved = np.arange(1, len(own)) * (own[-1] - own[:-1]) if len(own) > 1 else np.zeros(1)
            if saved.max(initial=0) > best:
                best, cut = saved.max(), start + 1 + int(saved.argmax())
        if not cut:
            break
        bounds = sorted([*bounds, cut])
    return list(itertools.pairwise(bounds))


def tiny(x: Tensor) -> float:
    """Return a number above zero that changes no other number of a tensor's type when added."""
    return 1e-30 if x.dtype == torch.float32 else 1e-200


def norm(x: Tensor, dim: int) -> Tensor:
    """Compute lengths along one axis, which is kept; with a gradient also where they are zero."""
    return (x * x).sum(dim=dim, keepdim=True).clamp_min(tiny(x)).sqrt()
