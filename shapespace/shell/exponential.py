"""The time-discrete exponential map: the geodesic from a shape with an initial velocity (paper, appendix B)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import comb

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.shell.coupling import coupling, factorised
from shapespace.shell.space import TOLERANCE, ChordSolver, DiscretePath, ShellPoint, ShellSpace, fault_between
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.line_search import backtrack
from shapespace.solve.outcome import Outcome, Status
from shapespace.solve.preconditioner import step_length

#: Number of shapes from which the first guess of the next one is extrapolated. With eight, its error is of eighth order
#: in the time step.
EXTRAPOLATED = 8


@dataclass(frozen=True)
class Renewals:
    """When a factor is rotated or replaced."""

    cost: int = 8  # cost of a new factor, in iterations
    patience: int = 1  # once a step needs this many more iterations than with a new factor, factors are rotated
    slow: float = 0.5  # an iteration with a factor fails if two iterations leave more than this share of the residual


RENEWALS = Renewals()
#: Most steps of exact Newton: 4 to 8 suffice where it converges, beyond, a face collapses (posed bodies). Smallest step
#: length of its line search.
NEWTON_STEPS, SMALLEST_STEP = 12, 1 / 16


def exponential(
    space: ShellSpace,
    start: FloatArray,
    velocity: FloatArray,
    steps: int = 16,
    *,
    tolerance: float = TOLERANCE,
    deadline: Deadline | None = None,
) -> DiscretePath:
    """Shoot the discrete geodesic of K steps: a first step to X_1, then solve one equation for each further shape.

    The paper's first step is ``X_1 = X_0 + d/K``. It leaves out the acceleration, and its error falls only like 1/K. A
    centred step adds the acceleration: ``X_1 = X_0 + d/K + a``. Here a is half the second difference of the step from
    ``X_0 − d/K`` and X_0. ``space.first_step`` chooses one; with K = 1 the step is always the paper's.

    Rigid motions are removed from the velocity, see ``without_rigid_motion``. The discrete logarithm with equal K is
    then the inverse, to the tolerance of the solver.

    Args:
        space: Riemannian space of the shapes.
        start: X_0 (V, 3).
        velocity: d, a vertex field (V, 3); ``space.project`` makes one from lengths and angles.
        steps: K. A negative number shoots backwards in time: the result is the shapes before X_0 on a geodesic that
            passes X_0 with this velocity. They agree with ``−velocity`` to first order in 1/K, and they continue a path
            that was shot forwards exactly.
        tolerance: tolerance of ``sqrt(Fᵀ A⁻¹ F)`` at every step.
        deadline: checked before every step; after it the status is Status.DEADLINE.

    Returns:
        |K| + 1 shapes from X_0 on, or fewer if a step failed.
    """
    start, velocity = space.shape(start), space.shape(velocity)
    if steps == 0:
        raise ValueError("steps must not be 0")
    if not (np.isfinite(start).all() and np.isfinite(velocity).all()):
        start = np.where(np.isfinite(start), start, space.reference.vertices)
        reason = "start or velocity has an entry that is not finite"
        return DiscretePath(vertices=start[None], space=space, status=Status.NOT_FINITE, reason=reason)
    stride = without_rigid_motion(velocity, start) / abs(steps)
    second, before = start + stride, None
    if space.first_step == "centred" and abs(steps) > 1:
        step = centred_step(space, start, stride, tolerance)
        if not step.converged:
            return replace(step, vertices=start[None])
        second, before = step.vertices[-1], start - stride
    if steps < 0:
        path = extrapolate(space, second, start, -steps, forward=False, tolerance=tolerance, deadline=deadline)
        return replace(path, vertices=path.vertices[1:])
    path = extrapolate(space, start, second, steps - 1, tolerance=tolerance, deadline=deadline)
    return replace(path, before=before)


def centred_step(space: ShellSpace, start: FloatArray, stride: FloatArray, tolerance: float) -> DiscretePath:
    """Take the centred first step: the path X_0, X_1 from a start X_0 (V, 3) and a stride d/K without rigid motion.

    Let X be the shape that follows ``X_0 − d/K`` and X_0. Then ``X_1 = (X_0 + d/K + X) / 2``, with X aligned to X_0.
    """
    path = extrapolate(space, start - stride, start, 1, tolerance=tolerance)
    if not path.converged:
        return replace(path, reason=f"the first step: {path.reason}")
    second = (start + stride + align(path.vertices[-1], start)) / 2
    return replace(path, vertices=np.stack([start, second]))


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def velocity_of(path: DiscretePath, tolerance: float = TOLERANCE) -> FloatArray | None:
    """Find the velocity (V, 3) whose exponential is a geodesic: the inverse of the first step.

    The shapes before and after the start of a centred step lie symmetrically about X_1, so one equation for the shape
    after it gives both. Returns None if it has no solution, because steps are too long.
    """
    space, start, steps = path.space, path.vertices[0], len(path.vertices) - 1
    wanted = align(path.vertices[1], start)
    stride = without_rigid_motion(wanted - start, start)
    if space.first_step == "paper" or steps == 1:
        return steps * stride
    try:
        solution = _Renewal(space).solve(_CentredStep(space.point(start), stride), start + stride, tolerance)
    except NotPositiveDefiniteError:
        return None
    if not solution.converged:
        return None
    return steps * without_rigid_motion(start + 2 * stride - solution.point.vertices, start)


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
) -> DiscretePath:
    """Continue a discrete geodesic from two neighbouring shapes.

    The second shape (V, 3) is one time step later than the first, or earlier if not ``forward``. W is not symmetric, so
    a backward step solves another equation: a forward step from its solution and ``second`` leads to ``first`` exactly.
    For tolerance and deadline see ``exponential``.

    Returns:
        2 + steps shapes, the given ones first, or fewer if a step failed.
    """
    previous, current = space.point(first), space.point(second)
    shapes: list[FloatArray] = [previous.vertices, current.vertices]
    fault = fault_between(previous, current)
    if fault:
        reason = f"the given step: {fault}"
        return DiscretePath(vertices=shapes[0][None], space=space, status=Status.DEGENERATE, reason=reason)
    renewal, areas = _Renewal(space), previous.rest.areas
    iterations, residual = 0, 0.0

    def path(status: Status, reason: str = "") -> DiscretePath:
        where = f"step {len(shapes)}: {reason}" if reason else ""
        found = DiscretePath(vertices=np.stack(shapes), space=space, status=status, reason=where)
        return replace(found, iterations=iterations, residual=residual)

    for _ in range(steps):
        if deadline is not None and deadline.passed:
            return path(Status.DEADLINE, "the time was over")
        equation = _Step(previous, current, forward)
        try:
            solution = renewal.solve(equation, _extrapolated(shapes[-EXTRAPOLATED:]), tolerance)
        except NotPositiveDefiniteError as error:
            return path(Status.DEGENERATE, str(error))
        if not solution.converged:
            smallest = (current.rest.areas / areas).min()
            return path(Status.STALLED, f"{solution.reason}; a face has {smallest:.1e} of its area at the start")
        iterations, residual = iterations + solution.iterations, max(residual, solution.residual)
        shapes.append(solution.point.vertices)
        previous, current = current, solution.point
    return path(Status.CONVERGED)


class _Renewal:
    """The factor of a path, and when it is replaced by a factor at the present shape.

    A factor is **new** in the step for which it was computed, which takes ``_when_new`` iterations. It is **old** in
    later steps, whose additional iterations ``_excess`` sums. Once a step needs more than `patience` of these, or
    fails, old factors are rotated to the present shape until the end of the path. Rotating is cheap, but useless for
    small motions. A factor is **spent** once ``_excess`` reaches `cost`, because a new one would have been cheaper. It
    is also spent if an iteration fails or predicts more than `cost` additional iterations. Then the step is solved
    again with a new one.
    """

    def __init__(self, space: ShellSpace) -> None:
        self._space = space
        self._factor: ChordSolver | None = None
        self._when_new = self._excess = 0
        self._rotates = False

    def solve(self, equation: _Equation, start: FloatArray, tolerance: float) -> _Solution:
        """Solve one step, with the old factor if possible. Raises NotPositiveDefiniteError."""
        wasted = 0
        if self._factor is not None:
            solution = self._with_old_factor(self._factor, equation, start, tolerance)
            if solution.converged:
                return solution
            wasted = solution.iterations
        chord = self._space.factorise(equation.current)
        solution = _chord(equation, chord, start, tolerance)
        self._factor, self._when_new, self._excess = chord, solution.iterations, 0
        if not solution.converged:
            solution = _newton(equation, chord, tolerance)
        return replace(solution, iterations=wasted + solution.iterations)

    def _with_old_factor(
        self, factor: ChordSolver, equation: _Equation, start: FloatArray, tolerance: float
    ) -> _Solution:
        chord = factor.rotated_to(equation.current) if self._rotates else factor
        # The matrix of the factor may differ from the matrix of the step by about a factor of 2.
        solution = _chord(equation, chord, start, tolerance / 2, self._when_new + RENEWALS.cost)
        more = solution.iterations - self._when_new
        self._excess += max(more, 0)
        self._rotates = self._rotates or not solution.converged or more > RENEWALS.patience
        if self._excess >= RENEWALS.cost:
            self._factor = None
        return solution


def _extrapolated(shapes: list[FloatArray]) -> FloatArray:
    """Extrapolate the polynomial through shapes at equal times by one step."""
    n = len(shapes)
    weights = [(-1.0) ** (j + 1) * comb(n, j) for j in range(n, 0, -1)]
    return np.einsum("n,nvc->vc", weights, np.stack(shapes))


class _Step:
    """The discrete Euler–Lagrange equation of one step, for the next shape X.

    Forward in time it is ``F(X) = J_kᵀ (∂₂W[z_{k−1}, z_k] + ∂₁W[z_k, z(X)]) = 0``, and backward in time
    ``F(X) = J_kᵀ (∂₁W[z_k, z_{k+1}] + ∂₂W[z(X), z_k]) = 0``.
    """

    def __init__(self, previous: ShellPoint, current: ShellPoint, forward: bool) -> None:
        self.current = current
        self._forward = forward
        if forward:
            self._known = previous.rest.gradient_deformed(current.z)
        else:
            self._known = current.rest.gradient_rest(previous.z)

    def forces(self, unknown: ShellPoint) -> FloatArray:
        """Compute F (V, 3)."""
        if self._forward:
            covector = self.current.rest.gradient_rest(unknown.z)
        else:
            covector = unknown.rest.gradient_deformed(self.current.z)
        return self.current.pull_back(covector + self._known)

    def derivative(self, unknown: ShellPoint) -> sparse.csc_array:
        """Compute ``DF(X)`` (3V, 3V)."""
        if self._forward:
            return coupling(self.current, unknown)
        return sparse.csc_array(coupling(unknown, self.current).T)


class _CentredStep:
    """The equation of a centred first step, for the shape X after ``X_0 − s`` and X_0 with ``s + X − X_0 = 2 stride``.

    Both neighbours of X_0 move with X, so F is half the sum of a forward and a backward step's forces. Then
    ``DF(X) ≈ −A`` as there.
    """

    def __init__(self, start: ShellPoint, stride: FloatArray) -> None:
        self.current = start
        self._stride = stride

    def _before(self, unknown: ShellPoint) -> ShellPoint:
        return self.current.space.point(unknown.vertices - 2 * self._stride)

    def forces(self, unknown: ShellPoint) -> FloatArray:
        """Compute F (V, 3)."""
        return _Step(self._before(unknown), self.current, True).forces(unknown) / 2

    def derivative(self, unknown: ShellPoint) -> sparse.csc_array:
        """Compute ``DF(X)`` (3V, 3V)."""
        before = self._before(unknown)
        forward, backward = _Step(before, self.current, True), _Step(unknown, self.current, False)
        return sparse.csc_array((forward.derivative(unknown) + backward.derivative(before)) / 2)


_Equation = _Step | _CentredStep


@dataclass(frozen=True, kw_only=True)
class _Solution(Outcome):
    """The result of an iteration on one step."""

    point: ShellPoint


def _accepted(equation: _Equation, point: ShellPoint, iterations: int, residual: float) -> _Solution:
    """Check that a solution of the equation is a deformation of the present shape."""
    fault = fault_between(equation.current, point)
    status = Status.DEGENERATE if fault else Status.CONVERGED
    return _Solution(status=status, iterations=iterations, residual=residual, reason=fault or "", point=point)


def _stalled(point: ShellPoint, iterations: int, residual: float, reason: str) -> _Solution:
    return _Solution(status=Status.STALLED, iterations=iterations, residual=residual, reason=reason, point=point)


def _chord(
    equation: _Equation, chord: ChordSolver, start: FloatArray, tolerance: float, limit: float = np.inf
) -> _Solution:
    """Iterate ``X ← X + A⁻¹F(X)`` with a fixed factor, accelerated, until it converges or slows down.

    Once the tolerance of ``sqrt(Fᵀ A⁻¹ F)`` is met, one more step is taken. This costs little, and errors grow a
    hundredfold when shapes are extrapolated. The iteration also ends once its rate predicts more than ``limit``
    iterations.
    """
    space, mixing = equation.current.space, Anderson()
    x, residuals = start, [np.inf, np.inf]
    while True:
        point = space.point(x)
        forces = equation.forces(point)
        step = chord.solve(forces)
        residuals.append(step_length(forces, step))
        iterations = len(residuals) - 3
        if residuals[-1] <= tolerance:
            return _accepted(equation, space.point(x + step), iterations, residuals[-1])
        rate = (residuals[-1] / residuals[2]) ** (1 / max(iterations, 1))
        needed = iterations + np.log(tolerance / residuals[-1]) / np.log(rate) if rate < 1 else 0
        if not residuals[-1] < RENEWALS.slow * residuals[-3] or (iterations > 1 and needed > limit):
            return _stalled(point, iterations, residuals[-1], f"no convergence, residual {residuals[-1]:.1e}")
        x = mixing(x, forces, step)


def _newton(equation: _Equation, chord: ChordSolver, tolerance: float) -> _Solution:
    """Solve by exact Newton with a line search, from the present shape. A factor measures the residuals."""
    point, forces, residual = equation.current, *_measured(equation, chord, equation.current)
    for iteration in range(NEWTON_STEPS + 1):
        if residual <= tolerance:
            return _accepted(equation, point, iteration, residual)
        if iteration == NEWTON_STEPS:
            break
        try:
            step = -factorised(equation.derivative(point)).solve(forces.ravel()).reshape(-1, 3)
        except RuntimeError:
            return _stalled(point, iteration, residual, "the derivative is singular")
        found = _line_search(equation, chord, point, step, residual)
        if found is None:
            return _stalled(point, iteration, residual, f"Newton stalls at residual {residual:.1e}")
        point, forces, residual = found
    return _stalled(point, NEWTON_STEPS, residual, f"Newton is slow, residual {residual:.1e}")


def _measured(equation: _Equation, chord: ChordSolver, point: ShellPoint) -> tuple[FloatArray, float]:
    forces = equation.forces(point)
    return forces, step_length(forces, chord.solve(forces))


def _line_search(
    equation: _Equation, chord: ChordSolver, point: ShellPoint, step: FloatArray, residual: float
) -> tuple[ShellPoint, FloatArray, float] | None:
    """Find a share t of a step that reduces the residual by t/4 or more; returns shape, F and residual there."""

    def trial(t: float) -> tuple[ShellPoint, FloatArray, float]:
        there = point.space.point(point.vertices + t * step)
        return there, *_measured(equation, chord, there)

    found = backtrack(trial, lambda t, there: there[2] < (1 - t / 4) * residual, SMALLEST_STEP)
    return found and found[1]
