"""Edge lengths and signed dihedral angles: known shapes, invariances, derivatives, weights."""

import numpy as np
import pytest
import trimesh

from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import (
    HingeGeometry,
    NRICJacobian,
    WeightedNorm,
    dihedral_angles,
    edge_lengths,
    nric,
    unwrap,
    wrap,
)
from shapespace.mesh.triangle_mesh import TriangleMesh, face_normals
from tests.shapespace.conftest import MESHES, hinge


def mesh_of(shape):
    return TriangleMesh.from_arrays(shape.vertices, shape.faces)


def halves(mesh):
    return np.split(nric(mesh.vertices, mesh.connectivity), 2)


def flipped(mesh):
    return TriangleMesh.from_arrays(mesh.vertices, mesh.faces[:, ::-1])


# ---------------------------------------------------------------- known shapes


def test_a_cube_has_twelve_right_angles_and_six_flat_diagonals():
    lengths, angles = halves(mesh_of(trimesh.creation.box()))
    sides = np.isclose(lengths, 1, atol=1e-15)
    assert sides.sum() == 12
    np.testing.assert_allclose(angles[sides], np.pi / 2, atol=1e-15)
    assert len(angles[~sides]) == 6
    np.testing.assert_allclose(lengths[~sides], np.sqrt(2), atol=1e-15)
    np.testing.assert_allclose(angles[~sides], 0, atol=1e-15)


def test_lengths_and_angles_come_in_edge_order():
    mesh = TriangleMesh.from_arrays([[0, 0, 0], [3, 0, 0], [0, 4, 0], [0, 0, 12]], [[0, 2, 1], [0, 1, 3], [0, 3, 2]])
    # Edges (0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3); the last three are the boundary.
    lengths, angles = halves(mesh)
    np.testing.assert_allclose(lengths, [3, 4, 12, 5, np.sqrt(153), np.sqrt(160)])
    np.testing.assert_allclose(angles, [np.pi / 2, np.pi / 2, np.pi / 2, 0, 0, 0])


@pytest.mark.parametrize("phi", [1e-9, 1e-3, 0.5, np.pi / 2, 2.5, np.pi - 1e-9])
def test_convex_is_positive_and_concave_negative(phi):
    """Also at small angles, where arccos loses half of the digits."""
    for angle in (phi, -phi):
        _, angles = halves(hinge(angle))
        assert angles[0] == pytest.approx(angle, rel=1e-6, abs=1e-15)
        assert not angles[1:].any()


@pytest.mark.parametrize("tip", [[1, 1, 0], [1, 0.9, 0], [-3, 0.5, 0]])
@pytest.mark.parametrize("faces", [[[0, 1, 2], [1, 0, 3]], [[1, 0, 2], [0, 1, 3]]])
def test_a_hinge_folded_flat_has_the_angle_pi(tip, faces):
    """It is never −π, on either side: the range is (−π, π]."""
    folded = TriangleMesh.from_arrays([[0, 0, 0], [2, 0, 0], tip, [1, 1, 0]], faces)
    _, angles = halves(folded)
    assert angles[0] == np.pi


def test_the_mean_curvature_of_a_convex_body_is_that_of_its_support_function(rng):
    """Steiner: ½ Σ lθ is the integral over all directions of the support function h, for any convex body."""
    for _ in range(3):
        mesh = mesh_of(trimesh.convex.convex_hull(rng.standard_normal((30, 3)) * [3, 2, 1]))
        lengths, angles = halves(mesh)
        assert (angles > 0).all()
        # Fibonacci's lattice on the sphere.
        k = np.arange(20_000) + 0.5
        z, turn = 1 - k / 10_000, np.pi * (1 + np.sqrt(5)) * k
        directions = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)
        support = (directions @ mesh.vertices.T).max(axis=1)
        assert lengths @ angles / 2 == pytest.approx(4 * np.pi * support.mean(), rel=1e-3)


# ---------------------------------------------------------------- invariances


def test_turning_a_surface_inside_out_changes_the_sign_of_the_angles(mesh):
    lengths, angles = halves(mesh)
    lengths_flipped, angles_flipped = halves(flipped(mesh))
    assert np.array_equal(lengths_flipped, lengths)
    np.testing.assert_allclose(angles_flipped, -angles, atol=1e-14)
    assert np.abs(angles).max() > 0.01


def test_rigid_motions_change_nothing(mesh, pose, move):
    z = nric(pose, mesh.connectivity)
    for _ in range(5):
        np.testing.assert_allclose(nric(move(pose), mesh.connectivity), z, atol=1e-12)


