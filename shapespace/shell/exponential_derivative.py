"""The derivative of the time-discrete exponential map by the velocity, and its transpose."""

from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import rigid_motions, without_rigid_motion
from shapespace.shell.coupling import coupling, factorised
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

    With a centred first step, ``X_1 = (X_0 + v/K + X) / 2``, where X follows ``X_{−1} = X_0 − v/K`` and X_0. Its change
    is δ = ``D⁻¹ D_{−1}ᵀ δv/K``, with D for the step from X_0 to X. Then δ is projected, because X is aligned to X_0.

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
            ahead = coupling(current, following)
            self._ahead.append(ahead)
            self._here.append(_stiffness(previous, current, following))
            self._factors.append(factorised(ahead))
        self._first = None if path.before is None else _CentredStep(path, path.before)

    def push_forward(self, velocities: FloatArray) -> FloatArray:
        """Compute ``D exp(v) δv`` (n, V, 3), the changes of the last shape for changes δv of the velocity (n, V, 3)."""
        before = np.zeros_like(velocities)
        now = without_rigid_motion(velocities, self._shapes[0]) / self._steps
        if self._first:
            now = self._first.push_forward(now)
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
        if self._first:
            following = self._first.pull_back(following)
        return without_rigid_motion(following, self._shapes[0]) / self._steps

    def _solve(self, k: int, right: FloatArray, *, transposed: bool = False) -> FloatArray:
        """Solve with D_k for forces on X_k, or with D_kᵀ for forces on X_{k+1}, up to rigid motions."""
        shapes = self._shapes[k], self._shapes[k + 1]
        return _solve(self._ahead[k - 1], self._factors[k - 1], shapes, right, transposed=transposed)


class _CentredStep:
    """The derivative of X_1 by the stride v/K, for a centred first step."""

    def __init__(self, path: DiscretePath, before: FloatArray) -> None:
        self._start = path.vertices[0]
        self._following = 2 * path.vertices[1] - 2 * self._start + before
        start = path.space.point(self._start)
        self._behind = coupling(path.space.point(before), start)
        self._ahead = coupling(start, path.space.point(self._following))
        self._factor = factorised(self._ahead)
        self._here, self._there = rigid_motions(self._start), rigid_motions(self._following)

    def push_forward(self, strides: FloatArray) -> FloatArray:
        """Compute the changes of X_1 for changes of the stride (n, V, 3) without rigid motion."""
        forces = _apply(self._behind.T, strides)
        following = self._solve(forces)
        return (strides + _projected(following, self._there, self._here)) / 2

    def pull_back(self, gradients: FloatArray) -> FloatArray:
        """Convert gradients (n, V, 3) by X_1 to gradients by the stride."""
        following = _projected(gradients, self._here, self._there)
        return (gradients + _apply(self._behind, self._solve(following, transposed=True))) / 2

    def _solve(self, right: FloatArray, *, transposed: bool = False) -> FloatArray:
        return _solve(self._ahead, self._factor, (self._start, self._following), right, transposed=transposed)


def _projected(fields: FloatArray, along: FloatArray, onto: FloatArray) -> FloatArray:
    """Remove from fields (n, V, 3) the motions (6, 3V) ``along`` that make them orthogonal to the motions ``onto``."""
    flat = fields.reshape(len(fields), -1)
    shares = np.linalg.solve(onto @ along.T, onto @ flat.T)
    return (flat - shares.T @ along).reshape(fields.shape)


def _solve(
    matrix: sparse.csc_array,
    factor: SuperLU,
    shapes: tuple[FloatArray, FloatArray],
    right: FloatArray,
    *,
    transposed: bool = False,
) -> FloatArray:
    """Solve with a factorised D for forces on the first of two shapes, or with Dᵀ for forces on the second."""
    of, at = shapes[::-1] if transposed else shapes
    kind: Literal["N", "T"] = "T" if transposed else "N"
    found, left = np.zeros_like(right), right
    for _ in range(2):  # twice, because the factorised matrix is regularised
        balanced = without_rigid_motion(left, of).reshape(len(right), -1)
        step: FloatArray = factor.solve(balanced.T, kind)  # type: ignore[call-overload] # stubs lack it
        found = found + without_rigid_motion(step.T.reshape(right.shape), at)
        left = right - _apply(matrix.T if transposed else matrix, found)
    return found


def _apply(matrix: sparse.csc_array | sparse.csr_array, fields: FloatArray) -> FloatArray:
    product: FloatArray = np.asarray(matrix @ fields.reshape(len(fields), -1).T)
    return product.T.reshape(fields.shape)


def _stiffness(previous: ShellPoint, current: ShellPoint, following: ShellPoint) -> sparse.csc_array:
    """Compute the symmetric matrix ``C_k`` (3V, 3V)."""
    space = current.space
    jacobian = space.jacobian.matrix(current.gradients)
    hessian = current.rest.hessian_rest(following.z) + space.energy.matrix(previous.rest.hessian_deformed(current.z))
    covector = previous.rest.gradient_deformed(current.z) + current.rest.gradient_rest(following.z)
    return sparse.csc_array(jacobian.T @ hessian @ jacobian + space.curvature(current, covector))
