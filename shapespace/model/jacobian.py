"""Derivatives of a shape by its code, without difference quotients of networks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.model.decoder import TOLERANCE, Decoder, MeshChoice
from shapespace.model.derivatives import carried
from shapespace.model.latent_space import Codes, LatentError
from shapespace.model.network_operators import NumPyOperations
from shapespace.model.network_program import NetworkProgram
from shapespace.model.shape import Quality
from shapespace.solve.cholesky import NotPositiveDefiniteError

#: Share of the usual tolerance to which the shape is solved: the derivative is that of the exact minimum.
SHARPER = 1e-5
#: Coordinates that are differentiated at a time, since the arrays of a combiner are large.
AT_ONCE = 4
#: Imaginary part that carries a derivative; see NetworkProgram.derivatives.
STEP = 1e-30


class NoDerivativeError(LatentError):
    """A code whose shape has no derivative; the message says why."""


class NetworkDerivatives:
    """Derivatives of lengths and angles by the code, from the files of a bundle's networks.

    Raises BundleError if a network has operators that are not known.
    """

    def __init__(self, decoder: Decoder, networks: Mapping[str, bytes]) -> None:
        manifest = decoder.manifest
        self._factors = [(factor, NetworkProgram(networks[factor.file], factor)) for factor in manifest.factors]
        self._combiner = NetworkProgram(networks[manifest.combiner.file], manifest.combiner)

    def __call__(self, code: FloatArray) -> FloatArray:
        """Return the derivatives (m, 2E) at a code (m,)."""
        found = [program.derivatives(code[factor.start : factor.stop]) for factor, program in self._factors]
        shapes = np.stack([shape for shape, _ in found]).astype(np.complex128)
        columns = [(j, change) for j, (_, changes) in enumerate(found) for change in changes]
        derivatives = []
        for start in range(0, len(columns), AT_ONCE):
            some = columns[start : start + AT_ONCE]
            moved = np.repeat(shapes[None], len(some), axis=0)
            for row, (j, change) in zip(moved, some, strict=True):
                row[j] += 1j * STEP * change
            derivatives.append(self._combiner(moved, self._combiner.arrays, NumPyOperations()).imag / STEP)
        return np.concatenate(derivatives)


def shape_jacobian(decoder: Decoder, networks: NetworkDerivatives, code: Codes, mesh: MeshChoice) -> FloatArray:
    """Return the derivatives (V, 3, m) of the full shape's vertices by its code (m,), in the user's units.

    Vertices X minimise ``½ ‖z(X) − z*‖²``, so ``(JᵀWJ + Σ_i w_i (z_i − z*_i) D²z_i) dX = JᵀW dz*`` by the implicit
    function theorem. Raises NoDerivativeError if the shape is no strict minimum.
    """
    target = decoder.nric(code.astype(np.float64))
    start = decoder.shape(code, mesh=MeshChoice.COARSE, quality=Quality.FULL).vertices / decoder.manifest.scale
    changes = networks(code.astype(np.float64))
    with decoder.solver() as reconstruct:
        shape = reconstruct(target, start, tolerance=SHARPER * TOLERANCE).vertices
        try:
            fields = reconstruct.exact_differential(shape, target, changes)
        except NotPositiveDefiniteError:
            raise NoDerivativeError(
                "The shape of this code has almost collapsed, so it has no derivative. Choose a code nearer to the "
                "bounds."
            ) from None

    # The mean of differences in both directions, whose error is quadratic in a small step.
    ahead, behind = (
        carried(decoder, lambda shapes: decoder.placed(shapes, mesh), shape, each) for each in (fields, -fields)
    )
    moves = (ahead - behind) / 2
    return decoder.manifest.scale * np.moveaxis(moves, 0, -1)
