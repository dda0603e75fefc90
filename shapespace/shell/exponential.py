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
from shapespace.shell.space import TOLERANCE, ChordSolver, DiscretePath, ShellPoint, ShellSpace, fault_between
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.line_search import backtrack
from shapespace.solve.outcome import Outcome, Status
from shapespace.solve.preconditioner import step_length

#: How many shapes the first guess of the next one is extrapolated from: with eight its error is of eighth order in the
#: time step.
EXTRAPOLATED = 8
#: The cost of a new factor, in iterations.
COST = 8
#: Once a step needs so many more iterations than the step with a new factor did, old factors are rotated to each shape.
PATIENCE = 1
#: If two iterations leave more than this share of the residual, the present factor is replaced.
SLOW = 0.5
#: Most iterations of exact Newton, and the smallest step length tried. Where it converges it needs 4 to 8 iterations;
#: where it needs more, a face is collapsing, and the path would end a few steps later anyway (as posed bodies show).
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
) -> DiscretePath:
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
        reason = "start or velocity has an entry that is not finite"
        return DiscretePath(vertices=start[None], space=space, status=Status.NOT_FINITE, reason=reason)
    second = start + without_rigid_motion(velocity, start) / abs(steps)
    if steps < 0:
        path = extrapolate(space, second, start, -steps, forward=False, tolerance=tolerance, deadline=deadline)
        return replace(path, vertices=path.vertices[1:])
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
) -> DiscretePath:
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
    fault = fault_between(previous, current)
    if fault:
        reason = f"the given step: {fault}"
        return DiscretePath(vertices=shapes[0][None], space=space, status=Status.DEGENERATE, reason=reason)
    renewal, areas = _Renewal(space), previous.rest.areas
    iterations, residual = 0, 0.0

    def path(status: Status, reason: str = "") -> DiscretePath:
        told = f"step {len(shapes)}: {reason}" if reason else ""
        return DiscretePath(
            vertices=np.stack(shapes),
            space=space,
            status=status,
            iterations=iterations,
            residual=residual,
            reason=told,
        )

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
    """When a factor made at one shape of a path is given up for a new one, at the next shape.

    A factor is, in turn,

    - **new**, for the step that it is made for. The iterations of that step, ``_when_new``, are what later ones are
      compared with.
    - **old**, for the steps after it. What they take more is added up in ``_excess``. Once a step has taken more than
      PATIENCE iterations more, or has failed, old factors are rotated along to the shape at hand, from the next step
      to the end of the path: rotating costs little, but for small motions it is of no use.
    - **spent**, when ``_excess`` reaches COST, for then a new factor would have been cheaper; or when an iteration with
      it fails or foresees more than COST additional iterations, in which case the step is solved again with a new one.
    """

    def __init__(self, space: ShellSpace) -> None:
        self._space = space
        self._factor: ChordSolver | None = None
        self._when_new = self._excess = 0
        self._rotates = False

    def solve(self, equation: _Step, start: FloatArray, tolerance: float) -> _Solution:
        """Solve one step, with the factor at hand if it will do; raises NotPositiveDefiniteError."""
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

    def _with_old_factor(self, factor: ChordSolver, equation: _Step, start: FloatArray, tolerance: float) -> _Solution:
        chord = factor.rotated_to(equation.current) if self._rotates else factor
        # The factor's matrix may differ from the step's own by a factor of 2 or so.
        solution = _chord(equation, chord, start, tolerance / 2, self._when_new + COST)
        more = solution.iterations - self._when_new
        self._excess += max(more, 0)
        self._rotates = self._rotates or not solution.converged or more > PATIENCE
        if self._excess >= COST:
            self._factor = None
        return solution


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

    def __init__(self, previous: ShellPoint, current: ShellPoint, forward: bool) -> None:
        self.current = current
        self._forward = forward
        if forward:
            self._known = previous.rest.gradient_deformed(current.z)
        else:
            self._known = current.rest.gradient_rest(previous.z)

    def forces(self, unknown: ShellPoint) -> FloatArray:
        """F (V, 3)."""
        if self._forward:
            covector = self.current.rest.gradient_rest(unknown.z)
        else:
            covector = unknown.rest.gradient_deformed(self.current.z)
        return self.current.pull_back(covector + self._known)

    def derivative(self, unknown: ShellPoint) -> sparse.csc_array:
        """``DF(X)`` (3V, 3V), near −A and not symmetric; the rigid motions are lifted out of its null space."""
        matrix = self.current.space.jacobian.matrix
        here, there = matrix(self.current.gradients), matrix(unknown.gradients)
        if self._forward:
            derivative = here.T @ self.current.rest.mixed_hessian(unknown.z) @ there
        else:
            derivative = here.T @ unknown.rest.mixed_hessian(self.current.z).T @ there
        shift = NormalMatrix.REGULARISATION * derivative.diagonal().mean()
        return sparse.csc_array(derivative + shift * sparse.eye_array(derivative.shape[0]))


