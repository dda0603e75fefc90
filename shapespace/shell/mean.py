"""Means of shapes: the elastic mean and the Riemannian centre of mass, both weighted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from shapespace.arrays import FloatArray
from shapespace.shell.geodesic import Logarithm, logarithm
from shapespace.shell.space import TOLERANCE, Point, ShellSpace, edge_length, fault_between, keeps_faces
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.status import Status
from shapespace.solve.truncated_newton import descend

#: Most iterations of either mean.
ITERATIONS = 100


@dataclass(frozen=True)
class Mean:
    """A mean shape.

    Attributes:
        vertices: (V, 3), always finite; the best found.
        status: how the iteration ended.
        iterations: shapes tried.
        residual: ``sqrt(Fᵀ A⁻¹ F)``, the length of the step still to go.
        reason: what happened if it did not converge, in words.
        worst: of the elastic mean, where it did not converge: number of the shape and of the face whose areas in shape
            and mean are furthest apart.
        logarithms: for the centre of mass, those of the shapes at it, in their order.
    """

    vertices: FloatArray
    status: Status
    iterations: int
    residual: float
    reason: str = ""
    logarithms: tuple[Logarithm, ...] = ()
    worst: tuple[int, int] | None = None


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def elastic_mean(
    space: ShellSpace,
    shapes: Sequence[FloatArray] | FloatArray,
    weights: ArrayLike | None = None,
    *,
    start: FloatArray | None = None,
) -> Mean:
    """The shape into which all are deformed with least energy: ``min_X Σ w_i W[z_i, z(X)]``.

    Quasi-Newton with the metric of the current shape: ``Σ w_i ∂₂∂₂W[z_i, z]`` is close to ``Hess₂W[z, z]``,
    whose J-pull-back is positive definite, so that its steps always lower the energy if short enough;
    Anderson acceleration takes over where full steps do. Where faces differ so much between the shapes that this is
    no longer close, Newton's steps go on. A first guess of the centre of mass, and cheap.

    Args:
        space: where.
        shapes: n shapes (V, 3), in any position.
        weights: n positive weights, equal by default; only their ratios count.
        start: (V, 3) first guess, the shape of least total energy by default.
    """
    shapes, w = _checked(space, shapes, weights)
    fault = _not_finite(shapes)
    if fault:
        return Mean(space.reference.vertices, Status.NOT_FINITE, 0, np.inf, fault)
    energy = _MeanEnergy(space, shapes, w)
    if start is None:
        start = shapes[int(np.argmin([energy.value(x) for x in shapes]))]
    found = _quasi_newton(energy, start)
    if found.status is Status.CONVERGED:
        return found
    iterations, residual, reason = found.iterations, found.residual, found.reason
    vertices, status = found.vertices, found.status
    if np.isfinite(energy.value(vertices)):
        try:
            more = descend(energy, vertices, TOLERANCE, ITERATIONS)
        except NotPositiveDefiniteError as error:
            status, reason = Status.DEGENERATE, str(error)
        else:
            iterations, residual, vertices = iterations + more.iterations, more.residual, more.x
            if more.converged:
                return Mean(vertices, Status.CONVERGED, iterations, residual)
            status, reason = Status.STALLED, f"residual {residual:.1e} after {iterations} iterations"
    else:
        status, reason = Status.DEGENERATE, "a shape has a face without area"
    return Mean(vertices, status, iterations, residual, reason, worst=energy.worst(vertices))


class _MeanEnergy:
    """``Σ w_i W[z_i, z(X)]`` of shapes (n, V, 3) with weights (n,); see newton.Energy."""

    def __init__(self, space: ShellSpace, shapes: FloatArray, weights: FloatArray) -> None:
        self.space, self._weights = space, weights
        self._rest = space.energy.rest(space.nric(shapes))
        self.length = edge_length(space)

    def value_of(self, z: FloatArray) -> float:
        """Of lengths and angles (2E,)."""
        return float(self._weights @ self._rest.value(z))

    def forces_at(self, point: Point) -> FloatArray:
        """(V, 3)."""
        return -point.pull_back(self._weights @ self._rest.gradient_deformed(point.z))

    def value(self, x: FloatArray) -> float:
        return self.value_of(self.space.nric(x))

    def forces(self, x: FloatArray) -> FloatArray:
        return self.forces_at(self.space.point(x))

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        return keeps_faces(self.space, x, x + step)

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        self.space.chord.factorise(self.space.point(x))
        return self.space.chord.solve

    def worst(self, x: FloatArray) -> tuple[int, int]:
        """The shape and the face whose area is furthest from that in a mean."""
        ratios = np.abs(np.log(self._rest.areas / self.space.point(x).rest.areas))
        shape, face = np.unravel_index(np.nan_to_num(ratios, nan=np.inf).argmax(), ratios.shape)
        return int(shape), int(face)


def _quasi_newton(mean: _MeanEnergy, start: FloatArray) -> Mean:
    space = mean.space
    point, energy = space.point(start), mean.value(start)
    best, lowest = start, np.inf
    mixing, residual, iterations = Anderson(), np.inf, 0
    chord = space.chord
    for iterations in range(ITERATIONS):
        forces = mean.forces_at(point)
        if residual > RENEW_ABOVE:
            try:
                chord.factorise(point)
            except NotPositiveDefiniteError as error:
                return Mean(best, Status.DEGENERATE, iterations, residual, str(error))
        step = chord.solve(forces)
        residual = float(np.sqrt(abs(np.vdot(forces, step))))
        if residual <= TOLERANCE:
            return Mean(point.vertices, Status.CONVERGED, iterations, residual)
        if residual < lowest:
            best, lowest = point.vertices, residual
        if residual <= RENEW_ABOVE:
            point = space.point(mixing(point.vertices, forces, step))
            if np.isfinite(point.z).all():
                continue
            break
        t = 1.0
        while t > 1e-4:
            trial = space.point(point.vertices + t * step)
            trial_energy = mean.value_of(trial.z)
            if trial_energy <= energy - 1e-4 * t * residual**2:
                break
            t /= 2
        else:
            break
        point, energy = trial, trial_energy
    return Mean(best, Status.STALLED, iterations, lowest)


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def centre_of_mass(
    space: ShellSpace,
    shapes: Sequence[FloatArray] | FloatArray,
    weights: ArrayLike | None = None,
    *,
    steps: int = 4,
    start: FloatArray | None = None,
    tolerance: float = 1e-6,
) -> Mean:
    """The Riemannian centre of mass: the shape of least weighted sum of squared distances (paper, section 3).

    Discretely, the least ``Σ w_i K Σ_k W[z^i_{k−1}, z^i_k]`` over the mean z^i_0 = z and the paths to all
    shapes: ``F = Σ w_i Jᵀ ∂₁W[z, z^i_1] = 0``, whose quasi-Newton step with the metric is the weighted sum
    of the logarithms. Karcher's fixed point, accelerated; each iteration costs n geodesics.

    Args:
        space: where.
        shapes: n shapes (V, 3), in any position.
        weights: n positive weights, equal by default.
        steps: K of the geodesics.
        start: (V, 3) first guess, the elastic mean by default.
        tolerance: of the length of the weighted sum of logarithms.
    """
    shapes, w = _checked(space, shapes, weights)
    fault = _not_finite(shapes)
    if fault:
        return Mean(space.reference.vertices, Status.NOT_FINITE, 0, np.inf, fault)
    if start is None:
        start = elastic_mean(space, shapes, w).vertices
    mixing, residual = Anderson(), np.inf
    vertices, best = start, start
    logarithms: tuple[Logarithm, ...] = ()
    reason = f"{ITERATIONS} iterations were not enough"
    for iteration in range(ITERATIONS):
        logarithms = tuple(logarithm(space, vertices, shape, steps) for shape in shapes)
        failed = next((i for i, log in enumerate(logarithms) if not log.path.converged), None)
        if failed is not None:
            reason = f"no geodesic to shape {failed}: {logarithms[failed].path.reason}"
            return Mean(best, Status.STALLED, iteration, residual, reason)
        point, chord = space.point(vertices), space.chord
        first = np.stack([log.path.nric[1] for log in logarithms])
        forces = -steps * point.pull_back(w @ point.rest.gradient_rest(first))
        try:
            chord.factorise(point)
        except NotPositiveDefiniteError as error:
            return Mean(best, Status.DEGENERATE, iteration, residual, str(error))
        step = chord.solve(forces)
        before, residual = residual, float(np.sqrt(abs(np.vdot(forces, step))))
        if residual <= tolerance:
            return Mean(vertices, Status.CONVERGED, iteration, residual, "", logarithms)
        if residual > 2 * before:
            reason = f"residual grows from {before:.1e} to {residual:.1e}"
            break
        best, vertices = vertices, mixing(vertices, forces, step)
        fault = fault_between(point, space.point(vertices))
        if fault:
            reason = fault
            break
    return Mean(best, Status.STALLED, iteration, residual, reason)


#: Below this the elastic mean keeps its factor and trusts full, accelerated steps.
RENEW_ABOVE = 1e-2


def _checked(
    space: ShellSpace, shapes: Sequence[FloatArray] | FloatArray, weights: ArrayLike | None
) -> tuple[FloatArray, FloatArray]:
    if len(shapes) == 0:
        raise ValueError("there is no mean of no shapes")
    shapes = np.stack([space.shape(x) for x in shapes])
    w = np.ones(len(shapes)) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (len(shapes),) or not (w >= 0).all() or not 0 < w.sum() < np.inf:
        raise ValueError("weights must be as many as shapes, not negative, and not all zero")
    return shapes, w / w.sum()


def _not_finite(shapes: FloatArray) -> str | None:
    bad = np.flatnonzero(~np.isfinite(shapes).all(axis=(1, 2)))
    return f"shape {bad[0]} has a coordinate that is not finite" if len(bad) else None
