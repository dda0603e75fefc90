"""Nonlinear rotation-invariant coordinates: edge lengths and signed dihedral angles (paper, appendix C).

A shape is ``z = (l, θ)`` of 2E entries: first every edge length, then every dihedral angle, both in edge
order. θ is the angle between the two face normals in radians, in (−π, π], zero where flat and positive where
the surface is convex seen from the side the normals point to. A boundary edge keeps its slot with θ = 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.mesh.vectors import components, cross, dot


class HingeGeometry:
    """Edge vectors, and at every hinge the vectors and normals that angles are made of, all (3, …).

    Lengths, angles and their derivatives are all computed from these, and these are most of the work.

    Args:
        vertices: shapes (…, V, 3).
        connectivity: of all these shapes.
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
        """(…, H) by atan2 of (sine, cosine), which stays accurate near 0 and π where arccos does not."""
        sine = dot(self.left_normal, self.to_right)
        sine *= -self.hinge_lengths
        sine += 0.0  # never −0, for which arctan2 gives −π instead of π at a hinge folded flat
        return np.arctan2(sine, dot(self.left_normal, self.right_normal))

    def nric(self) -> FloatArray:
        """(…, 2E) lengths and angles."""
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
        """The derivatives, of one shape."""
        edge, length = self.hinge_edges, self.hinge_lengths
        square = length**2
        # The gradient at an opposite vertex is along its face's normal, with 1/height as size.
        angles = np.empty((4, *edge.shape))
        tail, head, left, right = angles
        np.multiply(self.left_normal, -length / dot(self.left_normal, self.left_normal), out=left)
        np.multiply(self.right_normal, -length / dot(self.right_normal, self.right_normal), out=right)
        np.multiply(left, -dot(self.to_left, edge) / square, out=head)
        head -= (dot(self.to_right, edge) / square) * right
        # The four sum to zero: nothing changes when all move together.
        np.negative(head, out=tail)
        tail -= left
        tail -= right
        return NRICGradients(self.edges / self.lengths, angles)

    def second_derivatives(self) -> NRICSecondDerivatives:
        """The second derivatives, of one shape.

        Of an angle by the edge vector e and the vectors a and b to the opposite vertices, whose gradients are
        ``g_a = −|e| n_a/|n_a|²`` with ``n_a = e × a``, ``g_b = −|e| n_b/|n_b|²`` with ``n_b = b × e`` and
        ``g_e = −(a·e/|e|²) g_a − (b·e/|e|²) g_b``; by the tail, minus the sum.
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
    """Lengths (…, E) of the edges of shapes (…, V, 3)."""
    x = components(vertices)
    i, j = connectivity.edge_ends
    edge = x.take(j, axis=-1) - x.take(i, axis=-1)
    return np.sqrt(dot(edge, edge))


def dihedral_angles(vertices: FloatArray, connectivity: Connectivity) -> FloatArray:
    """Signed dihedral angles (…, E) of shapes (…, V, 3), in (−π, π], zero on boundary edges."""
    angles = np.zeros((*vertices.shape[:-2], connectivity.edge_count))
    angles[..., connectivity.hinge_edges] = HingeGeometry(vertices, connectivity).angles()
    return angles


def nric(vertices: FloatArray, connectivity: Connectivity) -> FloatArray:
    """Lengths and angles ``z`` (…, 2E) of shapes (…, V, 3)."""
    return HingeGeometry(vertices, connectivity).nric()


def wrap(angles: FloatArray) -> FloatArray:
    """Bring angles, or differences of angles, into (−π, π]."""
    return np.pi - np.mod(np.pi - angles, 2 * np.pi)


def unwrap(z: FloatArray, reference: FloatArray) -> FloatArray:
    """Choose the representative of each angle in ``z`` (…, 2E) that lies within π of the reference's (2E)."""
    half = z.shape[-1] // 2
    angles = reference[..., half:] + wrap(z[..., half:] - reference[..., half:])
    return np.concatenate([z[..., :half], angles], axis=-1)


