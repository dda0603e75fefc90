"""Both Cholesky backends, compared with dense algebra on normal matrices."""

import importlib.util
import weakref

import numpy as np
import pytest
from scipy import sparse

from shapespace.coordinates.normal_matrix import NormalMatrix, QuadraticForm
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.solve.cholesky import (
    BandedCholesky,
    NotPositiveDefiniteError,
    PardisoCholesky,
    SymmetricPattern,
    analyse,
)
from tests.shapespace.conftest import MESHES, bent

BACKENDS = ["banded", "pardiso"]


@pytest.fixture(params=BACKENDS)
def backend(request):
    return request.param


@pytest.fixture
def pattern(rng):
    """About four entries a row, and some rows with the diagonal only."""
    rows, columns = rng.integers(0, 35, (2, 80))
    return SymmetricPattern(40, rows, columns)


@pytest.fixture
def positive(pattern, rng):
    """A function that draws entries of a diagonally dominant, hence positive definite, matrix."""

    def draw():
        entries = rng.standard_normal(len(pattern))
        entries[pattern.diagonal] = 1 + np.abs(pattern.matrix(entries)).sum(axis=1)
        return entries

    return draw


def normal_matrix(name, form_of=None, pose=None):
    mesh = MESHES[name]()
    pose = bent(mesh.vertices, 0.7) if pose is None else pose
    form = WeightedNorm.of(mesh, 1e-2) if form_of is None else form_of(mesh)
    jacobian = NRICJacobian(mesh.connectivity)
    normal = NormalMatrix(mesh.connectivity)
    return normal, normal.entries(jacobian.gradients(pose), form), jacobian(pose), form, mesh


# ---------------------------------------------------------------- pattern


def test_contributions_add_up_and_those_below_the_diagonal_are_mirrored():
    pattern = SymmetricPattern(3, np.array([0, 1, 1, 0, 2]), np.array([1, 0, 1, 1, 2]))
    entries = pattern.scatter(np.array([1.0, 10, 5, 100, 7]))
    assert pattern.matrix(entries).toarray().tolist() == [[0, 111, 0], [111, 5, 0], [0, 0, 7]]
    # The diagonal is always stored: (0, 0) is there without a contribution.
    assert len(pattern) == 4
    assert pattern.rows.tolist() == [0, 0, 1, 2]
    assert pattern.indices.tolist() == [0, 1, 1, 2]
    assert pattern.indptr.tolist() == [0, 2, 3, 4]
    assert pattern.diagonal.tolist() == [0, 2, 3]


# ---------------------------------------------------------------- solving


def test_solutions_are_those_of_dense_algebra(backend, pattern, positive, rng):
    cholesky = analyse(pattern, backend)
    for _ in range(5):
        entries, right = positive(), rng.standard_normal(40)
        kept = right.copy()
        factor = cholesky.factorise(entries)
        expected = np.linalg.solve(pattern.matrix(entries).toarray(), right)
        np.testing.assert_allclose(factor.solve(right), expected, rtol=1e-10, atol=1e-13)
        assert np.array_equal(right, kept)


def test_several_right_hand_sides_at_once(backend, pattern, positive, rng):
    entries, right = positive(), rng.standard_normal((3, 40))
    factor = analyse(pattern, backend).factorise(entries)
    dense = pattern.matrix(entries).toarray()
    for rows in (right, np.asfortranarray(right), right[:1], rng.integers(-5, 5, (2, 40))):
        found = factor.solve(rows)
        assert found.shape == rows.shape
        np.testing.assert_allclose(found, np.linalg.solve(dense, rows.T).T, rtol=1e-10, atol=1e-13)


def test_single_precision_rounds_more_and_holds_less(backend, pattern, positive, rng):
    entries, right = positive(), rng.standard_normal(40)
    cholesky = analyse(pattern, backend, precision=np.float32)
    found = cholesky.factorise(entries).solve(right)
    assert found.dtype == np.float64
    away = np.linalg.norm(pattern.matrix(entries) @ found - right) / np.linalg.norm(right)
    assert 1e-9 < away < 1e-5
    entries[0] = 1e39  # too large for single precision
    with pytest.raises(NotPositiveDefiniteError, match="not finite"), np.errstate(over="ignore"):
        cholesky.factorise(entries)
    nearly = SymmetricPattern(2, np.array([0]), np.array([1]))
    almost_singular = np.array([1.0, 1.0, 1 + 1e-9])
    analyse(nearly, backend).factorise(almost_singular)
    with pytest.raises(NotPositiveDefiniteError):
        analyse(nearly, backend, precision=np.float32).factorise(almost_singular)


