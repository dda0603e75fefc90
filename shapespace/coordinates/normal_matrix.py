"""The matrix ``JᵀHJ``: a quadratic form on lengths and angles, pulled back to vertex positions."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import NRICGradients, NRICSecondDerivatives, WeightedNorm
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.solve.cholesky import SymmetricPattern


@dataclass(frozen=True)
class QuadraticForm:
    """A quadratic form H on lengths and angles that couples only the three lengths of each face."""

    faces: FloatArray  # (…, 3, 3, F) symmetric blocks on the lengths of the three sides of each face
    angles: FloatArray  # (…, E) diagonal on the angles, 0 on the boundary


def _upper(size: int) -> int:
    """Number of entries in the upper triangle of a symmetric block, including the diagonal."""
    return size * (size + 1) // 2


#: Sizes of the blocks: coordinates of the ends of an edge, the corners of a face and the vertices of a hinge.
EDGE, FACE, HINGE = 2 * 3, 3 * 3, 4 * 3


class NormalMatrix:
    """Entries of ``JᵀHJ + εI`` on a fixed symmetric pattern, by one scatter.

    The matrix is the sum of a 9×9 block per face, from lengths, and a 12×12 block per hinge, from angles. Only upper
    triangles are computed. For a norm, which couples no lengths, 6×6 blocks per edge replace the blocks per face. εI
    makes the matrix positive definite: JᵀHJ vanishes on the six rigid motions. Sparse products would take as long, but
    they drop entries that cancel exactly, so the pattern would change.
    """

    #: ε as a share of the mean diagonal entry.
    REGULARISATION = 1e-9

    def __init__(self, connectivity: Connectivity) -> None:
        self._sides = connectivity.face_sides
        # Side k runs from corner k+1 to corner k+2; stored edges run from the smaller to the larger vertex.
        self._corners = np.array([[1, 2], [2, 0], [0, 1]])
        tails = connectivity.faces.T[self._corners[:, 0]]
        self._signs = np.where(tails == connectivity.edges[self._sides, 0], 1.0, -1.0)
        self._interior = connectivity.hinge_edges
        self._ends = connectivity.edge_ends
        rows, columns = [], []
        for vertices in (connectivity.faces, connectivity.hinges):
            unknowns = (3 * vertices[:, :, None] + np.arange(3)).reshape(len(vertices), -1).T
            a, b = np.triu_indices(len(unknowns))
            rows.append(unknowns[a].ravel())
            columns.append(unknowns[b].ravel())
        self.pattern = SymmetricPattern(3 * connectivity.vertex_count, np.concatenate(rows), np.concatenate(columns))

    def entries(self, gradients: NRICGradients, form: QuadraticForm | WeightedNorm) -> FloatArray:
        """Compute the upper-triangle entries of ``JᵀHJ + εI`` for the Jacobian of one shape."""
        if isinstance(form, WeightedNorm):
            edges = gradients.lengths.shape[-1]
            contributions, on_lengths, on_angles = self._work_space(_upper(EDGE), edges)
            self._edges(gradients.lengths, form.squared[:edges], on_lengths)
            self._angles(gradients.angles, form.squared[edges:], on_angles)
            entries = self.pattern.scatter(contributions, self._slots_of_edges)
        else:
            contributions, on_lengths, on_angles = self._work_space(_upper(FACE), form.faces.shape[-1])
            self._faces(gradients.lengths, form.faces, on_lengths)
            self._angles(gradients.angles, form.angles, on_angles)
            entries = self.pattern.scatter(contributions)
        entries[self.pattern.diagonal] += self.REGULARISATION * entries[self.pattern.diagonal].mean()
        return entries

    def second_derivative(self, second: NRICSecondDerivatives, covector: FloatArray) -> FloatArray:
        """Upper-triangle entries of ``Σ_i p_i D²z_i(X)``, the derivative of ``Jᵀp`` by X at fixed p (2E,)."""
        edges = second.lengths.shape[-1]
        contributions, on_lengths, on_angles = self._work_space(_upper(EDGE), edges)
        blocks = second.lengths * covector[:edges]
        on_lengths[:6] = on_lengths[6:12] = blocks[np.triu_indices(3)]
        on_lengths[12:] = -blocks.reshape(9, edges)
        a, b = np.triu_indices(HINGE)
        angles = second.angles[a // 3, b // 3, a % 3, b % 3]
        np.multiply(angles, covector.take(edges + self._interior), out=on_angles)
        return self.pattern.scatter(contributions, self._slots_of_edges)

    def _work_space(self, entries: int, blocks: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Allocate contributions, with views of the part from lengths (entries, blocks) and the part from angles."""
        lengths = entries * blocks
        contributions = np.empty(lengths + _upper(HINGE) * len(self._interior))
        on_lengths, on_angles = contributions[:lengths], contributions[lengths:]
        return contributions, on_lengths.reshape(entries, blocks), on_angles.reshape(_upper(HINGE), -1)

    def _angles(self, gradients: FloatArray, weights: FloatArray, out: FloatArray) -> None:
        g = gradients.reshape(HINGE, -1)
        weighted = g * weights.take(self._interior)
        start = 0
        for a in range(HINGE):
            np.multiply(g[a], weighted[a:], out=out[start : start + HINGE - a])
            start += HINGE - a

    @cached_property
    def _slots_of_edges(self) -> IntArray:
        """Entries that receive the contributions of a norm: first from `_edges`, then from the hinges."""
        size = self.pattern.size
        a, b = np.triu_indices(3)
        tails, heads = (3 * end[None] for end in self._ends)
        rows = [tails + a[:, None], heads + a[:, None], *(tails + k for k in range(3) for _ in range(3))]
        columns = [tails + b[:, None], heads + b[:, None], *(heads + k for _ in range(3) for k in range(3))]
        keys = self.pattern.rows * size + self.pattern.indices
        slots = np.searchsorted(keys, (np.concatenate(rows) * size + np.concatenate(columns)).ravel())
        return np.concatenate([slots, self.pattern.slots[_upper(FACE) * self._sides.shape[1] :]])

    def _edges(self, directions: FloatArray, weights: FloatArray, out: FloatArray) -> None:
        # 3×3 blocks. Tail with tail and head with head are equal; only their upper triangles are kept. Tail with head
        # is the negative of these, with all nine entries.
        tails, heads, both = np.split(out, [_upper(3), 2 * _upper(3)])
        weighted = directions * weights
        start = 0
        for a in range(3):
            np.multiply(directions[a], weighted[a:], out=tails[start : start + 3 - a])
            np.multiply(-directions[a], weighted, out=both[3 * a : 3 * a + 3])
            start += 3 - a
        heads[:] = tails

    def _faces(self, directions: FloatArray, blocks: FloatArray, out: FloatArray) -> None:
        u = directions.take(self._sides, axis=1) * self._signs
        # (side, corner, xyz, face): derivative of each length by each corner; one of the three is zero.
        corners = np.zeros((3, 3, 3, u.shape[-1]))
        for k, (tail, head) in enumerate(self._corners):
            corners[k, tail], corners[k, head] = -u[:, k], u[:, k]
        g = corners.reshape(3, FACE, -1)
        weighted = np.einsum("kmf,mbf->kbf", blocks, g)
        start = 0
        for a in range(FACE):
            i, j = self._corners[a // 3]
            piece = out[start : start + FACE - a]
            np.multiply(g[i, a], weighted[i, a:], out=piece)
            piece += g[j, a] * weighted[j, a:]
            start += FACE - a
