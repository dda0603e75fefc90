"""Random codes: uniform in the box, on a ball in each factor, or normal within the bounds."""

import numpy as np
import pytest

from shapespace.training.runs.latent_coordinates import Coordinates

#: Four bounded coordinates in two factors, and a periodic one.
LOWER, UPPER = np.array([-1, 0, -3, 2, 0.0]), np.array([1, 4, -1, 8, 2 * np.pi])
COORDINATES = Coordinates(LOWER, UPPER, np.array([np.nan] * 4 + [2 * np.pi]))
FACTORS = [[0, 1, 2], [3], [4]]


def units(distribution: str) -> np.ndarray:
    codes = COORDINATES.drawn(distribution, FACTORS, 20000, np.random.default_rng(0))
    return (codes - (LOWER + UPPER) / 2) / ((UPPER - LOWER) / 2)


def test_a_box_is_what_it_was() -> None:
    codes = COORDINATES.drawn("box", FACTORS, 50, np.random.default_rng(3))
    assert np.array_equal(codes, COORDINATES.uniform(50, np.random.default_rng(3)))


def test_each_factor_has_a_ball_of_its_own() -> None:
    x = units("ball")
    radius = np.linalg.norm(x[:, :3], axis=1)
    assert radius.max() <= 1
    assert (radius**3).mean() == pytest.approx(1 / 2, abs=0.01), "uniform in the volume"
    assert x[:, :3].mean(axis=0) == pytest.approx(0, abs=0.02)
    assert x[:, 3].std() == pytest.approx(1 / np.sqrt(3), abs=0.01), "a ball of one dimension is an interval"
    assert np.linalg.norm(x[:, :4], axis=1).max() > 1.1, "factors are independent"


def test_normal_codes_stay_within_the_bounds() -> None:
    x = units("normal")[:, :4]
    assert np.abs(x).max() <= 1
    assert x.std(axis=0) == pytest.approx(0.44, abs=0.01)  # of a normal distribution cut off at two deviations
    assert np.corrcoef(x.T) == pytest.approx(np.eye(4), abs=0.03)


@pytest.mark.parametrize("distribution", ["ball", "normal"])
def test_a_circle_has_no_middle(distribution: str) -> None:
    counts = np.histogram(units(distribution)[:, 4], 8, (-1, 1))[0]
    assert counts == pytest.approx(2500, rel=0.08)
