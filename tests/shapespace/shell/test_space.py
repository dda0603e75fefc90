"""The tangent space, the metric, and Cholesky factors used at neighbouring shapes."""

import numpy as np
import pytest

from shapespace.coordinates.integrability import Integrability
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.exponential import exponential
from shapespace.shell.space import ShellSpace, fault_between
from tests.shapespace.conftest import TETRAHEDRON, hinge

K = 4


def test_projection_finds_the_tangent_vector_it_is_given(space, mesh, velocity):
    change = space.point(mesh.vertices).push_forward(velocity)
    np.testing.assert_allclose(space.project(mesh.vertices, change), velocity, atol=1e-9 * mesh.diagonal)


def test_projection_is_orthogonal_and_lands_in_the_kernel_of_the_conditions(space, mesh, rng):
    point = space.point(mesh.vertices)
    e = space.connectivity.edge_count
    change = rng.standard_normal(2 * e) * np.concatenate([point.z[:e], space.connectivity.interior])
    tangent = point.push_forward(space.project(mesh.vertices, change))
    left = point.pull_back(point.lower(change - tangent))
    assert np.abs(left).max() < 1e-9 * np.abs(point.pull_back(point.lower(change))).max()
    off = Integrability(space.connectivity).jacobian(point.z) @ tangent
    assert np.abs(off).max() < 1e-12 * np.abs(tangent).max() * mesh.diagonal + 1e-10


def test_rigid_motions_have_no_length_and_are_taken_out(space, mesh, velocity):
    turning = np.cross([0.3, -0.2, 0.5], mesh.vertices) + np.array([1, 2, 3])
    assert space.norm(mesh.vertices, turning) < 1e-9 * mesh.diagonal
    cleaned = without_rigid_motion(velocity + turning, mesh.vertices)
    np.testing.assert_allclose(cleaned, velocity, atol=1e-10 * mesh.diagonal)


def test_a_factor_rotated_with_a_rigid_motion_is_that_of_the_moved_shape(space, mesh, move, rng):
    moved = space.point(move(mesh.vertices))
    forces = moved.pull_back(rng.standard_normal(len(moved.z)))
    change = rng.standard_normal(len(moved.z))
    chord = space.factorise(space.point(mesh.vertices)).rotated_to(moved)
    rotated = chord.solve(forces), chord.push_forward(forces), chord.project(change)
    chord = space.factorise(moved)
    fresh = chord.solve(forces), moved.push_forward(forces), chord.project(change)
    for a, b in zip(rotated, fresh, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max())


@pytest.mark.parametrize("pose", [1.3], indirect=True)
def test_rotating_a_factor_along_brings_it_nearer(space, mesh, pose, velocity):
    """``A⁻¹`` at a bent shape, approximated by the factor of another, on ``A d`` with a known ``d``."""
    there = space.point(pose)
    field = without_rigid_motion(velocity, pose)
    forces = there.pull_back(there.lower(there.push_forward(field)))
    chord = space.factorise(space.point(mesh.vertices))
    misses = []
    for used in (chord, chord.rotated_to(there)):
        miss = there.push_forward(used.solve(forces) - field)
        misses.append(miss @ there.lower(miss))
    assert misses[1] < 0.5 * misses[0]


@pytest.mark.parametrize(("angle", "told"), [(1.7, None), (3.0, "turn")])
def test_a_fold_within_one_step_is_told(angle, told):
    space = ShellSpace(hinge())
    fault = fault_between(space.point(hinge().vertices), space.point(hinge(angle).vertices))
    assert (fault is None) if told is None else (told in fault)


def test_angles_are_unwrapped_along_the_path(space, mesh, velocity):
    path = exponential(space, mesh.vertices, velocity, 8)
    assert np.abs(np.diff(path.nric, axis=0)).max() < 0.5 * np.pi


def test_shapes_of_another_mesh_are_refused(space, mesh):
    ball = TriangleMesh.from_arrays(np.eye(4)[:, :3], TETRAHEDRON)
    with pytest.raises(ValueError, match="vertices"):
        exponential(space, ball.vertices, np.zeros((4, 3)), K)
