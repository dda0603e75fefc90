"""Modes of an ellipsoid with three bumps that move independently of each other."""

from dataclasses import dataclass, replace
from typing import get_args

import numpy as np
import pytest
import trimesh
from scipy.optimize import lsq_linear

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm, unwrap
from shapespace.mesh.rigid_motion import align, rigid_motions, without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh, vertex_areas
from shapespace.shell.exponential import exponential
from shapespace.shell.geodesic import geodesic
from shapespace.shell.space import ShellSpace
from shapespace.solve.outcome import Status
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space import logarithms as search
from shapespace.training.space import sparse_modes
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.modes import (
    ModeError,
    Modes,
    Norm,
    left_of_held_out,
    localisation,
    mode_count,
    pga,
)
from shapespace.training.space.related import Related
from shapespace.training.space.sparse_modes import _fit_in_box, spga
from tests.shapespace.conftest import bent


@dataclass(frozen=True)
class Bumps:
    """Fields (n, V, 3), mixtures of three known ones (3, V, 3) without common edges, about equally strong."""

    space: ShellSpace
    mean: FloatArray
    planted: FloatArray
    fields: FloatArray
    misfit: Norm

    def inner(self, a: FloatArray, b: FloatArray) -> FloatArray:
        """Inner products (n, k) of fields (n, V, 3) and (k, V, 3), in the norm of the misfit."""
        if self.misfit == "shell":
            return self.inner_shell(a, b)
        if self.misfit == "vertices":
            return self.inner_vertices(a, b)
        ratio = (
            self.inner_vertices(self.fields, self.fields).trace() / self.inner_shell(self.fields, self.fields).trace()
        )
        return self.inner_vertices(a, b) + 0.1 * ratio * self.inner_shell(a, b)

    def inner_shell(self, a: FloatArray, b: FloatArray) -> FloatArray:
        return np.array([[self.space.inner(self.mean, x, y) for y in b] for x in a])

    def inner_vertices(self, a: FloatArray, b: FloatArray) -> FloatArray:
        areas = np.repeat(vertex_areas(self.mean, self.space.connectivity.faces), 3)
        root = np.sqrt(areas / areas.mean())
        q = np.linalg.qr((rigid_motions(self.mean) * root).T)[0]
        a, b = (root * fields.reshape(len(fields), -1) for fields in (a, b))
        return (a - a @ q @ q.T) @ b.T

    def length(self, d: FloatArray) -> float:
        return float(np.sqrt(self.inner(d[None], d[None])[0, 0]))

    def pga(self, fields: FloatArray, count: int) -> Modes:
        return pga(self.space, self.mean, fields, count, self.misfit)

    def spga(self, fields: FloatArray, count: int, sparsity: float, **options: float) -> Modes:
        return spga(self.space, self.mean, fields, count, sparsity, self.misfit, **options)

    def cosines(self, a: FloatArray, b: FloatArray) -> FloatArray:
        lengths = [np.sqrt(self.inner(x, x).diagonal()) for x in (a, b)]
        return np.abs(self.inner(a, b)) / np.outer(*lengths)

    @property
    def norm(self) -> WeightedNorm:
        return WeightedNorm.of(self.space.reference, self.space.material.eta)


