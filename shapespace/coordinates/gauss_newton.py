"""Gauss–Newton for reconstruction, continued by Levenberg and Marquardt's damped steps where it stalls."""

from __future__ import annotations

import copy
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import HingeGeometry, NRICGradients, NRICJacobian, WeightedNorm
from shapespace.mesh.rigid_motion import rigid_motions
from shapespace.mesh.triangle_mesh import Connectivity, face_areas
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import Backend, Cholesky, Factorisation, NotPositiveDefiniteError, analyse
from shapespace.solve.deadline import Deadline
from shapespace.solve.line_search import backtrack, sufficient_decrease
from shapespace.solve.outcome import Outcome, Status, limit_reached
from shapespace.solve.preconditioner import Preconditioner

#: Below this relative misfit factors are computed in single precision, and a first guess is used without trying others.
GOOD_MISFIT = 0.05


@dataclass(frozen=True)
class FactorReuse:
    """When a Cholesky factor is used again, and its precision."""

    steps: int = 16  # most steps with one factor; together they cost about as much as a new factor
    reach: float = 1e-2  # a factor is used within this distance from its shape, as a fraction of the diagonal
    tolerance: float = 0.25  # share of the tolerance for the last step with a reused factor: the error may be longer
    diagonal_shift: float = 2e-7  # relative, a few rounding errors of single precision, so that a factor exists


@dataclass(frozen=True)
class Damping:
    """Damping of steps where Gauss–Newton stalls, as a share of each diagonal entry (Marquardt 1963)."""

    first: float = 1e-6  # initial value
    factor: float = 10  # increase after a failed step, and decrease after a successful one
    largest: float = 1e3  # the iteration stalls beyond this value
    at_minimum: float = 1e-4  # largest value at which a short step means convergence; more would shorten every step
    least_area: float = 0.1  # smallest share of its area that a step may leave to a face


REUSE, DAMPING = FactorReuse(), Damping()


class LeastSquares:
    """The misfit between shapes of one connectivity and a target."""

    def __init__(self, connectivity: Connectivity, norm: WeightedNorm, matrix: NormalMatrix) -> None:
        self.connectivity, self.norm, self.matrix = connectivity, norm, matrix
        self.jacobian = NRICJacobian(connectivity)

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def __call__(self, vertices: FloatArray, target: FloatArray) -> LeastSquaresPoint:
        """Compare a shape (V, 3) with a target z* (2E,)."""
        geometry = HingeGeometry(vertices, self.connectivity)
        misfit = geometry.nric()
        misfit -= target
        half = len(misfit) // 2
        # Like `wrap`, but in place and ten times faster. The sign of half a turn doesn't change its square.
        misfit[half:] -= 2 * np.pi * np.rint(misfit[half:] / (2 * np.pi))
        return LeastSquaresPoint(vertices, misfit, float(self.norm.square(misfit)), self, geometry)


@dataclass(frozen=True)
class LeastSquaresPoint:
    """A shape and its misfit."""

    vertices: FloatArray  # (V, 3)
    misfit: FloatArray  # (2E,) ``z(X) − z*``, angles modulo 2π
    energy: float  # squared norm of the misfit
    squares: LeastSquares  # the objective
    geometry: HingeGeometry  # edge vectors and normals of the shape

    @cached_property
    def gradients(self) -> NRICGradients:
        """Derivatives of the lengths and angles, computed on demand: the last shape doesn't need them."""
        return self.geometry.gradients()

    def forces(self) -> FloatArray:
        """Negative gradient (V, 3) of half the energy."""
        return -self.squares.jacobian.pull_back(self.gradients, self.squares.norm.squared * self.misfit)

    def entries(self) -> FloatArray:
        """Entries of the normal matrix ``JᵀWJ + εI``, on its pattern."""
        return self.squares.matrix.entries(self.gradients, self.squares.norm)


