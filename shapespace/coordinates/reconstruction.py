"""Reconstruction of vertices from lengths and angles: weighted nonlinear least squares (paper, section 3)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.coordinates.frame_integration import FrameIntegration
from shapespace.coordinates.gauss_newton import REUSE, GaussNewton, IterationLimits, LeastSquares, LeastSquaresPoint
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.solve.cholesky import Backend, Factorisation
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Outcome, Status

#: Weight η of the angles in the norm of reconstruction. The metric's η would be far too small: this norm is
#: dimensionless and a sum over edges.
DEFAULT_ETA = 1e-2
#: Largest relative misfit of a draft. Within the bounds of the bundled models the misfit of a shape from face frames is
#: 0.004 (figure) to 0.16 (torus). Beyond 0.2 such shapes are off by several percent of their size.
LARGEST_DRAFT_MISFIT = 0.2
#: Range of misfits, as a share of the largest one of drafts that are good enough, in which a shape lies between draft
#: and improved shape. Otherwise a shape would jump where a path of codes enters the range.
BLENDED = 0.05
#: Largest number of iterations for one shape.
MAX_ITERATIONS = 200


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Outcome):
    """A reconstructed shape.

    An iteration is one evaluation of z(X) and one solve. The residual is ``‖z(X) − z*‖ / ‖z*‖`` in the weighted norm,
    about the relative misfit of an edge.
    """

    vertices: FloatArray  # (V, 3), always finite
    flipped_faces: int = 0  # number of faces at edges whose angle differs from the target by more than π/2


def improved_share(misfit: float, good_misfit: float) -> float:
    """Return how much of Gauss–Newton's improvement a draft gets: 0 well below ``good_misfit``, 1 above it."""
    if misfit >= good_misfit:
        return 1.0
    return max(0.0, 1 - (good_misfit - misfit) / (BLENDED * good_misfit))


