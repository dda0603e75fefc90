"""The time-discrete geodesic between two shapes, and the logarithm (paper, appendix B)."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import unwrap
from shapespace.mesh.rigid_motion import align
from shapespace.shell.exponential import velocity_of
from shapespace.shell.initial_paths import (
    InitialPath,
    bisected,
    descended,
    factorised,
    inverse_in_time,
    nearest,
    path_forces,
    straight,
)
from shapespace.shell.space import TOLERANCE, ChordSolver, DiscretePath, Factorise, ShellSpace, fault_between
from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status


@dataclass(frozen=True)
class Relaxation:
    """Limits of the iteration on all equations of a path at once."""

    iterations: int = 40  # most iterations with one set of factors
    renewals: int = 20  # most sets of factors
    slow: float = 0.1  # factors are renewed after three iterations that leave more than this share of the residual
    jump: float = 4.0  # a step with this many times the mean energy is a jump: a geodesic has constant speed


RELAXATION = Relaxation()


@np.errstate(divide="ignore", over="ignore", invalid="ignore")
def geodesic(
    space: ShellSpace,
    start: FloatArray,
    end: FloatArray,
    steps: int = 8,
    *,
    tolerance: float = TOLERANCE,
    first: FloatArray | None = None,
    bisect: bool = True,
) -> DiscretePath:
    """Connect two shapes by K + 1 shapes of least path energy ``K Σ W[z_{k−1}, z_k]``.

    The path is stationary where ``F_k = J_kᵀ (∂₂W[z_{k−1}, z_k] + ∂₁W[z_k, z_{k+1}]) = 0`` at every inner shape. The
    iteration starts at a straight line in lengths and angles, projected to the manifold shape by shape.

    Newton's matrix is block tridiagonal; factorising it would take as long as K² factors of one shape. In lengths and
    angles it is nearly ``T ⊗ H`` with T = tridiag(−1, 2, −1), because H and the tangent spaces change little along the
    path. So a step maps the forces F_k to tangent vectors ``J_k A_k⁻¹ F_k``, solves T along time, and projects the
    result back to each tangent space. This needs K − 1 factors, and two solves with each factor in every iteration. The
    contraction is 0.1 to 0.2 without Anderson acceleration.

    Args:
        space: Riemannian space of the shapes.
        start: X_0 (V, 3).
        end: (V, 3), in any position; X_K is aligned to its neighbour.
        steps: K.
        tolerance: tolerance of ``sqrt(F_kᵀ A_k⁻¹ F_k)`` at every inner shape.
        first: (K + 1, V, 3) initial path from start to end, such as one through a shape near the end.
        bisect: whether to also try the slower initial path for distant shapes.
    """
    start, end = space.shape(start), space.shape(end)
    if steps < 1:
        raise ValueError(f"a path needs at least one step, not {steps}")
    for name, shape, first_shape in (("start", start, space.reference.vertices), ("end", end, start)):
        if not np.isfinite(shape).all():
            reason = f"{name} has an entry that is not finite"
            return DiscretePath(vertices=first_shape[None], space=space, status=Status.NOT_FINITE, reason=reason)
    if steps == 1:
        both = np.stack([start, align(end, start)])
        return DiscretePath(vertices=both, space=space, status=Status.CONVERGED, residual=0)
    factorise = space.factorisations(steps - 1)
    ways: list[Callable[[], InitialPath]] = [lambda: straight(space, start, end, factorise)]
    if bisect:
        ways.append(lambda: descended(space, bisected(space, start, end, factorise), factorise, tolerance))
    if first is not None:
        given = np.concatenate([start[None], first[1:-1], align(end, first[-2])[None]])
        ways = [lambda: descended(space, given, factorise, tolerance)]
    for begin in ways:
        try:
            found = _relax(space, begin(), factorise, tolerance)
        except NotPositiveDefiniteError as error:
            reason = f"a shape on the way is degenerate: {error}"
            found = DiscretePath(vertices=start[None], space=space, status=Status.STALLED, iterations=1, reason=reason)
        if found.converged:
            shapes = found.vertices
            for k in range(1, steps + 1):
                shapes[k] = align(shapes[k], shapes[k - 1])
            return found
    return replace(found, vertices=start[None], status=Status.STALLED)


@dataclass(frozen=True)
class Logarithm:
    """The initial velocity of a geodesic.

    Attributes:
        velocity: (V, 3) vertex field without rigid motion: an argument for ``exponential``. With the paper's first step
            it is ``K (X_1 − X_0)``. Zero if no geodesic was found.
        nric: (2E,) ``K (z_1 − z_0)``, the velocity of lengths and angles over the first step, tangent up to O(1/K).
        path: the geodesic, with status and reason.
    """

    velocity: FloatArray
    nric: FloatArray
    path: DiscretePath


def logarithm(
    space: ShellSpace, start: FloatArray, end: FloatArray, steps: int = 8, *, tolerance: float = TOLERANCE
) -> Logarithm:
    """Compute the discrete logarithm of ``end`` at ``start``, the inverse of ``exponential`` with equal steps.

    X_1 is aligned to X_0 before the difference is taken, so that the velocity has no rigid part.
    """
    path = geodesic(space, start, end, steps, tolerance=tolerance)
    if not path.converged:
        nothing = np.zeros_like(path.vertices[0])
        return Logarithm(nothing, np.zeros(2 * space.connectivity.edge_count), path)
    velocity, change = velocity_of(path, tolerance), steps * (path.nric[1] - path.nric[0])
    if velocity is None:
        reason = "no velocity leads to the first shape; more steps may help"
        return Logarithm(np.zeros_like(path.vertices[0]), change, replace(path, status=Status.STALLED, reason=reason))
    return Logarithm(velocity, change, path)


def towards(space: ShellSpace, path: DiscretePath, end: FloatArray) -> FloatArray:
    """Make an initial path (K + 1, V, 3) to ``end`` from a geodesic whose last shape is close to it.

    A share k/K of the difference between the two ends is added to the lengths and angles of shape k.
    """
    steps = len(path.vertices) - 1
    change = unwrap(space.nric(end), path.nric[-1]) - path.nric[-1]
    shapes = [path.vertices[0]]
    for k in range(1, steps):
        chord = space.factorise(space.point(path.vertices[k]))
        shapes.append(nearest(chord, path.nric[k] + k / steps * change))
    return np.stack([*shapes, align(end, shapes[-1])])


def halved(space: ShellSpace, path: DiscretePath) -> DiscretePath:
    """Double the number of steps: between two shapes insert one at half the change of lengths and angles."""
    shapes = [path.vertices[0]]
    for k in range(1, len(path.vertices)):
        chord = space.factorise(space.point(shapes[-1]))
        middle = nearest(chord, (path.nric[k - 1] + path.nric[k]) / 2)
        shapes += [middle, align(path.vertices[k], middle)]
    return DiscretePath(vertices=np.stack(shapes), space=space, status=path.status)


def _jump(space: ShellSpace, shapes: FloatArray) -> str | None:
    """Say why a stationary path is no geodesic: a step passes over a collapse, beyond which W is finite again."""
    z = space.nric(shapes)
    energies = space.energy.rest(z[:-1]).value(z[1:])
    worst = int(energies.argmax())
    if energies[worst] > RELAXATION.jump * energies.mean():
        return f"step {worst + 1} takes {energies[worst] / energies.mean():.1f} times the mean energy of all: a jump"
    return None


def _relax(space: ShellSpace, begun: InitialPath, factorise: list[Factorise], tolerance: float) -> DiscretePath:
    """Solve all equations of a path at once from an initial path, in rounds with new factors.

    It ends after two rounds that don't halve the residual.
    """
    shapes, chords = begun
    chords = [c.rotated_to(space.point(x)) for c, x in zip(chords, shapes[1:-1], strict=True)]
    best, lowest = shapes, np.inf
    iterations = failures = 0
    for renewal in range(RELAXATION.renewals):
        if renewal:
            chords = factorised(space, best, factorise)
        found = _round(space, best, chords, tolerance)
        iterations += found.iterations
        if found.status in (Status.CONVERGED, Status.DEGENERATE):
            return replace(found, iterations=iterations)
        failures += min(found.residual, lowest) > lowest / 2
        if found.residual < lowest:
            best, lowest = found.vertices, found.residual
        if failures == 2:
            break
    return _stalled(space, best, iterations, lowest)


def _stalled(space: ShellSpace, shapes: FloatArray, iterations: int, residual: float) -> DiscretePath:
    reason = f"residual {residual:.1e} after {iterations} iterations"
    path = DiscretePath(vertices=shapes, space=space, status=Status.STALLED, reason=reason)
    return replace(path, iterations=iterations, residual=residual)


def _round(space: ShellSpace, shapes: FloatArray, chords: list[ChordSolver], tolerance: float) -> DiscretePath:
    """Iterate with the same factors, accelerated, until it converges or slows down.

    Returns the shapes of the smallest residual. The status is DEGENERATE if the solution is no geodesic.
    """
    inverse = inverse_in_time(len(shapes) - 1)
    shapes, best, lowest = shapes.copy(), shapes, np.inf
    mixing, residuals = Anderson(), []
    for _ in range(RELAXATION.iterations):
        points, forces = path_forces(space, shapes)
        moves = np.stack([c.solve(f) for c, f in zip(chords, forces, strict=True)])
        residuals.append(float(np.sqrt(np.abs(np.einsum("kvc,kvc->k", forces, moves)).max())))
        if residuals[-1] <= tolerance:
            faults = (fault_between(a, b) for a, b in pairwise(points))
            fault = next((f for f in faults if f), None) or _jump(space, shapes)
            status = Status.DEGENERATE if fault else Status.CONVERGED
            path = DiscretePath(vertices=shapes, space=space, status=status, reason=fault or "")
            return replace(path, iterations=len(residuals) - 1, residual=residuals[-1])
        if residuals[-1] < lowest:
            lowest, best = residuals[-1], shapes.copy()
        if not np.isfinite(residuals[-1]) or (len(residuals) > 3 and residuals[-1] > RELAXATION.slow * residuals[-4]):
            return _stalled(space, best, len(residuals) - 1, lowest)
        tangents = np.stack([c.push_forward(m) for c, m in zip(chords, moves, strict=True)])
        moves = np.stack([c.project(t) for c, t in zip(chords, inverse @ tangents, strict=True)])
        shapes[1:-1] = mixing(shapes[1:-1].copy(), forces, moves)
    return _stalled(space, best, RELAXATION.iterations, lowest)