@dataclass(frozen=True, kw_only=True)
class _Solution(Outcome):
    """Where an iteration on one step ended."""

    point: ShellPoint


def _accepted(equation: _Step, point: ShellPoint, iterations: int, residual: float) -> _Solution:
    """A solution of the equation, which also has to be a deformation."""
    fault = fault_between(equation.current, point)
    status = Status.DEGENERATE if fault else Status.CONVERGED
    return _Solution(status=status, iterations=iterations, residual=residual, reason=fault or "", point=point)


def _stalled(point: ShellPoint, iterations: int, residual: float, reason: str) -> _Solution:
    return _Solution(status=Status.STALLED, iterations=iterations, residual=residual, reason=reason, point=point)


def _chord(
    equation: _Step, chord: ChordSolver, start: FloatArray, tolerance: float, limit: float = np.inf
) -> _Solution:
    """``X ← X + A⁻¹F(X)`` with the factor at hand, accelerated, until it is solved or isn't worth going on.

    Args:
        equation: the step to solve.
        chord: A⁻¹ of a shape nearby.
        start: first guess.
        tolerance: of ``sqrt(Fᵀ A⁻¹ F)``, with the factor at hand. Where it holds, the step at hand is taken as well:
            that costs little, and what error it leaves grows a hundredfold when shapes are extrapolated.
        limit: iterations, above which it is given up as soon as the rate so far says so.
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
        if not residuals[-1] < SLOW * residuals[-3] or (iterations > 1 and needed > limit):
            return _stalled(point, iterations, residuals[-1], f"no convergence, residual {residuals[-1]:.1e}")
        x = mixing(x, forces, step)


def _newton(equation: _Step, chord: ChordSolver, tolerance: float) -> _Solution:
    """Exact Newton with a line search, from the current shape; residuals are measured with the factor of a chord."""
    point, forces, residual = equation.current, *_measured(equation, chord, equation.current)
    for iteration in range(NEWTON_ITERATIONS + 1):
        if residual <= tolerance:
            return _accepted(equation, point, iteration, residual)
        if iteration == NEWTON_ITERATIONS:
            break
        try:
            step = -splu(equation.derivative(point)).solve(forces.ravel()).reshape(-1, 3)
        except RuntimeError:
            return _stalled(point, iteration, residual, "the derivative is singular")
        found = _line_search(equation, chord, point, step, residual)
        if found is None:
            return _stalled(point, iteration, residual, f"Newton stalls at residual {residual:.1e}")
        point, forces, residual = found
    return _stalled(point, NEWTON_ITERATIONS, residual, f"Newton is slow, residual {residual:.1e}")


def _measured(equation: _Step, chord: ChordSolver, point: ShellPoint) -> tuple[FloatArray, float]:
    """F at a shape, and the residual."""
    forces = equation.forces(point)
    return forces, step_length(forces, chord.solve(forces))


def _line_search(
    equation: _Step, chord: ChordSolver, point: ShellPoint, step: FloatArray, residual: float
) -> tuple[ShellPoint, FloatArray, float] | None:
    """The shape after a share t of a step that takes away t/4 of the residual or more, with F and residual there."""

    def trial(t: float) -> tuple[ShellPoint, FloatArray, float]:
        there = point.space.point(point.vertices + t * step)
        return there, *_measured(equation, chord, there)

    found = backtrack(trial, lambda t, there: there[2] < (1 - t / 4) * residual, SMALLEST_STEP)
    return found and found[1]
