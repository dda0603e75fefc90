"""Shapes of successive codes in a search, with derivatives by the code."""

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.model.decoder import Decoder
from shapespace.solve.deadline import Deadline


class SearchedShapes:
    """Shapes of successive codes, normalised and in any pose; the last shape is cached.

    Each shape is reconstructed from the last shape, or from integrated frames or a given shape if these are nearer.

    The decoder has lent the solver. After the deadline, shapes are not iterated further. A solved shape has converged
    if no vertex moves further than ``tolerance``, a fraction of the diagonal. If ``rough``, shapes are the shapes of
    the frames (shapespace.coordinates.frame_integration), without Gauss–Newton. This takes at most a third of the time
    and differs by about half a percent of the diagonal.
    """

    def __init__(
        self,
        model: Decoder,
        reconstruct: Reconstructor,
        deadline: Deadline | None,
        tolerance: float = 1e-5,
        *,
        rough: bool = False,
    ) -> None:
        self._model, self._reconstruct, self._deadline, self._rough = model, reconstruct, deadline, rough
        self._code, self._shape = np.full(model.latents.dimension, np.nan), model.reference.vertices
        self._tolerance, self.count = tolerance, 0

    def __call__(self, x: FloatArray, near: FloatArray | None = None) -> FloatArray:
        """Return the shape (V, 3) of a code (m,), not finite where the networks overflow; ``near`` replaces frames."""
        if not np.array_equal(x, self._code):
            self._code, self._shape = x.copy(), self._solve(self._model.nric(x), near)
        return self._shape

    def derivatives(self, x: FloatArray, changes: FloatArray) -> FloatArray:
        """Return derivatives (m, V, 3) at a code (m,), without rigid motion, from derivatives (2E, m) of NRIC."""
        return self._reconstruct.differential(self(x), changes.T)

    def _solve(self, target: FloatArray, near: FloatArray | None) -> FloatArray:
        reconstruct = self._reconstruct
        framed = reconstruct.integrate(target) if self._rough or near is None else near
        if self._rough:
            return reconstruct.nearest(target, framed, self._model.reference.vertices)
        self.count += 1
        start = reconstruct.nearest(target, framed, self._shape)
        return reconstruct(target, start, tolerance=self._tolerance, deadline=self._deadline).vertices
