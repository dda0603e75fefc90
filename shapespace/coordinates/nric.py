"""Nonlinear rotation-invariant coordinates: edge lengths and signed dihedral angles (paper, appendix C).

A shape is ``z = (l, θ)`` with 2E entries: first every edge length, then every dihedral angle, both in edge order. θ is
the angle between the two face normals in radians, in (−π, π]. It is zero where the surface is flat, and positive where
it is convex on the side of the normals. A boundary edge keeps its entry, with θ = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.mesh.vectors import components, cross, dot


class HingeGeometry:
    """Edge vectors of shapes (…, V, 3), and the vectors and normals at every hinge, all by components (3, …).

    Lengths, angles and their derivatives share them, and they are most of the work.
    """

    def __init__(self, vertices: FloatArray, connectivity: Connectivity) -> None:
        self.connectivity = connectivity
        # `take` on whole components: ten times as fast as indexing.
        x = components(vertices)
        i, j = connectivity.edge_ends
        self.edges = x.take(j, axis=-1)
        tails = x.take(i, axis=-1)
        self.edges -= tails
        self.lengths = np.sqrt(dot(self.edges, self.edges))
        inner = connectivity.hinge_edges
        closed = connectivity.is_closed
        self.hinge_edges = self.edges if closed else self.edges.take(inner, axis=-1)
        self.hinge_lengths = self.lengths if closed else self.lengths.take(inner, axis=-1)
        tail, _, left, right = connectivity.hinge_corners
        origin = tails if closed else x.take(tail, axis=-1)
        self.to_left = x.take(left, axis=-1)
        self.to_left -= origin
        self.to_right = x.take(right, axis=-1)
        self.to_right -= origin
        self.left_normal = cross(self.hinge_edges, self.to_left)
        self.right_normal = cross(self.to_right, self.hinge_edges)

    def angles(self) -> FloatArray:
        """Compute the angles (…, H) by atan2, which is accurate near 0 and π, where arccos is not."""
        sine = dot(self.left_normal, self.to_right)
        sine *= -self.hinge_lengths
        sine += 0.0  # turns −0 into 0: at a hinge folded flat arctan2 would give −π instead of π
        return np.arctan2(sine, dot(self.left_normal, self.right_normal))

    def nric(self) -> FloatArray:
        """Compute lengths and angles (…, 2E)."""
        connectivity = self.connectivity
        e = connectivity.edge_count
        z = np.zeros((*self.lengths.shape[:-1], 2 * e))
        z[..., :e] = self.lengths
        if connectivity.is_closed:
            z[..., e:] = self.angles()
        else:
            z[..., e + connectivity.hinge_edges] = self.angles()
        return z

    def gradients(self) -> NRICGradients:
        """Compute the first derivatives. For one shape only."""
        edge, length = self.hinge_edges, self.hinge_lengths
        square = length**2
        # The gradient at an opposite vertex is normal to its face and has length 1/height.
        angles = np.empty((4, *edge.shape))
        tail, head, left, right = angles
        np.multiply(self.left_normal, -length / dot(self.left_normal, self.left_normal), out=left)
        np.multiply(self.right_normal, -length / dot(self.right_normal, self.right_normal), out=right)
        np.multiply(left, -dot(self.to_left, edge) / square, out=head)
        head -= (dot(self.to_right, edge) / square) * right
        # The four sum to zero: a translation changes nothing.
        np.negative(head, out=tail)
        tail -= left
        tail -= right
        return NRICGradients(self.edges / self.lengths, angles)

    def second_derivatives(self) -> NRICSecondDerivatives:
        """Compute the second derivatives. For one shape only.

        The first derivatives of an angle are taken by the edge vector e and the vectors a and b from the tail to the
        opposite vertices: ``g_a = −|e| n_a/|n_a|²`` with ``n_a = e × a``, ``g_b = −|e| n_b/|n_b|²`` with
        ``n_b = b × e``, and ``g_e = −(a·e/|e|²) g_a − (b·e/|e|²) g_b``. The derivative by the tail is minus their sum.
        """
        direction = self.edges / self.lengths
        eye = np.eye(3)[:, :, None]
        lengths = (eye - direction[:, None] * direction[None]) / self.lengths
        e, size = self.hinge_edges, self.hinge_lengths
        along = e / size
        by = np.empty((4, 4, 3, 3, e.shape[-1]))  # by tail, head, left and right
        head = np.zeros((3, 3, e.shape[-1]))
        for vertex, arm, normal, sign in (
            (2, self.to_left, self.left_normal, 1),
            (3, self.to_right, self.right_normal, -1),
        ):
            square = dot(normal, normal)
            # Reflection at the face's plane: d(n/|n|²) = (I − 2 n nᵀ/|n|²) dn / |n|².
            reflection = (eye - 2 * normal[:, None] * normal[None] / square) * (size / square)
            turned = sign * np.einsum("ijh,jkh->ikh", reflection, _cross_matrix(arm))
            by[vertex, vertex] = -sign * np.einsum("ijh,jkh->ikh", reflection, _cross_matrix(e))
            by[vertex, 1] = turned - normal[:, None] * along[None] / square
            by[1, vertex] = by[vertex, 1].swapaxes(0, 1)
            gradient = -size / square * normal
            share = dot(arm, e) / size**2
            slope = (arm - 2 * share * e) / size**2
            head -= gradient[:, None] * slope[None] + share * by[vertex, 1]
        by[1, 1] = head
        by[2, 3] = by[3, 2] = 0
        by[0, 1:] = -by[1:, 1:].sum(axis=0)
        by[1:, 0] = by[0, 1:].swapaxes(1, 2)
        by[0, 0] = -by[1:, 0].sum(axis=0)
        return NRICSecondDerivatives(lengths, by)


def edge_lengths(vertices: FloatArray, connectivity: Connectivity) -> FloatArray:
    """Compute the edge lengths (…, E) of shapes (…, V, 3)."""
    x = components(vertices)
    i, j = connectivity.edge_ends
    edge = x.take(j, axis=-1) - x.take(i, axis=-1)
    return np.sqrt(dot(edge, edge))


def dihedral_angles(vertices: FloatArray, connectivity: Connectivity) -> FloatArray:
    """Compute the signed dihedral angles (…, E) of shapes (…, V, 3), in (−π, π], zero on boundary edges."""
    angles = np.zeros((*vertices.shape[:-2], connectivity.edge_count))
    angles[..., connectivity.hinge_edges] = HingeGeometry(vertices, connectivity).angles()
    return angles


def nric(vertices: FloatArray, connectivity: Connectivity) -> FloatArray:
    """Compute lengths and angles ``z`` (…, 2E) of shapes (…, V, 3)."""
    return HingeGeometry(vertices, connectivity).nric()


def wrap(angles: FloatArray) -> FloatArray:
    """Map angles, or differences of angles, into (−π, π] modulo 2π."""
    return np.pi - np.mod(np.pi - angles, 2 * np.pi)


def unwrap(z: FloatArray, reference: FloatArray) -> FloatArray:
    """Shift each angle in ``z`` (…, 2E) by a multiple of 2π to within π of the reference (2E)."""
    half = z.shape[-1] // 2
    angles = reference[..., half:] + wrap(z[..., half:] - reference[..., half:])
    return np.concatenate([z[..., :half], angles], axis=-1)


@dataclass(frozen=True)
class WeightedNorm:
    """The norm ``‖·‖_{2,z̄}`` of differences of NRIC (paper, section 3).

    ``‖d‖² = Σ (d_l / l̄)² + η Σ (l̄ a^{-1/2} d_θ)²``, with l̄ the lengths of the reference and ``a`` one third of the
    area of the two faces at an edge. Boundary angles have weight 0. The norm is dimensionless.
    """

    squared: FloatArray  # (2E,) weights of the squared differences, including η
    eta: float  # weight η of the angles

    @classmethod
    def of(cls, reference: TriangleMesh, eta: float) -> WeightedNorm:
        """Compute the weights from a reference shape."""
        connectivity = reference.connectivity
        lengths = edge_lengths(reference.vertices, connectivity)
        angle = np.zeros(connectivity.edge_count)
        inner = connectivity.interior
        area = reference.face_areas[connectivity.edge_faces[inner]].sum(axis=1) / 3
        angle[inner] = eta * lengths[inner] ** 2 / area
        return cls(np.concatenate([lengths**-2, angle]), eta)

    def square(self, difference: FloatArray) -> FloatArray:
        """Compute squared norms (…) of differences (…, 2E). Angles are not wrapped: unwrap them first."""
        return np.einsum("...e,e,...e->...", difference, self.squared, difference)


@dataclass(frozen=True)
class NRICGradients:
    """The entries of ``Dz(X)``, by components."""

    lengths: FloatArray  # (3, E) derivative of each length by its head; the derivative by its tail is the negative
    angles: FloatArray  # (4, 3, H) derivative of each interior angle by the tail, head, left and right opposite vertex


@dataclass(frozen=True)
class NRICSecondDerivatives:
    """The entries of ``D²z(X)``, by components."""

    # (3, 3, E) second derivative of each length by its head, and by its tail; the mixed one is the negative
    lengths: FloatArray
    # (4, 4, 3, 3, H) second derivatives of each interior angle by the tail, head, left and right vertex
    angles: FloatArray


def _cross_matrix(v: FloatArray) -> FloatArray:
    """(3, 3, …) matrices of ``x ↦ v × x`` by components (3, …)."""
    out = np.zeros((3, *v.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[k, j], out[j, k] = v[i], -v[i]
    return out


class NRICJacobian:
    """``Dz(X)``, the (2E, 3V) Jacobian of the lengths and angles of a shape, on a fixed sparsity pattern.

    Lengths depend on 2 vertices, angles on 4. Entries that happen to vanish are kept, so that all Jacobians of a
    connectivity have the same pattern. Angle gradients after Tamstorf and Grinspun, "Discrete bending forces and their
    Jacobians" (2013); they are finite for any non-degenerate hinge.
    """

    def __init__(self, connectivity: Connectivity) -> None:
        self.connectivity = connectivity
        e = connectivity.edge_count
        self.columns = np.concatenate(
            [
                (3 * connectivity.edges[:, :, None] + np.arange(3)).ravel(),
                (3 * connectivity.hinges[:, :, None] + np.arange(3)).ravel(),
            ]
        ).astype(np.int32)
        self.shape = (2 * e, 3 * connectivity.vertex_count)
        starts = np.zeros(2 * e + 1, dtype=np.int64)
        starts[1 : e + 1] = 6
        starts[e + 1 :][connectivity.hinge_edges] = 12
        self._indptr = np.cumsum(starts).astype(np.int32)
        #: Vertex of each term of a pull-back: tails, heads, then the four vertices of every hinge.
        self._vertices = np.concatenate([connectivity.edges.T.ravel(), connectivity.hinges.T.ravel()])

    def __call__(self, vertices: FloatArray) -> sparse.csr_array:
        """Compute the matrix at a shape (V, 3)."""
        return self.matrix(self.gradients(vertices))

    def matrix(self, gradients: NRICGradients) -> sparse.csr_array:
        """Assemble the Jacobian from its entries."""
        lengths = np.concatenate([-gradients.lengths, gradients.lengths])
        angles = gradients.angles.reshape(12, -1)
        data = np.concatenate([lengths.T.ravel(), angles.T.ravel()])
        return sparse.csr_array((data, self.columns, self._indptr), shape=self.shape)

    def push_forward(self, gradients: NRICGradients, displacement: FloatArray) -> FloatArray:
        """Compute ``J d`` (2E,) for a vertex field d (V, 3), without forming J."""
        e = self.connectivity.edge_count
        d = components(displacement)
        i, j = self.connectivity.edge_ends
        out = np.zeros(2 * e)
        out[:e] = dot(gradients.lengths, d.take(j, axis=1) - d.take(i, axis=1))
        hinges = d.take(self.connectivity.hinge_corners, axis=1)
        out[e + self.connectivity.hinge_edges] = np.einsum("vch,cvh->h", gradients.angles, hinges)
        return out

    def pull_back(self, gradients: NRICGradients, covector: FloatArray) -> FloatArray:
        """Compute ``Jᵀ p`` (V, 3) for a covector p (2E,), without forming J."""
        e = self.connectivity.edge_count
        terms = np.empty((3, len(self._vertices)))
        np.multiply(gradients.lengths, covector[:e], out=terms[:, e : 2 * e])
        np.negative(terms[:, e : 2 * e], out=terms[:, :e])
        on_hinges = terms[:, 2 * e :].reshape(3, 4, -1)
        angles = covector.take(e + self.connectivity.hinge_edges)
        np.multiply(gradients.angles.swapaxes(0, 1), angles, out=on_hinges)
        v = self.connectivity.vertex_count
        return np.stack([np.bincount(self._vertices, weights=t, minlength=v) for t in terms], axis=1)

    def gradients(self, vertices: FloatArray) -> NRICGradients:
        """Compute the entries of the Jacobian at a shape (V, 3)."""
        return HingeGeometry(vertices, self.connectivity).gradients()