@pytest.mark.parametrize("name", MESHES)
def test_backends_agree_on_normal_matrices(name, rng):
    normal, entries, *_ = normal_matrix(name)
    # Orthogonal to translations, as forces are: on these the matrix is well conditioned enough to compare.
    right = rng.standard_normal((normal.pattern.size // 3, 3))
    right = (right - right.mean(axis=0)).ravel()
    entries[normal.pattern.diagonal] *= 1 + 1e-4
    dense = np.linalg.solve(normal.pattern.matrix(entries).toarray(), right)
    for backend in BACKENDS:
        factor = analyse(normal.pattern, backend).factorise(entries)
        assert np.linalg.norm(factor.solve(right) - dense) < 1e-8 * np.linalg.norm(dense)


def test_one_analysis_serves_many_factors_side_by_side(backend, pattern, positive, rng):
    cholesky = analyse(pattern, backend, factors=3)
    matrices = [positive() for _ in range(3)]
    factors = []
    right = rng.standard_normal(40)

    def check():
        for entries, factor in zip(matrices, factors, strict=True):
            expected = np.linalg.solve(pattern.matrix(entries).toarray(), right)
            np.testing.assert_allclose(factor.solve(right), expected, rtol=1e-10, atol=1e-13)

    for number, entries in enumerate(matrices):
        given = entries.copy()
        factors.append(cholesky.factorise(given, number))
        given[:] = np.nan  # later changes of the matrix don't affect its factor
    check()
    matrices[1] = positive()
    factors[1] = cholesky.factorise(matrices[1], 1)
    check()


def test_two_analyses_do_not_meet(backend, pattern, positive, rng):
    a, b, right = positive(), positive(), rng.standard_normal(40)
    first, second = (analyse(pattern, backend).factorise(entries) for entries in (a, b))
    expected = np.linalg.solve(pattern.matrix(a).toarray(), right)
    del second
    np.testing.assert_allclose(first.solve(right), expected, rtol=1e-10, atol=1e-13)


def test_at_the_end_of_python_mkl_is_left_alone(pattern, positive):
    """MKL may be unloaded before the factors are deleted."""
    cholesky = PardisoCholesky(pattern)
    entries = positive()
    factor = cholesky.factorise(entries)
    cholesky.__del__(finalizing=lambda: True)
    np.testing.assert_allclose(pattern.matrix(entries) @ factor.solve(np.ones(40)), 1, rtol=1e-10)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize("place", [0, 17, 39])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf], ids=["negative", "nan", "inf"])
def test_what_has_no_factor_is_refused_and_harms_no_other(backend, pattern, positive, rng, place, value):
    cholesky = analyse(pattern, backend, factors=2)
    good, right = positive(), rng.standard_normal(40)
    factor = cholesky.factorise(good, 1)
    bad = positive()
    bad[pattern.diagonal[place]] = value
    with pytest.raises(NotPositiveDefiniteError):
        cholesky.factorise(bad, 0)
    expected = np.linalg.solve(pattern.matrix(good).toarray(), right)
    for unharmed in (factor, cholesky.factorise(good, 0)):
        np.testing.assert_allclose(unharmed.solve(right), expected, rtol=1e-10, atol=1e-13)


def test_an_indefinite_matrix_of_positive_diagonal_is_refused(backend):
    pattern = SymmetricPattern(2, np.array([0]), np.array([1]))
    with pytest.raises(NotPositiveDefiniteError):
        analyse(pattern, backend).factorise(np.array([1.0, 2.0, 1.0]))


def test_a_hidden_entry_that_is_not_finite_is_named(backend, pattern, positive):
    entries = positive()
    entries[np.setdiff1d(np.arange(len(pattern)), pattern.diagonal)[3]] = np.nan
    with pytest.raises(NotPositiveDefiniteError, match="not finite"):
        analyse(pattern, backend).factorise(entries)


def test_a_factor_that_has_been_replaced_is_not_taken_for_the_new_one(backend, pattern, positive):
    cholesky, entries, right = analyse(pattern, backend), positive(), np.ones(40)
    old = cholesky.factorise(entries)
    expected = old.solve(right)
    cholesky.factorise(positive())
    if backend == "banded":  # each factor has memory of its own
        assert np.array_equal(old.solve(right), expected)
    else:
        with pytest.raises(RuntimeError, match="replaced"):
            old.solve(right)


