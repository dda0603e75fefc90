"""Chord steps: Newton steps with the matrix of an earlier point, factorised once (Kelley 1995, section 5.4)."""

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.solve.cholesky import Factorisation


class Preconditioner:
    """``P ≈ A⁻¹`` for vertex fields, with the factor of a regularised matrix A with a known null space.

    For an energy that is invariant under rigid motions, the null space of A is spanned by the six infinitesimal rigid
    motions of the shape at which A was computed. Forces at a neighbouring shape are orthogonal to the rigid motions of
    the neighbour, but not to these. So a solve would rotate the shape by a huge amount. Removing this component of the
    forces fixes the gauge, and the remaining equation still determines the shape. The basis ``null_space`` (n, 3V)
    is orthonormal.
    """

    def __init__(self, factor: Factorisation, null_space: FloatArray) -> None:
        self._factor, self._null_space = factor, null_space

    def __call__(self, forces: FloatArray) -> FloatArray:
        """Compute ``P F`` for fields (…, V, 3)."""
        flat = forces.reshape(-1, self._null_space.shape[1])
        balanced = flat - (flat @ self._null_space.T) @ self._null_space
        return self._factor.solve(balanced).reshape(forces.shape)


def step_length(forces: FloatArray, step: FloatArray) -> float:
    """Compute ``sqrt(Fᵀ P F)`` from F and ``P F``: the norm of F in P, and the length of the step in A."""
    return float(np.sqrt(np.abs(np.vdot(forces, step))))
