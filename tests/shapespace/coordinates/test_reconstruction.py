"""Vertices from lengths and angles that are exact, noisy, or far from all shapes."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from shapespace.coordinates.nric import NRICJacobian, nric
from shapespace.coordinates.reconstruction import DEFAULT_ETA, Reconstructor
from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status
from shapespace.training.collection.generators.freaky_torus import FreakyTorus
from tests.shapespace.conftest import MESHES, bent

ETAS = [DEFAULT_ETA, 1.0]


@pytest.fixture
def reconstruct(mesh):
    return Reconstructor(mesh)


@pytest.fixture
def target(mesh, pose):
    return nric(pose, mesh.connectivity)


@pytest.fixture(scope="module")
def torus():
    return FreakyTorus()


@pytest.fixture(scope="module")
def capsule():
    straight = trimesh.creation.capsule(height=4, radius=0.5, count=[16, 16])
    return TriangleMesh.from_arrays(straight.vertices[:, [2, 0, 1]], straight.faces)


def assert_found(result, expected, mesh):
    assert result.status is Status.CONVERGED
    assert result.residual < 1e-7
    assert result.flipped_faces == 0
    assert np.abs(align(result.vertices, expected) - expected).max() < 1e-6 * mesh.diagonal


def gradient(reconstruct, vertices, target):
    """Gradient of the misfit by the vertices, relative to the size of its terms."""
    c = reconstruct.reference.connectivity
    misfit = nric(vertices, c) - target
    misfit[c.edge_count :] = np.angle(np.exp(1j * misfit[c.edge_count :]))
    jacobian = NRICJacobian(c)(vertices)
    forces = reconstruct.norm.squared * misfit
    return np.abs(jacobian.T @ forces).max() / (abs(jacobian).T @ np.abs(forces)).max()


# ---------------------------------------------------------------- exact targets


@pytest.mark.parametrize("eta", ETAS)
def test_every_shape_of_freaky_torus_is_found_from_the_reference(torus, eta):
    reconstruct = Reconstructor(torus.reference, eta)
    codes = np.random.default_rng(5).uniform(0, 2 * np.pi, (4, 4))
    for shape in torus.shapes(codes).vertices:
        assert_found(reconstruct(nric(shape, torus.reference.connectivity)), shape, torus.reference)


@pytest.mark.parametrize("eta", ETAS)
@pytest.mark.parametrize("angle", [0.5, 1.5, 3.0])
def test_a_bent_capsule_is_found_from_the_straight_one(capsule, eta, angle):
    shape = bent(capsule.vertices, angle)
    assert_found(Reconstructor(capsule, eta)(nric(shape, capsule.connectivity)), shape, capsule)


@pytest.mark.parametrize("backend", ["banded", "pardiso"])
@pytest.mark.parametrize("eta", ETAS)
def test_every_kind_of_mesh_is_found(mesh, pose, target, eta, backend):
    assert_found(Reconstructor(mesh, eta, backend)(target), pose, mesh)


def test_one_reconstructor_serves_many_shapes(mesh, pose, reconstruct, target):
    first = reconstruct(target)
    assert_found(reconstruct(nric(mesh.vertices, mesh.connectivity)), mesh.vertices, mesh)
    again = reconstruct(target)
    assert np.array_equal(first.vertices, again.vertices)
    assert first.iterations == again.iterations > 1


def test_another_one_gives_the_same_and_has_its_own_work_space(mesh, reconstruct, target):
    other = reconstruct.another()
    found = reconstruct(target, reconstruct.guess(target))
    other(nric(mesh.vertices, mesh.connectivity))
    assert np.array_equal(other(target, other.guess(target)).vertices, found.vertices)
    with ThreadPoolExecutor(2) as pool:
        both = pool.map(lambda solver: [solver(target).vertices for _ in range(5)], (reconstruct, other))
    expected = reconstruct(target).vertices
    assert all(np.array_equal(vertices, expected) for results in both for vertices in results)


def test_where_it_starts_does_not_matter_up_to_a_rigid_motion(mesh, pose, reconstruct, target, move):
    start = move(mesh.vertices)
    kept = start.copy()
    found = reconstruct(target, start)
    assert_found(found, pose, mesh)
    assert np.array_equal(start, kept)
    # It stays aligned with its start, as a frame of an animation does with the frame before.
    beside = align(found.vertices, start)
    assert np.abs(beside - found.vertices).max() < 0.25 * mesh.diagonal
    assert np.abs(start - mesh.vertices).max() > 0.25 * mesh.diagonal


def test_a_start_at_the_solution_ends_at_once(mesh, pose, reconstruct, target):
    found = reconstruct(target, pose)
    assert_found(found, pose, mesh)
    assert found.iterations == 1
    np.testing.assert_allclose(found.vertices, pose, atol=1e-9 * mesh.diagonal)


def test_a_tolerance_beyond_rounding_ends_soon_and_as_stalled(mesh, pose, reconstruct, target):
    found = reconstruct(target, tolerance=1e-17)
    assert found.status is Status.STALLED
    assert found.iterations < 60
    assert np.abs(align(found.vertices, pose) - pose).max() < 1e-6 * mesh.diagonal


def test_angles_count_modulo_full_turns_and_not_at_all_on_the_boundary(mesh, pose, reconstruct, target, rng):
    c = mesh.connectivity
    target[c.edge_count :] += 2 * np.pi * rng.integers(-3, 4, c.edge_count)
    target[c.edge_count :][~c.interior] = rng.standard_normal((~c.interior).sum())
    found = reconstruct(target)
    assert found.status is Status.CONVERGED
    assert found.flipped_faces == 0
    assert np.abs(align(found.vertices, pose) - pose).max() < 1e-6 * mesh.diagonal


def test_the_unit_of_length_does_not_matter(mesh, pose, reconstruct, target):
    unit = 2.0**20  # a power of two, so that scaling rounds nothing
    large = mesh.with_vertices(unit * mesh.vertices)
    found = Reconstructor(large)(nric(unit * pose, mesh.connectivity))
    assert_found(found, unit * pose, large)
    assert found.iterations == reconstruct(target).iterations


# ---------------------------------------------------------------- targets of no shape


def test_noise_is_left_over_and_nothing_else(mesh, reconstruct, target, rng):
    """The result is stationary, at most as far from the target as the exact shape, and reports its misfit."""
    e = mesh.connectivity.edge_count
    noise = np.concatenate([0.01 * target[:e] * rng.standard_normal(e), 0.02 * rng.standard_normal(e)])
    noisy = target + noise
    found = reconstruct(noisy)
    assert found.status is Status.CONVERGED
    size = np.sqrt(reconstruct.norm.square(noise) / reconstruct.norm.square(noisy))
    assert 0.1 * size < found.residual < size
    assert gradient(reconstruct, found.vertices, noisy) < 1e-5


def test_the_residual_is_the_misfit_in_the_norm_relative_to_the_target(mesh, pose, reconstruct, target):
    misfit = nric(mesh.vertices, mesh.connectivity) - target
    found = reconstruct(target, max_iterations=0)
    assert found.status is Status.ITERATION_LIMIT
    assert found.residual == pytest.approx(
        np.sqrt(reconstruct.norm.square(misfit) / reconstruct.norm.square(target)), rel=1e-12
    )


def test_no_iteration_makes_it_worse(capsule):
    """Full steps would: the first ones are shortened. A rejected step counts as an iteration too."""
    reconstruct = Reconstructor(capsule)
    target = nric(bent(capsule.vertices, 3.0), capsule.connectivity)
    residuals = [reconstruct(target, max_iterations=n).residual for n in range(20)]
    assert (np.diff(residuals) <= 0).all()
    assert (np.diff(residuals[:4]) < 0).all()
    assert residuals[-1] < 1e-8


@pytest.mark.parametrize("seed", [0, 3])
def test_faces_that_no_triangle_fits_do_not_stop_it(seed):
    """The closest shape has faces of almost no height, where angles change too fast for undamped steps."""
    mesh = MESHES["closed"]()
    c, reconstruct = mesh.connectivity, Reconstructor(mesh)
    target = nric(mesh.vertices, c)
    for face in np.random.default_rng(seed).integers(len(c.faces), size=3):
        sides = c.face_edges[face]
        longest = sides[target[sides].argmax()]
        target[longest] = 1.6 * (target[sides].sum() - target[longest])
    found = reconstruct(target, tolerance=2e-5)
    assert found.status is Status.CONVERGED
    # It is a minimum: small smooth changes of the shape increase the misfit.
    for change in mesh.vertices**2, mesh.vertices * [1, -1, 0]:
        for size in (1e-3, -1e-3):
            assert reconstruct(target, found.vertices + size * change, max_iterations=0).residual > found.residual


def test_another_shape_than_the_one_asked_for_is_told_by_its_residual(capsule):
    """The target is bent almost to a ring; from the straight capsule Gauss–Newton ends in another minimum."""
    reconstruct = Reconstructor(capsule)
    found = reconstruct(nric(bent(capsule.vertices, 5.0), capsule.connectivity))
    assert found.residual > 0.01
    assert found.flipped_faces > 0


def test_faces_folded_the_wrong_way_are_counted(mesh, reconstruct):
    c = mesh.connectivity
    target = nric(mesh.vertices, c)
    assert reconstruct(target, max_iterations=0).flipped_faces == 0
    # Two sides of one face, which is counted once, and an edge elsewhere.
    first, second = next(sides[c.interior[sides]][:2] for sides in c.face_edges if c.interior[sides].sum() > 1)
    apart = next(
        e for e in np.flatnonzero(c.interior)[::-1] if not np.isin(c.edge_faces[e], c.edge_faces[[first, second]]).any()
    )
    for count, edge in ((2, first), (3, second), (5, apart)):
        target[c.edge_count + edge] += 2
        assert reconstruct(target, max_iterations=0).flipped_faces == count
    # A boundary edge has no angle, whatever the target says.
    target[c.edge_count :][~c.interior] += 2
    assert reconstruct(target, max_iterations=0).flipped_faces == 5


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200, 1e308])
@pytest.mark.parametrize("half", [0, 1], ids=["length", "angle"])
def test_a_target_that_is_not_finite_or_too_large_to_square_is_refused(mesh, pose, reconstruct, target, half, value):
    if half and np.isfinite(value):
        value = np.nan  # every finite number is a valid angle
    target[half * mesh.connectivity.edge_count + 3] = value
    for start in (None, pose):
        found = reconstruct(target, start)
        assert found.status is Status.NOT_FINITE
        assert found.iterations == 0
        assert found.residual == np.inf
        assert np.isfinite(found.vertices).all()


def test_a_start_that_is_not_finite_is_refused(pose, reconstruct, target):
    pose[5, 1] = np.nan
    found = reconstruct(target, pose)
    assert found.status is Status.NOT_FINITE
    assert np.isfinite(found.vertices).all()


@pytest.mark.parametrize("kind", ["all lengths", "one length", "negative lengths"])
def test_a_hopeless_target_ends_with_finite_vertices_and_no_claim(mesh, reconstruct, target, kind):
    e = mesh.connectivity.edge_count
    target[{"all lengths": slice(e), "one length": 3, "negative lengths": slice(e)}[kind]] = (
        -1e30 if kind == "negative lengths" else 1e30
    )
    found = reconstruct(target, max_iterations=20)
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == 20
    assert np.isfinite(found.vertices).all()
    # A shape with all lengths this large may exist; one with a single such length, or negative ones, doesn't.
    assert found.residual > 0.5 or kind == "all lengths"


def test_shapes_end_within_the_tolerance_of_the_exact_solution(mesh, pose, reconstruct, target, rng):
    for noise in 10 ** rng.uniform(-4, -2, 12):
        noisy = target * (1 + noise * rng.standard_normal(len(target)))
        found, exact = (reconstruct.from_guess(noisy, tolerance=tolerance) for tolerance in (2e-5, 1e-9))
        assert found.converged
        assert exact.converged
        assert np.abs(align(found.vertices, exact.vertices) - exact.vertices).max() < 2e-5 * mesh.diagonal


@pytest.mark.parametrize("precision", ["single", "double"])
def test_where_single_precision_does_not_do_double_does(mesh, pose, reconstruct, target, monkeypatch, precision):
    def refuse(_: object) -> None:
        raise NotPositiveDefiniteError("refused")

    monkeypatch.setattr(getattr(reconstruct.solver, precision), "factorise", refuse)
    assert_found(reconstruct(target, pose + 1e-3 * mesh.diagonal * np.sin(7 * pose)), pose, mesh)


def test_a_target_of_nothing_does_not_converge(reconstruct, target):
    found = reconstruct(0 * target)
    assert found.status is not Status.CONVERGED
    assert found.residual == np.inf
    assert np.isfinite(found.vertices).all()


def test_a_collapsed_start_stalls(mesh, reconstruct, target):
    start = mesh.vertices.copy()
    start[mesh.edges[0, 0]] = start[mesh.edges[0, 1]]
    found = reconstruct(target, start)
    assert found.status is Status.STALLED
    assert found.iterations == 0
    assert np.array_equal(found.vertices, start)


def test_where_the_guess_stalls_others_are_tried(mesh, pose, reconstruct, target, monkeypatch):
    collapsed = pose.copy()
    collapsed[mesh.edges[0, 0]] = collapsed[mesh.edges[0, 1]]
    monkeypatch.setattr("shapespace.coordinates.gauss_newton.GOOD_MISFIT", np.inf)
    monkeypatch.setitem(vars(reconstruct), "integrate", lambda _: collapsed)
    assert reconstruct(target, reconstruct.guess(target)).status is Status.STALLED
    assert_found(reconstruct.from_guess(target), pose, mesh)
    assert reconstruct.from_guess(target, deadline=Deadline(-1)).status is Status.DEADLINE
    # If all guesses stall, the result is that of the first.
    stalled = reconstruct(target, collapsed)
    monkeypatch.setattr(reconstruct, "_iterate", lambda *_: replace(stalled, iterations=5))
    found = reconstruct.from_guess(target, lambda: pose)
    assert np.array_equal(found.vertices, collapsed)
    assert found.iterations == 15


def test_a_step_that_overflows_stalls(mesh, reconstruct, target, monkeypatch):
    """Without a check, the line search would halve it forever."""
    for value in (np.nan, np.inf):
        broken = SimpleNamespace(solve=lambda right, value=value: np.full_like(right, value))
        for cholesky in (reconstruct.solver.single, reconstruct.solver.double):
            monkeypatch.setattr(cholesky, "factorise", lambda _, broken=broken: broken)
        found = reconstruct(target)
        assert found.status is Status.STALLED
        assert np.array_equal(found.vertices, mesh.vertices)


# ---------------------------------------------------------------- limits


def test_after_the_deadline_no_iteration_begins(mesh, pose, reconstruct, target):
    for start in (mesh.vertices, pose):
        found = reconstruct(target, start, deadline=Deadline(-1))
        assert found.status is Status.DEADLINE
        assert found.iterations == 0
        assert np.array_equal(found.vertices, start)
    assert_found(reconstruct(target, deadline=Deadline(1000)), pose, mesh)


def test_one_iteration_is_a_step_on_the_way(mesh, pose, reconstruct, target):
    before = reconstruct(target, max_iterations=0)
    found = reconstruct(target, max_iterations=1)
    assert found.status is Status.ITERATION_LIMIT
    assert found.iterations == 1
    assert 1e-10 < found.residual < before.residual
    assert np.isfinite(found.vertices).all()
    # Continued from there, it ends at the same shape.
    assert_found(reconstruct(target, found.vertices), pose, mesh)


def test_a_coarse_tolerance_ends_sooner(mesh, pose, reconstruct, target):
    coarse, fine = reconstruct(target, tolerance=1e-2), reconstruct(target)
    assert coarse.status is Status.CONVERGED
    assert coarse.iterations < fine.iterations
    assert np.abs(align(coarse.vertices, pose) - pose).max() < 1e-2 * mesh.diagonal


# ---------------------------------------------------------------- derivatives


def test_the_differential_is_how_the_found_shape_moves(mesh, reconstruct, target, rng):
    change = 1e-3 * rng.standard_normal((3, len(target)))  # of lengths and angles that need not be integrable
    at = reconstruct(target, tolerance=1e-10).vertices
    fields = reconstruct.differential(at, change)
    h = 1e-2
    for field, direction in zip(fields, change, strict=True):
        ahead, behind = (reconstruct(target + s * direction, at, tolerance=1e-12).vertices for s in (h, -h))
        expected = (align(ahead, at) - align(behind, at)) / (2 * h)
        moved = (align(at + h * field, at) - align(at - h * field, at)) / (2 * h)
        assert np.abs(moved - expected).max() < 1e-3 * np.abs(expected).max()


def test_the_sensitivity_is_the_transposed_differential(mesh, pose, reconstruct, rng):
    changes = rng.standard_normal((2, 2 * mesh.connectivity.edge_count))
    fields = without_rigid_motion(rng.standard_normal((3, *pose.shape)), pose)
    products = np.einsum("nvx,kvx->kn", reconstruct.differential(pose, changes), fields)
    transposed = reconstruct.sensitivity(pose, fields) @ changes.T
    np.testing.assert_allclose(transposed, products, rtol=1e-5, atol=1e-6 * np.abs(products).max())


def test_a_draft_of_a_shapes_own_lengths_and_angles_is_the_shape(mesh, pose, reconstruct, target):
    draft = reconstruct.draft(target)
    assert draft is not None
    assert draft.residual < 1e-6
    assert np.abs(align(draft.vertices, pose) - pose).max() < 1e-6 * mesh.diagonal


def test_drafts_with_a_small_misfit_stay_and_others_approach_the_improved_shape_continuously(
    mesh, reconstruct, target, rng
):
    unreachable = target + 0.003 * rng.standard_normal(len(target)) * np.abs(target).mean()
    draft, improved = reconstruct.draft(unreachable), reconstruct.draft(unreachable, 1e-2)
    away = [
        np.abs(reconstruct.draft(unreachable, 1e-2, good).vertices - draft.vertices).max()
        for good in draft.residual * np.array([2, 1 / 0.95001, 1.04, 1.02, 1.01, 1, 0.5])
    ]
    whole = np.abs(improved.vertices - draft.vertices).max()
    assert (improved.iterations, draft.iterations) == (1, 0)
    assert away[0] == 0 < away[2] < away[3] < away[4] < away[5] == away[6] == whole
    assert away[1] < 1e-3 * whole


def test_a_draft_of_what_is_no_shape_is_none(mesh, reconstruct, target, rng):
    noise = target + 0.5 * rng.standard_normal(len(target)) * np.abs(target).mean()
    assert reconstruct.draft(noise) is None