@dataclass(frozen=True)
class WeightedNorm:
    """The norm ``‖·‖_{2,z̄}`` of differences of NRIC (paper, section 3).

    ``‖d‖² = Σ (d_l / l̄)² + η Σ (l̄ a^{-1/2} d_θ)²`` with lengths l̄ of the reference and ``a`` one third of
    the area of the two faces at an edge. Boundary angles weigh nothing. Dimensionless.

    Attributes:
        squared: (2E,) weights of the squared differences, η included.
        eta: η.
    """

    squared: FloatArray
    eta: float

    @classmethod
    def of(cls, reference: TriangleMesh, eta: float) -> WeightedNorm:
        """Weights of a reference shape."""
        connectivity = reference.connectivity
        lengths = edge_lengths(reference.vertices, connectivity)
        angle = np.zeros(connectivity.edge_count)
        inner = connectivity.interior
        area = reference.face_areas[connectivity.edge_faces[inner]].sum(axis=1) / 3
        angle[inner] = eta * lengths[inner] ** 2 / area
        return cls(np.concatenate([lengths**-2, angle]), eta)

    def square(self, difference: FloatArray) -> FloatArray:
        """Squared norms (…) of differences (…, 2E); angles count as they stand, so unwrap them first."""
        return np.einsum("...e,e,...e->...", difference, self.squared, difference)


@dataclass(frozen=True)
class NRICGradients:
    """What ``Dz(X)`` is made of, as whole arrays that are quick to work on.

    Attributes:
        lengths: (3, E) derivative of each length by its head; by its tail it is the negative.
        angles: (4, 3, H) derivative of each interior angle by tail, head, left and right opposite vertex.
    """

    lengths: FloatArray
    angles: FloatArray


@dataclass(frozen=True)
class NRICSecondDerivatives:
    """What ``D²z(X)`` is made of.

    Attributes:
        lengths: (3, 3, E) second derivative of each length by its head; also by its tail, and minus that by both.
        angles: (4, 4, 3, 3, H) of each interior angle by tail, head, left and right opposite vertex.
    """

    lengths: FloatArray
    angles: FloatArray


def _cross_matrix(v: FloatArray) -> FloatArray:
    """(3, 3, …) matrices of ``x ↦ v × x`` by components (3, …)."""
    out = np.zeros((3, *v.shape))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[k, j], out[j, k] = v[i], -v[i]
    return out


class NRICJacobian:
    """``Dz(X)``, the (2E, 3V) Jacobian of the NRIC of a shape, on a sparsity pattern found once.

    Lengths depend on 2 vertices, angles on 4; an entry is kept even where it happens to vanish, so that every
    Jacobian of a connectivity has the same pattern. Angle gradients after Tamstorf and Grinspun, "Discrete
    bending forces and their Jacobians" (2013), which stay finite for any non-degenerate hinge.
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
        #: Vertex of each term of a pull-back: tails, heads, then the four of every hinge.
        self._vertices = np.concatenate([connectivity.edges.T.ravel(), connectivity.hinges.T.ravel()])

    def __call__(self, vertices: FloatArray) -> sparse.csr_array:
        """The Jacobian at a shape (V, 3)."""
        return self.matrix(self.gradients(vertices))

    def matrix(self, gradients: NRICGradients) -> sparse.csr_array:
        """The Jacobian made of these gradients."""
        lengths = np.concatenate([-gradients.lengths, gradients.lengths])
        angles = gradients.angles.reshape(12, -1)
        data = np.concatenate([lengths.T.ravel(), angles.T.ravel()])
        return sparse.csr_array((data, self.columns, self._indptr), shape=self.shape)

    def push_forward(self, gradients: NRICGradients, displacement: FloatArray) -> FloatArray:
        """``J d`` (2E,) of a vertex field (V, 3), without forming J."""
        e = self.connectivity.edge_count
        d = components(displacement)
        i, j = self.connectivity.edge_ends
        out = np.zeros(2 * e)
        out[:e] = dot(gradients.lengths, d.take(j, axis=1) - d.take(i, axis=1))
        hinges = d.take(self.connectivity.hinge_corners, axis=1)
        out[e + self.connectivity.hinge_edges] = np.einsum("vch,cvh->h", gradients.angles, hinges)
        return out

    def pull_back(self, gradients: NRICGradients, covector: FloatArray) -> FloatArray:
        """``Jᵀ p`` (V, 3) of a covector (2E,), without forming J."""
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
        """The derivatives at a shape (V, 3)."""
        return HingeGeometry(vertices, self.connectivity).gradients()
