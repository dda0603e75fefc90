"""The space of discrete shells as a Riemannian manifold, in vertex positions.

The paper works with lengths and angles ``z ∈ R^{2E}`` under 3V integrability constraints. Here the manifold
of immersed meshes is parametrised by ``X ↦ z(X)`` instead: its tangent space at z(X) is the range of the
Jacobian ``J = Dz(X)``, so an equation that has to hold on tangent vectors becomes ``Jᵀ(…) = 0``, 3V
equations in 3V unknowns with only the six rigid motions left over. Integrability is exact, the genus doesn't
matter, and the matrices are symmetric positive definite and nine times smaller in work than the indefinite
ones of the constrained form (which the tests compare with).

The modules that do something with this space: ``exponential`` (shooting), ``geodesic`` (connecting, logarithm),
``transport`` and ``mean``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

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

#: Tolerance of equations F = 0: on ``sqrt(Fᵀ A⁻¹ F)``, the length in the metric of a further Newton step.
TOLERANCE = 1e-9
#: A face has collapsed if a time step leaves less than this share of its area; the energy is near its barrier.
SMALLEST_AREA_RATIO = 1e-3
#: Largest share of its area that a face may lose in one step of a descent.
LARGEST_LOSS = 0.8
#: If an angle changes by more than this in one time step, the surface has passed through a fold or a collapsed face.
LARGEST_TURN = 0.75 * np.pi


class ShellPoint:
    """A shape with what its tangent space and its energy are made of, each computed when first asked for.

    Attributes:
        vertices: (V, 3) X.
        z: (2E,) lengths and angles.
    """

    def __init__(self, space: ShellSpace, vertices: FloatArray, z: FloatArray | None = None) -> None:
        self.space = space
        self.vertices = vertices
        self.z = space.nric(vertices) if z is None else z

    @cached_property
    def rest(self) -> RestShape:
        """The shape as first argument of W."""
        return self.space.energy.rest(self.z)

    @cached_property
    def gradients(self) -> NRICGradients:
        """``Dz(X)`` in parts."""
        return self.space.jacobian.gradients(self.vertices)

    @cached_property
    def face_frames(self) -> FloatArray:
        """(xyz, 3, F), see VertexRotations."""
        return self.space.vertex_rotations.face_frames(self.vertices)

    @cached_property
    def hessian(self) -> QuadraticForm:
        """``Hess₂ W[z, z]``, twice the metric."""
        return self.rest.hessian()

    def push_forward(self, displacement: FloatArray) -> FloatArray:
        """``J d`` (2E,): the change of lengths and angles by a vertex field (V, 3)."""
        return self.space.jacobian.push_forward(self.gradients, displacement)

    def pull_back(self, covector: FloatArray) -> FloatArray:
        """``Jᵀ p`` (V, 3): the forces on vertices by forces on lengths and angles (2E,)."""
        return self.space.jacobian.pull_back(self.gradients, covector)

    def lower(self, tangent: FloatArray) -> FloatArray:
        """``Hess₂ W[z, z] u`` (2E,) of a change of lengths and angles (2E,)."""
        lengths, angles = np.split(tangent, 2)
        energy = self.space.energy
        sides = np.einsum("ijf,jf->if", self.hessian.faces, lengths.take(energy.sides))
        return np.concatenate([energy.sum_over_faces(sides), self.hessian.angles * angles])


def fault_between(old: ShellPoint, new: ShellPoint) -> str | None:
    """Why the step from one shape to the next is no deformation of a surface; None if it is one."""
    if not np.isfinite(new.z).all():
        return "a vertex is not finite or an edge has no length"
    ratio = new.rest.areas / old.rest.areas
    worst = int(ratio.argmin())
    if not ratio[worst] > SMALLEST_AREA_RATIO:
        return f"face {worst} shrinks to {ratio[worst]:.1e} of its area in one step"
    turn = np.abs(wrap((new.z - old.z)[len(new.z) // 2 :]))
    worst = int(turn.argmax())
    if not turn[worst] < LARGEST_TURN:
        i, j = new.space.connectivity.edges[worst]
        return f"the faces at edge ({i}, {j}) turn by {np.degrees(turn[worst]):.0f}° in one step"
    return None


def keeps_faces(space: ShellSpace, old: FloatArray, new: FloatArray) -> bool:
    """Whether no face (F,) of shapes (…, V, 3) loses more than LARGEST_LOSS of its area from old to new.

    The energy is infinite where a face has no area, but a step may pass over that and leave the face turned over.
    """
    before, after = (face_areas(x, space.connectivity.faces) for x in (old, new))
    return bool((after >= (1 - LARGEST_LOSS) * before).all())


def edge_length(space: ShellSpace) -> float:
    """Mean length of the reference's edges."""
    return float(edge_lengths(space.reference.vertices, space.connectivity).mean())


