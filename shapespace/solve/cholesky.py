"""Sparse Cholesky factorisation of matrices with one pattern: analyse once, factorise and solve many times.

There are two backends with one interface. ``pardiso`` (MKL, a wheel for x86-64) is the faster one. ``banded`` needs
only SciPy: a reverse Cuthill–McKee ordering, then LAPACK on the band. On meshes of about 1000 vertices it takes two to
three times as long. Both are faster than SuperLU, which has no symbolic phase to reuse.
"""

from __future__ import annotations

import ctypes
import importlib.util
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from shapespace.arrays import FloatArray, IntArray

Backend = Literal["auto", "banded", "pardiso"]
Precision = type[np.float32] | type[np.float64]

_MKL_SEQUENTIAL = 1
_MINIMUM_DEGREE, _NESTED_DISSECTION = 0, 2


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has no Cholesky factor: it is not positive definite to working precision, or not finite."""


class SymmetricPattern:
    """The pattern of the upper triangle of a symmetric sparse matrix, into which contributions are summed.

    C contributions have ``rows`` and ``columns`` (C,); an entry may receive several. A contribution below the diagonal
    is added to the mirrored entry.
    """

    def __init__(self, size: int, rows: IntArray, columns: IntArray) -> None:
        diagonal = np.arange(size)
        low, high = np.minimum(rows, columns), np.maximum(rows, columns)
        key = np.concatenate([low * size + high, diagonal * (size + 1)])
        entries, slots = np.unique(key, return_inverse=True)
        self.size = size
        self.slots: IntArray = slots[: len(rows)]  # (C,) index of the entry of each contribution
        self.diagonal: IntArray = slots[len(rows) :]  # (N,) index of each diagonal element among the entries
        # CSR structure of the upper triangle, with all diagonal entries.
        self.indices = (entries % size).astype(np.int32)
        self.indptr = np.searchsorted(entries, np.arange(size + 1) * size).astype(np.int32)

    def __len__(self) -> int:
        return len(self.indices)

    @property
    def rows(self) -> IntArray:
        """Row of each entry."""
        return np.repeat(np.arange(self.size), np.diff(self.indptr))

    def scatter(self, contributions: FloatArray, slots: IntArray | None = None) -> FloatArray:
        """Sum contributions (C,) into the entries of the pattern, at ``slots`` or at the slots of the pattern."""
        sums = np.bincount(self.slots if slots is None else slots, weights=contributions, minlength=len(self))
        return np.asarray(sums, dtype=np.float64)

    def matrix(self, entries: FloatArray) -> sparse.csc_array:
        """Assemble the whole symmetric matrix, for checks and comparisons."""
        upper = sparse.csr_array((entries, self.indices, self.indptr), shape=(self.size, self.size))
        return sparse.csc_array(upper + sparse.triu(upper, 1).T)


class Factorisation(Protocol):
    """A factorised matrix. Only one thread may use it at a time."""

    def solve(self, right: ArrayLike) -> FloatArray:
        """Solve for one right-hand side (N,), or for several (n, N)."""


class Cholesky(Protocol):
    """Factorises symmetric positive definite matrices of one pattern. Only one thread may use it at a time.

    It can hold several factors, each with a number. A new factor replaces the factor with the same number, which can't
    be used any more: a backend that has overwritten its memory raises RuntimeError.
    """

    def factorise(self, entries: FloatArray, number: int = 0) -> Factorisation:
        """Factorise the matrix with given upper-triangle entries; raises NotPositiveDefiniteError."""


class BandedCholesky:
    """LAPACK's banded factorisation after a reverse Cuthill–McKee ordering."""

    def __init__(self, pattern: SymmetricPattern, precision: Precision = np.float64) -> None:
        n, self._precision = pattern.size, precision
        graph = pattern.matrix(np.ones(len(pattern)))
        self._order: IntArray = reverse_cuthill_mckee(sparse.csr_matrix(graph), symmetric_mode=True).astype(np.int64)
        place = np.empty(n, dtype=np.int64)
        place[self._order] = np.arange(n)
        a, b = place[pattern.rows], place[pattern.indices]
        low, high = np.minimum(a, b), np.maximum(a, b)
        self.bandwidth = int((high - low).max())
        # Lower form, Fortran order: entry (high, low) is at row high − low of column low.
        self._slots = low * (self.bandwidth + 1) + (high - low)
        self._shape = (self.bandwidth + 1, n)

    def factorise(self, entries: FloatArray, number: int = 0) -> Factorisation:
        """See Cholesky. Every factor has its own memory here, so the number is ignored."""
        band = np.zeros(self._shape, self._precision, order="F")
        band.ravel(order="K")[self._slots] = entries
        if not np.isfinite(band).all():
            raise NotPositiveDefiniteError("the matrix has an entry that is not finite")
        try:
            factor = linalg.cholesky_banded(band, overwrite_ab=True, lower=True, check_finite=False)
        except linalg.LinAlgError as error:
            raise NotPositiveDefiniteError(str(error)) from error
        return _BandedFactor(factor, self._order)


