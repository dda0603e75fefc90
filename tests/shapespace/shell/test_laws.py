"""Laws of Riemannian geometry, each written once and tested in every space.

Laws of time-discrete operations (Rumpf and Wirth 2015) hold either exactly, to the tolerance of the solvers, or to
first order in the step: then the error halves when the number of steps doubles, and vanishes in a flat space.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray
from shapespace.shell.space import ShellSpace
from tests.shapespace.shell.spaces import FlatSpace, Shells, Space

K = 4
ROTATION = Rotation.from_rotvec([1.2, -0.7, 2.1]).as_matrix()


def move(shapes: FloatArray) -> FloatArray:
    """A rigid motion of shapes (…, V, 3)."""
    return shapes @ ROTATION.T + [1, 2, 3]


@dataclass(frozen=True)
class Case:
    """Two points, and the velocity at the first that leads approximately to the second."""

    space: Space
    start: FloatArray
    end: FloatArray
    velocity: FloatArray

    def norm(self, at: FloatArray, vector: FloatArray) -> float:
        return float(np.sqrt(self.space.inner(at, vector, vector)))

    @property
    def speed(self) -> float:
        return self.norm(self.start, self.velocity)

    @property
    def slower(self) -> Case:
        """With half the velocity: first-order convergence shows only if steps are not too large."""
        return replace(self, velocity=0.5 * self.velocity)


class Laws:
    """One method for each law; subclasses give a fixture ``case``."""

    def same(self, case: Case, first: FloatArray, second: FloatArray) -> bool:
        distances = [case.space.distance(a, b) for a, b in zip(first, second, strict=True)]
        return max(distances) < case.space.tolerance

    def halves(self, case: Case, misses: list[float], size: float) -> bool:
        """Whether errors halve when K doubles, or are zero relative to a size."""
        if case.space.flat:
            return max(misses) < 1e-12 * size
        return misses[1] < 0.65 * misses[0] + 1e-7 * size

    # ------------------------------------------------------------ endpoints

    def test_a_geodesic_goes_from_start_to_end(self, case: Case) -> None:
        path = case.space.geodesic(case.start, move(case.end) if not case.space.flat else case.end, K)
        assert len(path) == K + 1
        np.testing.assert_array_equal(path[0], case.start)
        assert case.space.distance(path[-1], case.end) < 1e-12

    def test_an_exponential_leaves_with_its_velocity(self, case: Case) -> None:
        """Exactly with the paper's first step, and to first order with a centred step, which adds the acceleration."""
        misses = []
        for steps in (K, 2 * K):
            path = case.space.exponential(case.start, case.velocity, steps)
            assert len(path) == steps + 1
            np.testing.assert_array_equal(path[0], case.start)
            left = steps * case.space.difference(path[1], case.start) - case.velocity
            misses.append(case.norm(case.start, left))
        if case.space.centred:
            assert misses[1] == pytest.approx(misses[0] / 2, rel=0.1)
        else:
            assert max(misses) < 1e-7 * max(1, case.speed)

    def test_without_velocity_nothing_moves(self, case: Case) -> None:
        for path in (
            case.space.exponential(case.start, 0 * case.velocity, K),
            case.space.geodesic(case.start, case.start, K),
        ):
            np.testing.assert_allclose(path, np.stack([case.start] * (K + 1)), atol=1e-7 * np.abs(case.start).max())

    # ------------------------------------------------------------ inverse

    def test_the_exponential_undoes_the_logarithm(self, case: Case) -> None:
        velocity = case.space.logarithm(case.start, case.end, K)
        assert case.space.distance(case.space.exponential(case.start, velocity, K)[-1], case.end) < case.space.tolerance

    def test_the_logarithm_undoes_the_exponential(self, case: Case) -> None:
        end = case.space.exponential(case.start, case.velocity, K)[-1]
        velocity = case.space.logarithm(case.start, move(end) if not case.space.flat else end, K)
        assert case.norm(case.start, velocity - case.velocity) < 1e-7

    def test_a_geodesic_goes_where_an_exponential_went(self, case: Case) -> None:
        shot = case.space.exponential(case.start, case.velocity, K)
        assert self.same(case, shot, case.space.geodesic(case.start, shot[-1], K))

    # ------------------------------------------------------------ scaling, rigid invariance

    def test_the_unit_of_length_does_not_matter(self, case: Case) -> None:
        larger = case.space.scaled(10)
        small = case.space.exponential(case.start, case.velocity, K)
        large = larger.exponential(10 * case.start, 10 * case.velocity, K)
        np.testing.assert_allclose(large, 10 * small, atol=1e-7 * np.abs(case.start).max())
        small = case.space.geodesic(case.start, case.end, K)
        large = larger.geodesic(10 * case.start, 10 * case.end, K)
        assert self.same(replace(case, space=larger), large, 10 * small)

    def test_what_is_moved_rigidly_goes_the_same_way(self, case: Case) -> None:
        moved, turned = move(case.start), case.velocity @ ROTATION.T
        size = np.abs(case.start).max()
        shot = case.space.exponential(case.start, case.velocity, K)
        np.testing.assert_allclose(case.space.exponential(moved, turned, K), move(shot), atol=1e-6 * size)
        velocity = case.space.logarithm(case.start, case.end, K)
        there = case.space.logarithm(moved, move(case.end), K)
        assert case.norm(moved, there - velocity @ ROTATION.T) < 1e-6
        assert case.space.inner(moved, turned, turned) == pytest.approx(case.speed**2)

    # ------------------------------------------------------------ symmetry, reversal

    def test_the_way_back_is_as_long_to_first_order(self, case: Case) -> None:
        misses = []
        for steps in (4, 8):
            there = case.space.energy(case.space.geodesic(case.start, case.end, steps))
            back = case.space.energy(case.space.geodesic(case.end, case.start, steps))
            misses.append(abs(there - back))
        assert self.halves(case, misses, there)
        assert misses[1] < 0.05 * there

    def test_reversal_leads_back_to_first_order(self, case: Case) -> None:
        case, misses = case.slower, []
        size = np.ptp(case.start, axis=0).max()
        for steps in (8, 16):
            there = case.space.exponential(case.start, case.velocity, steps)
            back = case.space.exponential(there[-1], steps * case.space.difference(there[-2], there[-1]), steps)
            misses.append(np.abs(case.space.difference(back[-1], case.start)).max())
        assert self.halves(case, misses, size)
        assert misses[0] < 0.1 * size

    # ------------------------------------------------------------ convergence

    def test_the_exponential_converges_to_first_order(self, case: Case) -> None:
        case = case.slower
        ends = [case.space.exponential(case.start, case.velocity, steps)[-1] for steps in (4, 8, 16)]
        coarse, fine = (np.abs(case.space.difference(b, a)).max() for a, b in pairwise(ends))
        if case.space.flat:
            assert coarse + fine < 1e-12
        elif case.space.centred:
            assert coarse / fine > 1.7, "not slower"
        else:
            assert coarse / fine == pytest.approx(2, abs=0.5), "neither slower nor faster"

    # ------------------------------------------------------------ minimality

    def test_part_of_a_geodesic_is_one(self, case: Case) -> None:
        path = case.space.geodesic(case.start, case.end, 6)
        assert self.same(case, path[1:5], case.space.geodesic(path[1], path[4], 3))

    def test_a_geodesic_has_less_energy_than_paths_beside_it(self, case: Case, rng: np.random.Generator) -> None:
        path = case.space.geodesic(case.start, case.end, K)
        least = case.space.energy(path)
        for _ in range(3):
            beside = path.copy()
            beside[2] += 1e-4 * np.ptp(path[0]) * rng.standard_normal(beside[2].shape)
            assert case.space.energy(beside) > least

    # ------------------------------------------------------------ transport

    def test_transport_along_a_geodesic_carries_its_velocity(self, case: Case) -> None:
        """To first order, the accuracy of a discrete geodesic's velocity."""
        case, misses = case.slower, []
        for steps in (4, 8):
            path = case.space.exponential(case.start, case.velocity, steps)
            last = -steps * case.space.difference(path[-2], path[-1])
            misses.append(case.norm(path[-1], case.space.transport(path, case.velocity)[-1] - last))
        assert self.halves(case, misses, case.speed)
        assert misses[1] < 0.4 * case.speed

    def test_transport_keeps_lengths_and_angles_between_vectors(self, case: Case) -> None:
        stretched = case.space.logarithm(case.start, case.start * [1, 1.1, 0.95], K)
        path = case.space.exponential(case.start, 0.5 * case.velocity, 8)

        def products(at: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
            return np.array([case.space.inner(at, *pair) for pair in ((u, u), (v, v), (u, v))])

        before = products(path[0], case.velocity, stretched)
        after = products(path[-1], *(case.space.transport(path, v)[-1] for v in (case.velocity, stretched)))
        np.testing.assert_allclose(after, before, atol=0.1 * np.sqrt(before[0] * before[1]), rtol=0.1)

    def test_transport_does_not_depend_on_the_length_of_the_vector(self, case: Case) -> None:
        path = case.space.exponential(case.start, 0.5 * case.velocity, 2)
        plain, long = (case.space.transport(path, s * case.velocity) for s in (1, 50))
        np.testing.assert_allclose(long, 50 * plain, atol=1e-4 * np.abs(long).max())

    # ------------------------------------------------------------ means

    def test_the_mean_of_one_point_is_that_point(self, case: Case) -> None:
        twice = np.stack([case.end, case.end if case.space.flat else move(case.end)])
        for mean in case.space.means(twice, np.ones(2), case.start, K):
            assert case.space.distance(mean, case.end) < 1e-4

    def test_logarithms_at_the_centre_of_mass_balance(self, case: Case) -> None:
        ends = [case.space.exponential(case.start, s * case.velocity, K)[-1] for s in (-0.3, 0.1, 0.4)]
        weights = np.array([4, 1, 1]) / 6
        *_, centre = case.space.means(np.stack(ends), weights, case.start, K)
        logarithms = [case.space.logarithm(centre, end, K) for end in ends]
        assert case.norm(centre, np.tensordot(weights, logarithms, 1)) < 0.05 * case.speed

    def test_the_centre_of_two_points_is_half_way(self, case: Case) -> None:
        end = case.space.exponential(case.start, 0.5 * case.velocity, 2)[-1]
        *_, centre = case.space.means(np.stack([case.start, end]), np.ones(2), case.start, 8)
        half = case.space.geodesic(case.start, end, 16)[8]
        assert case.norm(half, case.space.difference(centre, half)) < 0.1 * 0.5 * case.speed


@pytest.mark.parametrize(("mesh", "pose"), [("closed", 1.3), ("sheet", 0.1), ("torus", 1.3)], indirect=True)
class TestShells(Laws):
    """For every mesh, two with a strongly bent pose and one with a pose that is nearly flat."""

    @pytest.fixture
    def case(self, space, mesh, pose, velocity) -> Case:
        return Case(Shells(space), mesh.vertices, pose, velocity)


@pytest.mark.parametrize(("mesh", "pose"), [("torus", 1.3)], indirect=True)
class TestShellsWithThePapersFirstStep(Laws):
    """As the paper and version 0.2 have it."""

    @pytest.fixture
    def case(self, space, mesh, pose, velocity) -> Case:
        paper = ShellSpace(space.reference, space.material, first_step="paper")
        return Case(Shells(paper), mesh.vertices, pose, velocity)


class TestFlatSpace(Laws):
    """In flat space all laws hold exactly: one that fails here is wrong, or its test is."""

    @pytest.fixture
    def case(self, rng: np.random.Generator) -> Case:
        start, end = rng.standard_normal((2, 5, 3))
        return Case(FlatSpace(), start, end, end - start)
