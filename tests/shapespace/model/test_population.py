"""The Gaussian of codes: moments, shrinkage, scores."""

import numpy as np

from shapespace.model.population import Population

WIDTH = np.array([2.0, 4.0, 1.0])


def _codes(count: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    x = rng.standard_normal((count, 3))
    x[:, 1] = 0.9 * x[:, 0] + np.sqrt(1 - 0.81) * x[:, 1]
    return x * [0.5, 1.0, 0.25] + [0.1, 0, -0.2]


def test_many_codes_give_their_own_moments() -> None:
    codes = _codes(20_000)
    found = Population.of(codes, WIDTH)
    assert np.allclose(found.mean, codes.mean(axis=0))
    assert np.allclose(found.covariance, np.cov(codes.T), atol=0.01)


def test_few_codes_shrink_correlations_and_keep_variances() -> None:
    codes = _codes(4)
    found = Population.of(codes, WIDTH)
    assert np.allclose(found.covariance.diagonal(), codes.var(axis=0))
    plain = np.cov(codes.T, bias=True)
    assert abs(found.covariance[0, 2]) < abs(plain[0, 2])
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_correlations_shrink_by_the_share_that_chance_has_in_their_squares() -> None:
    """The formula of Ledoit and Wolf with variances kept, written out entry by entry (Schäfer and Strimmer 2005)."""
    codes = _codes(12)
    found, spread = Population.of(codes, WIDTH), codes.std(axis=0)
    scores = (codes - codes.mean(axis=0)) / spread
    chance, square, pairs = 0.0, 0.0, [(i, j) for i in range(3) for j in range(3) if i != j]
    for i, j in pairs:
        products = scores[:, i] * scores[:, j]
        chance += products.var() / 12
        square += products.mean() ** 2
    assert 0.05 < chance / square < 0.95
    for i, j in pairs:
        kept = (1 - chance / square) * (scores[:, i] * scores[:, j]).mean()
        assert np.isclose(found.covariance[i, j], kept * spread[i] * spread[j], rtol=1e-9)


def test_chance_alone_leaves_no_correlation_and_none_leaves_all_but_a_millionth() -> None:
    independent = Population.of(np.array([[1.0, 1], [1, -1], [-1, 1], [-1, -1]]), np.ones(2))
    assert np.allclose(independent.covariance, np.eye(2), atol=1e-15)
    together = Population.of(np.array([[1.0, 1], [-1, -1]]), np.ones(2))
    assert np.isclose(together.covariance[0, 1], 1 - 1e-6, rtol=1e-12)


def test_one_code_and_coordinates_that_never_differ_have_some_room() -> None:
    found = Population.of(np.zeros((1, 3)), WIDTH)
    assert np.allclose(np.sqrt(found.covariance.diagonal()), 1e-3 * WIDTH)


def test_two_codes_have_a_gaussian_too() -> None:
    found = Population.of(_codes(2), WIDTH)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_scores_are_standard() -> None:
    found = Population.of(_codes(500), WIDTH)
    drawn = found.sample(50_000, seed=1)
    assert np.allclose(np.cov(found.scores(drawn).T), np.eye(3), atol=0.02)
    assert np.allclose(found.mean + found.scores(drawn) @ found.root.T, drawn)
    one = found.scores(drawn[0])
    apart = drawn[0] - found.mean
    assert np.isclose(one @ one, apart @ np.linalg.solve(found.covariance, apart))


def test_temperature_and_seed() -> None:
    found = Population.in_box(np.array([-1.0, 0, 2]), np.array([1.0, 4, 3]))
    assert np.allclose(found.mean, [0, 2, 2.5])
    assert np.allclose(found.covariance, np.diag(WIDTH**2 / 12))
    assert np.array_equal(found.sample(3, 7), found.sample(3, 7))
    assert np.allclose(found.sample(3, 7, 2.0) - found.mean, 2 * (found.sample(3, 7) - found.mean))