@dataclass(frozen=True)
class _BandedFactor:
    band: NDArray
    order: IntArray

    def solve(self, right: ArrayLike) -> FloatArray:
        """See Factorisation."""
        b = np.asarray(right, self.band.dtype)[..., self.order].T
        x = np.empty(b.shape[::-1])
        x[..., self.order] = linalg.cho_solve_banded((self.band, True), b, check_finite=False, overwrite_b=True).T
        return x


@cache
def _mkl() -> ctypes.CDLL:
    """Load the MKL library. The list of files of its wheel has the path; pypardiso's search takes most of a second."""
    files: list[metadata.PackagePath] = []
    with suppress(metadata.PackageNotFoundError):
        files = metadata.files("mkl") or []
    if found := [file for file in files if re.fullmatch(r"(lib)?mkl_rt\b.*\.(so|dll)\b.*", file.name)]:
        library = ctypes.CDLL(str(found[0].locate()))
    else:
        from pypardiso import PyPardisoSolver

        library = PyPardisoSolver().libmkl
    # One thread, because requests and samples run in parallel. By default MKL uses the OpenMP that the process has
    # loaded (such as PyTorch's), and the rounding depends on it.
    library.MKL_Set_Threading_Layer(ctypes.c_int(_MKL_SEQUENTIAL))
    pardiso = library.pardiso
    pardiso.argtypes, pardiso.restype = [ctypes.c_void_p] * 16, None
    return library


@cache
def _reference(number: int) -> Any:
    """Return a pointer to an integer, for arguments that MKL only reads."""
    return ctypes.byref(ctypes.c_int32(number))


