"""The derivative of the time-discrete exponential map by the velocity, and its transpose."""

from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from shapespace.arrays import FloatArray
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.shell.space import DiscretePath, ShellPoint


class ExponentialDerivative:
    """``D exp_{X_0}(v)``, the derivative of the last shape of a path from X_0 by the initial velocity v.

    The shapes satisfy ``F_k = J_kᵀ (∂₂W[z_{k−1}, z_k] + ∂₁W[z_k, z_{k+1}]) = 0`` for 0 < k < K, with X_0 fixed and
    ``X_1 = X_0 + v/K``. Their changes δ_k therefore satisfy the linear recursion

        D_k δ_{k+1} + C_k δ_k + D_{k−1}ᵀ δ_{k−1} = 0,   δ_0 = 0,   δ_1 = δv/K,

    with ``D_k = J_kᵀ ∂₂∂₁W[z_k, z_{k+1}] J_{k+1}`` and the symmetric ``C_k = J_kᵀ (∂₂∂₂W[z_{k−1}, z_k] +
    ∂₁∂₁W[z_k, z_{k+1}]) J_k + Σ_i p_i D²z_i(X_k)``. Here p is the covector in parentheses in F_k. It vanishes on
    tangent vectors only, so the curvature of ``X ↦ z(X)`` contributes. One LU factorisation per step serves any number
    of directions, and the transposed recursion backwards in time.

    All fields are without infinitesimal rigid motions of their shapes, which change no length and no angle.

    Args:
        path: a complete path from ``exponential`` with positive steps.

    Raises:
        ValueError: the path is not complete.
        RuntimeError: a matrix is singular, because the end of the path is conjugate to its start.
    """

    def __init__(self, path: DiscretePath) -> None:
        if not path.converged:
            raise ValueError(f"a path that ended early has no derivative: {path.reason}")
        self._steps = len(path.vertices) - 1
        self._shapes = path.vertices
        points = [path.space.point(x) for x in path.vertices]
        self._ahead: list[sparse.csc_array] = []  # D_k, k = 1 … K − 1
        self._here: list[sparse.csc_array] = []  # C_k
        self._factors: list[SuperLU] = []
        for previous, current, following in zip(points, points[1:], points[2:], strict=False):
            ahead = _coupling(current, following)
            self._ahead.append(ahead)
            self._here.append(_stiffness(previous, current, following))
            # Regularise on rigid motions. The matrix is close to −A, which is definite, so no pivoting is needed, and
            # the ordering is for symmetric patterns.
            shift = NormalMatrix.REGULARISATION * ahead.diagonal().mean() * sparse.eye_array(ahead.shape[0])
            regular = sparse.csc_array(ahead + shift)
            mode = {"SymmetricMode": True}
            self._factors.append(splu(regular, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=mode))

    def push_forward(self, velocities: FloatArray) -> FloatArray:
        """Compute ``D exp(v) δv`` (n, V, 3), the changes of the last shape for changes δv of the velocity (n, V, 3)."""
        before = np.zeros_like(velocities)
        now = without_rigid_motion(velocities, self._shapes[0]) / self._steps
        for k in range(1, self._steps):
            forces = _apply(self._here[k - 1], now)
            if k > 1:
                forces += _apply(self._ahead[k - 2].T, before)
            before, now = now, self._solve(k, -forces)
        return without_rigid_motion(now, self._shapes[-1])

    def pull_back(self, covectors: FloatArray) -> FloatArray:
        """Compute ``D exp(v)ᵀ r``: convert gradients r (n, V, 3) by the last shape to gradients by the velocity."""
        following, current = without_rigid_motion(covectors, self._shapes[-1]), np.zeros_like(covectors)
        for k in range(self._steps - 1, 0, -1):
            multiplier = self._solve(k, following, transposed=True)
            following = current - _apply(self._here[k - 1], multiplier)
            current = -_apply(self._ahead[k - 2], multiplier) if k > 1 else current
        return without_rigid_motion(following, self._shapes[0]) / self._steps

    def _solve(self, k: int, right: FloatArray, *, transposed: bool = False) -> FloatArray:
        """Solve with D_k for forces on X_k, or with D_kᵀ for forces on X_{k+1}, up to rigid motions."""
        of, at = (k + 1, k) if transposed else (k, k + 1)
        matrix = self._ahead[k - 1].T if transposed else self._ahead[k - 1]
        kind: Literal["N", "T"] = "T" if transposed else "N"
        found, left = np.zeros_like(right), right
        for _ in range(2):  # twice, because the factorised matrix is regularised
            balanced = without_rigid_motion(left, self._shapes[of]).reshape(len(right), -1)
            step: FloatArray = self._factors[k - 1].solve(balanced.T, kind)  # type: ignore[call-overload] # stubs lack it
            found = found + without_rigid_motion(step.T.reshape(right.shape), self._shapes[at])
            left = right - _apply(matrix, found)
        return found


def _apply(matrix: sparse.csc_array | sparse.csr_array, fields: FloatArray) -> FloatArray:
    product: FloatArray = np.asarray(matrix @ fields.reshape(len(fields), -1).T)
    return product.T.reshape(fields.shape)


def _coupling(current: ShellPoint, following: ShellPoint) -> sparse.csc_array:
    """Compute ``D_k`` (3V, 3V)."""
    matrix = current.space.jacobian.matrix
    hessian = current.rest.mixed_hessian(following.z)
    return sparse.csc_array(matrix(current.gradients).T @ hessian @ matrix(following.gradients))


def _stiffness(previous: ShellPoint, current: ShellPoint, following: ShellPoint) -> sparse.csc_array:
    """Compute the symmetric matrix ``C_k`` (3V, 3V)."""
    space = current.space
    jacobian = space.jacobian.matrix(current.gradients)
    hessian = current.rest.hessian_rest(following.z) + space.energy.matrix(previous.rest.hessian_deformed(current.z))
    covector = previous.rest.gradient_deformed(current.z) + current.rest.gradient_rest(following.z)
    return sparse.csc_array(jacobian.T @ hessian @ jacobian + space.curvature(current, covector))
