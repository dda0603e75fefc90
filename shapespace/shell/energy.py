"""The elastic energy of a thin shell in lengths and angles, with its derivatives.

``W[z, z~] = W_mem + W_bend`` measures the deformation of a rest shape z into z~ (paper, appendix C). On each
face, with the Cauchy–Green tensor A of the affine map between the two triangles and the rest area a,

    W_mem = Σ_f a (μ/2 tr A + λ/4 det A − κ log det A − μ − λ/4),   κ = μ/2 + λ/4,

and on each interior edge, with d_e = (a_f + a_f')/3,

    W_bend = η Σ_e (θ_e − θ~_e)² l_e² / d_e.

**A misprint in the paper.** The paper prints the factor of the logarithm as μ + λ/2. Then the derivative of the density
at A = I would be (μ/2 + λ/4 − μ − λ/2) I = −κ I. The rest shape would be under stress, and W would not be a squared
distance to second order. With κ the density and its gradient vanish at A = I; a test checks this.

**Computation.** Let q_i be the squared lengths of a rest face, c_i = q_j + q_k − q_i and S = Σ c_i q_i = 16 a² (Heron).
Then tr A = 2/S Σ c_i q~_i and det A = S~/S. This needs no inverse of a first fundamental form and no choice of a
corner. In the change δ = q~ − q of the squared lengths and γ_i = δ_j + δ_k − δ_i,

    t = tr A − 2 = 2/S Σ c_i δ_i,   s = det A − 1 = t + 1/S Σ γ_i δ_i,
    W_mem/a = μ/2 t + λ/4 s − κ log(1 + s),

so energy and gradients of a small step are no differences of large numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.normal_matrix import QuadraticForm
from shapespace.mesh.triangle_mesh import Connectivity


@dataclass(frozen=True)
class Material:
    """Elastic parameters of a shell of unit area, with the defaults of the project.

    Attributes:
        mu: Lamé's μ of the membrane.
        lambda_: Lamé's λ of the membrane.
        eta: weight η of bending relative to stretching, about the squared thickness. Far above the default, geodesics
            of real collections lead to collapsed triangles, with any solver.
    """

    mu: float = 1.0
    lambda_: float = 1.0
    eta: float = 1e-4

    def __post_init__(self) -> None:
        if not (0 < self.mu < np.inf and 0 <= self.lambda_ < np.inf and 0 < self.eta < np.inf):
            raise ValueError(f"a material needs finite μ > 0, λ ≥ 0 and η > 0, not {self}")


class ShellEnergy:
    """The energy ``W`` on a connectivity.

    W_mem scales with area and W_bend does not, so η has a meaning only for a given size. Therefore the membrane part is
    divided by the ``area`` of the reference. Meshes in any unit then give the same numbers as meshes of unit area.
    """

    def __init__(self, connectivity: Connectivity, material: Material | None = None, area: float = 1.0) -> None:
        material = material or Material()
        self.connectivity = connectivity
        self.material = material
        self.area = area
        self.mu, self.lambda_, self.eta = material.mu / area, material.lambda_ / area, material.eta
        self.kappa = self.mu / 2 + self.lambda_ / 4
        #: (3, F) the edge on each side of each face.
        self.sides: IntArray = connectivity.face_sides
        # Index of the first and the second side of each edge among the 3F sides; a boundary edge has no second side.
        order = np.argsort(self.sides.ravel(), kind="stable")
        starts = np.searchsorted(self.sides.ravel()[order], np.arange(connectivity.edge_count))
        self._first: IntArray = order[starts]
        self._second: IntArray = order[np.minimum(starts + 1, len(order) - 1)]
        self._boundary: IntArray = np.flatnonzero(~connectivity.interior)

    def rest(self, z: FloatArray) -> RestShape:
        """Prepare rest shapes z (…, 2E)."""
        return RestShape(self, z)

    def matrix(self, form: QuadraticForm) -> sparse.csr_array:
        """Assemble a quadratic form of one shape as a matrix (2E, 2E)."""
        e = self.connectivity.edge_count
        rows, columns = (np.broadcast_to(x, form.faces.shape).ravel() for x in (self.sides[:, None], self.sides[None]))
        angles = np.arange(e, 2 * e)
        data = np.concatenate([form.faces.ravel(), form.angles])
        place = np.concatenate([rows, angles]), np.concatenate([columns, angles])
        return sparse.csr_array((data, place), shape=(2 * e, 2 * e))

    def sum_over_faces(self, sides: FloatArray) -> FloatArray:
        """Add the values of the sides of faces (…, 3, F) to their edges (…, E)."""
        flat = sides.reshape(*sides.shape[:-2], -1)
        second = flat.take(self._second, axis=-1)
        second[..., self._boundary] = 0
        second += flat.take(self._first, axis=-1)
        return second


def _opposite(q: FloatArray) -> FloatArray:
    """Compute ``q_j + q_k − q_i`` (…, 3, F) from values q on the three sides of faces."""
    return q.sum(axis=-2, keepdims=True) - 2 * q


class RestShape:
    """Rest shapes z (…, 2E), prepared for the energy of many deformed shapes.

    Leading dimensions broadcast: K rest shapes with K deformed shapes, or one rest shape with many. Areas of the faces
    are (…, F).
    """

    def __init__(self, energy: ShellEnergy, z: FloatArray) -> None:
        connectivity = energy.connectivity
        self._energy = energy
        self.z = z
        self._lengths, self._angles = np.split(z, 2, axis=-1)
        self._sides = self._lengths.take(energy.sides, axis=-1)
        self._q = self._sides**2
        self._c = _opposite(self._q)
        self._S = np.einsum("...if,...if->...f", self._c, self._q)
        with np.errstate(invalid="ignore"):
            self.areas: FloatArray = np.sqrt(self._S) / 4
        sides = np.broadcast_to(self.areas[..., None, :], self._sides.shape)
        self._edge_area = energy.sum_over_faces(sides)
        self._beta = 3 * energy.eta * self._lengths**2 / self._edge_area * connectivity.interior

    def _compare(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Compute γ (…, 3, F), t and s (…, F) of the faces, and the change of the angles modulo 2π (…, E)."""
        lengths, angles = np.split(z, 2, axis=-1)
        delta = lengths.take(self._energy.sides, axis=-1) ** 2 - self._q
        gamma = _opposite(delta)
        t = np.einsum("...if,...if->...f", self._c, delta)
        s = np.einsum("...if,...if->...f", gamma, delta)
        t *= 2 / self._S
        s /= self._S
        s += t
        turn = angles - self._angles
        # Like `wrap`, but in place and ten times faster. The sign of half a turn doesn't change its square.
        turn -= 2 * np.pi * np.rint(turn / (2 * np.pi))
        return gamma, t, s, turn

    def value(self, z: FloatArray) -> FloatArray:
        """Compute ``W[rest, z]`` (…), infinite where a face of the deformed shape z has no area."""
        m = self._energy
        _, t, s, turn = self._compare(z)
        with np.errstate(divide="ignore", invalid="ignore"):
            membrane = self.areas * (m.mu / 2 * t + m.lambda_ / 4 * s - m.kappa * np.log1p(s))
        total = membrane.sum(axis=-1) + (turn**2 * self._beta).sum(axis=-1)
        return np.where(np.isnan(total), np.inf, total)

    def gradient_deformed(self, z: FloatArray) -> FloatArray:
        """Compute ``∂₂W[rest, z]`` (…, 2E), the derivative by the deformed shape.

        By q~_i it is ``1/(16a) (2κ s/(1+s) c_i + (λ/2 − 2κ/(1+s)) γ_i)``.
        """
        m = self._energy
        gamma, _, s, turn = self._compare(z)
        stiffness = 2 * m.kappa / (1 + s)
        by_q = (stiffness * s)[..., None, :] * self._c + (m.lambda_ / 2 - stiffness)[..., None, :] * gamma
        by_q /= 16 * self.areas[..., None, :]
        lengths = m.sum_over_faces(by_q)
        lengths *= 2 * z[..., : lengths.shape[-1]]
        return np.concatenate([lengths, 2 * self._beta * turn], axis=-1)

    def gradient_rest(self, z: FloatArray) -> FloatArray:
        """Compute ``∂₁W[rest, z]`` (…, 2E), the derivative by the rest shape.

        By q_i the membrane part is ``1/(16a) (μ γ_i − c_i (μ/2 t + λ/4 s + κ log(1+s)))``; the bending part
        depends on l_e and, by ``∂a/∂q_i = c_i/(16a)``, on the areas in d_e.
        """
        m = self._energy
        gamma, t, s, turn = self._compare(z)
        bending = turn**2 * self._beta
        by_area = (-bending / self._edge_area).take(m.sides, axis=-1).sum(axis=-2)
        density = m.mu / 2 * t + m.lambda_ / 4 * s + m.kappa * np.log1p(s)
        by_q = m.mu * gamma + (by_area - density)[..., None, :] * self._c
        by_q /= 16 * self.areas[..., None, :]
        lengths = m.sum_over_faces(by_q)
        lengths *= 2 * self._lengths
        lengths += 2 * bending / self._lengths
        return np.concatenate([lengths, -2 * self._beta * turn], axis=-1)

    def hessian(self) -> QuadraticForm:
        """Compute ``Hess₂ W[rest, rest]``, twice the metric, which equals ``−∂₁∂₂W[rest, rest]``.

        By the q of a face it is ``1/(16a) ((2μ+λ)/S c cᵀ + μ (2I − 11ᵀ))``.
        """
        m = self._energy
        c = self._c
        blocks = c[..., :, None, :] * (c * ((2 * m.mu + m.lambda_) / self._S)[..., None, :])[..., None, :, :]
        blocks += m.mu * (2 * np.eye(3) - 1)[:, :, None]
        # Chain rule for q = l², and 4/(16a) = 1/√S.
        scaled = self._sides / np.sqrt(np.sqrt(self._S))[..., None, :]
        blocks *= scaled[..., :, None, :]
        blocks *= scaled[..., None, :, :]
        return QuadraticForm(blocks, 2 * self._beta)

    def mixed_hessian(self, z: FloatArray) -> sparse.csr_array:
        """Compute ``∂₂∂₁W[rest, z]`` (2E, 2E), with rows by rest and columns by deformed coordinates. One rest shape
        only.

        By q_i and q~_m it is ``1/(16a) (μ (1 − 2δ_im) − c_i (μ c_m + (λ/2 + 2κ/(1+s)) c~_m)/S)``. Unlike ``−hessian()``
        it is exact, and not symmetric: bending depends on rest lengths but not on deformed lengths.
        """
        m = self._energy
        e = m.connectivity.edge_count
        gamma, _, s, turn = self._compare(z)
        slope = m.mu * self._c + (m.lambda_ / 2 + 2 * m.kappa / (1 + s)) * (self._c + gamma)
        blocks = m.mu * (1 - 2 * np.eye(3))[:, :, None] - self._c[:, None] * (slope / self._S)[None]
        blocks *= 4 * self._sides[:, None] * z[:e][m.sides][None] / (16 * self.areas)
        rows = np.broadcast_to(m.sides[:, None], blocks.shape)
        columns = np.broadcast_to(m.sides[None], blocks.shape)

        # ∂₁W_bend by lengths is turn² times a function of the rest shape; differentiate turn².
        by_turn = 2 * turn * self._beta
        by_area = (-by_turn / self._edge_area)[m.sides]
        areas = by_area[None] * (self._c * self._sides / (8 * self.areas))[:, None]
        angles = np.arange(e, 2 * e)
        i = np.concatenate([rows, rows, angles - e, angles], axis=None)
        j = np.concatenate([columns, e + columns, angles, angles], axis=None)
        data = np.concatenate([blocks, areas, 2 * by_turn / self._lengths, -2 * self._beta], axis=None)
        return sparse.csr_array((data, (i, j)), shape=(2 * e, 2 * e))

    def hessian_deformed(self, z: FloatArray) -> QuadraticForm:
        """Compute ``∂₂∂₂W[rest, z]``, which is ``hessian()`` at z = rest. One rest shape and one deformed shape only.

        By q~_i and q~_m it is ``1/(16a) (4κ/(S (1+s)²) c~_i c~_m + (λ/2 − 2κ/(1+s)) (1 − 2δ_im))``.
        """
        m = self._energy
        gamma, _, s, _ = self._compare(z)
        c = self._c + gamma
        stiffness = 2 * m.kappa / (1 + s)
        blocks = c[:, None] * (c * (2 * stiffness / ((1 + s) * self._S)))[None]
        blocks += (m.lambda_ / 2 - stiffness) * _OPPOSITE
        by_q = stiffness * s * self._c + (m.lambda_ / 2 - stiffness) * gamma
        return QuadraticForm(_by_lengths(blocks, by_q, z[: len(z) // 2][m.sides]) / (16 * self.areas), 2 * self._beta)

    def hessian_rest(self, z: FloatArray) -> sparse.csr_array:
        """Compute ``∂₁∂₁W[rest, z]`` (2E, 2E). One rest shape and one deformed shape only.

        Membrane part by the q of a face, with ``T = t + 2``, ``c~ = c + γ`` and ``Q = μ/2 t + λ/4 s + κ log(1+s)``:
        ``1/(16a) (−(1 − 2δ_im) (μ + Q) − (μ/S) (c_m γ_i + c_i c~_m) + (c_i c_m/S) (Q + μ T + λ/2 (1+s) + 2κ))``.
        Bending couples the sides of both faces at an edge, by their area in d_e.
        """
        m = self._energy
        e = m.connectivity.edge_count
        gamma, t, s, turn = self._compare(z)
        c, S = self._c, self._S
        Q = m.mu / 2 * t + m.lambda_ / 4 * s + m.kappa * np.log1p(s)
        outer = c[:, None] * c[None]

        # Bending is ``b = 3η l² turn² / A`` with A the area of the two faces. Differentiate by l, A and the angle.
        bending = turn**2 * self._beta
        length, A = self._lengths, self._edge_area
        by_A = -bending / A
        around = by_A[m.sides].sum(axis=0)

        blocks = (outer * (Q + m.mu * (t + 2) + m.lambda_ / 2 * (1 + s) + 2 * m.kappa - around)) / S
        blocks -= m.mu / S * (c[None] * gamma[:, None] + c[:, None] * (c + gamma)[None])
        blocks += (around - m.mu - Q) * _OPPOSITE
        by_q = m.mu * gamma + (around - Q) * c
        blocks = _by_lengths(blocks, by_q, self._sides) / (16 * self.areas)

        edges, (i, j) = np.arange(e), np.broadcast_arrays(m.sides[:, None], m.sides[None])
        membrane = sparse.csr_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=(e, e))
        slopes = 2 * self._sides * c / (16 * self.areas)
        areas = sparse.csr_array((np.broadcast_to(slopes[None], i.shape).ravel(), (i.ravel(), j.ravel())), shape=(e, e))

        def diagonal(entries: FloatArray) -> sparse.csr_array:
            return sparse.csr_array((entries, (edges, edges)), shape=(e, e))

        mixed = areas.T @ diagonal(2 * by_A / length)
        lengths = membrane + diagonal(2 * bending / length**2) + mixed + mixed.T
        lengths = lengths + areas.T @ diagonal(2 * bending / A**2) @ areas
        by_turn = 2 * turn * self._beta
        angles = areas.T @ diagonal(by_turn / A) - diagonal(2 * by_turn / length)
        whole = sparse.block_array([[lengths, angles], [angles.T, diagonal(2 * self._beta)]])
        return sparse.csr_array(whole)


#: ``∂(q_j + q_k − q_i)/∂q_m`` for the three sides of a face, with a dimension for the faces.
_OPPOSITE = (1.0 - 2.0 * np.eye(3))[:, :, None]


def _by_lengths(by_q: FloatArray, slope: FloatArray, sides: FloatArray) -> FloatArray:
    """Convert second derivatives (3, 3, F) by squared lengths to lengths, given the first ones (3, F)."""
    blocks = 4 * by_q * sides[:, None] * sides[None]
    blocks[np.arange(3), np.arange(3)] += 2 * slope
    return blocks