@dataclass(frozen=True)
class IterationLimits:
    """When to stop. Lengths are in the unit of the mesh."""

    step: float  # the iteration has converged once no vertex moves further
    reach: float  # a factor is replaced once a vertex has moved further
    iterations: int  # largest number of iterations, for both kinds together
    deadline: Deadline | None  # no iteration begins after it


@dataclass(frozen=True, kw_only=True)
class Ended(Outcome):
    """The point at which one of the two iterations ended, and its status."""

    point: LeastSquaresPoint


class GaussNewton:
    """Minimises the least squares of a reconstruction.

    The normal matrix is symmetric positive definite with a fixed pattern: its symbolic analysis happens once.

    **Reused factors.** Near the shape of a Cholesky factor, the factor is used again (a modified Newton method), with
    Anderson acceleration. Where z* is not integrable, Gauss–Newton itself converges only linearly, and a step with a
    reused factor costs an eighth of a step with a new one. See FactorReuse.

    **Damping.** If even a short step with a new factor doesn't lower the misfit, a face has nearly collapsed, and
    angles change too fast for a linearisation. Then Levenberg and Marquardt's damped steps continue. See Damping.
    """

    def __init__(self, squares: LeastSquares, faces: IntArray, backend: Backend) -> None:
        self.squares, self._faces = squares, faces
        self._backend: Backend = backend
        self.single = analyse(squares.matrix.pattern, backend, precision=np.float32)

    def another(self) -> GaussNewton:
        """Return a solver for another thread, which shares everything that is never modified."""
        twin = copy.copy(self)
        twin.single = analyse(self.squares.matrix.pattern, self._backend, precision=np.float32)
        twin.__dict__.pop("double", None)
        return twin

    @cached_property
    def double(self) -> Cholesky:
        """Cholesky in double precision: for single solves, and where single precision is not enough."""
        return analyse(self.squares.matrix.pattern, self._backend)

    def __call__(self, target: FloatArray, start: LeastSquaresPoint, limits: IterationLimits) -> Ended:
        """Minimise the misfit to a target z* (2E,) from a start of finite misfit."""
        ended = self._gauss_newton(target, start, limits)
        if ended.status is Status.STALLED and ended.iterations:
            ended = self._levenberg_marquardt(target, ended, limits)
        return ended

    def _gauss_newton(self, target: FloatArray, here: LeastSquaresPoint, limits: IterationLimits) -> Ended:
        """Iterate with a line search for new factors, and with acceleration for reused ones until a step fails."""
        iterations = 0
        factor: _ReusedFactor | None = None
        while (reached := limit_reached(iterations, limits.iterations, limits.deadline)) is None:
            new = factor is None
            if factor is None:
                try:
                    factor = _ReusedFactor(self.factor(here, target), here.vertices)
                except NotPositiveDefiniteError as error:
                    return _stalled(here, iterations, str(error))
            iterations += 1
            forces = here.forces()
            step, mixed = factor.step(here.vertices, forces)
            size = float(np.abs(step).max())
            if not new:
                t, trial = 1.0, self.squares(mixed, target)
            elif np.isfinite(size):
                t, trial = self._line_search(target, here, forces, step, limits.step)
            else:
                return _stalled(here, iterations, "a step is not finite")
            helps, tiny = trial.energy <= here.energy, size * t <= limits.step * (1 if new else REUSE.tolerance)
            if not (helps or new or tiny):
                factor = None
                continue
            # Take the last, tiny step only if it lowers the energy: at the minimum rounding decides.
            here = trial if helps else here
            if tiny or not helps:
                if t < 1:
                    return _stalled(here, iterations, "only steps shorter than the tolerance lower the misfit")
                return Ended(point=here, status=Status.CONVERGED, iterations=iterations)
            if t < 1 or factor.is_spent(here.vertices, limits.reach):
                factor = None
        return Ended(point=here, status=reached, iterations=iterations)

    def _line_search(
        self, target: FloatArray, here: LeastSquaresPoint, forces: FloatArray, step: FloatArray, shortest: float
    ) -> tuple[float, LeastSquaresPoint]:
        """Find a share of a step that lowers the energy enough, or moves no vertex further than ``shortest``."""
        slope, size = 2 * float(np.vdot(forces, step)), np.abs(step).max()
        found = backtrack(
            lambda t: self.squares(here.vertices + t * step, target),
            lambda t, trial: sufficient_decrease(here.energy, trial.energy, t, slope) or size * t <= shortest,
            smallest=0,
        )
        return found or (0.0, here)

    def _levenberg_marquardt(self, target: FloatArray, begun: Ended, limits: IterationLimits) -> Ended:
        """Continue with Levenberg and Marquardt's iteration (Marquardt 1963) where Gauss–Newton stalled.

        A step is taken if it lowers the energy and no face loses most of its area. If no shape has the target angles,
        the minimum may have a degenerate face; then the steps end before that.
        """
        here, iterations, damping = begun.point, begun.iterations, DAMPING.first
        areas = face_areas(here.vertices, self._faces)
        while (reached := limit_reached(iterations, limits.iterations, limits.deadline)) is None:
            try:
                factor = self.double.factorise(self._damped(here.entries(), damping))
                step = factor.solve(here.forces().ravel()).reshape(-1, 3)
            except NotPositiveDefiniteError as error:
                return _stalled(here, iterations, str(error))
            iterations += 1
            trial = self.squares(here.vertices + step, target)
            left = face_areas(trial.vertices, self._faces)
            helps = trial.energy < here.energy and bool((left >= DAMPING.least_area * areas).all())
            if helps:
                here, areas = trial, left
            if np.abs(step).max() <= limits.step and damping <= DAMPING.at_minimum:
                return Ended(point=here, status=Status.CONVERGED, iterations=iterations)
            damping = damping / DAMPING.factor if helps else max(damping * DAMPING.factor, DAMPING.first)
            if not damping <= DAMPING.largest:
                return _stalled(here, iterations, "no damped step lowers the misfit")
        return Ended(point=here, status=reached, iterations=iterations)

    def factor(self, here: LeastSquaresPoint, target: FloatArray) -> Factorisation:
        """Factorise the normal matrix, in single precision where possible; raises NotPositiveDefiniteError."""
        entries = here.entries()
        if self.is_good(here, target):
            with suppress(NotPositiveDefiniteError):
                return self.single.factorise(self._damped(entries, REUSE.diagonal_shift))
        return self.double.factorise(entries)

    def is_good(self, here: LeastSquaresPoint, target: FloatArray) -> bool:
        """Whether the relative misfit of a point is small, see GOOD_MISFIT."""
        return bool(here.energy <= GOOD_MISFIT**2 * self.squares.norm.square(target))

    def _damped(self, entries: FloatArray, share: float) -> FloatArray:
        damped = entries.copy()
        damped[self.squares.matrix.pattern.diagonal] *= 1 + share
        return damped


def _stalled(point: LeastSquaresPoint, iterations: int, reason: str) -> Ended:
    return Ended(point=point, status=Status.STALLED, iterations=iterations, reason=reason)


class _ReusedFactor:
    """The factorised normal matrix of one shape, for steps from this shape and its neighbours."""

    def __init__(self, factor: Factorisation, at: FloatArray) -> None:
        self._at, self._steps = at, 0
        self._inverse, self._mixing = Preconditioner(factor, rigid_motions(at)), Anderson()

    def step(self, vertices: FloatArray, forces: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the step from a shape, and the next shape by Anderson acceleration."""
        self._steps += 1
        step = self._inverse(forces)
        return step, self._mixing(vertices, forces, step)

    def is_spent(self, vertices: FloatArray, reach: float) -> bool:
        """Whether the factor has been used often enough, or the shape has left its neighbourhood."""
        return self._steps == REUSE.steps or bool(np.abs(vertices - self._at).max() > reach)
