"""Distances between shapes, and residuals of paths."""

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.shell.space import DiscretePath, ShellSpace
from shapespace.solve.preconditioner import step_length


def distance(space: ShellSpace, first: FloatArray, second: FloatArray) -> float:
    """Largest difference of lengths, relative to their mean, and of angles; invariant under rigid motions."""
    a, b = space.nric(first), space.nric(second)
    e = space.connectivity.edge_count
    turn = np.angle(np.exp(1j * (a[..., e:] - b[..., e:])))
    return max(np.abs(a[..., :e] - b[..., :e]).max() / a[..., :e].mean(), np.abs(turn).max())


def true_residuals(space: ShellSpace, path: DiscretePath) -> FloatArray:
    """``sqrt(F_kᵀ A_k⁻¹ F_k)`` of the discrete Euler–Lagrange equation, each with its own factor."""
    points = [space.point(x) for x in path.vertices]
    found = []
    for before, here, after in zip(points, points[1:], points[2:], strict=False):
        forces = here.pull_back(before.rest.gradient_deformed(here.z) + here.rest.gradient_rest(after.z))
        found.append(step_length(forces, space.factorise(here).solve(forces)))
    return np.array(found)
