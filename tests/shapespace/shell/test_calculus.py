"""The laws of Riemannian calculus, on every mesh and every strength of deformation."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from shapespace.coordinates.integrability import Integrability
from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential, extrapolate
from shapespace.shell.geodesic import geodesic, halved, logarithm, towards
from shapespace.shell.many_exponentials import exponentials
from shapespace.shell.mean import centre_of_mass, elastic_mean
from shapespace.shell.space import ShellSpace, fault_between
from shapespace.shell.transport import parallel_transport
from shapespace.solve.deadline import Deadline
from shapespace.solve.preconditioner import step_length
from shapespace.solve.status import Status
from tests.shapespace.conftest import MESHES, bent
from tests.shapespace.shell.constrained import constrained_exponential

K = 4


def distance(space, first, second):
    """Largest difference of lengths, relative to their mean, and of angles; the same for all poses in space."""
    a, b = space.nric(first), space.nric(second)
    e = space.connectivity.edge_count
    turn = np.angle(np.exp(1j * (a[..., e:] - b[..., e:])))
    return max(np.abs(a[..., :e] - b[..., :e]).max() / a[..., :e].mean(), np.abs(turn).max())


def true_residuals(space, path):
    """``sqrt(F_kᵀ A_k⁻¹ F_k)`` of the discrete Euler–Lagrange equation, with a fresh factor for each shape."""
    points = [space.point(x) for x in path.vertices]
    found = []
    for before, here, after in zip(points, points[1:], points[2:], strict=False):
        forces = here.pull_back(before.rest.gradient_deformed(here.z) + here.rest.gradient_rest(after.z))
        found.append(step_length(forces, space.factorise(here).solve(forces)))
    return np.array(found)


def spread(mesh, vertices):
    """Some vertices tell how far shapes are apart, after alignment."""
    return np.abs(align(vertices, mesh.vertices) - mesh.vertices).max() / mesh.diagonal


# ---------------------------------------------------------------- tangent space and metric


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


def test_the_unit_of_length_does_not_matter(mesh, velocity):
    material = Material(eta=1e-3)
    larger = mesh.with_vertices(10 * mesh.vertices)
    small = exponential(ShellSpace(mesh, material), mesh.vertices, velocity, K)
    large = exponential(ShellSpace(larger, material), larger.vertices, 10 * velocity, K)
    assert small.iterations == large.iterations
    np.testing.assert_allclose(large.vertices, 10 * small.vertices, atol=1e-8 * larger.diagonal)
    assert large.residual == pytest.approx(small.residual, rel=0.1, abs=1e-12)


def test_a_factor_turned_along_with_a_rigid_motion_is_that_of_the_moved_shape(space, mesh, rng):
    turn = Rotation.from_rotvec([1.2, -0.7, 2.1]).as_matrix()
    moved = space.point(mesh.vertices @ turn.T + [1, 2, 3])
    forces = moved.pull_back(rng.standard_normal(len(moved.z)))
    change = rng.standard_normal(len(moved.z))
    chord = space.factorise(space.point(mesh.vertices)).rotated_to(moved)
    turned = chord.solve(forces), chord.push_forward(forces), chord.project(change)
    chord = space.factorise(moved)
    fresh = chord.solve(forces), moved.push_forward(forces), chord.project(change)
    for a, b in zip(turned, fresh, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6 * np.abs(b).max())


@pytest.mark.parametrize("pose", [1.3], indirect=True)
def test_turning_a_factor_along_brings_it_nearer(space, mesh, pose, velocity):
    """``A⁻¹`` of a bent shape, applied to the forces that a known field of displacements needs."""
    there = space.point(pose)
    field = without_rigid_motion(velocity, pose)
    forces = there.pull_back(there.lower(there.push_forward(field)))
    chord = space.factorise(space.point(mesh.vertices))
    misses = []
    for used in (chord, chord.rotated_to(there)):
        miss = there.push_forward(used.solve(forces) - field)
        misses.append(miss @ there.lower(miss))
    assert misses[1] < 0.5 * misses[0]


# ---------------------------------------------------------------- exponential, geodesic, logarithm


def test_the_exponential_ends_when_its_deadline_passes(space, mesh, velocity):
    deadline = Deadline(60)
    assert len(exponential(space, mesh.vertices, velocity, 4, deadline=deadline).vertices) == 5
    deadline.call_off()
    path = exponential(space, mesh.vertices, velocity, 4, deadline=deadline)
    assert path.status is Status.DEADLINE
    assert len(path.vertices) == 2


def test_every_step_of_the_exponential_solves_its_equation(space, mesh, velocity):
    path = exponential(space, mesh.vertices, velocity, 8)
    assert path.converged
    assert len(path.vertices) == 9
    assert true_residuals(space, path).max() <= 1e-9


def test_standing_still_needs_no_iteration(space, mesh):
    path = exponential(space, mesh.vertices, np.zeros_like(mesh.vertices), K)
    assert path.iterations == 0
    np.testing.assert_allclose(path.vertices[-1], mesh.vertices, atol=1e-12 * mesh.diagonal)


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
    assert max(half) < 1.5 * min(half), "equal times"


def test_a_geodesic_has_less_energy_than_paths_beside_it(space, mesh, pose, rng):
    path = geodesic(space, mesh.vertices, pose, K)
    for _ in range(3):
        beside = path.vertices.copy()
        beside[2] += 1e-4 * mesh.diagonal * rng.standard_normal(beside[2].shape)
        z = space.nric(beside)
        assert K * space.energy.rest(z[:-1]).value(z[1:]).sum() > path.energy


def test_exponential_undoes_logarithm(space, mesh, pose):
    found = logarithm(space, mesh.vertices, pose, K)
    there = exponential(space, mesh.vertices, found.velocity, K)
    assert distance(space, there.vertices[-1], pose) < 1e-6


def test_logarithm_undoes_exponential(space, mesh, velocity, move):
    there = exponential(space, mesh.vertices, velocity, K)
    found = logarithm(space, mesh.vertices, move(there.vertices[-1]), K)
    assert space.norm(mesh.vertices, found.velocity - velocity) < 1e-7
    z = there.nric
    np.testing.assert_allclose(found.nric, K * (z[1] - z[0]), atol=1e-5)


def test_a_rigid_part_of_the_velocity_changes_nothing(space, mesh, velocity):
    turning = np.cross([0.1, 0.4, -0.2], mesh.vertices)
    plain = exponential(space, mesh.vertices, velocity, K)
    turned = exponential(space, mesh.vertices, velocity + turning, K)
    np.testing.assert_allclose(turned.vertices, plain.vertices, atol=1e-9 * mesh.diagonal)


def test_a_step_back_and_forth_returns(space, mesh, velocity):
    first = mesh.vertices
    second = first + velocity / K
    back = extrapolate(space, second, first, 2, forward=False)
    forth = extrapolate(space, back.vertices[-1], back.vertices[-2], 2)
    assert back.converged
    assert forth.converged
    assert distance(space, forth.vertices[-2], first) < 1e-6
    assert distance(space, forth.vertices[-1], second) < 1e-6


def test_shooting_backwards_continues_the_path_before_its_start(space, mesh, velocity):
    before = exponential(space, mesh.vertices, 0.5 * velocity, -2)
    after = exponential(space, mesh.vertices, 0.5 * velocity, 2)
    whole = extrapolate(space, before.vertices[-1], before.vertices[-2], 3)
    assert distance(space, whole.vertices[-1], after.vertices[-1]) < 1e-6


def test_reversal_holds_to_first_order(space, mesh, velocity):
    """Forward along v and back by the reversed last step; the miss halves when K doubles."""
    misses = []
    for steps in (8, 16):
        there = exponential(space, mesh.vertices, 0.5 * velocity, steps)
        last = steps * (align(there.vertices[-2], there.vertices[-1]) - there.vertices[-1])
        back = exponential(space, there.vertices[-1], last, steps)
        misses.append(spread(mesh, back.vertices[-1]))
    assert misses[1] < 0.65 * misses[0] + 1e-7  # of which much is tolerance where there is hardly motion
    assert misses[0] < 0.1


def test_the_exponential_converges_to_first_order(space, mesh, velocity):
    ends = [exponential(space, mesh.vertices, 0.5 * velocity, steps).vertices[-1] for steps in (4, 8, 16)]
    coarse, fine = (np.abs(align(b, a) - a).max() for a, b in pairwise(ends))
    assert coarse / fine == pytest.approx(2, abs=0.5)


def test_part_of_a_geodesic_is_one(space, mesh, pose):
    path = geodesic(space, mesh.vertices, pose, 6)
    part = geodesic(space, path.vertices[1], path.vertices[4], 3)
    for a, b in zip(path.vertices[1:5], part.vertices, strict=True):
        assert distance(space, a, b) < 1e-6


def test_a_geodesic_starts_again_where_an_exponential_went(space, mesh, velocity):
    shot = exponential(space, mesh.vertices, velocity, K)
    found = geodesic(space, mesh.vertices, shot.vertices[-1], K)
    for a, b in zip(shot.vertices, found.vertices, strict=True):
        assert distance(space, a, b) < 1e-6


@pytest.mark.parametrize("mesh", ["closed", "sheet"], indirect=True)  # simply connected
def test_nodal_and_constrained_form_are_the_same(space, mesh, velocity):
    path = exponential(space, mesh.vertices, velocity, K, tolerance=1e-11)
    z = constrained_exponential(space, path.nric[0], path.nric[1], K)
    np.testing.assert_allclose(z, path.nric, atol=1e-8)


def test_backends_agree(mesh, velocity):
    paths = []
    for backend in ("banded", "auto"):
        space = ShellSpace(mesh, Material(eta=1e-3), backend)
        paths.append(exponential(space, mesh.vertices, velocity, K))
        paths.append(geodesic(space, mesh.vertices, paths[-1].vertices[-1], K))
    for path in paths[1:]:
        assert distance(space, path.vertices[-1], paths[0].vertices[-1]) < 1e-6


def test_angles_are_unwrapped_along_the_path(space, mesh, velocity):
    path = exponential(space, mesh.vertices, velocity, 8)
    assert np.abs(np.diff(path.nric, axis=0)).max() < 0.5 * np.pi


# ---------------------------------------------------------------- transport


def test_transport_along_a_geodesic_carries_its_velocity(space, mesh, velocity):
    """To first order: so much is a discrete geodesic's velocity itself known."""
    misses = []
    for steps in (4, 8):
        path = exponential(space, mesh.vertices, 0.5 * velocity, steps)
        carried = parallel_transport(space, path, 0.5 * velocity)
        assert carried.status is Status.CONVERGED
        last = steps * (path.vertices[-1] - align(path.vertices[-2], path.vertices[-1]))
        misses.append(space.norm(path.vertices[-1], carried.velocities[-1] - last))
    assert misses[1] < 0.65 * misses[0]
    assert misses[1] < 0.2 * space.norm(mesh.vertices, velocity)


