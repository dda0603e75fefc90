"""The space of discrete shells as a Riemannian manifold, in vertex positions.

The paper works with lengths and angles ``z ∈ R^{2E}`` under integrability constraints. Here ``X ↦ z(X)`` parametrises
the manifold of immersed meshes instead. Its tangent space at z(X) is the range of the Jacobian ``J = Dz(X)``. An
equation on tangent vectors becomes ``Jᵀ(…) = 0``: 3V equations in 3V unknowns, determined up to the six rigid motions.

So integrability is exact and the genus doesn't matter. The matrices are symmetric positive definite. They take a ninth
of the work of the indefinite matrices in the constrained form, with which the tests compare.

Operations on this space are in ``exponential`` (shooting), ``geodesic`` (connecting, logarithm), ``transport`` and
``mean``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.coordinates.normal_matrix import NormalMatrix, QuadraticForm
from shapespace.coordinates.nric import HingeGeometry, NRICGradients, NRICJacobian, edge_lengths, nric, wrap
from shapespace.mesh.rigid_motion import rigid_motions, without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.shell.energy import Material, RestShape, ShellEnergy
from shapespace.shell.vertex_rotations import VertexRotations
from shapespace.solve.cholesky import Backend, Cholesky, analyse
from shapespace.solve.outcome import Outcome
from shapespace.solve.preconditioner import Preconditioner

#: Tolerance of equations F = 0, for ``sqrt(Fᵀ A⁻¹ F)``: the length in the metric of a further Newton step.
TOLERANCE = 1e-9
#: The first step of an exponential: straight on by d/K, as in the paper, or centred. See ``exponential``.
FirstStep = Literal["centred", "paper"]


@dataclass(frozen=True)
class StepLimits:
    """Limits for one step from shape to shape."""

    area_ratio: float = 1e-3  # a face has collapsed if a time step leaves less than this share of its area
    area_loss: float = 0.8  # largest share of its area that a face may lose in one step of a descent
    turn: float = 0.75 * np.pi  # largest change of an angle in a time step; beyond, the surface passes through a fold


STEP = StepLimits()


class ShellPoint:
    """A shape X (V, 3) with lengths and angles z (2E,), derivatives and energy, each computed on first use."""

    def __init__(self, space: ShellSpace, vertices: FloatArray, z: FloatArray | None = None) -> None:
        self.space = space
        self.vertices = vertices
        self.z = space.nric(vertices) if z is None else z

    @cached_property
    def rest(self) -> RestShape:
        """The shape as the first argument of W."""
        return self.space.energy.rest(self.z)

    @cached_property
    def gradients(self) -> NRICGradients:
        """The entries of ``Dz(X)``."""
        return self.space.jacobian.gradients(self.vertices)

    @cached_property
    def face_frames(self) -> FloatArray:
        """(xyz, 3, F) frames of the faces, see VertexRotations."""
        return self.space.vertex_rotations.face_frames(self.vertices)

    @cached_property
    def hessian(self) -> QuadraticForm:
        """``Hess₂ W[z, z]``, twice the metric."""
        return self.rest.hessian()

    def push_forward(self, displacement: FloatArray) -> FloatArray:
        """Compute ``J d`` (2E,), the change of lengths and angles by a vertex field d (V, 3)."""
        return self.space.jacobian.push_forward(self.gradients, displacement)

    def pull_back(self, covector: FloatArray) -> FloatArray:
        """Compute ``Jᵀ p`` (V, 3), the forces on vertices from forces p on lengths and angles (2E,)."""
        return self.space.jacobian.pull_back(self.gradients, covector)

    def lower(self, tangent: FloatArray) -> FloatArray:
        """Compute ``Hess₂ W[z, z] u`` (2E,) for a change u of lengths and angles (2E,)."""
        lengths, angles = np.split(tangent, 2)
        energy = self.space.energy
        sides = np.einsum("ijf,jf->if", self.hessian.faces, lengths.take(energy.sides))
        return np.concatenate([energy.sum_over_faces(sides), self.hessian.angles * angles])


def fault_between(old: ShellPoint, new: ShellPoint) -> str | None:
    """Say why the step from one shape to the next is no deformation of a surface; None if it is one."""
    if not np.isfinite(new.z).all():
        return "a vertex is not finite or an edge has no length"
    ratio = new.rest.areas / old.rest.areas
    worst = int(ratio.argmin())
    if not ratio[worst] > STEP.area_ratio:
        return f"face {worst} shrinks to {ratio[worst]:.1e} of its area in one step"
    turn = np.abs(wrap((new.z - old.z)[len(new.z) // 2 :]))
    worst = int(turn.argmax())
    if not turn[worst] < STEP.turn:
        i, j = new.space.connectivity.edges[worst]
        return f"the faces at edge ({i}, {j}) turn by {np.degrees(turn[worst]):.0f}° in one step"
    return None


def keeps_faces(space: ShellSpace, old: FloatArray, new: FloatArray) -> bool:
    """Whether every face of shapes (…, V, 3) keeps enough of its area from old to new, see `StepLimits.area_loss`.

    The energy is infinite where a face has no area, but a step may jump over this barrier and turn the face over.
    """
    before, after = (face_areas(x, space.connectivity.faces) for x in (old, new))
    return bool((after >= (1 - STEP.area_loss) * before).all())


def edge_length(space: ShellSpace) -> float:
    """Compute the mean edge length of the reference."""
    return float(edge_lengths(space.reference.vertices, space.connectivity).mean())


@dataclass(frozen=True)
class ChordSolver:
    """The matrix ``A = Jᵀ Hess₂W[z, z] J``, factorised at one shape and used for neighbouring shapes.

    Rigid motions are removed from the forces, see Preconditioner. The spectrum of A relative to the matrix of a
    neighbour is close to 1. Measured values are 0.95 to 1.05 for a bend by 5°, and 0.5 to 2.4 for 75°.
    """

    at: ShellPoint  # the shape of the factor
    inverse: Preconditioner  # A⁻¹, up to the rigid motions of this shape
    # (V, 3, 3) rotations of the vertices from this shape to the neighbour, or None to ignore them
    rotations: FloatArray | None = None

    def rotated_to(self, point: ShellPoint) -> ChordSolver:
        """Return the factor for another shape: ``R A⁻¹ Rᵀ`` and ``J Rᵀ``, with rotations R of the vertices to it."""
        return replace(self, rotations=point.space.vertex_rotations(self.at.face_frames, point.face_frames))

    def solve(self, forces: FloatArray) -> FloatArray:
        """Compute ``A⁻¹F`` (…, V, 3), up to the rigid motions of the factor's shape."""
        return self._there(self.inverse(self._back(forces)))

    def push_forward(self, displacement: FloatArray) -> FloatArray:
        """Compute ``J d`` (2E,) for a vertex field d (V, 3), with J of the factor's shape."""
        return self.at.push_forward(self._back(displacement))

    def project(self, tangent: FloatArray) -> FloatArray:
        """Find the vertex field d (V, 3) whose J d is closest to a change (2E,) of lengths and angles."""
        return self._there(self.inverse(self.at.pull_back(self.at.lower(tangent))))

    def _there(self, field: FloatArray) -> FloatArray:
        return field if self.rotations is None else np.einsum("vij,...vj->...vi", self.rotations, field)

    def _back(self, field: FloatArray) -> FloatArray:
        return field if self.rotations is None else np.einsum("vji,...vj->...vi", self.rotations, field)


