"""A reference computation that makes times on different machines comparable."""

from __future__ import annotations

from collections.abc import Callable

from scipy import sparse
from scipy.sparse.linalg import splu


def superlu(matrix: sparse.sparray) -> Callable[[], object]:
    """Return a call that factorises JᵀWJ plus a small multiple of I by SuperLU, in symmetric mode."""
    matrix = sparse.csc_array(matrix)
    shift = 1e-9 * matrix.diagonal().mean()
    lifted = sparse.csc_array(matrix + shift * sparse.eye_array(matrix.shape[0]))
    options = {"SymmetricMode": True}
    return lambda: splu(lifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
