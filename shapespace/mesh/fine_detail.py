"""What weights of neighbouring coarse vertices cannot carry to the fine mesh, learned from the collection's shapes.

Where shapes differ little, the fine detail of a place follows the whole shape, not only its surroundings. A bone that
is wider here may have a deeper groove there. Ridge regression of this detail on the principal coordinates of the
coarse shape, and principal fields of the result, keep the part that returns on unseen shapes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import Placement

#: Ridges that are tried, as shares of the largest square of a principal coordinate.
RIDGES = (1e-6, 1e-5, 1e-4, 1e-3, 1e-2, 1e-1)
#: Principal coordinates below this share of the largest are left out.
SMALLEST = 1e-5
#: Share of the predicted detail that the principal fields keep, and most numbers that they have together.
KEPT, LARGEST = 0.999, 1_500_000
#: Detail is used if it lowers the error of held-out shapes by at least this share.
GAIN = 0.02


@dataclass(frozen=True, eq=False)
class FineDetail:
    """Displacements of fine vertices that depend linearly on the coarse shape, placed at rest.

    Coordinate k of a coarse shape y is ``⟨a_k, y − rest⟩``, after rigid alignment to the rest shape. Each coordinate
    has a field of displacements, which turns with the shape. At rest there is no displacement.
    """

    rest: FloatArray  # (V, 3) the coarse shape at rest
    axes: FloatArray  # (r, V, 3) a_k
    fields: NDArray[np.float32]  # (r, Vf, 3) displacements

    def __call__(self, coarse: FloatArray) -> FloatArray:
        """Return displacements (Vf, 3) for a coarse shape (V, 3) in any position."""
        place = Placement.between(coarse, self.rest)
        coordinates = np.tensordot(self.axes, place(coarse) - self.rest, axes=2)
        displacements = coordinates.astype(np.float32) @ self.fields.reshape(len(self.fields), -1)
        return displacements.reshape(-1, 3).astype(np.float64) @ place.rotation

    @classmethod
    def fitted(cls, rest: FloatArray, coarse: FloatArray, missing: FloatArray, ridge: float) -> FineDetail | None:
        """Fit to coarse shapes (n, V, 3) whose fine vertices miss displacements (n, Vf, 3).

        Returns None if there is nothing to learn, or the mesh is so fine that one field is too large.
        """
        places = [Placement.between(y, rest) for y in coarse]
        coarse = np.stack([place(y) for place, y in zip(places, coarse, strict=True)])
        missing = np.stack([each @ place.rotation.T for place, each in zip(places, missing, strict=True)])
        u, s, axes = np.linalg.svd((coarse - rest).reshape(len(coarse), -1), full_matrices=False)
        some = s > SMALLEST * s[0]
        u, s, axes = u[:, some], s[some], axes[some]
        shrunk = s / (s**2 + ridge * s[0] ** 2)
        # The prediction is ``x axesᵀ slopes`` for rows x, and its values at the training shapes are u (s slopes).
        slopes = shrunk[:, None] * (u.T @ missing.reshape(len(missing), -1))
        values, vectors = np.linalg.eigh((s[:, None] * slopes) @ (s[:, None] * slopes).T)
        values, vectors = values[::-1].clip(0), vectors[:, ::-1]
        enough = 1 + int((np.cumsum(values) < KEPT * values.sum()).sum())
        count = min(enough, LARGEST // (missing[0].size + rest.size), len(values))
        if not count or not values[0] > 0:
            return None
        # Principal fields of the values, with orthonormal coefficients q = vectorsᵀ uᵀ.
        fields = vectors[:, :count].T @ (s[:, None] * slopes)
        return cls(
            rest,
            (vectors[:, :count].T / s @ axes).reshape(count, *rest.shape),
            fields.reshape(count, *missing.shape[1:]).astype(np.float32),
        )