@pytest.fixture(scope="module")
def mixed() -> Bumps:
    """For what does not depend on the norm, or hardly."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    bumpy = 1 + 0.1 * np.sin(ball.vertices @ [3.0, 5.0, 7.0])
    mesh = TriangleMesh.from_arrays(ball.vertices * [2, 1, 1] * bumpy[:, None], ball.faces)
    x = mesh.vertices
    space = ShellSpace(mesh)
    planted = np.zeros((3, *x.shape))
    for field, centre in zip(planted, x[[x[:, 0].argmin(), x[:, 0].argmax(), x[:, 2].argmax()]], strict=True):
        height = np.maximum(0, 1 - np.square(x - centre).sum(axis=1) / 0.7**2)
        field += 0.1 * height[:, None] * centre / np.linalg.norm(centre)
        field /= space.norm(x, field)
    mixing = np.random.default_rng(3).uniform(-1, 1, (14, 3)) * [1, 1.02, 0.98]
    return Bumps(space, x, planted, without_rigid_motion(np.tensordot(mixing, planted, 1), x), "mixed")


@pytest.fixture(scope="module", params=get_args(Norm))
def bumps(mixed: Bumps, request: pytest.FixtureRequest) -> Bumps:
    return replace(mixed, misfit=request.param)


@pytest.fixture(scope="module")
def plain(bumps: Bumps) -> Modes:
    return bumps.pga(bumps.fields, 3)


@pytest.fixture(scope="module")
def sparse(bumps: Bumps) -> Modes:
    return bumps.spga(bumps.fields, 3, 0.02)


def test_sparse_modes_are_the_bumps_that_plain_ones_mix(bumps, plain, sparse):
    assert bumps.cosines(plain.vertices, bumps.planted).max(axis=1).max() < 0.95
    found = bumps.cosines(sparse.vertices, bumps.planted)
    assert found.max(axis=1).min() > 0.999
    assert sorted(found.argmax(axis=1)) == [0, 1, 2]
    assert localisation(sparse.nric, bumps.norm).mean() < 0.5 * localisation(plain.nric, bumps.norm).mean()


def test_plain_modes_are_the_best_subspace(bumps, rng):
    fields = bumps.fields + 0.05 * rng.standard_normal(bumps.fields.shape)
    fields = without_rigid_motion(fields, bumps.mean)
    bumps = replace(bumps, fields=fields)
    modes = bumps.pga(fields, 2)
    values = np.sort(np.linalg.eigvalsh(bumps.inner(fields, fields)))[::-1]
    assert modes.explained == pytest.approx(values[:2].sum() / values.sum(), rel=1e-9)
    gram = bumps.inner(modes.vertices, modes.vertices)
    assert abs(gram[0, 1]) < 1e-9 * gram[0, 0]


def test_coefficients_are_orthogonal_projections(bumps, sparse):
    left = bumps.fields - np.tensordot(sparse.coefficients, sparse.vertices, 1)
    assert np.abs(bumps.inner(left, sparse.vertices)).max() < 1e-9
    whole = bumps.inner(bumps.fields, bumps.fields).trace()
    assert sparse.explained == pytest.approx(1 - bumps.inner(left, left).trace() / whole, rel=1e-9)


def test_without_sparsity_the_plain_subspace_is_found(bumps, rng):
    fields = without_rigid_motion(bumps.fields + 0.02 * rng.standard_normal(bumps.fields.shape), bumps.mean)
    plain = bumps.pga(fields, 3)
    modes = bumps.spga(fields, 3, 0)
    assert modes.explained == pytest.approx(plain.explained, rel=1e-9)
    assert modes.history[-1]["objective"] == pytest.approx(1 - plain.explained, rel=1e-6)
    both = np.concatenate([modes.vertices, plain.vertices])
    both /= np.sqrt(bumps.inner(both, both).diagonal())[:, None, None]
    assert np.linalg.eigvalsh(bumps.inner(both, both))[:3].max() < 1e-6


def test_the_start_is_concentrated_already(bumps, plain, sparse):
    assert sparse.history[0]["misfit"] == pytest.approx(0, abs=1e-9)
    assert sparse.history[0]["support"] < 0.7 * localisation(plain.nric, bumps.norm).mean()


@pytest.mark.parametrize("sparsity", [0.1, 0.4])
def test_the_objective_never_rises_and_is_that_of_the_problem(bumps, sparsity):
    modes = bumps.spga(bumps.fields, 3, sparsity)
    objective = np.array([h["objective"] for h in modes.history])
    assert (np.diff(objective) <= 1e-12).all()
    assert objective[-1] < 0.9 * objective[0]
    assert modes.converged
    assert all(h["misfit"] + h["penalty"] == pytest.approx(h["objective"]) for h in modes.history)
    assert modes.history[-1]["misfit"] >= 1 - modes.explained - 1e-9


def test_modes_that_are_solved_together_are_no_worse_than_one_after_the_other(mixed, rng, monkeypatch):
    """One after the other, with ten iterations each, was the search of version 0.2."""
    mixing, noise = rng.uniform(-1, 1, (30, 3)), 0.3 * rng.standard_normal((30, 6)) @ rng.standard_normal((6, 486))
    fields = np.tensordot(mixing, mixed.planted, 1) + 0.01 * noise.reshape(30, 162, 3)
    fields = without_rigid_motion(fields, mixed.mean)
    together = mixed.spga(fields, 9, 0.1)
    assert max(map(len, sparse_modes._groups(*_gram(mixed, together)))) > 1
    monkeypatch.setattr(sparse_modes, "TOGETHER", 1)
    monkeypatch.setattr(sparse_modes, "ADMM_ITERATIONS", 10)
    alone = mixed.spga(fields, 9, 0.1)
    tolerance = sparse_modes.TOLERANCE[mixed.misfit]
    assert together.history[-1]["objective"] <= (1 + tolerance) * alone.history[-1]["objective"]


def test_coupled_modes_that_are_solved_together_never_raise_the_objective(mixed):
    """With equal coefficients, each mode alone would make good the whole of what is missing."""
    problem = sparse_modes._SparseProblem(mixed.space, mixed.mean, mixed.fields, 3, mixed.misfit)
    D, W, price = problem.principal(3)[0] / 10, np.ones((3, 14)), 1e-6

    def objective() -> float:
        left = problem.D - W.T @ D
        return float(np.vdot(left.T, problem.M @ left.T) + price * problem.one_norms(D).sum())

    before = objective()
    sparse_modes._improve(problem, sparse_modes._Shrinkage(problem, D), D, W, np.arange(3), price)
    assert objective() < before


def _gram(bumps: Bumps, modes: Modes) -> tuple[FloatArray, FloatArray]:
    return bumps.inner(modes.vertices, modes.vertices), modes.coefficients.T


def test_modes_are_as_sparse_as_shapes_that_are_held_out_allow(bumps, rng):
    """Sparsity adds at most 2 % to the error of held-out shapes; without such an error it is small."""
    fields = without_rigid_motion(bumps.fields + 0.02 * rng.standard_normal(bumps.fields.shape), bumps.mean)
    exact, noisy = bumps.spga(bumps.fields, 3, None), bumps.spga(fields, 3, None)
    assert exact.sparsity < noisy.sparsity < 0.2
    judged: Norm = "shell" if bumps.misfit == "shell" else "vertices"
    seen = replace(bumps, misfit=judged)

    def unseen(sparsity: float | None) -> float:
        """Return the mean error of held-out fields; of principal modes in the norm of errors without a sparsity."""
        errors = []
        for held in (np.arange(part, len(fields), 5) for part in range(3)):
            kept = np.delete(fields, held, axis=0)
            found = seen.pga(kept, 3) if sparsity is None else bumps.spga(kept, 3, sparsity)
            inner = seen.inner(fields[held], found.vertices)
            within = np.linalg.solve(seen.inner(found.vertices, found.vertices), inner.T).T
            errors.append(np.sqrt(seen.inner(fields[held], fields[held]).diagonal() - (inner * within).sum(axis=1)))
        return float(np.concatenate(errors).mean())

    plain = unseen(None)
    assert unseen(noisy.sparsity) <= 1.025 * plain
    assert unseen(4 * noisy.sparsity) > 1.02 * plain


def test_modes_are_dense_where_every_sparsity_costs_too_much(mixed, monkeypatch):
    monkeypatch.setattr(sparse_modes, "SPARSITIES", (0.5,))
    tried = []
    alternate = sparse_modes._alternate
    monkeypatch.setattr(sparse_modes, "_alternate", lambda *given: tried.append(given) or alternate(*given))
    found = mixed.spga(mixed.fields, 3, None)
    assert found.sparsity == 0
    assert len(tried) <= 3, "one trial for each fold, and no search"


def test_an_iteration_cut_short_says_so(mixed):
    modes = mixed.spga(mixed.fields, 3, 0.1, max_iterations=4)
    assert not modes.converged
    assert len(modes.history) == 5


def test_one_mode_of_one_shape_is_a_minimum(bumps, rng):
    """The problem is convex then, min ‖u − v‖² + λ ‖u‖_1, and no tangent vector is better than the result."""
    v, share, eta = bumps.fields[0], 0.3, bumps.space.material.eta
    bumps = replace(bumps, fields=v[None])
    lengths, bending = np.sqrt(bumps.norm.squared.reshape(2, -1))
    weights = np.concatenate([lengths, np.sqrt(eta) * bending])

    def one_norm(d: FloatArray) -> float:
        return float(weights @ np.abs(bumps.space.point(bumps.mean).push_forward(d)))

    whole = bumps.length(v) ** 2
    price = share * 2 * whole / one_norm(v)

    def best_multiple(d: FloatArray) -> float:
        """The least objective of all multiples of d, as a share of ‖v‖²."""
        along = bumps.inner(v[None], d[None])[0, 0]
        gain = max(abs(along) - price * one_norm(d) / 2, 0) ** 2
        return 1 - gain / bumps.length(d) ** 2 / whole

    modes = bumps.spga(v[None], 1, share, tolerance=1e-9, max_iterations=400)
    found = best_multiple(modes.vertices[0])
    assert modes.history[-1]["objective"] == pytest.approx(found, abs=1e-6)
    assert found < best_multiple(v) - 1e-3
    others = [*bumps.planted, v, *(rng.standard_normal(v.shape) * np.abs(v) for _ in range(20))]
    for other in others:
        other = other / bumps.length(other) * np.sqrt(whole)
        for step in (-0.1, -1e-3, 1e-3, 0.1):
            assert best_multiple(modes.vertices[0] + step * other) > found - 1e-6


def test_coefficients_stay_in_the_box_and_are_best_there(rng):
    basis, targets = rng.standard_normal((9, 4)), 2 * rng.standard_normal((9, 6))
    found = np.zeros((4, 6))
    _fit_in_box(basis.T @ basis, basis.T @ targets, found)
    assert np.abs(found).max() == 1
    best = np.stack([lsq_linear(basis, b, (-1, 1)).x for b in targets.T], axis=1)
    assert found == pytest.approx(best, abs=1e-6)


@pytest.mark.parametrize("which", ["plain", "sparse"])
def test_modes_are_tangent_and_do_not_move_rigidly(bumps, which, request):
    modes = request.getfixturevalue(which)
    for u, d in zip(modes.nric, modes.vertices, strict=True):
        assert bumps.space.point(bumps.mean).push_forward(d) == pytest.approx(u, abs=1e-12)
        assert bumps.space.project(bumps.mean, u) == pytest.approx(d, abs=1e-6 * np.abs(d).max())
        assert np.abs(rigid_motions(bumps.mean) @ d.ravel()).max() < 1e-12


@pytest.mark.parametrize("which", ["plain", "sparse"])
def test_modes_are_scaled_oriented_and_sorted(bumps, which, request):
    modes = request.getfixturevalue(which)
    assert modes.coefficients.shape == (14, 3)
    assert modes.coefficients.max(axis=0) == pytest.approx(np.ones(3))
    assert np.abs(modes.coefficients).max() <= 1 + 1e-12
    energies = (modes.coefficients**2).sum(axis=0) * bumps.inner(modes.vertices, modes.vertices).diagonal()
    assert (np.diff(energies) < 0).all()


def test_directions_that_shapes_do_not_have_give_no_modes(bumps, plain):
    modes = bumps.pga(bumps.fields, 7)
    assert len(modes) == 3
    assert modes.vertices == pytest.approx(plain.vertices, abs=1e-9)
    assert len(bumps.spga(bumps.fields, 7, 0.02)) == 3


def test_a_high_price_leaves_fewer_modes_and_then_none(mixed):
    weak = np.concatenate([mixed.fields, 0.05 * (mixed.planted[:1] - mixed.planted[1:2])])
    first = mixed.planted[:1] / mixed.length(mixed.planted[0])
    weak[:-1] -= np.tensordot(mixed.inner(weak[:-1], first)[:, 0], first[0], 0)
    assert len(mixed.spga(weak, 3, 1e-3)) == 3
    assert len(mixed.spga(weak, 3, 0.5)) == 2
    with pytest.raises(ModeError, match="sparsity is too high"):
        mixed.spga(mixed.fields, 3, 50)


def test_sparsity_means_the_same_in_other_units_and_for_twice_the_shapes_and_nothing_is_random(mixed):
    larger = ShellSpace(mixed.space.reference.with_vertices(3 * mixed.mean))
    smaller_twice = 0.1 * np.concatenate([mixed.fields, mixed.fields])
    modes, again, same = (
        spga(larger, 3 * mixed.mean, 3 * smaller_twice, 3, 0.02, mixed.misfit),
        *(mixed.spga(mixed.fields, 3, 0.02) for _ in range(2)),
    )
    assert modes.coefficients[:14] == pytest.approx(again.coefficients, abs=1e-4)
    assert modes.history[-1]["objective"] == pytest.approx(again.history[-1]["objective"], rel=1e-4)
    assert (again.vertices == same.vertices).all()
    assert (again.coefficients == same.coefficients).all()


def test_localisation_counts_edges(mixed):
    e = mixed.space.connectivity.edge_count
    nric = np.zeros((2, 2 * e))
    nric[0, 5] = 3
    nric[1] = 1 / np.sqrt(mixed.norm.squared)
    assert localisation(nric, mixed.norm) == pytest.approx([1 / e, 0.95], abs=1.01 / e)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"count": 0}, "from 1 to the number of shapes, 14, not 0"),
        ({"count": 15}, "from 1 to the number of shapes, 14, not 15"),
        ({"fields": np.zeros((3, 7, 3))}, r"fields must be \(n, 162, 3\), not \(3, 7, 3\)"),
        ({"fields": np.zeros((3, 162, 3))}, "all shapes are the same as the mean"),
        ({"fields": np.full((3, 162, 3), np.nan)}, "not finite"),
    ],
)
def test_what_is_not_possible_is_refused(mixed, change, message):
    settings = {"fields": mixed.fields, "count": 3, "sparsity": 0.1} | change
    with pytest.raises(ModeError, match=message):
        mixed.spga(**settings)


def test_logarithms_lead_back_to_the_shapes_wherever_they_are(mixed, rng):
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    shapes = (mixed.mean + 0.3 * mixed.fields[:2]) @ (turn * np.linalg.det(turn)) + [1, 2, 3]
    found = logarithms(mixed.space, mixed.mean, shapes, 4, workers=1)
    assert found.status == (Status.CONVERGED,) * 2
    assert found.steps == (4, 4)
    assert found.fallbacks == []
    for shape, field in zip(shapes, found.fields, strict=True):
        assert np.abs(rigid_motions(mixed.mean) @ field.ravel()).max() < 1e-12
        end = exponential(mixed.space, mixed.mean, field, 4).vertices[-1]
        assert align(end, mixed.mean) == pytest.approx(align(shape, mixed.mean), abs=1e-4)


def test_processes_give_what_one_gives(mixed):
    shapes = mixed.mean + 0.1 * mixed.fields[:5]
    here = logarithms(mixed.space, mixed.mean, shapes, 4, workers=1)
    there = logarithms(mixed.space, mixed.mean, shapes, 4, workers=2)
    assert (here.fields == there.fields).all()
    assert here.reasons == there.reasons == ("",) * 5


def test_far_shapes_are_reached_by_way_of_their_neighbours():
    """From a rod rolled up one way to rods rolled the other way; the straight lines degenerate on the way."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    rod = TriangleMesh.from_arrays(ball.vertices * [4, 0.5, 0.5], ball.faces)
    space, start = ShellSpace(rod), bent(rod.vertices, -7)
    shapes = np.stack([bent(rod.vertices, angle) for angle in (4, -1, 1)])
    straight = [geodesic(space, start, shape, 8, tolerance=1e-6, bisect=False) for shape in shapes]
    assert [path.converged for path in straight] == [False, True, False]
    found = logarithms(space, start, shapes, 8, workers=1)
    assert found.status == (Status.CONVERGED,) * 3
    # The longest path may need twice as many steps.
    assert found.steps[1:] == (8, 8)
    assert found.steps[0] in (8, 16)
    assert found.via[1] == -1
    assert found.via[0] >= 0 <= found.via[2]
    assert [bool(reason) for reason in found.reasons] == [True, False, True]
    for shape, field, steps in zip(shapes, found.fields, found.steps, strict=True):
        end = exponential(space, start, field, steps)
        assert end.converged
        assert align(end.vertices[-1], shape) == pytest.approx(shape, abs=1e-3 * rod.diagonal)
        # A path with a detour or across a fold would be longer than the distance of the shapes.
        whole = geodesic(space, start, shape, steps, tolerance=1e-6, first=end.vertices)
        assert space.norm(start, field) == pytest.approx(np.sqrt(whole.energy), rel=0.3)


