"""The coupling of two neighbours of a discrete path: the mixed second derivative of W by both shapes."""

from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.shell.space import ShellPoint


def coupling(current: ShellPoint, following: ShellPoint) -> sparse.csc_array:
    """Compute ``D_k = J_kᵀ ∂₂∂₁W[z_k, z_{k+1}] J_{k+1}`` (3V, 3V). It is close to −A and not symmetric."""
    matrix = current.space.jacobian.matrix
    hessian = current.rest.mixed_hessian(following.z)
    return sparse.csc_array(matrix(current.gradients).T @ hessian @ matrix(following.gradients))


def factorised(matrix: sparse.csc_array) -> SuperLU:
    """Factorise ``D_k``, regularised on rigid motions. Raises RuntimeError if it is singular.

    The matrix is close to −A, which is definite. So no pivoting is needed, and the ordering is for symmetric patterns.
    """
    shift = NormalMatrix.REGULARISATION * matrix.diagonal().mean() * sparse.eye_array(matrix.shape[0])
    mode = {"SymmetricMode": True}
    regular = sparse.csc_array(matrix + shift)
    return splu(regular, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=mode)
