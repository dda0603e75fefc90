"""Weighted means of shapes: the elastic mean and the Riemannian centre of mass."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from shapespace.arrays import FloatArray, IntArray
from shapespace.shell.geodesic import Logarithm, logarithm
from shapespace.shell.space import TOLERANCE, ShellPoint, ShellSpace, edge_length, fault_between, keeps_faces
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.line_search import backtrack, sufficient_decrease
from shapespace.solve.outcome import Outcome, Status
from shapespace.solve.preconditioner import step_length
from shapespace.solve.truncated_newton import descend

#: Largest number of iterations of each mean.
ITERATIONS = 100
#: Below this residual the elastic mean keeps its factor and makes full, accelerated steps.
RENEW_ABOVE = 1e-2
#: Largest number of shapes that are tried as a first guess. All would take a time that grows with their square.
CANDIDATES = 100
#: Smallest step length of the line search above this residual.
SMALLEST_STEP = 1e-4


@dataclass(frozen=True, kw_only=True)
class Mean(Outcome):
    """A mean shape. Its residual is ``sqrt(Fᵀ A⁻¹ F)``, the length of the next step.

    Attributes:
        vertices: (V, 3), always finite; the best shape found.
        logarithms: for the centre of mass, the logarithms of the shapes at the mean, in their order.
        worst: for an elastic mean that did not converge, the indices of the shape and of the face with the largest
            ratio between the area in the shape and the area in the mean.
    """

    vertices: FloatArray
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
    """Compute the shape to which all shapes are deformed with least energy: ``min_X Σ w_i W[z_i, z(X)]``.

    The method is quasi-Newton with the metric of the present shape: ``Σ w_i ∂₂∂₂W[z_i, z]`` is close to
    ``Hess₂W[z, z]``, whose pull-back by J is positive definite. So short steps always lower the energy. Near the mean,
    full steps are accelerated (Anderson). If the faces of the shapes differ too much for this approximation, truncated
    Newton continues. The elastic mean is cheap, and a first guess for the centre of mass.

    Args:
        space: Riemannian space of the shapes.
        shapes: n shapes (V, 3), in any position.
        weights: n weights, not negative, equal by default; only their ratios matter.
        start: (V, 3) first guess. By default it is the shape of least total energy, among the 100 shapes that take the
            least energy to get the mean lengths and angles.
    """
    shapes, w, fault = _checked(space, shapes, weights)
    if fault:
        return fault
    energy = _MeanEnergy(space, shapes, w)
    if start is None:
        tried = shapes[energy.typical()]
        start = tried[int(np.argmin([energy.value(x) for x in tried]))]
    found = _quasi_newton(energy, start)
    return found if found.converged else _newton(energy, found)


class _MeanEnergy:
    """``Σ w_i W[z_i, z(X)]`` for shapes (n, V, 3) with weights (n,); see truncated_newton.Energy."""

    def __init__(self, space: ShellSpace, shapes: FloatArray, weights: FloatArray) -> None:
        self.space, self._weights = space, weights
        self._rest = space.energy.rest(space.nric(shapes))
        self.length = edge_length(space)

    def typical(self) -> IntArray:
        """Return the indices of the CANDIDATES shapes that take the least energy to get the mean lengths and angles."""
        energies = self._rest.value(self._weights @ self._rest.z)
        return np.sort(np.argsort(energies, kind="stable")[:CANDIDATES])

    def value_at(self, point: ShellPoint) -> float:
        return float(self._weights @ self._rest.value(point.z))

    def forces_at(self, point: ShellPoint) -> FloatArray:
        return -point.pull_back(self._weights @ self._rest.gradient_deformed(point.z))

    def value(self, x: FloatArray) -> float:
        return self.value_at(self.space.point(x))

    def forces(self, x: FloatArray) -> FloatArray:
        return self.forces_at(self.space.point(x))

    def admits(self, x: FloatArray, step: FloatArray) -> bool:
        return keeps_faces(self.space, x, x + step)

    def precondition(self, x: FloatArray) -> Callable[[FloatArray], FloatArray]:
        return self.space.factorise(self.space.point(x)).solve

    def worst(self, x: FloatArray) -> tuple[int, int]:
        """Find the shape and the face with the largest ratio of areas between the shape and a mean."""
        ratios = np.abs(np.log(self._rest.areas / self.space.point(x).rest.areas))
        shape, face = np.unravel_index(np.nan_to_num(ratios, nan=np.inf).argmax(), ratios.shape)
        return int(shape), int(face)


def _quasi_newton(mean: _MeanEnergy, start: FloatArray) -> Mean:
    """Iterate with a line search and a new factor in each step; near the mean with one factor, accelerated."""
    space = mean.space
    point, energy = space.point(start), mean.value(start)
    best, lowest = start, np.inf
    mixing, residual, iterations = Anderson(), np.inf, 0
    for iterations in range(ITERATIONS):
        forces = mean.forces_at(point)
        if residual > RENEW_ABOVE:
            try:
                chord = space.factorise(point)
            except NotPositiveDefiniteError as error:
                found = Mean(vertices=best, status=Status.DEGENERATE, reason=str(error))
                return replace(found, iterations=iterations, residual=residual)
        step = chord.solve(forces)
        residual = step_length(forces, step)
        if residual <= TOLERANCE:
            return Mean(vertices=point.vertices, status=Status.CONVERGED, iterations=iterations, residual=residual)
        if residual < lowest:
            best, lowest = point.vertices, residual
        if residual <= RENEW_ABOVE:
            point = space.point(mixing(point.vertices, forces, step))
            if np.isfinite(point.z).all():
                continue
            break
        there = _line_search(mean, point, energy, step, residual**2)
        if there is None:
            break
        point, energy = there
    return Mean(vertices=best, status=Status.STALLED, iterations=iterations, residual=lowest)


def _line_search(
    mean: _MeanEnergy, point: ShellPoint, energy: float, step: FloatArray, slope: float
) -> tuple[ShellPoint, float] | None:
    def trial(t: float) -> tuple[ShellPoint, float]:
        there = mean.space.point(point.vertices + t * step)
        return there, mean.value_at(there)

    found = backtrack(trial, lambda t, there: sufficient_decrease(energy, there[1], t, slope), SMALLEST_STEP)
    return found and found[1]


def _newton(mean: _MeanEnergy, begun: Mean) -> Mean:
    """Continue by truncated Newton where quasi-Newton ended."""
    vertices, iterations, residual = begun.vertices, begun.iterations, begun.residual
    status, reason = Status.DEGENERATE, "a shape has a face without area"
    if np.isfinite(mean.value(vertices)):
        try:
            found = descend(mean, vertices, TOLERANCE, ITERATIONS)
        except NotPositiveDefiniteError as error:
            reason = str(error)
        else:
            vertices, iterations, residual = found.x, iterations + found.iterations, found.residual
            if found.converged:
                return Mean(vertices=vertices, status=Status.CONVERGED, iterations=iterations, residual=residual)
            status, reason = Status.STALLED, f"residual {residual:.1e} after {iterations} iterations"
    ended = Mean(vertices=vertices, status=status, iterations=iterations, residual=residual, reason=reason)
    return replace(ended, worst=mean.worst(vertices))


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
    """Compute the Riemannian centre of mass, the shape with the least sum of squared distances (paper, section 3).

    The discrete problem is to minimise ``Σ w_i K Σ_k W[z^i_{k−1}, z^i_k]`` over the mean z^i_0 = z and the paths to all
    shapes. At the minimum ``F = Σ w_i Jᵀ ∂₁W[z, z^i_1] = 0``. A quasi-Newton step with the metric is the weighted sum
    of the logarithms. This is Karcher's fixed-point iteration, with acceleration. Each iteration needs n geodesics.

    Args:
        space: Riemannian space of the shapes.
        shapes: n shapes (V, 3), in any position.
        weights: n weights, not negative, equal by default.
        steps: K of the geodesics.
        start: (V, 3) first guess, the elastic mean by default.
        tolerance: tolerance of the length of the weighted sum of logarithms.
    """
    shapes, w, failed = _checked(space, shapes, weights)
    if failed:
        return failed
    if start is None:
        start = elastic_mean(space, shapes, w).vertices
    mixing, residual = Anderson(), np.inf
    vertices, best = start, start

    def mean(status: Status, iterations: int, reason: str = "") -> Mean:
        return Mean(vertices=best, status=status, iterations=iterations, residual=residual, reason=reason)

    for iteration in range(ITERATIONS):
        logarithms = tuple(logarithm(space, vertices, shape, steps) for shape in shapes)
        for i, log in enumerate(logarithms):
            if not log.path.converged:
                return mean(Status.STALLED, iteration, f"no geodesic to shape {i}: {log.path.reason}")
        point = space.point(vertices)
        first = np.stack([log.path.nric[1] for log in logarithms])
        forces = -steps * point.pull_back(w @ point.rest.gradient_rest(first))
        try:
            step = space.factorise(point).solve(forces)
        except NotPositiveDefiniteError as error:
            return mean(Status.DEGENERATE, iteration, str(error))
        before, residual = residual, step_length(forces, step)
        if residual <= tolerance:
            best = vertices
            return replace(mean(Status.CONVERGED, iteration), logarithms=logarithms)
        if residual > 2 * before:
            return mean(Status.STALLED, iteration, f"residual grows from {before:.1e} to {residual:.1e}")
        best, vertices = vertices, mixing(vertices, forces, step)
        fault = fault_between(point, space.point(vertices))
        if fault:
            return mean(Status.STALLED, iteration, fault)
    return mean(Status.STALLED, iteration, f"{ITERATIONS} iterations were not enough")


def _checked(
    space: ShellSpace, shapes: Sequence[FloatArray] | FloatArray, weights: ArrayLike | None
) -> tuple[FloatArray, FloatArray, Mean | None]:
    """Return shapes (n, V, 3), weights (n,) with sum 1, and the failed result if a shape is not finite."""
    if len(shapes) == 0:
        raise ValueError("there is no mean of no shapes")
    shapes = np.stack([space.shape(x) for x in shapes])
    w = np.ones(len(shapes)) if weights is None else np.asarray(weights, dtype=np.float64)
    if w.shape != (len(shapes),) or not (w >= 0).all() or not 0 < w.sum() < np.inf:
        raise ValueError("weights must be as many as shapes, not negative, and not all zero")
    failed = None
    bad = np.flatnonzero(~np.isfinite(shapes).all(axis=(1, 2)))
    if len(bad):
        reason = f"shape {bad[0]} has a coordinate that is not finite"
        failed = Mean(vertices=space.reference.vertices, status=Status.NOT_FINITE, reason=reason)
    return shapes, w / w.sum(), failed