@dataclass(frozen=True)
class ChordSolver:
    """``A = Jᵀ Hess₂W[z, z] J``, factorised at one shape and used for all its neighbours.

    Rigid motions are left out of the forces, see Preconditioner. The spectrum of A relative to a neighbour's matrix is
    close to 1: 0.95 to 1.05 for a bend by 5°, 0.5 to 2.4 for 75°, measured.

    Attributes:
        at: the shape whose matrix is factorised.
        inverse: A⁻¹, up to the rigid motions of that shape.
        rotations: (V, 3, 3) of its vertices to the shape that is served, if they are taken into account.
    """

    at: ShellPoint
    inverse: Preconditioner
    rotations: FloatArray | None = None

    def rotated_to(self, point: ShellPoint) -> ChordSolver:
        """The same factor, serving another shape: ``R A⁻¹ Rᵀ`` and ``J Rᵀ`` with rotations of the vertices to it."""
        return replace(self, rotations=point.space.vertex_rotations(self.at.face_frames, point.face_frames))

    def solve(self, forces: FloatArray) -> FloatArray:
        """``A⁻¹F`` (…, V, 3), up to the rigid motions of the factor's shape."""
        return self._there(self.inverse(self._back(forces)))

    def push_forward(self, displacement: FloatArray) -> FloatArray:
        """``J d`` (2E,) of a vertex field (V, 3), with the factor's shape's J."""
        return self.at.push_forward(self._back(displacement))

    def project(self, tangent: FloatArray) -> FloatArray:
        """The vertex field (V, 3) whose J d comes closest to a change (2E,) of lengths and angles."""
        return self._there(self.inverse(self.at.pull_back(self.at.lower(tangent))))

    def _there(self, field: FloatArray) -> FloatArray:
        return field if self.rotations is None else np.einsum("vij,...vj->...vi", self.rotations, field)

    def _back(self, field: FloatArray) -> FloatArray:
        return field if self.rotations is None else np.einsum("vji,...vj->...vi", self.rotations, field)


#: Factorises A at a shape; raises NotPositiveDefiniteError. The factor that it returned before becomes unusable.
Factorise = Callable[[ShellPoint], ChordSolver]


