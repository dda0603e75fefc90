"""Comparisons of two groups: p-values are uniform without a difference, also with covariates, and find one."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from shapespace.arrays import FloatArray
from shapespace.model.group_comparison import GroupComparison, InvalidGroupsError, compare_groups
from shapespace.model.shape_model import ShapeModel, load
from tests.service.conftest import ROOT

PATIENT = np.arange(40) % 2 == 1


def codes_of(model: ShapeModel, seed: int) -> FloatArray:
    return model.sample(40, seed=seed).astype(float)


def many(model: ShapeModel, count: int, effect: float, older: float) -> list[GroupComparison]:
    """Comparisons of groups whose ages differ; age changes the code, and the group changes its first number."""
    found = []
    for seed in range(count):
        age = np.random.default_rng(seed).normal(size=40) + older * PATIENT
        codes = codes_of(model, seed)
        codes[:, 3] += 0.8 * age
        codes[PATIENT, 0] += effect
        found.append(compare_groups(model, codes, PATIENT, age, draws=599, seed=seed))
    return found


@pytest.mark.parametrize("older", [0.0, 1.5])
def test_p_values_are_uniform_where_groups_differ_by_chance_or_age_only(figure: ShapeModel, older: float) -> None:
    found = many(figure, 200, effect=0, older=older)
    assert stats.kstest([each.p for each in found], "uniform").pvalue > 0.01
    # Corrected for all numbers, one is below 0.05 in at most 5 % of the studies: 18 of 200 with probability 0.99.
    assert sum((each.p_each <= 0.05).any() for each in found) <= 18


def test_a_difference_is_found_beside_a_difference_in_age(figure: ShapeModel) -> None:
    found = many(figure, 20, effect=1.8, older=1.5)
    assert sum(each.p <= 0.05 for each in found) >= 16
    assert sum(each.p_each[0] <= 0.05 for each in found) >= 19
    assert np.mean([each.difference[0] for each in found]) == pytest.approx(1.8, abs=0.15)
    assert np.mean([each.difference[3] for each in found]) == pytest.approx(0, abs=0.15)


def test_without_covariates_it_is_the_exact_test_of_means(figure: ShapeModel) -> None:
    codes = codes_of(figure, 5)
    codes[PATIENT, 0] += 0.8
    found = compare_groups(figure, codes, np.where(PATIENT, "patient", "control"))
    assert found.groups == ("control", "patient")
    np.testing.assert_allclose(found.means, [codes[~PATIENT].mean(axis=0), codes[PATIENT].mean(axis=0)], atol=1e-12)
    np.testing.assert_allclose(found.difference, found.means[1] - found.means[0], atol=1e-12)
    expected = stats.permutation_test(
        (codes[~PATIENT], codes[PATIENT]),
        lambda a, b, axis: np.abs(stats.ttest_ind(a, b, axis=axis).statistic),
        alternative="greater",
        n_resamples=9999,
        rng=np.random.default_rng(1),
        axis=0,
    ).pvalue
    np.testing.assert_allclose(found.p_each, stats.false_discovery_control(expected), atol=0.06)


def test_covariates_may_follow_from_others(figure: ShapeModel) -> None:
    rng = np.random.default_rng(0)
    age, site = rng.normal(size=40) + PATIENT, np.eye(3)[rng.integers(3, size=40)]
    codes = codes_of(figure, 2)
    codes[:, 3] += 0.8 * age + site[:, 0]
    known = np.column_stack([PATIENT, site, age])
    expected = np.linalg.lstsq(known, codes, rcond=None)[0][0]
    for columns in ([age, site], [site, age], [np.ones(40), site[:, 1:], 1e9 + age], [site[:, :2], age, age]):
        found = compare_groups(figure, codes, PATIENT, np.column_stack(columns), draws=199)
        np.testing.assert_allclose(found.difference, expected, atol=1e-6)


@pytest.mark.parametrize("apart", [1e2, 1e4, 1e6])
def test_groups_that_are_exchanged_differ_as_much(figure: ShapeModel, apart: float) -> None:
    # Of the 20 ways to draw three of six, two tell the groups apart so well.
    codes, patient = codes_of(figure, 3)[:6], np.arange(6) < 3
    codes[patient] += apart
    assert compare_groups(figure, codes, patient).p == pytest.approx(0.1, abs=0.01)


def test_angles_are_compared_the_shorter_way_round() -> None:
    ring = load(ROOT / "models" / "freaky-torus")
    codes = 0.2 * np.random.default_rng(0).standard_normal((40, 4))
    codes[PATIENT, 0] += 0.3
    wrapped = np.mod(codes, 2 * np.pi)
    one, other = (compare_groups(ring, each, PATIENT, draws=999) for each in (codes, wrapped))
    assert one.p == other.p < 0.01
    np.testing.assert_allclose(one.difference, other.difference, atol=1e-9)
    shapes = [ring.decode(each.means) for each in (one, other)]
    np.testing.assert_allclose(shapes[1], shapes[0], atol=1e-5)


def test_angles_without_a_mean_are_refused() -> None:
    ring = load(ROOT / "models" / "freaky-torus")
    codes = 0.2 * np.random.default_rng(0).standard_normal((40, 4))
    codes[:, 1] = 2 * np.pi * np.arange(40) / 40
    with pytest.raises(InvalidGroupsError, match="point all ways"):
        compare_groups(ring, codes, PATIENT)


def test_numbers_that_do_not_vary_are_left_out(figure: ShapeModel) -> None:
    codes = codes_of(figure, 1)
    codes[PATIENT, 0] += 1.8
    every = compare_groups(figure, codes, PATIENT, draws=999)
    codes[:, 3], codes[:, 4] = 0.3, 0.1
    found = compare_groups(figure, codes, PATIENT, draws=999)
    assert found.p_each[3] == found.p_each[4] == 1
    assert found.p == pytest.approx(every.p, abs=0.02)
    assert found.p_each[0] < 0.05


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"group": np.ones(40)}, "there are 1: 1.0 \\(40\\)"),
        ({"group": np.arange(40) == 3}, "two groups of at least two"),
        ({"group": np.arange(40) % 3}, "there are 3"),
        ({"group": PATIENT[:39]}, "40 codes"),
        ({"group": np.where(PATIENT, np.nan, 0)}, "label is missing"),
        ({"group": [None, "a"] * 20}, "label is missing"),
        ({"draws": 0}, "draws is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"codes": np.zeros((40, 3))}, "takes 20"),
        ({"codes": np.full((40, 20), np.nan)}, "Row 0 of the codes"),
        ({"codes": np.ones((40, 20))}, "don't vary"),
        ({"codes": [["", *[0.0] * 19]] * 40}, "must be numbers"),
        ({"codes": np.zeros(20)}, "a row for each subject"),
        ({"covariates": PATIENT.astype(float)}, "tell the groups apart"),
        ({"covariates": np.zeros(39)}, "39 rows of covariates for 40 codes"),
        ({"covariates": np.random.default_rng(0).normal(size=(40, 39))}, "too few"),
    ],
)
def test_what_cannot_be_compared_is_refused(figure: ShapeModel, changed: dict[str, Any], says: str) -> None:
    with pytest.raises(InvalidGroupsError, match=says):
        compare_groups(figure, **{"codes": codes_of(figure, 1), "group": PATIENT} | changed)
