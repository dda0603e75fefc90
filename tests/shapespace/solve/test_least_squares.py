"""Least squares in a box, compared with SciPy's, which computes a Jacobian at every step."""

import numpy as np
import pytest
from scipy import optimize

from shapespace.solve.deadline import Deadline
from shapespace.solve.least_squares import Box, Fit, Stopping, least_squares
from shapespace.solve.outcome import Status

RNG = np.random.default_rng(0)
TIMES = np.linspace(0, 1, 40)
NOISE = 0.1 * RNG.standard_normal(40)


def rosenbrock(x: np.ndarray) -> np.ndarray:
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def decay(x: np.ndarray) -> np.ndarray:
    """Two exponentials under noise, so that the smallest residual is far from zero."""
    return x[0] * np.exp(-x[1] * TIMES) + x[2] * np.sin(4 * TIMES) - np.exp(-3 * TIMES) - NOISE


PROBLEMS = {
    "a curved valley": (rosenbrock, [-1.2, 1.0], [-5, -5], [5, 5]),
    "a valley with its end outside": (rosenbrock, [-1.2, 1.0], [-5, -5], [0.5, 5]),
    "noise": (decay, [0.2, 1.0, 0.0], [-np.inf] * 3, [np.inf] * 3),
    "noise between bounds": (decay, [0.2, 1.0, 0.0], [0, 0, -0.05], [0.8, 2.5, 0.05]),
}


def solve(residual, start, lower, upper, calls=None, secant=True, **options) -> Fit:  # type: ignore[no-untyped-def]
    def jacobian(x: np.ndarray, _: np.ndarray) -> np.ndarray:
        if calls is not None:
            calls.append(x)
        return np.atleast_2d(optimize.approx_fprime(x, residual))

    start, lower, upper = (np.array(value, dtype=float) for value in (start, lower, upper))
    options = {"tolerance": 1e-6, "gain_tolerance": 0, "max_evaluations": 300} | options
    box = Box(lower, upper, np.ones(len(start)))
    return least_squares(residual, jacobian, start, box, Stopping(**options), secant=secant)


@pytest.mark.parametrize("secant", [True, False])
@pytest.mark.parametrize("problem", PROBLEMS)
def test_it_finds_what_scipy_finds(problem: str, secant: bool) -> None:
    residual, start, lower, upper = PROBLEMS[problem]
    expected = optimize.least_squares(residual, start, bounds=(lower, upper), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    found = solve(residual, start, lower, upper, secant=secant)
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.x, expected.x, atol=2e-4)
    np.testing.assert_allclose(found.residuals, residual(found.x))
    assert found.residual**2 == pytest.approx(found.cost)
    assert found.cost == pytest.approx(2 * expected.cost, rel=1e-6, abs=1e-10)
    assert (found.x >= lower).all()
    assert (found.x <= upper).all()


def test_updates_save_jacobians() -> None:
    made = {secant: [] for secant in (True, False)}  # type: dict[bool, list[np.ndarray]]
    for secant, calls in made.items():
        solve(*PROBLEMS["noise"], calls=calls, secant=secant)
    assert len(made[True]) <= len(made[False]) / 2


def test_scale_says_what_counts_as_far() -> None:
    units = np.array([1.0, 1e-3, 1e4])

    def residual(x: np.ndarray) -> np.ndarray:
        return decay(x / units)

    found = least_squares(
        residual,
        lambda x, _: np.stack([(residual(x + d) - residual(x)) / d.sum() for d in np.diag(1e-6 * units)], axis=1),
        np.array([0.2, 1.0, 0.0]) * units,
        Box(np.full(3, -np.inf), np.full(3, np.inf), units),
        Stopping(tolerance=1e-7, gain_tolerance=0),
    )
    expected = optimize.least_squares(decay, [0.2, 1.0, 0.0]).x
    np.testing.assert_allclose(found.x / units, expected, atol=1e-4)


def test_a_start_outside_is_moved_to_the_side_of_the_box() -> None:
    found = solve(rosenbrock, [9, 9], [-2, -2], [2, 2], max_evaluations=1)
    np.testing.assert_array_equal(found.x, [2, 2])
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == 1


def test_failures_are_values() -> None:
    late = solve(rosenbrock, [0, 0], [-2, -2], [2, 2], deadline=Deadline(-1))
    assert late.status is Status.DEADLINE
    broken = solve(lambda x: rosenbrock(x) * np.nan, [0, 0], [-2, -2], [2, 2])
    assert broken.status is Status.NOT_FINITE

    def never(x: np.ndarray, r: np.ndarray) -> np.ndarray:
        raise AssertionError("the Jacobian is not needed here")

    box = Box(np.full(2, -2.0), np.full(2, 2.0), np.ones(2))
    assert least_squares(lambda x: x * np.nan, never, np.zeros(2), box).status is Status.NOT_FINITE

    def cliff(x: np.ndarray) -> np.ndarray:
        """Not finite where the first full steps lead."""
        return np.where(x > 0.5, np.nan, 1.0) * (x - 2)

    stopped = solve(cliff, [0.0], [-np.inf], [np.inf])
    assert stopped.status is Status.STALLED
    assert 0.4 < stopped.x[0] <= 0.5
    edge = solve(cliff, [0.5], [-np.inf], [np.inf])
    assert edge.status is Status.STALLED, "there is no Jacobian"


@pytest.mark.parametrize("secant", [True, False])
@pytest.mark.parametrize("height", [1e3, 1e7, 1e160])  # the last one's square overflows
def test_a_cliff_on_the_way_is_no_minimum(height: float, secant: bool) -> None:
    stopped = least_squares(
        lambda x: np.where(x > 0.5, height, 3 - x),
        lambda x, _: np.array([[-1.0]]),
        np.zeros(1),
        Box(np.full(1, -np.inf), np.full(1, np.inf), np.ones(1)),
        secant=secant,
    )
    assert stopped.status is not Status.NOT_FINITE
    assert 0.4 < stopped.x[0] <= 0.5