class ShellSpace:
    """The Riemannian manifold of the shapes of one connectivity, with metric ``g_z = ½ Hess₂ W[z, z]``.

    The symbolic analysis happens here, once. Holds work space: use one per thread, or pickle it to another
    process, which sends the reference and repeats the analysis there.

    Args:
        reference: gives connectivity and the area to which η refers, so that units don't matter.
        material: μ, λ, η.
        backend: Cholesky backend.
    """

    def __init__(self, reference: TriangleMesh, material: Material | None = None, backend: Backend = "auto") -> None:
        self.reference = reference
        self.connectivity = reference.connectivity
        self.material = material or Material()
        self.backend: Backend = backend
        self.energy = ShellEnergy(self.connectivity, self.material, reference.area)
        self.jacobian = NRICJacobian(self.connectivity)
        self.vertex_rotations = VertexRotations(self.connectivity)
        self._matrix = NormalMatrix(self.connectivity)
        self._factorise: list[Factorise] = []

    def __reduce__(self) -> tuple:
        return type(self), (self.reference, self.material, self.backend)

    def factorisations(self, count: int) -> list[Factorise]:
        """That many functions that factorise A at a shape, whose results can be used side by side."""
        if len(self._factorise) < count:
            cholesky = analyse(self._matrix.pattern, self.backend, count)
            self._factorise = [partial(_factorised, self._matrix, cholesky, number) for number in range(count)]
        return self._factorise[:count]

    def factorise(self, point: ShellPoint) -> ChordSolver:
        """A at a shape, by the first of the ``factorisations``."""
        return self.factorisations(1)[0](point)

    def nric(self, vertices: FloatArray) -> FloatArray:
        """Lengths and angles (…, 2E) of shapes (…, V, 3)."""
        return nric(vertices, self.connectivity)

    def point(self, vertices: FloatArray) -> ShellPoint:
        """A shape (V, 3) as a point of the manifold."""
        return ShellPoint(self, self.shape(vertices))

    def shape(self, vertices: ArrayLike) -> FloatArray:
        """Vertices as an array; raises ValueError if they can't be those of this mesh."""
        x = np.asarray(vertices, dtype=np.float64)
        if x.shape != self.reference.vertices.shape:
            raise ValueError(f"vertices must be {self.reference.vertices.shape} like the reference's, not {x.shape}")
        return x

    def curvature(self, point: ShellPoint, covector: FloatArray) -> sparse.csc_array:
        """``Σ_i p_i D²z_i(X)`` (3V, 3V) of a covector p (2E,): how ``Jᵀp`` changes with X."""
        second = HingeGeometry(point.vertices, self.connectivity).second_derivatives()
        return self._matrix.pattern.matrix(self._matrix.second_derivative(second, covector))

    def inner(self, vertices: FloatArray, first: FloatArray, second: FloatArray) -> float:
        """``g(u, v)`` of two vertex fields (V, 3) at a shape."""
        point = self.point(vertices)
        lowered = point.lower(point.push_forward(first))
        return 0.5 * float(lowered @ point.push_forward(second))

    def norm(self, vertices: FloatArray, tangent: FloatArray) -> float:
        """``sqrt(g(v, v))`` of a vertex field (V, 3) at a shape."""
        return float(np.sqrt(self.inner(vertices, tangent, tangent)))

    def project(self, vertices: FloatArray, change: FloatArray) -> FloatArray:
        """The vertex field (V, 3) whose J d comes closest, in the metric, to a change (2E,) of lengths and angles.

        ``J d`` is the orthogonal projection to the tangent space: d = (Jᵀ H J)⁻¹ Jᵀ H u. It has no rigid part.
        """
        point = self.point(vertices)
        chord = self.factorise(point)
        d = chord.project(change)
        # Once more with what is left, because A is regularised.
        d += chord.project(change - point.push_forward(d))
        return without_rigid_motion(d, point.vertices)


def _factorised(matrix: NormalMatrix, cholesky: Cholesky, number: int, point: ShellPoint) -> ChordSolver:
    factor = cholesky.factorise(matrix.entries(point.gradients, point.hessian), number)
    return ChordSolver(point, Preconditioner(factor, rigid_motions(point.vertices)))


@dataclass(frozen=True, kw_only=True)
class DiscretePath(Outcome):
    """Shapes at equal times, as far as they could be found; converged if the path is complete.

    ``iterations`` are those of all its equations together. ``residual`` is the largest ``sqrt(F_kᵀ A_k⁻¹ F_k)`` of the
    discrete Euler–Lagrange equation at an inner shape, with A_k factorised near it, or 0 where there was nothing to
    solve; the exponential takes one more step after that was measured.

    Attributes:
        vertices: (n, V, 3), always finite.
        space: where the path lies.
    """

    vertices: FloatArray
    space: ShellSpace = field(repr=False)

    @cached_property
    def nric(self) -> FloatArray:
        """(n, 2E) lengths and angles, the angles unwrapped along the path from the first shape's."""
        z = self.space.nric(self.vertices)
        e = self.space.connectivity.edge_count
        z[1:, e:] = z[0, e:] + np.cumsum(wrap(np.diff(z[:, e:], axis=0)), axis=0)
        return z

    @cached_property
    def energy(self) -> float:
        """Path energy ``K Σ W[z_{k−1}, z_k]``, for a complete path about the squared length."""
        z = self.nric
        return float((len(z) - 1) * self.space.energy.rest(z[:-1]).value(z[1:]).sum())
