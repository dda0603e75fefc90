"""Geodesics between two shapes: their equations, initial paths, and pairs without a geodesic."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.exponential import exponential
from shapespace.shell.geodesic import geodesic, halved, logarithm, towards
from shapespace.shell.initial_paths import _Middle
from shapespace.shell.space import ShellSpace
from tests.shapespace.conftest import bent
from tests.shapespace.shell.measures import distance, true_residuals

K = 4


def test_every_shape_of_a_geodesic_solves_its_equation_between_its_endpoints(space, mesh, pose, move):
    path = geodesic(space, mesh.vertices, move(pose), 5)
    assert path.converged
    assert true_residuals(space, path).max() <= 1e-9
    np.testing.assert_array_equal(path.vertices[0], mesh.vertices)
    assert distance(space, path.vertices[-1], pose) < 1e-12


@pytest.mark.parametrize("mesh", ["closed", "sheet"], indirect=True)
def test_shapes_too_far_apart_for_a_straight_start_are_connected(space, mesh):
    start, end = bent(mesh.vertices, -4), bent(mesh.vertices, 4)
    path = geodesic(space, start, end, 3)
    assert path.converged
    assert true_residuals(space, path).max() <= 1e-9
    assert distance(space, path.vertices[-1], end) < 1e-12
    half = [space.energy.rest(a).value(b) for a, b in pairwise(path.nric)]
    assert max(half) < 1.5 * min(half), "all steps have similar energies"


def test_the_logarithm_is_also_a_change_of_lengths_and_angles(space, mesh, velocity, move):
    there = exponential(space, mesh.vertices, velocity, K)
    found = logarithm(space, mesh.vertices, move(there.vertices[-1]), K)
    z = there.nric
    np.testing.assert_allclose(found.nric, K * (z[1] - z[0]), atol=1e-5)


def test_forces_on_a_shape_between_two_are_the_slope_of_its_energy(space, mesh, pose, velocity, rng, slope):
    between = _Middle(space, mesh.vertices, pose, (1, 3), space.factorise)
    x = mesh.vertices + velocity / 4
    direction = 0.1 * mesh.diagonal / np.sqrt(len(x)) * rng.standard_normal(x.shape)
    pull = np.vdot(between.forces(x), direction)
    assert slope(lambda h: between.value(x + h * direction) - between.value(x) + h * pull) > 1.9


@pytest.mark.parametrize("pose", [1.3], indirect=True)
def test_a_geodesic_begins_as_one_to_a_neighbour_or_in_fewer_steps(space, mesh, pose):
    path = geodesic(space, mesh.vertices, pose, 4)
    for near, end in ((halved(space, path), pose), (path, bent(mesh.vertices, 1.5))):
        steps = len(near.vertices) - 1
        first = towards(space, near, end)
        found = geodesic(space, mesh.vertices, end, steps, first=first)
        assert found.converged
        expected = geodesic(space, mesh.vertices, end, steps)
        assert distance(space, found.vertices, expected.vertices) < 1e-5
        # A good initial path is near the geodesic, and exact at the ends.
        assert distance(space, first, expected.vertices) < 0.3 * distance(space, mesh.vertices, end)
        assert distance(space, found.vertices[-1], end) < 1e-12
    assert len(halved(space, path).vertices) == 9


def test_a_path_that_passes_over_a_fold_in_one_step_is_no_geodesic():
    ball = trimesh.creation.icosphere(subdivisions=2)
    rod = TriangleMesh.from_arrays(ball.vertices * [4, 0.3, 0.3], ball.faces)
    space, start, end = ShellSpace(rod), bent(rod.vertices, -7), bent(rod.vertices, 7)
    found = geodesic(space, start, end, 8, tolerance=1e-6, bisect=False)
    assert not found.converged
    assert found.reason.endswith("a jump")


def test_a_path_needs_a_step(space, mesh, velocity):
    with pytest.raises(ValueError, match="step"):
        exponential(space, mesh.vertices, velocity, 0)
    with pytest.raises(ValueError, match="step"):
        geodesic(space, mesh.vertices, mesh.vertices, 0)