#: Factorises A at a shape; raises NotPositiveDefiniteError. Its previous factor can't be used any more.
Factorise = Callable[[ShellPoint], ChordSolver]


class ShellSpace:
    """The Riemannian manifold of the shapes of one connectivity, with metric ``g_z = ½ Hess₂ W[z, z]``.

    The symbolic analysis of A happens once. An instance holds work space: use one per thread. Pickling it sends the
    reference to another process, which repeats the analysis.

    Args:
        reference: mesh that determines the connectivity, and the area to which η refers, so that units don't matter.
        material: μ, λ and η.
        backend: Cholesky backend.
        first_step: first step of exponentials and logarithms.
    """

    def __init__(
        self,
        reference: TriangleMesh,
        material: Material | None = None,
        backend: Backend = "auto",
        first_step: FirstStep = "centred",
    ) -> None:
        self.reference = reference
        self.connectivity = reference.connectivity
        self.material = material or Material()
        self.backend: Backend = backend
        self.first_step: FirstStep = first_step
        self.energy = ShellEnergy(self.connectivity, self.material, reference.area)
        self.jacobian = NRICJacobian(self.connectivity)
        self.vertex_rotations = VertexRotations(self.connectivity)
        self._matrix = NormalMatrix(self.connectivity)
        self._factorise: list[Factorise] = []

    def __reduce__(self) -> tuple:
        return type(self), (self.reference, self.material, self.backend, self.first_step)

    def factorisations(self, count: int) -> list[Factorise]:
        """Return `count` functions that factorise A at a shape; their factors can be used at the same time."""
        if len(self._factorise) < count:
            cholesky = analyse(self._matrix.pattern, self.backend, count)
            self._factorise = [partial(_factorised, self._matrix, cholesky, number) for number in range(count)]
        return self._factorise[:count]

    def factorise(self, point: ShellPoint) -> ChordSolver:
        """Factorise A at a shape, with the first of the ``factorisations``."""
        return self.factorisations(1)[0](point)

    def nric(self, vertices: FloatArray) -> FloatArray:
        """Compute lengths and angles (…, 2E) of shapes (…, V, 3)."""
        return nric(vertices, self.connectivity)

    def point(self, vertices: FloatArray) -> ShellPoint:
        """Return a shape (V, 3) with its derivatives and its energy."""
        return ShellPoint(self, self.shape(vertices))

    def shape(self, vertices: ArrayLike) -> FloatArray:
        """Convert vertices to an array (V, 3); raises ValueError if it has another shape."""
        x = np.asarray(vertices, dtype=np.float64)
        if x.shape != self.reference.vertices.shape:
            raise ValueError(f"vertices must be {self.reference.vertices.shape} like the reference's, not {x.shape}")
        return x

    def curvature(self, point: ShellPoint, covector: FloatArray) -> sparse.csc_array:
        """Compute ``Σ_i p_i D²z_i(X)`` (3V, 3V) for a covector p (2E,): the derivative of ``Jᵀp`` by X."""
        second = HingeGeometry(point.vertices, self.connectivity).second_derivatives()
        return self._matrix.pattern.matrix(self._matrix.second_derivative(second, covector))

    def inner(self, vertices: FloatArray, first: FloatArray, second: FloatArray) -> float:
        """Compute ``g(u, v)`` for two vertex fields (V, 3) at a shape."""
        point = self.point(vertices)
        lowered = point.lower(point.push_forward(first))
        return 0.5 * float(lowered @ point.push_forward(second))

    def norm(self, vertices: FloatArray, tangent: FloatArray) -> float:
        """Compute ``sqrt(g(v, v))`` for a vertex field (V, 3) at a shape."""
        return float(np.sqrt(self.inner(vertices, tangent, tangent)))

    def project(self, vertices: FloatArray, change: FloatArray) -> FloatArray:
        """Find the vertex field d (V, 3) whose J d is closest, in the metric, to a change u (2E,) of lengths and
        angles.

        ``J d`` is the orthogonal projection to the tangent space: d = (Jᵀ H J)⁻¹ Jᵀ H u. The field has no rigid part.
        """
        point = self.point(vertices)
        chord = self.factorise(point)
        d = chord.project(change)
        # Again with the remainder, because A is regularised.
        d += chord.project(change - point.push_forward(d))
        return without_rigid_motion(d, point.vertices)