class PardisoCholesky:
    """MKL Pardiso: phase 11 analyses, phase 22 factorises, phase 33 solves.

    pypardiso finds the library, but the phases are called directly. Its ``solve`` repeats the analysis. Its call of a
    phase copies the pattern, which takes longer than a small solve.
    """

    _POSITIVE_DEFINITE = 2

    def __init__(self, pattern: SymmetricPattern, factors: int = 1, precision: Precision = np.float64) -> None:
        self._size, self._precision = pattern.size, precision
        self._structure = pattern.indptr + np.int32(1), pattern.indices + np.int32(1)
        #: Number of factors made so far for each number. Factors refer to this object. Holding them here too would be a
        #: reference cycle, and MKL's memory would stay until the garbage collector runs.
        self._versions = [0] * factors
        entries = np.ones(len(pattern), precision)
        entries[pattern.diagonal] = len(pattern)
        # Minimum degree gives smaller factors for long, thin shapes, and nested dissection for compact shapes. The
        # better ordering saves up to a third of the time.
        sizes = {ordering: self._analyse(ordering, entries) for ordering in (_MINIMUM_DEGREE, _NESTED_DISSECTION)}
        if sizes[_MINIMUM_DEGREE] < sizes[_NESTED_DISSECTION]:
            self._analyse(_MINIMUM_DEGREE, entries)
        # No iterative refinement: it doubles the time of a solve, and all callers iterate and so correct errors.
        self._options[7] = 0

    def _analyse(self, ordering: int, entries: NDArray) -> int:
        """Analyse with an ordering, and discard any earlier analysis. Returns the number of entries of the factor."""
        if hasattr(self, "_handle"):
            self._run(-1, entries)
        self._handle = np.zeros(64, dtype=np.int64)
        self._options = np.zeros(64, dtype=np.int32)
        self._options[[0, 1, 17, 27]] = 1, ordering, -1, self._precision is np.float32
        self._run(11, entries)
        return int(self._options[17])

    def _run(self, phase: int, entries: NDArray, right: NDArray | None = None, number: int = 0) -> NDArray:
        b = np.zeros(self._size, self._precision) if right is None else right
        x = np.empty_like(b)
        error = ctypes.c_int32(0)
        columns = b.size // self._size
        factors, number_, kind, phase_, size, columns_, quiet = map(
            _reference, (len(self._versions), number + 1, self._POSITIVE_DEFINITE, phase, self._size, columns, 0)
        )
        indptr, indices = (a.ctypes.data for a in self._structure)
        _mkl().pardiso(
            *(self._handle.ctypes.data, factors, number_, kind, phase_, size),
            *(entries.ctypes.data, indptr, indices, None, columns_, self._options.ctypes.data, quiet),
            *(b.ctypes.data, x.ctypes.data, ctypes.byref(error)),
        )
        if error.value:
            raise NotPositiveDefiniteError(f"Pardiso's phase {phase} failed with error {error.value}")
        return x

    def factorise(self, entries: FloatArray, number: int = 0) -> Factorisation:
        """See Cholesky."""
        kept = np.array(entries, self._precision)
        if not np.isfinite(kept).all():
            raise NotPositiveDefiniteError("the matrix has an entry that is not finite")
        self._versions[number] += 1
        self._run(22, kept, number=number)
        return _PardisoFactor(self, kept, number, self._versions[number])

    def solve(self, factor: _PardisoFactor, right: ArrayLike) -> FloatArray:
        """Solve with a factor of this object; raises RuntimeError if a later one has replaced it."""
        if self._versions[factor.number] != factor.version:
            raise RuntimeError(f"factor {factor.number} has been replaced by a later factorisation")
        solved = self._run(33, factor.entries, np.ascontiguousarray(right, self._precision), factor.number)
        return solved.astype(np.float64, copy=False)

    def __del__(self, finalizing: Callable[[], bool] = sys.is_finalizing) -> None:
        # MKL's memory must be freed explicitly. When the interpreter exits, `sys` itself may be gone.
        if hasattr(self, "_versions") and not finalizing():
            self._run(-1, np.zeros(1, self._precision))


@dataclass(frozen=True, eq=False)
class _PardisoFactor:
    """A factor in MKL's memory, with the entries of the matrix, which Pardiso reads again when it solves."""

    cholesky: PardisoCholesky
    entries: NDArray
    number: int
    version: int

    def solve(self, right: ArrayLike) -> FloatArray:
        """See Factorisation."""
        return self.cholesky.solve(self, right)


def analyse(
    pattern: SymmetricPattern, backend: Backend = "auto", factors: int = 1, precision: Precision = np.float64
) -> Cholesky:
    """Analyse a pattern for later factorisations.

    The backend ``auto`` takes Pardiso if it is installed. Up to ``factors`` factors can be held at the same time.
    Single precision takes two thirds of the time, and suffices in iterations that correct errors. It fails on some
    matrices that have a factor in double precision.
    """
    if backend == "auto":
        backend = "pardiso" if importlib.util.find_spec("pypardiso") else "banded"
    if backend == "pardiso":
        return PardisoCholesky(pattern, factors, precision)
    return BandedCholesky(pattern, precision)