def test_transport_keeps_lengths_and_angles_between_vectors(space, mesh, velocity, rng):
    path = exponential(space, mesh.vertices, 0.5 * velocity, 8)
    z = space.nric(mesh.vertices)
    stretched = mesh.vertices * [1, 1.1, 0.95]
    other = space.project(mesh.vertices, space.nric(stretched) - z)
    carried = [parallel_transport(space, path, v).velocities[-1] for v in (velocity, other)]

    def products(at, u, v):
        return np.array([space.inner(at, u, u), space.inner(at, v, v), space.inner(at, u, v)])

    before, after = products(mesh.vertices, velocity, other), products(path.vertices[-1], *carried)
    np.testing.assert_allclose(after, before, atol=0.1 * np.sqrt(before[0] * before[1]), rtol=0.1)


def test_transport_takes_one_step_and_not_none(space, mesh, velocity):
    path = exponential(space, mesh.vertices, 0.1 * velocity, 1)
    carried = parallel_transport(space, path, velocity)
    assert carried.status is Status.CONVERGED
    length = space.norm(mesh.vertices, velocity)
    assert space.norm(path.vertices[1], carried.velocities[1]) == pytest.approx(length, rel=0.1)
    with pytest.raises(ValueError, match="two shapes"):
        parallel_transport(space, replace(path, vertices=path.vertices[:1]), velocity)


