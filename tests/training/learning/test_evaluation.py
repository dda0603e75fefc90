"""R² and the multilinear grid, in cases with known values."""

import numpy as np
import pytest

from shapespace.coordinates.nric import WeightedNorm
from shapespace.training.collection.generators.freaky_torus import FreakyTorus
from shapespace.training.learning.baselines import MultilinearGrid, grid_nodes
from shapespace.training.learning.evaluation import r_squared, reconstruct
from shapespace.training.runs.latent_coordinates import alone
from shapespace.training.runs.settings import EvaluationSettings


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


def test_alone_keeps_one_factor_and_leaves_the_rest_at_the_reference() -> None:
    codes = np.array([[1.0, 2, 3, 4], [5, 6, 7, 8]])
    assert alone(codes, [2, 3]).tolist() == [[0, 0, 3, 4], [0, 0, 7, 8]]
    assert codes[0, 0] == 1


@pytest.mark.parametrize(("dimension", "nodes"), [(1, 16), (2, 16), (3, 10), (4, 5), (6, 3), (7, 2)])
def test_a_grid_has_no_more_nodes_than_allowed(dimension: int, nodes: int) -> None:
    settings = EvaluationSettings(grid_nodes=16)
    assert grid_nodes(dimension, settings) == nodes
    assert nodes**dimension <= settings.grid_size
    assert grid_nodes(dimension, EvaluationSettings()) == 0


def test_the_grid_is_exact_at_its_nodes_linear_between_them_and_closes_up(torus: FreakyTorus) -> None:
    grid = MultilinearGrid(torus.coordinates, [2, 3], 5, lambda codes: torus.shapes(codes).nric)
    step = 2 * np.pi / 5
    nodes = np.array([[1, 3], [2, 3], [4, 0], [0, 0]]) * step
    full = np.concatenate([np.zeros((4, 2)), nodes], axis=1)
    np.testing.assert_allclose(grid(full), torus.shapes(full).nric, atol=1e-6)
    between = grid(np.array([[0, 0, 1.25, 3], [0, 0, 4.5, 0]]) * step)
    values = grid(full)
    np.testing.assert_allclose(between[0], 0.75 * values[0] + 0.25 * values[1], atol=1e-6)
    np.testing.assert_allclose(between[1], 0.5 * values[2] + 0.5 * values[3], atol=1e-6)
    assert grid.size == 25 * torus.shapes(full[:1]).nric.nbytes


def test_vertex_error_of_exact_lengths_and_angles_is_nothing(torus: FreakyTorus) -> None:
    exact = torus.shapes(np.array([[1.0, 2.0, 3.0, 4.0]]))
    _, _, figures = reconstruct(torus.reference, 1e-2, exact.nric, exact.vertices)
    assert figures["max"] < 1e-6
    assert figures["status"] == {"converged": 1}
    _, _, wrong = reconstruct(torus.reference, 1e-2, 1.05 * exact.nric, exact.vertices)
    assert wrong["mean"] > 1e-3
