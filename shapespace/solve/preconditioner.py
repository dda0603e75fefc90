"""Steps of a chord method: Newton's with the matrix of an earlier point, factorised once (Kelley 1995, section 5.4)."""

from __future__ import annotations

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.solve.cholesky import Factorisation


class Preconditioner:
    """``P ≈ A⁻¹`` for vertex fields, by the factor of a regularised matrix A whose null space is known.

    For an energy that is invariant under rigid motions, the null space of A is spanned by the six infinitesimal rigid
    motions of the shape at which A was computed. Forces at a neighbouring shape are orthogonal to that shape's motions,
    not to these, so a solve would rotate the shape by a huge amount. Removing this component of the forces fixes the
    gauge, and the remaining equation still determines the shape.

    Args:
        factor: of ``A + εI``.
        null_space: (n, 3V) orthonormal basis.
    """

    def __init__(self, factor: Factorisation, null_space: FloatArray) -> None:
        self._factor, self._null_space = factor, null_space

    def __call__(self, forces: FloatArray) -> FloatArray:
        """``P F`` of fields (…, V, 3)."""
        flat = forces.reshape(-1, self._null_space.shape[1])
        balanced = flat - (flat @ self._null_space.T) @ self._null_space
        return self._factor.solve(balanced).reshape(forces.shape)


def step_length(forces: FloatArray, step: FloatArray) -> float:
    """``sqrt(Fᵀ P F)`` from F and ``P F``: the norm of the residual F, and the length of the step in that of A."""
    return float(np.sqrt(np.abs(np.vdot(forces, step))))
