"""Standard deviation of a shape's vertices, from the covariance of its code."""

import numpy as np
from numpy.typing import ArrayLike

from shapespace.arrays import FloatArray
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.derivatives import carried, derivatives
from shapespace.model.latent_space import Codes, LatentError
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline

#: Largest asymmetry and most negative eigenvalue that rounding may cause, as shares of the largest entry.
ROUNDING = 1e-5


class InvalidCovarianceError(LatentError):
    """A matrix that is not a covariance of codes; the message says what to do."""


def require_covariance(model: Decoder, covariance: ArrayLike) -> FloatArray:
    """Return a covariance (m, m) as an array; raises InvalidCovarianceError."""
    m = model.latents.dimension
    try:
        matrix = np.asarray(covariance, dtype=np.float64)
    except ValueError:
        matrix = np.zeros(0)
    if matrix.shape != (m, m):
        raise InvalidCovarianceError(f"covariance must have {m} rows of {m} numbers, as `edit` and `encode` answer it.")
    largest = np.abs(matrix).max()
    if not largest < np.finfo(np.float32).max:
        raise InvalidCovarianceError("covariance has numbers that are not finite or too large. Give finite ones.")
    lopsided = np.abs(matrix - matrix.T).max() > ROUNDING * largest
    if lopsided or np.linalg.eigvalsh(matrix).min() < -ROUNDING * largest:
        raise InvalidCovarianceError("covariance is not symmetric with eigenvalues of at least 0. Give one that is.")
    return matrix


def vertex_uncertainty(
    model: Decoder,
    code: Codes,
    covariance: FloatArray,
    mesh: MeshChoice = MeshChoice.FINE,
    deadline: Deadline | None = None,
) -> FloatArray:
    """Return the standard deviation (V,) of vertices, ``√tr(J C Jᵀ)`` with J the derivative of a vertex by the code.
    For C see ``require_covariance``. The vertices, on ``mesh``, are aligned to the reference. After the deadline the
    shape is not iterated further.

    Raises NotFiniteError if the numbers overflow at this code, and InvalidCovarianceError if the shape has nearly
    collapsed, so that it has no derivative.
    """
    scale, x = model.manifest.scale, code.astype(np.float64)
    values, vectors = np.linalg.eigh(covariance)
    directions = np.sqrt(np.maximum(values, 0))[:, None] * vectors.T
    coarse = model.shape(code, True, MeshChoice.COARSE, deadline).vertices / scale
    with model.solver() as reconstruct:
        try:
            fields = reconstruct.differential(coarse, (derivatives(model, x) @ directions.T).T)
        except NotPositiveDefiniteError:
            raise InvalidCovarianceError(
                "The shape of this code has almost collapsed, so its uncertainty is unknown. Leave color=spread out."
            ) from None
    moves = carried(model, lambda shapes: model.placed(shapes, mesh), coarse, fields)
    return scale * np.sqrt((moves**2).sum(axis=(0, 2)))
