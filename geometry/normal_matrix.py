"""``JᵀHJ``: quadratic forms on lengths and angles, pulled back to vertex positions, on a fixed pattern."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geometry.cholesky import SymmetricPattern
from geometry.mesh import Connectivity, FloatArray
from geometry.nric import NRICGradients, WeightedNorm


@dataclass(frozen=True)
class QuadraticForm:
    """A quadratic form H on NRIC that couples no more than the three lengths of a face.

    Attributes:
        faces: (…, 3, 3, F) a symmetric block per face, on the lengths of its three sides.
        angles: (…, E) the diagonal on the angles, 0 on the boundary.
    """

    faces: FloatArray
    angles: FloatArray

    @classmethod
    def of(cls, norm: WeightedNorm, connectivity: Connectivity) -> QuadraticForm:
        """The square of a weighted norm; each edge's weight goes to one of its faces."""
        lengths, angles = np.split(norm.squared, 2)
        sides = connectivity.face_edges.T
        edges, first = np.unique(sides, return_index=True)
        side, face = np.unravel_index(first, sides.shape)
        faces = np.zeros((3, 3, len(connectivity.faces)))
        faces[side, side, face] = lengths[edges]
        return cls(faces, angles)


class NormalMatrix:
    """``JᵀHJ + εI`` as entries of a fixed symmetric pattern, by one scatter.

    The matrix is a sum of a 9×9 block per face, from lengths, and a 12×12 block per hinge, from angles; only
    their upper triangles are formed. εI lifts the six rigid motions out of the null space: forces have no
    part there. Sparse products would be as fast, but drop entries that cancel exactly: the pattern would change.
    """

    REGULARISATION = 1e-9

    def __init__(self, connectivity: Connectivity) -> None:
        self._sides = np.ascontiguousarray(connectivity.face_edges.T)
        # Side k runs from corner k+1 to corner k+2; stored edges run from the smaller to the larger vertex.
        self._corners = np.array([[1, 2], [2, 0], [0, 1]])
        tails = connectivity.faces.T[self._corners[:, 0]]
        self._signs = np.where(tails == connectivity.edges[self._sides, 0], 1.0, -1.0)
        self._interior = np.flatnonzero(connectivity.interior)
        rows, columns = [], []
        for vertices in (connectivity.faces, connectivity.hinges):
            unknowns = (3 * vertices[:, :, None] + np.arange(3)).reshape(len(vertices), -1).T
            a, b = np.triu_indices(len(unknowns))
            rows.append(unknowns[a].ravel())
            columns.append(unknowns[b].ravel())
        self.pattern = SymmetricPattern(3 * connectivity.vertex_count, np.concatenate(rows), np.concatenate(columns))

    def entries(self, gradients: NRICGradients, form: QuadraticForm) -> FloatArray:
        """Upper-triangle entries of ``JᵀHJ + εI`` for one shape's Jacobian."""
        faces, hinges = form.faces.shape[-1], len(self._interior)
        contributions = np.empty(45 * faces + 78 * hinges)
        self._lengths(gradients.lengths, form.faces, contributions[: 45 * faces].reshape(45, faces))
        angles = contributions[45 * faces :].reshape(78, hinges)
        g = gradients.angles.reshape(12, hinges)
        weighted = g * form.angles.take(self._interior)
        start = 0
        for a in range(12):
            np.multiply(g[a], weighted[a:], out=angles[start : start + 12 - a])
            start += 12 - a
        entries = self.pattern.scatter(contributions)
        entries[self.pattern.diagonal] += self.REGULARISATION * entries[self.pattern.diagonal].mean()
        return entries

    def _lengths(self, directions: FloatArray, blocks: FloatArray, out: FloatArray) -> None:
        u = directions.take(self._sides, axis=1) * self._signs
        # (side, corner, xyz, face): derivative of each length by each corner, two of three not zero.
        corners = np.zeros((3, 3, 3, u.shape[-1]))
        for k, (tail, head) in enumerate(self._corners):
            corners[k, tail], corners[k, head] = -u[:, k], u[:, k]
        g = corners.reshape(3, 9, -1)
        weighted = np.einsum("kmf,mbf->kbf", blocks, g)
        start = 0
        for a in range(9):
            i, j = self._corners[a // 3]
            piece = out[start : start + 9 - a]
            np.multiply(g[i, a], weighted[i, a:], out=piece)
            piece += g[j, a] * weighted[j, a:]
            start += 9 - a