def _factorised(matrix: NormalMatrix, cholesky: Cholesky, number: int, point: ShellPoint) -> ChordSolver:
    factor = cholesky.factorise(matrix.entries(point.gradients, point.hessian), number)
    return ChordSolver(point, Preconditioner(factor, rigid_motions(point.vertices)))


@dataclass(frozen=True, kw_only=True)
class DiscretePath(Outcome):
    """Shapes at equal times, as far as they were found; converged if the path is complete.

    ``iterations`` counts the iterations of all equations. ``residual`` is the largest ``sqrt(F_kᵀ A_k⁻¹ F_k)`` of the
    discrete Euler–Lagrange equation at an inner shape, with A_k factorised near it, or 0 if there was no equation. The
    exponential makes one more step after the residual is measured.

    Attributes:
        vertices: (n, V, 3), always finite.
        space: the space of the shapes.
        before: X_0 − d/K (V, 3), where an exponential took a centred first step.
    """

    vertices: FloatArray
    space: ShellSpace = field(repr=False)
    before: FloatArray | None = field(default=None, repr=False)

    @cached_property
    def nric(self) -> FloatArray:
        """(n, 2E) lengths and angles; the angles are unwrapped along the path from the first shape."""
        z = self.space.nric(self.vertices)
        e = self.space.connectivity.edge_count
        z[1:, e:] = z[0, e:] + np.cumsum(wrap(np.diff(z[:, e:], axis=0)), axis=0)
        return z

    @cached_property
    def energy(self) -> float:
        """Path energy ``K Σ W[z_{k−1}, z_k]``, about the squared length of a complete path."""
        z = self.nric
        return float((len(z) - 1) * self.space.energy.rest(z[:-1]).value(z[1:]).sum())
