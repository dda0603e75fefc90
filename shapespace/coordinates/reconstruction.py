"""Vertices from lengths and angles: weighted nonlinear least squares by Gauss–Newton (paper, section 3)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.coordinates.frame_integration import FrameIntegration
from shapespace.coordinates.least_squares import LeastSquares, LeastSquaresPoint
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm
from shapespace.mesh.rigid_motion import rigid_motions
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import Backend, Cholesky, Factorisation, NotPositiveDefiniteError, analyse
from shapespace.solve.deadline import Deadline
from shapespace.solve.line_search import backtrack, sufficient_decrease
from shapespace.solve.outcome import Outcome, Status
from shapespace.solve.preconditioner import Preconditioner

#: Weight of the angles in the reconstruction's norm. It is not the metric's η, which would be far too small here:
#: this norm is dimensionless and a sum over edges.
DEFAULT_ETA = 1e-2
#: A factor is reused for at most LIFE steps, which together cost about as much as a new factor, and only while no
#: vertex is further than REACH, a fraction of the diagonal, from where it was when the factor was computed.
REACH, LIFE = 1e-2, 16
#: With a reused factor the tolerance of the last step is multiplied by this: along the directions in which the energy
#: hardly changes, the remaining error is then longer than the step.
OLD = 0.25
#: Relative increase of the diagonal for a factor in single precision: a few times its rounding error, so that the
#: matrix stays positive definite.
LIFT = 2e-7
#: Damping where Gauss–Newton stalls, as a share of each diagonal entry: its first value, the factor by which it
#: increases after a failed step and decreases after a successful one, and its largest value. A step within the
#: tolerance counts as a minimum only while the damping is at most the last number: more would shorten every step.
FIRST_DAMPING, DAMPING_FACTOR, LARGEST_DAMPING, DAMPING_AT_A_MINIMUM = 1e-6, 10, 1e3, 1e-4
#: A damped step may not shrink a face to less than this share of its area.
LEAST_AREA = 0.1
#: A shape from face frames is not used as a draft if its relative misfit is larger than this, or if a face is folded
#: over. Inside the bounds of the bundled models the misfit is 0.004 (figure) to 0.16 (torus); beyond 0.2 shapes are off
#: by several percent of their size.
ASTRAY = 0.2
#: Below this relative misfit a first guess from face frames is used without trying others, and factors are computed in
#: single precision.
GOOD_GUESS = 0.05


@dataclass(frozen=True, kw_only=True)
class Reconstruction(Outcome):
    """What Gauss–Newton found.

    An iteration is one evaluation of z(X) and one solve. The residual is ``‖z(X) − z*‖ / ‖z*‖`` in the weighted norm:
    about the relative misfit of an edge.

    Attributes:
        vertices: (V, 3), always finite.
        flipped_faces: faces at an edge whose angle is more than π/2 away from the one asked for.
    """

    vertices: FloatArray
    flipped_faces: int = 0


class Reconstructor:
    """Finds the shape whose NRIC come closest to given ones.

    Minimises ``½ ‖z(X) − z*‖²_{2,z̄}`` over X in R^{3V} (angles compared modulo 2π) by Gauss–Newton with a
    backtracking line search. The normal matrix is symmetric positive definite with a fixed pattern, so its symbolic
    analysis happens here, once. Near the shape at which it was made a factor is used again (a modified Newton method),
    with Anderson acceleration: where z* is not integrable, Gauss–Newton itself converges only linearly, and a step with
    an old factor costs an eighth of one with a new factor. Where not even a short step with a new factor lowers the
    misfit, a face has nearly collapsed, and angles change too fast for a linearisation: then Levenberg and Marquardt's
    damped steps continue. Works for any genus and with boundary, because z* need not be integrable. Holds work space:
    use one per thread.

    Args:
        reference: gives the weights, and the default start.
        eta: weight of the angles, see DEFAULT_ETA.
        backend: Cholesky backend.
    """

    def __init__(self, reference: TriangleMesh, eta: float = DEFAULT_ETA, backend: Backend = "auto") -> None:
        self.reference = reference
        self._diagonal = reference.diagonal
        self.norm = WeightedNorm.of(reference, eta)
        self.jacobian = NRICJacobian(reference.connectivity)
        self.normal_matrix = NormalMatrix(reference.connectivity)
        self._backend: Backend = backend
        self._squares = LeastSquares(reference.connectivity, self.norm, self.normal_matrix)
        self._single = analyse(self.normal_matrix.pattern, backend, precision=np.float32)

    def another(self) -> Reconstructor:
        """A reconstructor for another thread. It shares with this one everything that is never modified."""
        twin = copy.copy(self)
        twin._single = analyse(self.normal_matrix.pattern, self._backend, precision=np.float32)
        for own in ("integrate", "_double"):
            twin.__dict__.pop(own, None)
        return twin

    @cached_property
    def _double(self) -> Cholesky:
        """Factors in double precision: for solves without an iteration, and where single precision is not enough."""
        return analyse(self.normal_matrix.pattern, self._backend)

    @cached_property
    def integrate(self) -> FrameIntegration:
        """The shape of integrable z, without iterating."""
        return FrameIntegration(self.reference, self._backend)

    def guess(self, target: FloatArray, *others: Callable[[], FloatArray]) -> FloatArray:
        """A start (V, 3) near the shape of z* (2E,), which depends on nothing but z*.

        Integrated face frames are exact for integrable z*, but errors of z* accumulate along the tree. Where their
        misfit is large, the start with the smallest misfit is chosen among them, ``others`` (called only then) and the
        reference.
        """
        return self._guess(target, others).vertices

    def _guess(self, target: FloatArray, others: Iterable[Callable[[], FloatArray]]) -> LeastSquaresPoint:
        integrated = self._squares(self.integrate(target), target)
        if self._is_good(integrated, target):
            return integrated
        return self._nearest(target, integrated, [*(other() for other in others), self.reference.vertices])

    def draft(self, target: FloatArray) -> Reconstruction | None:
        """The shape from face frames alone, without an iteration; None where its misfit is too large (see ASTRAY).

        It is as far from the reconstructed shape as z* is from being integrable.
        """
        found = self._squares(self.integrate(target), target)
        residual, flipped = float(np.sqrt(found.energy / self.norm.square(target))), self._flipped(found.misfit)
        if not residual <= ASTRAY or flipped:
            return None
        return Reconstruction(
            vertices=found.vertices, status=Status.CONVERGED, residual=residual, flipped_faces=flipped
        )

    def nearest(self, target: FloatArray, *shapes: FloatArray) -> FloatArray:
        """The one of some shapes (V, 3) whose misfit is smallest; the last one if no misfit is finite."""
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
        max_iterations: int = 200,
        deadline: Deadline | None = None,
    ) -> Reconstruction:
        """Reconstruct one shape from a given start.

        Args:
            target: z*, (2E,); need not be integrable.
            start: (V, 3) first guess, the reference by default.
            tolerance: stop once no vertex moves further than this fraction of the reference's diagonal.
            max_iterations: most steps.
            deadline: after which no iteration begins.
        """
        here = self._squares(self.reference.vertices if start is None else np.asarray(start, np.float64), target)
        return self._iterate(target, here, tolerance, max_iterations, deadline)

    def from_guess(
        self,
        target: FloatArray,
        *others: Callable[[], FloatArray],
        tolerance: float = 1e-8,
        max_iterations: int = 200,
        deadline: Deadline | None = None,
    ) -> Reconstruction:
        """Reconstruct one shape from ``guess``, without computing the guess's misfit twice; otherwise as a call.

        Where that stalls, the other starts and the reference are tried, each with as many iterations: a bad guess can
        lead to a face that degenerates, where a smaller misfit lies beyond the degeneration. Raises what the other
        starts raise.
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
            again = self._iterate(target, self._squares(start, target), tolerance, max_iterations, deadline)
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
        limits = _Limits(tolerance * self._diagonal, REACH * self._diagonal, max_iterations, deadline)
        ended = self._gauss_newton(target, start, limits)
        if ended.status is Status.STALLED and ended.iterations:
            ended = self._levenberg_marquardt(target, ended, limits)
        return Reconstruction(
            vertices=ended.point.vertices,
            status=ended.status,
            iterations=ended.iterations,
            reason=ended.reason,
            residual=float(np.sqrt(ended.point.energy / self.norm.square(target))),
            flipped_faces=self._flipped(ended.point.misfit),
        )

    def _gauss_newton(self, target: FloatArray, here: LeastSquaresPoint, limits: _Limits) -> _Found:
        """Steps with a new factor use a line search; those with an old one are accelerated, until one doesn't help."""
        iterations = 0
        factor: _GaussNewtonFactor | None = None
        while (reached := limits.reached(iterations)) is None:
            new = factor is None
            if factor is None:
                try:
                    factor = _GaussNewtonFactor(self._factor(here, target), here.vertices)
                except NotPositiveDefiniteError as error:
                    return _stalled(here, iterations, str(error))
            iterations += 1
            forces = here.forces()
            step, mixed = factor.step(here.vertices, forces)
            size = float(np.abs(step).max())
            if not new:
                t, trial = 1.0, self._squares(mixed, target)
            elif np.isfinite(size):
                t, trial = self._line_search(target, here, forces, step, limits.step)
            else:
                return _stalled(here, iterations, "a step is not finite")
            helps, tiny = trial.energy <= here.energy, size * t <= limits.step * (1 if new else OLD)
            if not (helps or new or tiny):
                factor = None
                continue
            # The last, tiny step is taken only if it helps: at the minimum rounding decides.
            here = trial if helps else here
            if tiny or not helps:
                if t < 1:
                    return _stalled(here, iterations, "only steps shorter than the tolerance lower the misfit")
                return _Found(point=here, status=Status.CONVERGED, iterations=iterations)
            if t < 1 or factor.is_spent(here.vertices, limits.reach):
                factor = None
        return _Found(point=here, status=reached, iterations=iterations)

    def _line_search(
        self, target: FloatArray, here: LeastSquaresPoint, forces: FloatArray, step: FloatArray, shortest: float
    ) -> tuple[float, LeastSquaresPoint]:
        """The share of a step that lowers the energy enough, or moves no vertex further than ``shortest``."""
        slope, size = 2 * float(np.vdot(forces, step)), np.abs(step).max()
        found = backtrack(
            lambda t: self._squares(here.vertices + t * step, target),
            lambda t, trial: sufficient_decrease(here.energy, trial.energy, t, slope) or size * t <= shortest,
            smallest=0,
        )
        return found or (0.0, here)

    def _levenberg_marquardt(self, target: FloatArray, begun: _Found, limits: _Limits) -> _Found:
        """Levenberg and Marquardt's iteration (Marquardt 1963), from where Gauss–Newton stalled.

        A step is taken if it lowers the energy and no face loses most of its area (LEAST_AREA). If no shape has the
        angles asked for, the minimum may have a degenerate face; then the steps end before that.
        """
        here, iterations, damping = begun.point, begun.iterations, FIRST_DAMPING
        areas = face_areas(here.vertices, self.reference.faces)
        while (reached := limits.reached(iterations)) is None:
            try:
                step = self._damped_factor(here, damping).solve(here.forces().ravel()).reshape(-1, 3)
            except NotPositiveDefiniteError as error:
                return _stalled(here, iterations, str(error))
            iterations += 1
            trial = self._squares(here.vertices + step, target)
            left = face_areas(trial.vertices, self.reference.faces)
            helps = trial.energy < here.energy and bool((left >= LEAST_AREA * areas).all())
            if helps:
                here, areas = trial, left
            if np.abs(step).max() <= limits.step and damping <= DAMPING_AT_A_MINIMUM:
                return _Found(point=here, status=Status.CONVERGED, iterations=iterations)
            damping = damping / DAMPING_FACTOR if helps else max(damping * DAMPING_FACTOR, FIRST_DAMPING)
            if not damping <= LARGEST_DAMPING:
                return _stalled(here, iterations, "no damped step lowers the misfit")
        return _Found(point=here, status=reached, iterations=iterations)

    def _factor(self, here: LeastSquaresPoint, target: FloatArray) -> Factorisation:
        """A factor of the normal matrix, in single precision where possible; raises NotPositiveDefiniteError."""
        entries = here.entries()
        if self._is_good(here, target):
            with suppress(NotPositiveDefiniteError):
                return self._single.factorise(self._damped(entries, LIFT))
        return self._double.factorise(entries)

    def _is_good(self, here: LeastSquaresPoint, target: FloatArray) -> bool:
        return bool(here.energy <= GOOD_GUESS**2 * self.norm.square(target))

    def _damped_factor(self, here: LeastSquaresPoint, damping: float) -> Factorisation:
        """A factor of the normal matrix with its diagonal increased by a share; raises NotPositiveDefiniteError."""
        return self._double.factorise(self._damped(here.entries(), damping))

    def _damped(self, entries: FloatArray, share: float) -> FloatArray:
        damped = entries.copy()
        damped[self.normal_matrix.pattern.diagonal] *= 1 + share
        return damped

    def differential(self, vertices: FloatArray, changes: FloatArray) -> FloatArray:
        """How a reconstructed shape (V, 3) moves, (n, V, 3), when its target z* changes by (n, 2E).

        ``dX = (JᵀWJ)⁻¹ JᵀW dz``, from the implicit function theorem at a minimum whose residual is small; without rigid
        motion. Raises NotPositiveDefiniteError.
        """
        jacobian, factor = self._linearised_at(vertices)
        forces = jacobian.T @ (changes * self.norm.squared).T
        return factor.solve(forces.T).reshape(len(changes), -1, 3)

    def sensitivity(self, vertices: FloatArray, fields: FloatArray) -> FloatArray:
        """The transpose of ``differential``.

        The derivatives (n, 2E), by the target z*, of a reconstructed shape's (V, 3) products with vertex fields
        (n, V, 3).
        """
        jacobian, factor = self._linearised_at(vertices)
        solved = factor.solve(fields.reshape(len(fields), -1))
        return (jacobian @ solved.T).T * self.norm.squared

    def _linearised_at(self, vertices: FloatArray) -> tuple[sparse.csr_array, Factorisation]:
        """J and the factor of JᵀWJ."""
        gradients = self.jacobian.gradients(vertices)
        factor = self._double.factorise(self.normal_matrix.entries(gradients, self.norm))
        return self.jacobian.matrix(gradients), factor

    def _flipped(self, misfit: FloatArray) -> int:
        connectivity = self.reference.connectivity
        folded = (np.abs(misfit[connectivity.edge_count :]) > np.pi / 2) & connectivity.interior
        return len(np.unique(connectivity.edge_faces[folded]))