def test_transport_does_not_depend_on_the_length_of_the_vector(space, mesh, velocity):
    path = exponential(space, mesh.vertices, 0.5 * velocity, 2)
    plain, long = (parallel_transport(space, path, s * velocity).velocities for s in (1, 50))
    np.testing.assert_allclose(long, 50 * plain, atol=1e-4 * np.abs(long).max())
    assert not parallel_transport(space, path, 0 * velocity).velocities.any()
    lost = parallel_transport(space, path, np.nan * velocity)
    assert lost.status is Status.NOT_FINITE
    assert len(lost.velocities) == 0


# ---------------------------------------------------------------- means


@pytest.mark.parametrize("mean", [elastic_mean, centre_of_mass])
def test_the_mean_of_one_shape_is_that_shape(space, mesh, pose, move, mean):
    shapes = np.stack([pose, move(pose)])
    found = mean(space, shapes, start=mesh.vertices)
    assert found.status is Status.CONVERGED
    assert distance(space, found.vertices, pose) < 1e-4


def test_forces_balance_at_the_elastic_mean(space, mesh, pose):
    shapes, weights = np.stack([mesh.vertices, pose]), np.array([1.0, 2.0])
    found = elastic_mean(space, shapes, weights)
    assert found.status is Status.CONVERGED
    point = space.point(found.vertices)
    pulls = [point.pull_back(p) for p in space.energy.rest(space.nric(shapes)).gradient_deformed(point.z)]
    assert np.abs(weights @ np.reshape(pulls, (2, -1))).max() < 1e-6 * np.abs(pulls).max()


