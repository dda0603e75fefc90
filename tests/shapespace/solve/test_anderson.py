"""Anderson acceleration and the preconditioner on equations whose solution is known."""

import numpy as np
import pytest

from shapespace.solve.anderson import Anderson
from shapespace.solve.cholesky import SymmetricPattern, analyse
from shapespace.solve.preconditioner import Preconditioner, step_length


@pytest.fixture
def spectrum(rng):
    """A preconditioned matrix with four different eigenvalues, of which the plain iteration diverges along two."""
    q, _ = np.linalg.qr(rng.standard_normal((12, 12)))
    return q @ np.diag([0.3, 0.9, 2.1, 3.0] * 3) @ q.T


def test_an_affine_equation_is_solved_in_as_many_iterations_as_by_gmres(spectrum, rng):
    solution, mixing, x = rng.standard_normal(12), Anderson(), np.zeros(12)
    errors = []
    for _ in range(6):
        forces = spectrum @ (solution - x)
        x = mixing(x, forces, forces)
        errors.append(np.abs(x - solution).max())
    assert errors[2] > 1e-3
    assert errors[4] < 1e-9, "one iteration for each of four eigenvalues, and a last step at the solution"


def test_the_first_iterate_is_the_plain_one_and_nothing_given_is_changed(rng):
    x, forces, step = rng.standard_normal((3, 4, 3))
    kept = x.copy(), forces.copy(), step.copy()
    np.testing.assert_array_equal(Anderson()(x, forces, step), x + step)
    for before, after in zip(kept, (x, forces, step), strict=True):
        np.testing.assert_array_equal(before, after)


def test_the_preconditioner_solves_what_is_left_of_forces_without_the_null_space(rng):
    """The matrix is diag(1, …, 5, 1e-9), whose null space is almost that of e_6."""
    pattern = SymmetricPattern(6, np.arange(6), np.arange(6))
    entries = np.array([1, 2, 3, 4, 5, 1e-9])
    inverse = Preconditioner(analyse(pattern).factorise(entries), np.eye(6)[5:])
    forces = rng.standard_normal((3, 2, 3))
    expected = (forces.reshape(3, 6) / [1, 2, 3, 4, 5, np.inf]).reshape(3, 2, 3)
    np.testing.assert_allclose(inverse(forces), expected, atol=1e-12)
    np.testing.assert_allclose(inverse(forces[0]), expected[0], atol=1e-12)
    assert step_length(forces, expected) == pytest.approx(np.sqrt((forces * expected).sum()))
