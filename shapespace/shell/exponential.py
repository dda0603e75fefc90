"""The time-discrete exponential map: shooting a geodesic from a shape with a velocity (paper, appendix B)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from shapespace.arrays import FloatArray
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.shell.space import TOLERANCE, Path, Point, ShellSpace, fault_between
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.status import Status

#: Shapes behind a start value: a polynomial through eight of them leaves an error of eighth order in the step.
EXTRAPOLATED = 8
#: What a factor costs in iterations. An old one is renewed when it has taken so many more than it did when new, or
#: looks like taking them within one step.
COST = 8
#: Old factors are turned along from the step on in which one took so many more.
PATIENCE = 1
#: Two iterations that leave more than this of the residual aren't worth going on with.
SLOW = 0.5
#: Iterations of exact Newton, and the smallest step tried. Those that converge need 4 to 8; where it takes more, a face
#: is collapsing, and a path that is dragged on ends a few steps later (measured on posed bodies).
NEWTON_ITERATIONS = 12
SMALLEST_STEP = 1 / 16


def exponential(
    space: ShellSpace,
    start: FloatArray,
    velocity: FloatArray,
    steps: int = 16,
    *,
    tolerance: float = TOLERANCE,
    deadline: Deadline | None = None,
) -> Path:
    """Shoot the discrete geodesic of K steps: ``X_1 = X_0 + d/K``, then one equation after the other.

    The one-sided first step makes it first-order in 1/K. Rigid motions are taken out of the velocity, see
    ``without_rigid_motion``; at equal K the discrete logarithm is then the inverse to solver tolerance.

    Args:
        space: where.
        start: X_0 (V, 3).
        velocity: d, a vertex field (V, 3); ``space.project`` makes one from lengths and angles.
        steps: K. A negative number shoots backwards in time: the shapes before X_0 of a geodesic that passes
            through it with this velocity, which agree with ``−velocity`` to first order in 1/K, and exactly
            continue a path that was shot forwards.
        tolerance: of ``sqrt(Fᵀ A⁻¹ F)`` at every step.
        deadline: after which the status is Status.DEADLINE, looked at before every step.

    Returns:
        |K| + 1 shapes from X_0 on, fewer where a step failed.
    """
    start, velocity = space.shape(start), space.shape(velocity)
    if steps == 0:
        raise ValueError("steps must not be 0")
    if not (np.isfinite(start).all() and np.isfinite(velocity).all()):
        start = np.where(np.isfinite(start), start, space.reference.vertices)
        return Path(start[None], Status.NOT_FINITE, space, "start or velocity has an entry that is not finite")
    second = start + without_rigid_motion(velocity, start) / abs(steps)
    if steps < 0:
        path = extrapolate(space, second, start, -steps, forward=False, tolerance=tolerance, deadline=deadline)
        return Path(path.vertices[1:], path.status, space, path.reason, path.iterations, path.residuals)
    return extrapolate(space, start, second, steps - 1, tolerance=tolerance, deadline=deadline)


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def extrapolate(
    space: ShellSpace,
    first: FloatArray,
    second: FloatArray,
    steps: int,
    *,
    forward: bool = True,
    tolerance: float = TOLERANCE,
    deadline: Deadline | None = None,
) -> Path:
    """Continue two neighbouring shapes of a discrete geodesic by more of its shapes.

    Args:
        space: where.
        first: (V, 3).
        second: (V, 3), one time step later; earlier, if not ``forward``.
        steps: how many shapes to add.
        forward: whether time runs forward. W isn't symmetric, so going back is another equation, whose solution
            is exactly the shape that a forward step would have come from.
        tolerance: of ``sqrt(Fᵀ A⁻¹ F)`` at every step.
        deadline: after which the status is Status.DEADLINE, looked at before every step.

    Returns:
        2 + steps shapes, the given ones first; fewer where a step failed.
    """
    previous, current = space.point(first), space.point(second)
    shapes: list[FloatArray] = [previous.vertices, current.vertices]
    solved: list[_Solution] = []
    status, reason = Status.CONVERGED, ""
    fault = fault_between(previous, current)
    if fault:
        return Path(shapes[0][None], Status.DEGENERATE, space, f"the given step: {fault}")
    chord, areas = space.chord, previous.rest.areas
    # Iterations that the factor took when new, and that it has taken more since then.
    fresh, more, turning = 0, COST, False
    for _ in range(steps):
        if deadline is not None and deadline.passed:
            status, reason = Status.DEADLINE, f"step {len(shapes)}: the time was over"
            break
        equation = _Step(previous, current, forward)
        start = _extrapolated(shapes[-EXTRAPOLATED:])
        wasted, solution = 0, None
        if more < COST:
            if turning:
                chord.turn_to(current)
            # The factor's matrix may differ from the step's own by a factor of 2 or so.
            solution = _chord(equation, start, tolerance / 2, fresh + COST)
            more += max(solution.iterations - fresh, 0)
            turning = turning or solution.fault is not None or solution.iterations > fresh + PATIENCE
            if solution.fault:
                wasted = solution.iterations
        if solution is None or solution.fault:
            try:
                chord.factorise(current)
            except NotPositiveDefiniteError as error:
                status, reason = Status.DEGENERATE, f"step {len(shapes)}: {error}"
                break
            solution = _chord(equation, start, tolerance)
            fresh, more = solution.iterations, 0
        if solution.fault:
            solution = _newton(equation, tolerance)
        if solution.fault:
            smallest = (current.rest.areas / areas).min()
            status = Status.STALLED
            reason = f"step {len(shapes)}: {solution.fault}; a face has {smallest:.1e} of its area at the start"
            break
        solved.append(replace(solution, iterations=wasted + solution.iterations))
        shapes.append(solution.point.vertices)
        previous, current = current, solution.point
    return Path(
        np.stack(shapes),
        status,
        space,
        reason,
        tuple(s.iterations for s in solved),
        tuple(s.residual for s in solved),
    )


def _extrapolated(shapes: list[FloatArray]) -> FloatArray:
    """The next value of the polynomial through shapes at equal times."""
    n = len(shapes)
    weights = [(-1.0) ** (j + 1) * comb(n, j) for j in range(n, 0, -1)]
    return np.einsum("n,nvc->vc", weights, np.stack(shapes))


class _Step:
    """The discrete Euler–Lagrange equation of one step, for the shape X that comes next.

    ``F(X) = J_kᵀ (∂₂W[z_{k−1}, z_k] + ∂₁W[z_k, z(X)]) = 0``, and going back in time
    ``F(X) = J_kᵀ (∂₁W[z_k, z_{k+1}] + ∂₂W[z(X), z_k]) = 0``.
    """

    def __init__(self, previous: Point, current: Point, forward: bool) -> None:
        self.current = current
        self._forward = forward
        if forward:
            self._known = previous.rest.gradient_deformed(current.z)
        else:
            self._known = current.rest.gradient_rest(previous.z)

    def forces(self, unknown: Point) -> FloatArray:
        """F (V, 3)."""
        if self._forward:
            covector = self.current.rest.gradient_rest(unknown.z)
        else:
            covector = unknown.rest.gradient_deformed(self.current.z)
        return self.current.pull_back(covector + self._known)

    def derivative(self, unknown: Point) -> sparse.csc_array:
        """``DF(X)`` (3V, 3V), near −A and not symmetric; the rigid motions are lifted out of its null space."""
        matrix = self.current.space.jacobian.matrix
        here, there = matrix(self.current.gradients), matrix(unknown.gradients)
        if self._forward:
            derivative = here.T @ self.current.rest.mixed_hessian(unknown.z) @ there
        else:
            derivative = here.T @ unknown.rest.mixed_hessian(self.current.z).T @ there
        shift = NormalMatrix.REGULARISATION * derivative.diagonal().mean()
        return sparse.csc_array(derivative + shift * sparse.eye_array(derivative.shape[0]))


@dataclass(frozen=True)
class _Solution:
    """Where an iteration on one step ended, with its fault if it isn't solved."""

    point: Point
    iterations: int
    residual: float
    fault: str | None