@pytest.mark.parametrize(("name", "seed", "size"), [("sheet", 1, 0.25), ("closed", 3, 0.35), ("torus", 2, 0.35)])
def test_faces_that_differ_much_between_shapes_have_a_mean(name, seed, size):
    """With the metric alone the steps stall: it knows of one shape, and here each face is another in every shape."""
    mesh = MESHES[name]()
    edge = np.linalg.norm(mesh.vertices[mesh.edges[:, 0]] - mesh.vertices[mesh.edges[:, 1]], axis=1).mean()
    noise = np.random.default_rng(seed).standard_normal((5, *mesh.vertices.shape))
    shapes, space = mesh.vertices + size * edge * noise, ShellSpace(mesh)
    assert elastic_mean(space, shapes[:2]).status is Status.CONVERGED
    found = elastic_mean(space, shapes)
    assert found.status is Status.CONVERGED
    point = space.point(found.vertices)
    pulls = [point.pull_back(p) for p in space.energy.rest(space.nric(shapes)).gradient_deformed(point.z)]
    assert np.abs(np.sum(pulls, axis=0)).max() < 1e-6 * np.abs(pulls).max()


def test_without_a_mean_the_worst_face_is_named(space, mesh, pose):
    i, j, _ = mesh.faces[7]
    flat = pose.copy()
    flat[i] = flat[j]
    found = elastic_mean(space, np.stack([mesh.vertices, pose, flat]))
    assert found.status is not Status.CONVERGED
    assert found.reason
    assert found.worst is not None
    shape, face = found.worst
    assert shape == 2
    assert {i, j} <= set(mesh.faces[face])


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
        # As near as one could hope for, and exact at the ends.
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


def test_logarithms_at_the_centre_of_mass_balance(space, mesh, velocity):
    shapes = np.stack([exponential(space, mesh.vertices, s * velocity, K).vertices[-1] for s in (-0.3, 0.1, 0.4)])
    weights = np.array([4.0, 1.0, 1.0])
    found = centre_of_mass(space, shapes, weights)
    assert found.status is Status.CONVERGED
    total = sum(w * log.velocity for w, log in zip(weights / 6, found.logarithms, strict=True))
    assert space.norm(found.vertices, total) < 0.05 * space.norm(mesh.vertices, velocity)


def test_the_centre_of_two_shapes_is_half_way(space, mesh, velocity):
    end = exponential(space, mesh.vertices, 0.5 * velocity, 2).vertices[-1]
    found = centre_of_mass(space, np.stack([mesh.vertices, end]), steps=8)
    half = geodesic(space, mesh.vertices, end, 16).vertices[8]
    whole = space.norm(mesh.vertices, 0.5 * velocity)
    assert space.norm(half, without_rigid_motion(align(found.vertices, half) - half, half)) < 0.1 * whole


@pytest.mark.parametrize("weights", [[0, 0], [1, -1], [1], [np.nan, 1], [np.inf, 1]])
def test_weights_that_make_no_mean_are_refused(space, mesh, pose, weights):
    for mean in (elastic_mean, centre_of_mass):
        with pytest.raises(ValueError, match="weights"):
            mean(space, [mesh.vertices, pose], weights)
        with pytest.raises(ValueError, match="no shapes"):
            mean(space, [])


# ---------------------------------------------------------------- many at once


@pytest.mark.parametrize("mesh", ["sheet"], indirect=True)
@pytest.mark.parametrize("pose", [1.3], indirect=True)
def test_many_exponentials_do_not_depend_on_how_many_work(mesh, space, velocity):
    velocities = np.stack([velocity, 0.2 * velocity, np.full_like(velocity, np.nan), -0.3 * velocity])
    here = list(exponentials(space, mesh.vertices, velocities, K, workers=1))
    there = list(exponentials(space, mesh.vertices, velocities, K, workers=2, chunk=1))
    assert [p.status for p in here] == [p.status for p in there]
    assert here[2].status is Status.NOT_FINITE
    for a, b in zip(here, there, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)
    alone = exponential(space, mesh.vertices, velocities[3], K)
    np.testing.assert_array_equal(alone.vertices, here[3].vertices)