class Reconstructor:
    """Finds the shape whose lengths and angles (NRIC) are closest to a target z*.

    It minimises ``½ ‖z(X) − z*‖²_{2,z̄}`` over X in R^{3V}, with angles modulo 2π, see GaussNewton. The target need not
    be integrable, so any genus and any boundary are possible.

    An instance holds work space: use one per thread. The reference determines the weights and the default start;
    ``eta`` weighs the angles, see DEFAULT_ETA.
    """

    def __init__(self, reference: TriangleMesh, eta: float = DEFAULT_ETA, backend: Backend = "auto") -> None:
        self.reference = reference
        self._diagonal = reference.diagonal
        self.norm = WeightedNorm.of(reference, eta)
        self.jacobian = NRICJacobian(reference.connectivity)
        self.normal_matrix = NormalMatrix(reference.connectivity)
        self._backend: Backend = backend
        self._squares = LeastSquares(reference.connectivity, self.norm, self.normal_matrix)
        self.solver = GaussNewton(self._squares, reference.faces, backend)

    def another(self) -> Reconstructor:
        """Return a reconstructor for another thread, which shares everything that is never modified."""
        twin = copy.copy(self)
        twin.solver = self.solver.another()
        twin.__dict__.pop("integrate", None)
        return twin

    @cached_property
    def integrate(self) -> FrameIntegration:
        """Shapes from face frames, without iterating."""
        return FrameIntegration(self.reference, self._backend)

    def guess(self, target: FloatArray, *others: Callable[[], FloatArray]) -> FloatArray:
        """Return a start (V, 3) near the shape of z* (2E,), which depends only on z*.

        Integrated face frames are exact for integrable z*, but errors of z* accumulate along the tree. If their misfit
        is large, ``others`` are called, and the start with the smallest misfit is chosen among all and the reference.
        """
        return self._guess(target, others).vertices

    def _guess(self, target: FloatArray, others: Iterable[Callable[[], FloatArray]]) -> LeastSquaresPoint:
        integrated = self._squares(self.integrate(target), target)
        if self.solver.is_good(integrated, target):
            return integrated
        return self._nearest(target, integrated, [*(other() for other in others), self.reference.vertices])

    def draft(
        self,
        target: FloatArray,
        tolerance: float | None = None,
        good_misfit: float = 0.0,
        deadline: Deadline | None = None,
    ) -> Reconstruction | None:
        """Return the shape from face frames; with a tolerance improved by Gauss–Newton.

        The distance of a draft to the reconstructed shape grows with the distance between z* and integrable
        coordinates. Gauss–Newton ends once a step moves no vertex further than ``tolerance`` times the reference's
        diagonal; the shape itself is usually closer. Returns None if the misfit of the draft exceeds
        LARGEST_DRAFT_MISFIT, a face is folded over, or Gauss–Newton stalls.

        A draft is not improved if its misfit is at most ``good_misfit``. Just below, it is improved in part, so that
        shapes change continuously with the code, see BLENDED.
        """
        found = self._squares(self.integrate(target), target)
        size = self.norm.square(target)
        residual, flipped = float(np.sqrt(found.energy / size)), self._flipped(found.misfit)
        if not residual <= LARGEST_DRAFT_MISFIT or flipped:
            return None
        draft = Reconstruction(
            vertices=found.vertices, status=Status.CONVERGED, residual=residual, flipped_faces=flipped
        )
        share = improved_share(residual, good_misfit)
        if tolerance is None or share == 0:
            return draft
        improved = self._iterate(target, found, tolerance, MAX_ITERATIONS, deadline)
        if improved.status is Status.STALLED:
            return None
        if share == 1 or not improved.converged:
            return improved
        between = self._squares(found.vertices + share * (improved.vertices - found.vertices), target)
        residual = float(np.sqrt(between.energy / size))
        return replace(
            improved, vertices=between.vertices, residual=residual, flipped_faces=self._flipped(between.misfit)
        )

    def nearest(self, target: FloatArray, *shapes: FloatArray) -> FloatArray:
        """Return the shape (V, 3) with the smallest misfit, or the last one if no misfit is finite."""
        return self._nearest(target, self._squares(shapes[0], target), shapes[1:]).vertices

    def _nearest(self, target: FloatArray, best: LeastSquaresPoint, shapes: Iterable[FloatArray]) -> LeastSquaresPoint:
        for vertices in shapes:
            point = self._squares(vertices, target)
            if not best.energy <= point.energy < np.inf:
                best = point
        return best

    def __call__(
        self,
        target: FloatArray,
        start: FloatArray | None = None,
        *,
        tolerance: float = 1e-8,
        max_iterations: int = MAX_ITERATIONS,
        deadline: Deadline | None = None,
    ) -> Reconstruction:
        """Reconstruct one shape from a given start.

        The target z* (2E,) need not be integrable. By default the start (V, 3) is the reference. The steps end once no
        vertex moves further than ``tolerance`` times the reference's diagonal, and none begins after the deadline.
        """
        here = self._squares(self.reference.vertices if start is None else np.asarray(start, np.float64), target)
        return self._iterate(target, here, tolerance, max_iterations, deadline)

    def from_guess(
        self,
        target: FloatArray,
        *others: Callable[[], FloatArray],
        tolerance: float = 1e-8,
        max_iterations: int = MAX_ITERATIONS,
        deadline: Deadline | None = None,
    ) -> Reconstruction:
        """Reconstruct one shape from ``guess``, without computing the misfit of the guess twice.

        If that stalls, the other starts and the reference are tried, while iterations are left. A bad
        guess may lead to a face that degenerates, where a smaller misfit lies beyond the degeneration. Exceptions of
        the other starts are passed on.
        """
        guess = self._guess(target, others)
        found = self._iterate(target, guess, tolerance, max_iterations, deadline)
        if found.status is not Status.STALLED:
            return found
        iterations = found.iterations
        starts: list[Callable[[], FloatArray]] = [*others, lambda: self.reference.vertices]
        for other in starts:
            if np.array_equal(start := other(), guess.vertices):
                continue
            left = max_iterations - iterations
            again = self._iterate(target, self._squares(start, target), tolerance, left, deadline)
            iterations += again.iterations
            if again.converged or again.status is Status.DEADLINE:
                return replace(again, iterations=iterations)
        return replace(found, iterations=iterations)

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def _iterate(
        self,
        target: FloatArray,
        start: LeastSquaresPoint,
        tolerance: float,
        max_iterations: int,
        deadline: Deadline | None,
    ) -> Reconstruction:
        if not (np.isfinite(start.energy) and target.any()):
            reason = "lengths and angles of the start are not finite, or those asked for are not, or all are zero"
            return Reconstruction(vertices=self.reference.vertices, status=Status.NOT_FINITE, reason=reason)
        limits = IterationLimits(tolerance * self._diagonal, REUSE.reach * self._diagonal, max_iterations, deadline)
        ended = self.solver(target, start, limits)
        return Reconstruction(
            vertices=ended.point.vertices,
            status=ended.status,
            iterations=ended.iterations,
            reason=ended.reason,
            residual=float(np.sqrt(ended.point.energy / self.norm.square(target))),
            flipped_faces=self._flipped(ended.point.misfit),
        )

    def differential(self, vertices: FloatArray, changes: FloatArray) -> FloatArray:
        """Compute the changes (n, V, 3) of a reconstructed shape (V, 3) for changes (n, 2E) of its target z*.

        ``dX = (JᵀWJ)⁻¹ JᵀW dz``, from the implicit function theorem at a minimum with a small residual; without rigid
        motion. Raises NotPositiveDefiniteError.
        """
        jacobian, factor = self._linearised_at(vertices)
        forces = jacobian.T @ (changes * self.norm.squared).T
        return factor.solve(forces.T).reshape(len(changes), -1, 3)

    def exact_differential(self, vertices: FloatArray, target: FloatArray, changes: FloatArray) -> FloatArray:
        """Compute the same changes exactly at a minimum: with the second derivatives of lengths and angles, which count
        where the target z* (2E,) is not integrable.
        """
        point = self._squares(vertices, target)
        second = point.geometry.second_derivatives()
        entries = point.entries() + self.normal_matrix.second_derivative(second, self.norm.squared * point.misfit)
        forces = self.jacobian.matrix(point.gradients).T @ (changes * self.norm.squared).T
        return self.solver.double.factorise(entries).solve(forces.T).reshape(len(changes), -1, 3)

    def sensitivity(self, vertices: FloatArray, fields: FloatArray) -> FloatArray:
        """Apply the transpose of ``differential``.

        Returns the derivatives (n, 2E) by the target z* of the scalar products of a reconstructed shape (V, 3) with
        vertex fields (n, V, 3).
        """
        jacobian, factor = self._linearised_at(vertices)
        solved = factor.solve(fields.reshape(len(fields), -1))
        return (jacobian @ solved.T).T * self.norm.squared

    def _linearised_at(self, vertices: FloatArray) -> tuple[sparse.csr_array, Factorisation]:
        """Compute J and the factor of JᵀWJ at a shape."""
        gradients = self.jacobian.gradients(vertices)
        factor = self.solver.double.factorise(self.normal_matrix.entries(gradients, self.norm))
        return self.jacobian.matrix(gradients), factor

    def _flipped(self, misfit: FloatArray) -> int:
        connectivity = self.reference.connectivity
        folded = (np.abs(misfit[connectivity.edge_count :]) > np.pi / 2) & connectivity.interior
        return len(np.unique(connectivity.edge_faces[folded]))