def test_mirroring_keeps_lengths_and_changes_the_sign_of_the_angles(mesh, pose, move):
    e = mesh.connectivity.edge_count
    z = nric(pose, mesh.connectivity)
    mirrored = move(pose * [1, -1, 1])
    found = nric(mirrored, mesh.connectivity)
    np.testing.assert_allclose(found[:e], z[:e], atol=1e-12)
    np.testing.assert_allclose(found[e:], -z[e:], atol=1e-12)
    # Mirrored and turned inside out, it has the same lengths and angles.
    both = flipped(mesh.with_vertices(mirrored))
    np.testing.assert_allclose(nric(both.vertices, both.connectivity), z, atol=1e-12)


def test_scaling_scales_lengths_only(mesh):
    lengths, angles = halves(mesh)
    scaled_lengths, scaled_angles = halves(mesh.with_vertices(1e-4 * mesh.vertices))
    np.testing.assert_allclose(scaled_lengths, 1e-4 * lengths, rtol=1e-12)
    np.testing.assert_allclose(scaled_angles, angles, atol=1e-12)


def test_angles_are_those_between_normals(mesh, pose):
    c = mesh.connectivity
    left, right = np.moveaxis(face_normals(pose, c.faces)[c.edge_faces[c.interior]], 1, 0)
    angles = dihedral_angles(pose, c)
    np.testing.assert_allclose(np.cos(angles[c.interior]), (left * right).sum(axis=1), atol=1e-12)


def test_a_boundary_edge_has_the_angle_zero_and_no_weight(mesh, pose):
    boundary = ~mesh.connectivity.interior
    assert not dihedral_angles(pose, mesh.connectivity)[boundary].any()
    weights = np.split(WeightedNorm.of(mesh, 1e-2).squared, 2)
    assert not weights[1][boundary].any()
    assert (weights[1][~boundary] > 0).all()
    assert (weights[0] > 0).all()


def test_many_shapes_at_once_are_the_same_as_one_by_one(mesh, pose):
    c = mesh.connectivity
    shapes = np.stack([[mesh.vertices, pose], [2 * pose, pose[:, ::-1]], [-pose, mesh.vertices]])
    z, lengths, angles = nric(shapes, c), edge_lengths(shapes, c), dihedral_angles(shapes, c)
    assert z.shape == (3, 2, 2 * c.edge_count)
    np.testing.assert_array_equal(z, np.concatenate([lengths, angles], axis=-1))
    for index in np.ndindex(3, 2):
        np.testing.assert_allclose(z[index], nric(shapes[index], c), atol=1e-13)


# ---------------------------------------------------------------- angles modulo 2π


def test_wrapping_ends_in_the_half_open_interval(rng):
    angles = rng.uniform(-100, 100, 1000)
    found = wrap(angles)
    assert (found > -np.pi).all()
    assert (found <= np.pi).all()
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * angles), atol=1e-12)
    inside = rng.uniform(-3.14, 3.14, 1000)
    np.testing.assert_allclose(wrap(inside), inside, atol=1e-15)
    for end in (np.pi, -np.pi):
        assert wrap(end) == np.pi
    np.testing.assert_allclose(wrap(np.array([3, -3, 2, 0.0]) * np.pi), [np.pi, np.pi, 0, 0], atol=1e-15)


def test_unwrapping_stays_next_to_the_reference(rng):
    reference = np.concatenate([rng.uniform(1, 2, 50), rng.uniform(-9, 9, 50)])
    z = np.concatenate([rng.uniform(1, 9, (4, 50)), rng.uniform(-20, 20, (4, 50))], axis=1)
    found = unwrap(z, reference)
    assert np.array_equal(found[:, :50], z[:, :50])
    assert (np.abs(found[:, 50:] - reference[50:]) <= np.pi + 1e-12).all()
    turns = (found[:, 50:] - z[:, 50:]) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    assert np.abs(turns).max() > 0.5


def test_a_fold_past_pi_goes_on_growing():
    z = nric(hinge(3).vertices, hinge(3).connectivity)
    past = nric(hinge(3.3).vertices, hinge(3.3).connectivity)
    assert past[5] == pytest.approx(3.3 - 2 * np.pi)
    assert unwrap(past, z)[5] == pytest.approx(3.3)


# ---------------------------------------------------------------- derivatives


def test_the_jacobian_has_the_slopes_of_a_derivative(mesh, pose, rng, slope):
    c = mesh.connectivity
    direction = 0.05 * mesh.diagonal * rng.standard_normal(pose.shape)
    change = NRICJacobian(c)(pose) @ direction.ravel()
    z = nric(pose, c)

    def at(h):
        return unwrap(nric(pose + h * direction, c), z)

    # Lengths and angles separately: a small error of one must not be masked by the other.
    for half in (slice(c.edge_count), slice(c.edge_count, None)):
        taylor = slope(lambda h, half=half: (at(h) - z - h * change)[half], 1e-3)
        central = slope(lambda h, half=half: ((at(h) - at(-h)) / (2 * h) - change)[half], 1e-3)
        assert taylor == pytest.approx(2, abs=0.1)
        assert central == pytest.approx(2, abs=0.1)