def _checked(equation: _Step, point: Point, iterations: int, residual: float) -> _Solution:
    return _Solution(point, iterations, residual, fault_between(equation.current, point))


def _chord(equation: _Step, start: FloatArray, tolerance: float, limit: float = np.inf) -> _Solution:
    """``X ← X + A⁻¹F(X)`` with the factor at hand, accelerated, until it is solved or isn't worth going on.

    Args:
        equation: the step to solve.
        start: first guess.
        tolerance: of ``sqrt(Fᵀ A⁻¹ F)``, with the factor at hand. Where it holds, the step at hand is taken as well:
            that costs little, and what error it leaves grows a hundredfold when shapes are extrapolated.
        limit: iterations, above which it is given up as soon as the rate so far says so.
    """
    space = equation.current.space
    mixing = Anderson()
    x, residuals = start, [np.inf, np.inf]
    while True:
        point = space.point(x)
        forces = equation.forces(point)
        step = space.chord.solve(forces)
        residuals.append(float(np.sqrt(np.abs(np.vdot(forces, step)))))
        iterations = len(residuals) - 3
        if residuals[-1] <= tolerance:
            return _checked(equation, space.point(x + step), iterations, residuals[-1])
        rate = (residuals[-1] / residuals[2]) ** (1 / max(iterations, 1))
        needed = iterations + np.log(tolerance / residuals[-1]) / np.log(rate) if rate < 1 else 0
        if not residuals[-1] < SLOW * residuals[-3] or (iterations > 1 and needed > limit):
            return _Solution(point, iterations, residuals[-1], f"no convergence, residual {residuals[-1]:.1e}")
        x = mixing(x, forces, step)


def _newton(equation: _Step, tolerance: float) -> _Solution:
    """Exact Newton with a line search, from the current shape."""
    space = equation.current.space

    def residual_of(forces: FloatArray) -> float:
        return float(np.sqrt(np.abs(np.vdot(forces, space.chord.solve(forces)))))

    point = equation.current
    forces = equation.forces(point)
    residual = residual_of(forces)
    for iteration in range(NEWTON_ITERATIONS + 1):
        if residual <= tolerance:
            return _checked(equation, point, iteration, residual)
        if iteration == NEWTON_ITERATIONS:
            break
        try:
            step = -splu(equation.derivative(point)).solve(forces.ravel()).reshape(-1, 3)
        except RuntimeError:
            return _Solution(point, iteration, residual, "the derivative is singular")
        t = 1.0
        while True:
            trial = space.point(point.vertices + t * step)
            trial_forces = equation.forces(trial)
            trial_residual = residual_of(trial_forces)
            if trial_residual < (1 - t / 4) * residual:
                break
            t /= 2
            if t < SMALLEST_STEP:
                return _Solution(point, iteration, residual, f"Newton stalls at residual {residual:.1e}")
        point, forces, residual = trial, trial_forces, trial_residual
    return _Solution(point, NEWTON_ITERATIONS, residual, f"Newton is slow, residual {residual:.1e}")
