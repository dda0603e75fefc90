"""Vertices from lengths and angles: weighted nonlinear least squares by Gauss–Newton (paper, section 3)."""

from __future__ import annotations

import time
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from geometry.cholesky import Backend, NotPositiveDefiniteError, analyse
from geometry.mesh import FloatArray, TriangleMesh
from geometry.normal_matrix import NormalMatrix, QuadraticForm
from geometry.nric import NRICJacobian, WeightedNorm, nric, wrap

#: Weight of the angles in the reconstruction's norm. A parameter of its own: the metric's η is far too small here,
#: because this norm is dimensionless and sums over edges.
DEFAULT_ETA = 1e-2


class Status(StrEnum):
    """How an iteration ended; anything but CONVERGED still comes with finite vertices."""

    CONVERGED = "converged"
    STALLED = "stalled"
    ITERATION_LIMIT = "iteration_limit"
    DEADLINE = "deadline"
    NOT_FINITE = "not_finite"
    DEGENERATE = "degenerate"


@dataclass(frozen=True)
class Reconstruction:
    """What Gauss–Newton found.

    Attributes:
        vertices: (V, 3), always finite.
        status: how the iteration ended.
        iterations: factorisations done.
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
    analysis happens here, once. Works for any genus and with boundary, because it never asks that z* be integrable.
    Holds work space: use one per thread.

    Args:
        reference: gives the weights, and the default start.
        eta: weight of the angles, see DEFAULT_ETA.
        backend: Cholesky backend.
    """

    def __init__(self, reference: TriangleMesh, eta: float = DEFAULT_ETA, backend: Backend = "auto") -> None:
        self.reference = reference
        self.norm = WeightedNorm.of(reference, eta)
        self.jacobian = NRICJacobian(reference.connectivity)
        self.normal_matrix = NormalMatrix(reference.connectivity)
        self._form = QuadraticForm.of(self.norm, reference.connectivity)
        self._cholesky = analyse(self.normal_matrix.pattern, backend)

    def _misfit(self, vertices: FloatArray, target: FloatArray) -> FloatArray:
        r = nric(vertices, self.reference.connectivity) - target
        half = len(r) // 2
        r[half:] = wrap(r[half:])
        return r

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def __call__(
        self,
        target: FloatArray,
        start: FloatArray | None = None,
        *,
        tolerance: float = 1e-8,
        max_iterations: int = 100,
        deadline: float | None = None,
    ) -> Reconstruction:
        """Reconstruct one shape.

        Args:
            target: z*, (2E,); need not be integrable.
            start: (V, 3) first guess, the reference by default.
            tolerance: stop once no vertex moves further than this fraction of the reference's diagonal.
            max_iterations: most factorisations.
            deadline: time.monotonic() after which no iteration begins.
        """
        x = self.reference.vertices if start is None else np.asarray(start, dtype=np.float64)
        weights = self.norm.squared
        step_limit = tolerance * self.reference.diagonal
        r = self._misfit(x, target)
        energy = self.norm.square(r)
        if not np.isfinite(energy):
            return Reconstruction(self.reference.vertices, Status.NOT_FINITE, 0, np.inf, 0)
        status, iterations = Status.ITERATION_LIMIT, 0
        while iterations < max_iterations:
            if deadline is not None and time.monotonic() > deadline:
                status = Status.DEADLINE
                break
            gradients = self.jacobian.gradients(x)
            gradient = self.jacobian.matrix(gradients).T @ (weights * r)
            try:
                self._cholesky.factorise(self.normal_matrix.entries(gradients, self._form))
            except NotPositiveDefiniteError:
                status = Status.STALLED
                break
            iterations += 1
            step = -self._cholesky.solve(gradient).reshape(-1, 3)
            slope = 2 * np.vdot(gradient, step)
            size, t = np.abs(step).max(), 1.0
            if not np.isfinite(size):
                status = Status.STALLED
                break
            while True:
                trial = x + t * step
                trial_r = self._misfit(trial, target)
                trial_energy = self.norm.square(trial_r)
                if trial_energy <= energy + 1e-4 * t * slope or size * t <= step_limit:
                    break
                t /= 2
            if not trial_energy <= energy:
                # The last, tiny step is taken only if it helps: at the minimum rounding decides.
                status = Status.CONVERGED if t == 1 or size <= step_limit else Status.STALLED
                break
            x, r, energy = trial, trial_r, trial_energy
            if size * t <= step_limit:
                status = Status.CONVERGED if t == 1 else Status.STALLED
                break
        return Reconstruction(
            x, status, iterations, float(np.sqrt(energy / self.norm.square(target))), self._flipped(r)
        )

    def _flipped(self, misfit: FloatArray) -> int:
        connectivity = self.reference.connectivity
        folded = (np.abs(misfit[connectivity.edge_count :]) > np.pi / 2) & connectivity.interior
        return len(np.unique(connectivity.edge_faces[folded]))