@dataclass(frozen=True, kw_only=True)
class _Found(Outcome):
    """The point at which one of the two iterations ended, and how."""

    point: LeastSquaresPoint


def _stalled(point: LeastSquaresPoint, iterations: int, reason: str) -> _Found:
    return _Found(point=point, status=Status.STALLED, iterations=iterations, reason=reason)


@dataclass(frozen=True)
class _Limits:
    """When to stop: the lengths are in the mesh's unit.

    Attributes:
        step: the iteration has converged once no vertex moves further.
        reach: a factor is computed anew once a vertex has moved further.
        iterations: most iterations, of both kinds together.
        deadline: after which no iteration begins.
    """

    step: float
    reach: float
    iterations: int
    deadline: Deadline | None

    def reached(self, iterations: int) -> Status | None:
        """Which limit is reached after so many iterations, or None."""
        if iterations >= self.iterations:
            return Status.ITERATION_LIMIT
        return Status.DEADLINE if self.deadline is not None and self.deadline.passed else None


class _GaussNewtonFactor:
    """The normal matrix of one shape, factorised, for steps from there and from its neighbours."""

    def __init__(self, factor: Factorisation, at: FloatArray) -> None:
        self._at, self._steps = at, 0
        self._inverse, self._mixing = Preconditioner(factor, rigid_motions(at)), Anderson()

    def step(self, vertices: FloatArray, forces: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The step from a shape, and the next shape by Anderson acceleration."""
        self._steps += 1
        step = self._inverse(forces)
        return step, self._mixing(vertices, forces, step)

    def is_spent(self, vertices: FloatArray, reach: float) -> bool:
        """Whether it has been used often enough, or the shape has left its neighbourhood."""
        return self._steps == LIFE or bool(np.abs(vertices - self._at).max() > reach)