def test_where_there_is_no_geodesic_the_logarithm_is_linearised(mixed, rng):
    crumpled = mixed.mean + 0.8 * rng.standard_normal(mixed.mean.shape)
    i, j, k = mixed.space.connectivity.faces[7]
    crumpled[[i, j, k]] = [[0, 0, 0], [1, 0, 0], [3, 0, 0]]  # a face without area
    found = logarithms(mixed.space, mixed.mean, np.stack([crumpled, mixed.mean + 0.1 * mixed.fields[0]]), 4, workers=1)
    assert found.fallbacks == [0]
    assert found.steps == (0, 4)
    assert found.status[0] is not Status.CONVERGED
    assert found.reasons[0]
    assert found.reasons[1] == ""
    z = mixed.space.nric(mixed.mean)
    assert (found.fields[0] == mixed.space.project(mixed.mean, unwrap(mixed.space.nric(crumpled), z) - z)).all()


@pytest.mark.parametrize(("hard", "attempts"), [(2, 4), (3, 2)])
def test_a_search_that_fails_for_nearly_all_of_many_shapes_ends(mixed, rng, monkeypatch, hard, attempts):
    """With few shapes all attempts are made: from the one neighbour, and with twice as many steps."""
    made = []

    def counted(*given):
        made.append(given)
        return tried(*given)

    tried = search._from_neighbour
    monkeypatch.setattr(search, "_from_neighbour", counted)
    monkeypatch.setattr(search, "AT_A_TIME", 2)
    crumpled = mixed.mean + 0.8 * rng.standard_normal((hard, *mixed.mean.shape))
    shapes = np.concatenate([[mixed.mean + 0.1 * mixed.fields[0]], crumpled])
    found = logarithms(mixed.space, mixed.mean, shapes, 4, workers=1)
    assert found.fallbacks == list(range(1, hard + 1))
    assert len(made) == attempts


