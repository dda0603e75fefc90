"""Vertices from lengths and angles: weighted nonlinear least squares by Gauss–Newton (paper, section 3)."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.coordinates.frame_integration import FrameIntegration
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import Frame, NRICGradients, NRICJacobian, WeightedNorm
from shapespace.mesh.rigid_motion import rigid_motions
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import Backend, Cholesky, NotPositiveDefiniteError, analyse
from shapespace.solve.deadline import Deadline
from shapespace.solve.status import Status

#: Weight of the angles in the reconstruction's norm. A parameter of its own: the metric's η is far too small here,
#: because this norm is dimensionless and sums over edges.
DEFAULT_ETA = 1e-2
#: A factor serves shapes around its own up to this distance of any vertex, a fraction of the diagonal; and this many
#: steps, which is about what a new one costs.
REACH, LIFE = 1e-2, 16
#: Where Gauss–Newton stalls, damping as a share of each diagonal entry: the first, the factor by which it rises where a
#: step fails and falls where one succeeds, and the largest. A step as short as the tolerance is a minimum's up to the
#: last: that is felt by no motion but the softest (the matrix of a torus of 2048 vertices has entries of 1e-6).
FIRST_DAMPING, DAMPING_FACTOR, LARGEST_DAMPING, DAMPING_AT_A_MINIMUM = 1e-6, 10, 1e3, 1e-4
#: Least share of its area that a damped step leaves to a face.
LEAST_AREA = 0.1
#: A first guess from frames with a smaller relative misfit is good enough not to look for another.
GOOD_GUESS = 0.05


@dataclass(frozen=True)
class Reconstruction:
    """What Gauss–Newton found.

    Attributes:
        vertices: (V, 3), always finite.
        status: how the iteration ended.
        iterations: steps tried, each from one evaluation of z(X) and one solve.
        residual: ``‖z(X) − z*‖ / ‖z*‖`` in the weighted norm; about the relative misfit of an edge.
        flipped_faces: faces at an edge whose angle is more than π/2 away from the one asked for.
    """

    vertices: FloatArray
    status: Status
    iterations: int
    residual: float
    flipped_faces: int


class Reconstructor:
    """Finds the shape whose NRIC come closest to given ones.

    Minimises ``½ ‖z(X) − z*‖²_{2,z̄}`` over X in R^{3V} (angles compared modulo 2π) by Gauss–Newton with a
    backtracking line search. The normal matrix is symmetric positive definite with a fixed pattern, so its symbolic
    analysis happens here, once. Near the shape at which it was made a factor is used again (a modified Newton method),
    with Anderson acceleration: where z* is no shape's, Gauss–Newton itself converges only linearly, and a step with
    an old factor costs an eighth of one with a new factor. Where not even a short step with a new factor helps, a face
    has all but collapsed, and angles change too fast for any linearisation: Levenberg and Marquardt's damped steps
    lead on from there, past the collapse or along it. Works for any genus and with boundary, because it never asks
    that z* be integrable. Holds work space: use one per thread.

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
        self._cholesky = analyse(self.normal_matrix.pattern, backend)
        self._backend: Backend = backend

    def another(self) -> Reconstructor:
        """One more for another thread, which shares with this one all that never changes."""
        twin = copy.copy(self)
        twin._cholesky = analyse(self.normal_matrix.pattern, self._backend)
        twin.__dict__.pop("integrate", None)
        return twin

    @cached_property
    def integrate(self) -> FrameIntegration:
        """The shape of integrable z, without iterating."""
        return FrameIntegration(self.reference, self._backend)

    def guess(self, target: FloatArray, *others: Callable[[], FloatArray]) -> FloatArray:
        """A start (V, 3) near the shape of z* (2E,), which depends on nothing but z*.

        Frames first, which are exact for integrable z*. Where they go astray, for errors of z* add up along them,
        the start with the smallest misfit among them, the others, called only then, and the reference.
        """
        return self._guess(target, others).vertices

    def _guess(self, target: FloatArray, others: Iterable[Callable[[], FloatArray]]) -> _Point:
        framed = self._point(self.integrate(target), target)
        if framed.energy <= GOOD_GUESS**2 * self.norm.square(target):
            return framed
        return self._nearest(target, framed, [*(other() for other in others), self.reference.vertices])

    def nearest(self, target: FloatArray, *shapes: FloatArray) -> FloatArray:
        """The shape (V, 3) among some whose misfit is the smallest; the last where none has a finite one."""
        return self._nearest(target, self._point(shapes[0], target), shapes[1:]).vertices

    def _nearest(self, target: FloatArray, best: _Point, shapes: Iterable[FloatArray]) -> _Point:
        for vertices in shapes:
            point = self._point(vertices, target)
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
        here = self._point(self.reference.vertices if start is None else np.asarray(start, np.float64), target)
        return self._iterate(target, here, tolerance, max_iterations, deadline)

    def from_guess(
        self,
        target: FloatArray,
        *others: Callable[[], FloatArray],
        tolerance: float = 1e-8,
        max_iterations: int = 200,
        deadline: Deadline | None = None,
    ) -> Reconstruction:
        """Reconstruct one shape from its own ``guess``, whose misfit is then known already; otherwise as a call."""
        return self._iterate(target, self._guess(target, others), tolerance, max_iterations, deadline)

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def _iterate(
        self, target: FloatArray, here: _Point, tolerance: float, max_iterations: int, deadline: Deadline | None
    ) -> Reconstruction:
        limit, reach = (share * self._diagonal for share in (tolerance, REACH))
        if not np.isfinite(here.energy):
            return Reconstruction(self.reference.vertices, Status.NOT_FINITE, 0, np.inf, 0)
        status, iterations = Status.ITERATION_LIMIT, 0
        factor: _Factor | None = None
        while iterations < max_iterations:
            if deadline is not None and deadline.passed:
                status = Status.DEADLINE
                break
            if new := factor is None:
                try:
                    self._cholesky.factorise(self.normal_matrix.entries(here.gradients, self.norm))
                except NotPositiveDefiniteError:
                    status = Status.STALLED
                    break
                factor = _Factor(self._cholesky, here.vertices)
            iterations += 1
            forces = -self.jacobian.pull_back(here.gradients, self.norm.squared * here.misfit)
            step, mixed = factor.step(here.vertices, forces)
            size, t = np.abs(step).max(), 1.0
            if new and not np.isfinite(size):
                status = Status.STALLED
                break
            trial = self._point(mixed, target)
            if new:
                slope = 2 * np.vdot(forces, step)
                while not (trial.energy <= here.energy - 1e-4 * t * slope or size * t <= limit):
                    t /= 2
                    trial = self._point(here.vertices + t * step, target)
            if not trial.energy <= here.energy:
                if not (new or size <= limit):
                    factor = None
                    continue
                # The last, tiny step is taken only if it helps: at the minimum rounding decides.
                status = Status.CONVERGED if t == 1 or size <= limit else Status.STALLED
                break
            here = trial
            if size * t <= limit:
                status = Status.CONVERGED if t == 1 else Status.STALLED
                break
            if t < 1 or factor.steps == LIFE or np.abs(here.vertices - factor.at).max() > reach:
                factor = None
        if status is Status.STALLED and iterations:
            here, status, iterations = self._damped(target, here, limit, iterations, max_iterations, deadline)
        residual = float(np.sqrt(here.energy / self.norm.square(target)))
        return Reconstruction(here.vertices, status, iterations, residual, self._flipped(here.misfit))

    def _damped(
        self,
        target: FloatArray,
        here: _Point,
        limit: float,
        iterations: int,
        max_iterations: int,
        deadline: Deadline | None,
    ) -> tuple[_Point, Status, int]:
        """Levenberg and Marquardt's iteration (Marquardt 1963), from where Gauss–Newton stalled.

        A step is taken if it lowers the energy and lets no face collapse. The angles asked for may be those of no
        shape, and then the least energy may belong to a face without height: there the steps end at its edge.
        """
        damping, diagonal = FIRST_DAMPING, self.normal_matrix.pattern.diagonal
        areas = face_areas(here.vertices, self.reference.faces)
        while iterations < max_iterations:
            if deadline is not None and deadline.passed:
                return here, Status.DEADLINE, iterations
            entries = self.normal_matrix.entries(here.gradients, self.norm)
            entries[diagonal] *= 1 + damping
            forces = -self.jacobian.pull_back(here.gradients, self.norm.squared * here.misfit)
            try:
                self._cholesky.factorise(entries)
                step = self._cholesky.solve(forces.ravel()).reshape(-1, 3)
            except NotPositiveDefiniteError:
                return here, Status.STALLED, iterations
            iterations += 1
            trial = self._point(here.vertices + step, target)
            left = face_areas(trial.vertices, self.reference.faces)
            helps = trial.energy < here.energy and bool((left >= LEAST_AREA * areas).all())
            if helps:
                here, areas = trial, left
            if np.abs(step).max() <= limit and damping <= DAMPING_AT_A_MINIMUM:
                return here, Status.CONVERGED, iterations
            damping = damping / DAMPING_FACTOR if helps else max(damping * DAMPING_FACTOR, FIRST_DAMPING)
            if not damping <= LARGEST_DAMPING:
                return here, Status.STALLED, iterations
        return here, Status.ITERATION_LIMIT, iterations

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def _point(self, vertices: FloatArray, target: FloatArray) -> _Point:
        frame = Frame(vertices, self.reference.connectivity)
        misfit = frame.nric()
        misfit -= target
        half = len(misfit) // 2
        # As `wrap`, in place and ten times faster; half a turn counts the same either way round.
        misfit[half:] -= 2 * np.pi * np.rint(misfit[half:] / (2 * np.pi))
        return _Point(vertices, misfit, float(self.norm.square(misfit)), frame)

    def differential(self, vertices: FloatArray, changes: FloatArray) -> FloatArray:
        """How a reconstructed shape (V, 3) moves, (n, V, 3), where what it was asked for changes by (n, 2E).

        ``dX = (JᵀWJ)⁻¹ JᵀW dz``, from the implicit function theorem at a minimum whose residual is small; without rigid
        motion. Raises NotPositiveDefiniteError.
        """
        jacobian = self._factorised_at(vertices)
        forces = jacobian.T @ (changes * self.norm.squared).T
        return self._cholesky.solve(forces.T).reshape(len(changes), -1, 3)

    def sensitivity(self, vertices: FloatArray, fields: FloatArray) -> FloatArray:
        """The transpose of ``differential``.

        How products of a reconstructed shape (V, 3) with vertex fields (n, V, 3) depend on what it was asked for,
        (n, 2E).
        """
        jacobian = self._factorised_at(vertices)
        solved = self._cholesky.solve(fields.reshape(len(fields), -1))
        return (jacobian @ solved.T).T * self.norm.squared

    def _factorised_at(self, vertices: FloatArray) -> sparse.csr_array:
        gradients = self.jacobian.gradients(vertices)
        self._cholesky.factorise(self.normal_matrix.entries(gradients, self.norm))
        return self.jacobian.matrix(gradients)

    def _flipped(self, misfit: FloatArray) -> int:
        connectivity = self.reference.connectivity
        folded = (np.abs(misfit[connectivity.edge_count :]) > np.pi / 2) & connectivity.interior
        return len(np.unique(connectivity.edge_faces[folded]))


@dataclass(frozen=True)
class _Point:
    """A shape on the way: the misfit ``z(X) − z*`` (2E,), its squared norm, and what derivatives are made of."""

    vertices: FloatArray
    misfit: FloatArray
    energy: float
    frame: Frame

    @cached_property
    def gradients(self) -> NRICGradients:
        """The derivatives, which the last shape doesn't need."""
        return self.frame.gradients()


class _Factor:
    """The normal matrix of one shape, factorised, for steps from there and from its neighbours.

    The rigid motions of its own shape, which the matrix doesn't resist, are taken out of the forces: at a neighbour
    they are other motions, and forces that balance there would turn it without bound here.
    """

    def __init__(self, cholesky: Cholesky, at: FloatArray) -> None:
        self.at, self.steps = at, 0
        self._cholesky, self._rigid, self._mixing = cholesky, rigid_motions(at), Anderson()

    def step(self, vertices: FloatArray, forces: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The step from a shape, and the next shape, which the steps so far have their part in."""
        self.steps += 1
        flat = forces.ravel()
        balanced = flat - (self._rigid @ flat) @ self._rigid
        step = self._cholesky.solve(balanced).reshape(-1, 3)
        return step, self._mixing(vertices, forces, step)