# ---------------------------------------------------------------- what cannot work


def test_a_velocity_that_tears_the_mesh_is_told(space, mesh, rng):
    path = exponential(space, mesh.vertices, 20 * mesh.diagonal * rng.standard_normal(mesh.vertices.shape), K)
    assert not path.converged
    assert path.reason
    assert np.isfinite(path.vertices).all()


@pytest.mark.parametrize("pose", [1.3], indirect=True)
def test_a_long_way_ends_in_a_finite_path_whatever_happens(mesh, velocity):
    """Bending so stiff that faces collapse before the end: the shapes until then are there, and a reason."""
    space = ShellSpace(mesh, Material(eta=1.0))
    path = exponential(space, mesh.vertices, 5 * velocity, K)
    assert np.isfinite(path.vertices).all()
    assert path.converged == (len(path.vertices) == K + 1)
    assert path.converged or path.reason


def test_exact_newton_takes_over_where_the_chord_fails(space, mesh, velocity, monkeypatch):
    easy = exponential(space, mesh.vertices, velocity, K)
    monkeypatch.setattr("shapespace.shell.exponential.SLOW", 1e-9)
    hard = exponential(space, mesh.vertices, velocity, K)
    back = exponential(space, mesh.vertices, velocity, -2)
    assert hard.converged
    assert back.converged
    assert distance(space, hard.vertices[-1], easy.vertices[-1]) < 1e-6


@pytest.mark.parametrize(("angle", "told"), [(1.7, None), (3.0, "turn")])
def test_a_fold_within_one_step_is_told(angle, told):
    flat = TriangleMesh.from_arrays([[0, 0, 0], [2, 0, 0], [1, 1, 0], [1, -1, 0]], [[0, 1, 2], [1, 0, 3]])
    folded = flat.vertices.copy()
    folded[2] = [1, np.cos(angle), np.sin(angle)]
    space = ShellSpace(flat)
    fault = fault_between(space.point(flat.vertices), space.point(folded))
    assert (fault is None) if told is None else (told in fault)


@pytest.mark.parametrize("where", ["start", "velocity"])
def test_what_is_not_finite_is_told(space, mesh, velocity, where):
    start, velocity = mesh.vertices.copy(), velocity.copy()
    {"start": start, "velocity": velocity}[where][3, 1] = np.nan
    path = exponential(space, start, velocity, K)
    assert path.status is Status.NOT_FINITE
    assert np.isfinite(path.vertices).all()
    found = logarithm(space, start, start + velocity, K)
    assert found.path.status is Status.NOT_FINITE
    assert np.isfinite(found.velocity).all()
    mean = elastic_mean(space, np.stack([mesh.vertices, start + velocity]))
    assert mean.status is Status.NOT_FINITE
    assert mean.iterations == 0
    assert np.isfinite(mean.vertices).all()


@pytest.mark.parametrize("pose", [1.3], indirect=True)
@pytest.mark.parametrize(
    "operation", ["exponential", "geodesic", "elastic_mean", "centre_of_mass", "centre_of_mass from there"]
)
def test_a_degenerate_face_is_told(space, mesh, velocity, operation):
    flat = mesh.vertices.copy()
    a, b, c = mesh.faces[0]
    flat[c] = (flat[a] + flat[b]) / 2
    if operation == "exponential":
        result = exponential(space, flat, velocity, K)
    elif operation == "geodesic":
        result = geodesic(space, mesh.vertices, flat, K)
    elif operation == "elastic_mean":
        result = elastic_mean(space, np.stack([flat, flat]))
    elif operation == "centre_of_mass":
        result = centre_of_mass(space, np.stack([mesh.vertices, flat]), start=mesh.vertices)
    else:
        result = centre_of_mass(space, np.stack([mesh.vertices]), start=flat, steps=1)
    assert result.status is not Status.CONVERGED
    assert result.reason
    assert np.isfinite(result.vertices).all()


def test_a_path_needs_a_step(space, mesh, velocity):
    with pytest.raises(ValueError, match="step"):
        exponential(space, mesh.vertices, velocity, 0)
    with pytest.raises(ValueError, match="step"):
        geodesic(space, mesh.vertices, mesh.vertices, 0)


def test_shapes_of_another_mesh_are_refused(space, mesh):
    ball = TriangleMesh.from_arrays(np.eye(4)[:, :3], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    with pytest.raises(ValueError, match="vertices"):
        exponential(space, ball.vertices, np.zeros((4, 3)), K)
