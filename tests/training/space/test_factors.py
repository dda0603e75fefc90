"""Factors of modes with known supports."""

import numpy as np
import pytest
import trimesh

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.space.factors import FactorError, between, group, overlap

#: Which of three regions each of seven modes moves.
REGIONS = [1, 0, 1, 2, 0, 1, 2]
PLANTED = [[0, 2, 5], [1, 4], [3, 6]]


@pytest.fixture(scope="module")
def mesh() -> TriangleMesh:
    """A box, six wide, two high, one deep."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    return TriangleMesh.from_arrays(ball.vertices * [3, 1, 0.5] + [10, 20, 30], ball.faces)


@pytest.fixture(scope="module")
def norm(mesh: TriangleMesh) -> WeightedNorm:
    return WeightedNorm.of(mesh, 1e-2)


@pytest.fixture(scope="module")
def modes(mesh: TriangleMesh) -> FloatArray:
    """(7, 2E): modes, each large in a part of its region and small everywhere else."""
    rng = np.random.default_rng(2)
    x = mesh.edge_midpoints[:, 0]
    region = np.digitize(x, [9, 11])
    e = len(mesh.edges)
    fields = 1e-3 * rng.standard_normal((len(REGIONS), 2, e))
    for field, r in zip(fields, REGIONS, strict=True):
        field += rng.standard_normal((2, e)) * (region == r)
    return fields.reshape(len(REGIONS), -1)


def test_overlap_is_one_with_itself_and_nothing_with_what_is_elsewhere(norm, mesh, rng):
    e = len(mesh.edges)
    nric = np.zeros((4, 2, e))
    nric[0, :, :100] = rng.standard_normal((2, 100))
    nric[1] = -3 * nric[0]
    nric[2, :, 100:] = rng.standard_normal((2, e - 100))
    nric[3, 1, :100] = np.sqrt((nric[0] ** 2 * norm.squared.reshape(2, e)).sum(axis=0) / norm.squared[e:])[:100]
    found = overlap(nric.reshape(4, -1), norm)
    expected = np.ones((4, 4))
    expected[2, [0, 1, 3]] = expected[[0, 1, 3], 2] = 0
    assert found == pytest.approx(expected, abs=1e-12)


def test_half_shared_supports_overlap_by_half(norm, mesh):
    e = len(mesh.edges)
    nric = np.zeros((2, 2 * e))
    nric[0, :200] = nric[1, 100:300] = 1
    nric[:, :e] /= np.sqrt(norm.squared[:e])
    assert overlap(nric, norm)[0, 1] == pytest.approx(0.5)


@pytest.mark.parametrize("count", [None, 3])
def test_planted_factors_are_found(modes, norm, count):
    assert group(overlap(modes, norm), count) == PLANTED


def test_one_factor_or_one_for_each_mode(modes, norm):
    shared = overlap(modes, norm)
    assert group(shared, 1) == [[0, 1, 2, 3, 4, 5, 6]]
    assert group(shared, 7) == [[j] for j in range(7)]
    assert group(np.eye(1)) == group(np.eye(1), 1) == [[0]]
    assert group(np.eye(3)) == [[0], [1], [2]]
    assert group(np.ones((3, 3))) == [[0, 1, 2]]


def test_no_factor_takes_nearly_all_modes_of_a_face():
    """Modes of a face overlap with one another and with nothing else."""
    shared = np.eye(16)
    shared[:13, :13] = 0.5 + 0.5 * np.eye(13)
    sizes = [len(modes) for modes in group(shared, 4)]
    assert len(sizes) == 4
    assert max(sizes) <= 2 * 16 / 4


@pytest.mark.parametrize("count", [0, 8, -1])
def test_other_counts_are_refused(modes, norm, count):
    with pytest.raises(FactorError, match=f"from 1 to the number of modes, 7, not {count}"):
        group(overlap(modes, norm), count)


def test_every_count_is_kept_and_every_mode_has_one_factor(rng):
    sizes = np.abs(rng.standard_normal((9, 30))) ** 3
    sizes /= np.linalg.norm(sizes, axis=1, keepdims=True)
    for count in range(1, 10):
        groups = group(sizes @ sizes.T, count)
        assert len(groups) == count
        assert sorted(j for g in groups for j in g) == list(range(9))
        assert groups == sorted(sorted(g) for g in groups)


def test_a_limit_keeps_factors_small():
    shared = np.full((20, 20), 0.9) + 0.1 * np.eye(20)
    assert sorted(map(len, group(shared))) == [6, 7, 7], "at most nine"
    assert group(shared, 1) == [list(range(20))]


def test_what_overlaps_more_than_usual_is_joined():
    shared = np.array([[1, 0.6, 0.3], [0.6, 1, 0.2], [0.3, 0.2, 1]])
    assert group(shared) == [[0, 1], [2]]
    assert group(1.5 * shared - 0.5 * np.eye(3)) == [[0, 1], [2]]
    assert group(shared + 0.3) == [[0, 1, 2]], "more than half, whatever is usual"


def test_overlap_of_factors_is_the_average_over_pairs_of_modes(modes, norm):
    shared = overlap(modes, norm)
    found = between(shared, PLANTED)
    assert found[0, 1] == found[1, 0] == pytest.approx(shared[np.ix_([0, 2, 5], [1, 4])].mean())
    assert found[2, 2] == pytest.approx(shared[np.ix_([3, 6], [3, 6])].mean())
    assert found.diagonal().min() > 10 * found[~np.eye(3, dtype=bool)].max()
