"""What times stand beside, because machines and their load differ."""

from __future__ import annotations

from collections.abc import Callable

from scipy import sparse
from scipy.sparse.linalg import splu


def superlu(matrix: sparse.sparray) -> Callable[[], object]:
    """One symbolic and numeric factorisation by SuperLU, in symmetric mode, of a matrix JᵀWJ and a little of I."""
    matrix = sparse.csc_array(matrix)
    shift = 1e-9 * matrix.diagonal().mean()
    lifted = sparse.csc_array(matrix + shift * sparse.eye_array(matrix.shape[0]))
    options = {"SymmetricMode": True}
    return lambda: splu(lifted, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
