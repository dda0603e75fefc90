"""R² and the multilinear grid, where their values are known."""

from __future__ import annotations

import numpy as np
import pytest

from geometry.nric import WeightedNorm, nric
from training.evaluation import MultilinearGrid, exact_factors, r_squared, vertex_error
from training.freaky_torus import FreakyTorus


@pytest.fixture(scope="module")
def torus() -> FreakyTorus:
    return FreakyTorus()


def test_r_squared_is_one_for_the_truth_zero_for_the_mean_and_weighted_between(torus: FreakyTorus) -> None:
    rng = np.random.default_rng(0)
    z = torus.shapes(torus.coordinates.uniform(12, rng)).nric
    norm = WeightedNorm.of(torus.reference, 1e-2)
    mean = np.broadcast_to(z.mean(axis=0), z.shape)
    assert r_squared(z, z, norm) == {"total": 1, "lengths": 1, "angles": 1}
    assert r_squared(mean, z, norm) == pytest.approx({"total": 0, "lengths": 0, "angles": 0})
    half = z.shape[1] // 2
    only_lengths = np.concatenate([z[:, :half], mean[:, half:]], axis=1)
    figures = r_squared(only_lengths, z, norm)
    assert figures["lengths"] == 1
    assert figures["angles"] == pytest.approx(0)
    spread = norm.squared * ((z - mean) ** 2).sum(axis=0)
    assert figures["total"] == pytest.approx(spread[:half].sum() / spread.sum())


def test_exact_factors_are_the_joint_shape_where_only_one_factor_moves(torus: FreakyTorus) -> None:
    codes = np.array([[0, 2.0, 0, 0], [0, 0, 1.0, 2.0]])
    factors = exact_factors(torus, codes)
    joint = torus.shapes(codes).nric
    reference = nric(torus.reference.vertices, torus.reference.connectivity)
    np.testing.assert_allclose(factors[0, 1], joint[0], atol=1e-6)
    np.testing.assert_allclose(factors[1, 2], joint[1], atol=1e-6)
    np.testing.assert_allclose(factors[1, 0], reference, atol=1e-6)


def test_the_grid_is_exact_at_its_nodes_linear_between_them_and_closes_up(torus: FreakyTorus) -> None:
    grid = MultilinearGrid.of(torus, [2, 3], nodes=5)
    step = 2 * np.pi / 5
    nodes = np.array([[1, 3], [2, 3], [4, 0], [0, 0]]) * step
    full = np.concatenate([np.zeros((4, 2)), nodes], axis=1)
    np.testing.assert_allclose(grid(nodes), exact_factors(torus, full)[:, 2], atol=1e-6)
    between = grid(np.array([[1.25, 3], [4.5, 0]]) * step)
    values = grid(nodes)
    np.testing.assert_allclose(between[0], 0.75 * values[0] + 0.25 * values[1], atol=1e-6)
    np.testing.assert_allclose(between[1], 0.5 * values[2] + 0.5 * values[3], atol=1e-6)


def test_vertex_error_of_exact_lengths_and_angles_is_nothing(torus: FreakyTorus) -> None:
    exact = torus.shapes(np.array([[1.0, 2.0, 3.0, 4.0]]))
    figures = vertex_error(torus.reference, 1e-2, exact.nric, exact.vertices)
    assert figures["max"] < 1e-6
    assert figures["status"] == {"converged": 1}
    wrong = vertex_error(torus.reference, 1e-2, 1.05 * exact.nric, exact.vertices)
    assert wrong["mean"] > 1e-3