def test_a_factor_that_failed_leaves_none_behind(pattern, positive):
    cholesky, entries = PardisoCholesky(pattern), positive()
    old = cholesky.factorise(entries)
    entries[pattern.diagonal[3]] = -1
    with pytest.raises(NotPositiveDefiniteError):
        cholesky.factorise(entries)
    with pytest.raises(RuntimeError, match="replaced"):
        old.solve(np.ones(40))


def test_the_memory_of_factors_is_not_held_by_a_cycle(pattern, positive):
    """MKL's memory is freed with the last factor, not at the next run of the garbage collector."""
    cholesky = PardisoCholesky(pattern)
    factor, gone = cholesky.factorise(positive()), weakref.ref(cholesky)
    del cholesky
    assert gone() is not None
    del factor
    assert gone() is None


def test_pardiso_is_taken_where_it_is_installed(pattern, monkeypatch):
    assert isinstance(analyse(pattern, "banded"), BandedCholesky)
    assert isinstance(analyse(pattern, "pardiso"), PardisoCholesky)
    assert isinstance(analyse(pattern), PardisoCholesky)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert isinstance(analyse(pattern), BandedCholesky)


# ---------------------------------------------------------------- JᵀHJ


def any_form(mesh):
    """Random blocks that couple the lengths of each face, and random weights of angles."""
    rng = np.random.default_rng(3)
    c = mesh.connectivity
    roots = rng.standard_normal((3, 3, len(c.faces)))
    return QuadraticForm(
        np.einsum("ikf,jkf->ijf", roots, roots), np.where(c.interior, rng.uniform(0.5, 2, c.edge_count), 0)
    )


def assert_is_product(entries, normal, jacobian, weights):
    product = (jacobian.T @ weights @ jacobian).toarray()
    found = normal.pattern.matrix(entries).toarray()
    np.fill_diagonal(product, np.diag(product) + normal.REGULARISATION * np.diag(product).mean())
    np.testing.assert_allclose(found, product, rtol=0, atol=1e-13 * np.abs(product).max())


@pytest.mark.parametrize("name", MESHES)
def test_the_normal_matrix_of_a_norm_is_the_sparse_product(name):
    normal, entries, jacobian, _, mesh = normal_matrix(name)
    assert_is_product(entries, normal, jacobian, sparse.diags_array(WeightedNorm.of(mesh, 1e-2).squared))


@pytest.mark.parametrize("name", MESHES)
def test_the_normal_matrix_of_any_form_is_the_sparse_product(name):
    normal, entries, jacobian, form, mesh = normal_matrix(name, any_form)
    e = mesh.connectivity.edge_count
    weights = sparse.lil_array((2 * e, 2 * e))
    for f, edges in enumerate(mesh.connectivity.face_edges):
        for i in range(3):
            for j in range(3):
                weights[edges[i], edges[j]] += form.faces[i, j, f]
    weights.setdiag(weights.diagonal() + np.concatenate([np.zeros(e), form.angles]))
    assert_is_product(entries, normal, jacobian, weights.tocsr())


def test_the_pattern_stays_where_entries_cancel(backend):
    """A flat square in the x-y plane: angles depend on z only; sparse products would drop other entries."""
    flat = TriangleMesh.from_arrays([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    normal = NormalMatrix(flat.connectivity)
    jacobian = NRICJacobian(flat.connectivity)
    form = WeightedNorm.of(flat, 1.0)
    symmetric = normal.entries(jacobian.gradients(flat.vertices), form)
    assert len(symmetric) == len(normal.pattern) == 12 * 13 / 2
    assert (symmetric == 0).sum() > 20
    # The symbolic analysis is the same for every shape.
    cholesky = analyse(normal.pattern, backend)
    other = flat.vertices + 0.1 * np.random.default_rng(0).standard_normal((4, 3))
    for shape in (flat.vertices, other, flat.vertices):
        entries = normal.entries(jacobian.gradients(shape), form)
        factor = cholesky.factorise(entries)
        right = normal.pattern.matrix(entries) @ np.arange(12.0)
        assert np.abs(normal.pattern.matrix(entries) @ factor.solve(right) - right).max() < 1e-6