def test_second_derivatives_have_the_slope_of_a_derivative(mesh, pose, rng, slope):
    jacobian, matrix = NRICJacobian(mesh.connectivity), NormalMatrix(mesh.connectivity)
    covector = rng.standard_normal(2 * mesh.connectivity.edge_count)
    direction = 0.1 * edge_lengths(pose, mesh.connectivity).mean() * rng.standard_normal(pose.shape)
    second = HingeGeometry(pose, mesh.connectivity).second_derivatives()
    curvature = matrix.pattern.matrix(matrix.second_derivative(second, covector))
    change = (curvature @ direction.ravel()).reshape(pose.shape)

    def pulled(x):
        return jacobian.pull_back(jacobian.gradients(x), covector)

    assert slope(lambda h: pulled(pose + h * direction) - pulled(pose) - h * change) > 1.9


def test_rigid_motions_lie_in_the_jacobians_kernel(mesh, pose):
    jacobian = NRICJacobian(mesh.connectivity)(pose)
    for axis in np.eye(3):
        for motion in (np.tile(axis, (len(pose), 1)), np.cross(axis, pose)):
            change = jacobian @ motion.ravel()
            assert np.abs(change).max() < 1e-12 * np.abs(jacobian).max()


@pytest.mark.parametrize("name", ["closed", "torus"])
def test_a_closed_surface_obeys_schlaefli(name, rng):
    """Σ l dθ = 0 for any change of a closed polyhedral surface."""
    mesh = MESHES[name]()
    jacobian = NRICJacobian(mesh.connectivity)
    e = mesh.connectivity.edge_count
    for _ in range(3):
        shape = mesh.vertices + 0.05 * rng.standard_normal(mesh.vertices.shape)
        total = edge_lengths(shape, mesh.connectivity) @ jacobian(shape)[e:]
        assert np.abs(total).max() < 1e-12


def test_the_jacobian_keeps_its_pattern_where_entries_vanish(rng):
    """On a cube along the axes most derivatives are exactly zero."""
    cube = mesh_of(trimesh.creation.box())
    jacobian = NRICJacobian(cube.connectivity)
    symmetric = jacobian(cube.vertices)
    other = jacobian(cube.vertices + 0.1 * rng.standard_normal(cube.vertices.shape))
    assert symmetric.shape == (36, 24)
    assert symmetric.nnz == other.nnz == 18 * 6 + 18 * 12
    assert np.array_equal(symmetric.indices, other.indices)
    assert np.array_equal(symmetric.indptr, other.indptr)
    assert (symmetric.data == 0).sum() > 100
    assert (other.data != 0).all()


def test_boundary_angles_have_empty_rows(mesh, pose):
    c = mesh.connectivity
    counts = np.diff(NRICJacobian(c)(pose).indptr)
    assert (counts[: c.edge_count] == 6).all()
    assert np.array_equal(counts[c.edge_count :], np.where(c.interior, 12, 0))


def test_pushing_and_pulling_are_products_with_the_jacobian(mesh, pose, rng):
    jacobian = NRICJacobian(mesh.connectivity)
    gradients = jacobian.gradients(pose)
    matrix = jacobian(pose)
    displacement = rng.standard_normal(pose.shape)
    covector = rng.standard_normal(matrix.shape[0])
    scale = np.abs(matrix).max()
    pushed = jacobian.push_forward(gradients, displacement)
    pulled = jacobian.pull_back(gradients, covector)
    assert np.abs(pushed - matrix @ displacement.ravel()).max() < 1e-12 * scale
    assert np.abs(pulled.ravel() - matrix.T @ covector).max() < 1e-12 * scale


# ---------------------------------------------------------------- norm


def test_the_norm_is_that_of_the_paper(mesh, rng):
    eta = 0.03
    c = mesh.connectivity
    difference = rng.standard_normal(2 * c.edge_count)
    expected = 0.0
    for e, (i, j) in enumerate(c.edges):
        length = np.linalg.norm(mesh.vertices[i] - mesh.vertices[j])
        expected += (difference[e] / length) ** 2
        if c.interior[e]:
            third = sum(mesh.face_areas[f] for f in c.edge_faces[e]) / 3
            expected += eta * (length / np.sqrt(third) * difference[c.edge_count + e]) ** 2
    norm = WeightedNorm.of(mesh, eta)
    assert norm.eta == eta
    assert norm.square(difference) == pytest.approx(expected, rel=1e-12)
    np.testing.assert_allclose(norm.square(np.stack([difference, 2 * difference])), [expected, 4 * expected])


def test_the_norm_has_no_unit(mesh):
    e = mesh.connectivity.edge_count
    small, large = (WeightedNorm.of(mesh.with_vertices(s * mesh.vertices), 0.1).squared for s in (1, 50))
    np.testing.assert_allclose(2500 * large[:e], small[:e], rtol=1e-12)
    np.testing.assert_allclose(large[e:], small[e:], rtol=1e-12)
