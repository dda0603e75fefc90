"""Shapes of the codes that a search looks at, and how they move with the code."""

from __future__ import annotations

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.model.decoder import Decoder
from shapespace.solve.deadline import Deadline


class SearchedShapes:
    """Shapes of one code after the other, normalised and in any pose; the last one is kept.

    Each is reconstructed from the one before, or from integrated frames where these are nearer.

    Args:
        model: whose codes they are.
        reconstruct: a solver that the model has lent.
        deadline: after which shapes stay as they are.
        rough: that of the frames (shapespace.coordinates.frame_integration) without Gauss–Newton, which costs at most
            a third and lies about half a percent of the diagonal away.

    Attributes:
        count: shapes that were reconstructed.
    """

    def __init__(
        self, model: Decoder, reconstruct: Reconstructor, deadline: Deadline | None, *, rough: bool = False
    ) -> None:
        self._model, self._reconstruct, self._deadline, self._rough = model, reconstruct, deadline, rough
        self._code, self._shape = np.full(model.latents.dimension, np.nan), model.reference.vertices
        self.count = 0

    def __call__(self, x: FloatArray) -> FloatArray:
        """(V, 3) at a code (m,); not finite where the networks overflow."""
        if not np.array_equal(x, self._code):
            self._code, self._shape = x.copy(), self._solve(self._model.nric(x))
        return self._shape

    def derivatives(self, x: FloatArray, changes: FloatArray) -> FloatArray:
        """(m, V, 3) at a code (m,), without rigid motion, given those of lengths and angles (2E, m)."""
        return self._reconstruct.differential(self(x), changes.T)

    def _solve(self, target: FloatArray) -> FloatArray:
        framed, reconstruct = self._reconstruct.integrate(target), self._reconstruct
        if self._rough:
            return reconstruct.nearest(target, framed, self._model.reference.vertices)
        self.count += 1
        start = reconstruct.nearest(target, framed, self._shape)
        return reconstruct(target, start, tolerance=1e-5, deadline=self._deadline).vertices
