"""The exponential as the paper writes it: lengths and angles under integrability constraints, with multipliers.

A simple, dense and slow reference for ``shapespace.shell.exponential``, for small simply connected meshes.
The two share the energy, but not the parametrisation by vertices.
"""

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.integrability import Integrability
from shapespace.shell.space import ShellSpace


def constrained_exponential(
    space: ShellSpace, first: FloatArray, second: FloatArray, steps: int, *, tolerance: float = 1e-12
) -> FloatArray:
    """Continue two integrable ``z_0, z_1`` (2E,) to ``z_0 … z_K`` (K + 1, 2E).

    Each step solves, for z_{k+1} and multipliers λ,

        ∂₂W[z_{k−1}, z_k] + ∂₁W[z_k, z_{k+1}] + DQ(z_k)ᵀ λ = 0,   Q(z_{k+1}) = 0,

    by iterating with the matrix at z_k, ``[[−Hess₂W, DQᵀ], [DQ, 0]]``. Six rows of DQ are redundant on a
    closed surface, and boundary angles have no energy, so the matrix is singular, and its pseudoinverse is
    used. Newton's matrix with DQ(z_{k+1}) would have six *nearly* dependent rows instead, which is worse.

    Raises:
        ArithmeticError: a step did not converge.
    """
    conditions = Integrability(space.connectivity)
    path = [first, second]
    for _ in range(steps - 1):
        rest = space.energy.rest(path[-1])
        known = space.energy.rest(path[-2]).gradient_deformed(path[-1])
        hessian = -rest.mixed_hessian(path[-1]).toarray()
        jacobian = conditions.jacobian(path[-1]).toarray()
        # Lengths and angles differ by orders of magnitude in stiffness: scale to a unit diagonal before cutting off.
        diagonal = np.diag(hessian)
        scale = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0)
        n, r = len(hessian), len(jacobian)
        matrix = np.zeros((n + r, n + r))
        matrix[:n, :n] = -scale[:, None] * hessian * scale
        matrix[:n, n:] = scale[:, None] * jacobian.T
        matrix[n:, :n] = matrix[:n, n:].T
        inverse = np.linalg.pinv(matrix, rcond=1e-11, hermitian=True)
        z, multipliers = 2 * path[-1] - path[-2], np.zeros(r)
        for _ in range(MAX_ITERATIONS):
            residual = np.concatenate(
                [scale * (known + rest.gradient_rest(z) + jacobian.T @ multipliers), conditions.at_vertices(z).ravel()]
            )
            step = -inverse @ residual
            z = z + scale * step[:n]
            multipliers = multipliers + step[n:]
            if np.abs(step[:n]).max() <= tolerance:
                break
        else:
            raise ArithmeticError(f"step {len(path)} did not converge, last change {np.abs(step[:n]).max():.1e}")
        path.append(z)
    return np.stack(path)


#: Of the fixed-matrix iteration; it contracts by about 0.1 to 0.3.
MAX_ITERATIONS = 100