def test_a_shape_that_is_not_finite_has_no_logarithm(mixed):
    shapes = np.stack([mixed.mean, np.where(np.arange(3) == 1, np.nan, mixed.mean)])
    with pytest.raises(ModeError, match="shape 1 has a coordinate that is not finite"):
        logarithms(mixed.space, mixed.mean, shapes, 4, workers=1)


def test_a_shape_and_its_mirror_image_are_held_out_together(mixed: Bumps) -> None:
    """The count of modes of each logarithm twice is that of each once; held out alone, each would be known already."""
    rng = np.random.default_rng(5)
    noisy = mixed.fields + 0.3 * np.abs(mixed.fields).max() * rng.normal(size=mixed.fields.shape)
    twice, images = np.concatenate([noisy, noisy]), Related.images(np.tile(np.arange(len(noisy)), 2))
    once = mode_count(ModeSettings(), mixed.space, mixed.mean, noisy).count
    assert mode_count(ModeSettings(), mixed.space, mixed.mean, twice, images).count == once
    assert mode_count(ModeSettings(), mixed.space, mixed.mean, twice).count > once


@pytest.mark.parametrize("origin", [0.0, 3.0, None])
def test_inner_folds_know_nothing_of_what_is_held_out(origin: float | None) -> None:
    """Wherever the origin lies, errors are those of principal components about the mean of the other rows."""
    rows = np.random.default_rng(0).standard_normal((12, 30)) + 1
    about = rows - (rows.mean(axis=0) if origin is None else origin)
    related = Related.none(len(rows))
    left = left_of_held_out(about @ about.T, related)
    for held, kept in related.inner_folds():
        mean = rows[kept].mean(axis=0)
        components = np.linalg.svd(rows[kept] - mean, full_matrices=False)[2]
        for count in (0, 1, 3, len(kept) - 1):
            away = rows[held] - mean
            away = away - away @ components[:count].T @ components[:count]
            assert left[held, count] == pytest.approx((away**2).sum(axis=1))
