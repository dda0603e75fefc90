"""Prolongation: the fine surface computed from a coarse one."""

import io

import numpy as np
import pytest

from shapespace.mesh.coarsening import coarsen
from shapespace.mesh.prolongation import Prolongation, ProlongationError, nearest_counts
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from tests.shapespace.conftest import MESHES, bent, grid_faces
from tests.shapespace.mesh.test_coarsening import fine_mesh


class Pair:
    """A fine mesh, a coarse one on some of its vertices, and the prolongation between them."""

    def __init__(self, fine: TriangleMesh) -> None:
        self.fine = fine
        found = coarsen(fine, len(fine.vertices) // 4, bent(fine.vertices, 1.0)[None])
        self.index = found.fine_index
        self.coarse = TriangleMesh.from_arrays(fine.vertices[self.index], found.faces)
        self.prolong = Prolongation.of(self.coarse, fine)


@pytest.fixture(params=MESHES, scope="module")
def pair(request: pytest.FixtureRequest) -> Pair:
    return Pair(fine_mesh(request.param))


@pytest.fixture(scope="module")
def shape(pair: Pair) -> np.ndarray:
    return bent(pair.fine.vertices, 1.3)


def test_exact_at_rest_and_at_the_coarse_vertices(pair, shape):
    np.testing.assert_allclose(pair.prolong(pair.coarse.vertices), pair.fine.vertices, atol=1e-12)
    np.testing.assert_allclose(pair.prolong(shape[pair.index])[pair.index], shape[pair.index], atol=1e-12)
    np.testing.assert_array_equal(pair.prolong.coarse_vertices, pair.index)


def test_every_fine_vertex_counts_for_its_nearest_coarse_vertex(pair):
    counts = nearest_counts(pair.fine.vertices, pair.index)
    distances = np.linalg.norm(pair.fine.vertices[:, None] - pair.coarse.vertices, axis=2)
    own = [np.isclose(row, row.min(), atol=1e-12) for row in distances]
    most, fewest = np.sum(own, axis=0), np.sum([row & (row.sum() == 1) for row in own], axis=0)
    assert counts.sum() == len(pair.fine.vertices)
    assert (np.maximum(fewest, 1) <= counts).all()
    assert (counts <= most).all()


def test_moves_rigidly_and_grows_with_the_shape(pair, shape, move):
    coarse = shape[pair.index]
    both = move(np.concatenate([coarse, pair.prolong(coarse)]))
    np.testing.assert_allclose(pair.prolong(both[: len(coarse)]), both[len(coarse) :], atol=1e-11)
    np.testing.assert_allclose(pair.prolong(2.5 * coarse), 2.5 * pair.prolong(coarse), atol=1e-11)


@pytest.fixture(scope="module")
def fitted(pair: Pair) -> Prolongation:
    """The prolongation fitted to bends by other angles than the shape's."""
    fine = np.stack([bent(pair.fine.vertices, angle) for angle in (0.4, 0.8, 1.1, 1.6, 9.0)])
    some = np.arange(0, len(pair.fine.vertices), 2)
    return pair.prolong.fitted(fine[:, pair.index], fine, some, np.arange(4))


def test_fitted_weights_come_nearer_to_shapes_that_they_were_not_fitted_to(pair, shape, fitted):
    coarse = shape[pair.index]
    before, after = (np.linalg.norm(each(coarse) - shape, axis=1)[::2].mean() for each in (pair.prolong, fitted))
    assert after < 0.5 * before
    # The others are not affected.
    np.testing.assert_array_equal(fitted(coarse)[1::2], pair.prolong(coarse)[1::2])


def test_fitted_weights_move_with_the_shape_and_keep_coarse_vertices(pair, shape, fitted, move):
    coarse = shape[pair.index]
    both = move(np.concatenate([coarse, fitted(coarse)]))
    np.testing.assert_allclose(fitted(both[: len(coarse)]), both[len(coarse) :], atol=1e-11)
    np.testing.assert_allclose(fitted(2.5 * coarse), 2.5 * fitted(coarse), atol=1e-11)
    np.testing.assert_array_equal(fitted.coarse_vertices, pair.index)


@pytest.fixture(scope="module")
def detailed(pair: Pair) -> tuple[Prolongation, np.ndarray]:
    """A prolongation with detail, learned from all but the first of the shapes. Detail follows their length."""
    x = pair.fine.vertices
    rough = 0.02 * np.random.default_rng(1).standard_normal(x.shape)
    rough[pair.index] = 0
    lengths = np.array([1.25, 0.7, 0.9, 1.1, 1.2, 1.4])
    shapes = np.stack([x * [length, 1, 1] + (length - 1) * rough for length in lengths])
    every = np.arange(len(x))
    coarse = shapes[:, pair.index]
    return pair.prolong.detailed(pair.coarse.vertices, coarse, shapes, every, np.arange(1, 6), 1e-6), shapes


def test_detail_that_follows_the_whole_shape_returns_on_an_unseen_shape(pair, detailed, move):
    found, shapes = detailed
    coarse = shapes[0, pair.index]
    before, after = (np.linalg.norm(each(coarse) - shapes[0], axis=1).mean() for each in (pair.prolong, found))
    assert after < 0.1 * before
    np.testing.assert_allclose(found(pair.coarse.vertices), pair.fine.vertices, atol=1e-9)
    np.testing.assert_allclose(found(coarse)[pair.index], coarse, atol=1e-9)
    both = move(np.concatenate([coarse, found(coarse)]))
    np.testing.assert_allclose(found(both[: len(coarse)]), both[len(coarse) :], atol=1e-6)
    again = Prolongation.from_arrays(found.arrays())
    np.testing.assert_allclose(again(coarse), found(coarse), atol=1e-6)


def test_detail_of_another_form_is_refused(pair, detailed):
    arrays = detailed[0].arrays()
    names = [name for name in arrays if "detail" in name]
    assert len(names) == 3
    for name in names:
        with pytest.raises(ProlongationError, match=f"there is no array {name}"):
            Prolongation.from_arrays({key: array for key, array in arrays.items() if key != name})
        with pytest.raises(ProlongationError, match=r"detail_rest must be \("):
            Prolongation.from_arrays(arrays | {name: arrays[name][:-1]})
        with pytest.raises(ProlongationError, match="not finite"):
            Prolongation.from_arrays(arrays | {name: arrays[name] * np.nan})


def test_fitting_to_what_a_prolongation_does_changes_nothing(pair, shape):
    shapes = np.stack([shape, bent(pair.fine.vertices, 0.7)])[:, pair.index]
    again = pair.prolong.fitted(shapes, pair.prolong(shapes), np.arange(pair.prolong.vertex_count), np.arange(2))
    np.testing.assert_allclose(again.weights.data, pair.prolong.weights.data, atol=1e-12)


def test_follows_affine_maps_of_flat_places_exactly():
    """In a plane the local affine maps are the global map itself, stretch and shear included."""
    mesh = MESHES["sheet"]()
    flat = TriangleMesh.from_arrays(mesh.vertices * [1, 1, 0], mesh.faces)
    pair = Pair(flat)
    squeezed = flat.vertices @ [[1.4, 0, 0], [0.3, 0.8, 0], [0, 0, 1]]
    np.testing.assert_allclose(pair.prolong(squeezed[pair.index]), squeezed, atol=1e-12)


def tube(around: int, along: int) -> TriangleMesh:
    t, x = np.meshgrid(np.arange(around) * 2 * np.pi / around, np.linspace(-2, 2, along), indexing="ij")
    t = t + 0.2 * x  # so that no two vertices of the coarse mesh have the same angle
    vertices = np.stack([x, 0.4 * np.cos(t), 0.4 * np.sin(t)], -1).reshape(-1, 3)
    return TriangleMesh.from_arrays(vertices, grid_faces(around, along, around_u=True, around_v=False)[:, ::-1])


def test_a_bent_limb_stays_round():
    fine, coarse = tube(32, 65), tube(8, 17)
    prolong = Prolongation.of(coarse, fine)
    angle, radius = 2.0, 4 / 2.0
    found, exact = prolong(bent(coarse.vertices, angle)), bent(fine.vertices, angle)
    ring = np.hypot(found[:, 0], found[:, 2] - radius)  # distance from the centre of the bend
    around = np.hypot(ring - radius, found[:, 1])  # and from the limb's axis
    inner = np.abs(fine.vertices[:, 0]) < 1.7
    np.testing.assert_allclose(around[inner], 0.4, atol=0.012)
    assert np.linalg.norm(found - exact, axis=1)[inner].max() < 0.015
    # Flat facets would be this far inside the tube.
    assert 0.4 * (1 - np.cos(np.pi / 8)) > 0.03


def test_neighbours_in_space_that_are_far_on_the_surface_do_not_stick():
    """A strip folded onto itself, its ends almost touching, opens."""
    fine, coarse = strip(61, 7), strip(16, 4)
    closed, opened = (fold(mesh, gap) for mesh, gap in ((fine, 0.02), (fine, 3.0)))
    prolong = Prolongation.of(fold(coarse, 0.02), closed)
    found = prolong(fold(coarse, 3.0).vertices)
    halves = np.abs(fine.vertices[:, 0]) > 0.6
    assert np.linalg.norm(found - opened.vertices, axis=1)[halves].max() < 0.2


def strip(n: int, m: int) -> TriangleMesh:
    x, y = np.meshgrid(np.linspace(-2, 2, n), np.linspace(0, 1, m), indexing="ij")
    faces = grid_faces(n, m, around_u=False, around_v=False)
    return TriangleMesh.from_arrays(np.stack([x, y, 0 * x], -1).reshape(-1, 3), faces)


def fold(mesh: TriangleMesh, gap: float) -> TriangleMesh:
    """A strip with one half above the other, at distance ``gap``; the bend is a step of that height."""
    x, y, _ = mesh.vertices.T
    # The coarse strip misses these waves, so fine vertices are closer to coarse faces of the other half.
    z = gap / 2 * np.tanh(8 * x) + 0.05 * np.sin(3 * np.pi * y)
    return mesh.with_vertices(np.stack([np.sqrt(x**2 + 0.01), y, z], axis=1))


def test_many_shapes_are_each_of_them(pair, shape):
    shapes = np.stack([pair.fine.vertices, shape])[:, pair.index]
    both = pair.prolong(shapes)
    assert np.array_equal(both, np.stack([pair.prolong(x) for x in shapes]))


def test_errors_are_distances_to_the_true_shapes(pair, shape, move):
    fine = np.stack([pair.fine.vertices, shape])
    coarse = fine[:, pair.index]
    errors = pair.prolong.errors(coarse, np.stack([move(x) for x in fine]))
    distances = np.linalg.norm(align(pair.prolong(coarse[1]), shape) - shape, axis=1)
    distances = distances / np.linalg.norm(np.ptp(shape, axis=0))
    assert 0 < errors["mean"] < 0.01
    plain = pair.prolong.errors(coarse, fine)
    assert plain["max"] == pytest.approx(distances.max(), rel=1e-9)
    assert plain["mean"] == pytest.approx(distances.mean() / 2, rel=1e-9)


def test_a_file_gives_it_back(pair, shape):
    file = io.BytesIO()
    np.savez(file, vertices=pair.coarse.vertices, **pair.prolong.arrays())
    file.seek(0)
    with np.load(file, allow_pickle=False) as arrays:
        again = Prolongation.from_arrays(arrays)
    assert all(name.startswith("prolongation_") for name in pair.prolong.arrays())
    assert np.array_equal(again(shape[pair.index]), pair.prolong(shape[pair.index]))
    assert again.vertex_count == len(pair.fine.vertices)


@pytest.fixture
def arrays() -> dict[str, np.ndarray]:
    """Arrays of a small prolongation."""
    return Pair(MESHES["closed"]()).prolong.arrays()


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("faces", (0, 0), -1, "prolongation_faces: faces name vertices -1"),
        ("indices", 5, 20, r"prolongation_indices must lie in \[0, 20\), but reach 0 to 20"),
        ("indices", 5, -1, "but reach -1 to"),
        ("indptr", 1, 9999, "prolongation_indptr must rise from 0"),
        ("indptr", -1, 3, "prolongation_indptr must rise from 0"),
        ("weights", 4, np.nan, "prolongation_weights has an entry that is not finite"),
        ("weights", 0, 7.0, "the weights of fine vertex 0 sum up to"),
    ],
)
def test_arrays_that_are_no_prolongation_are_refused(arrays, name, index, value, message):
    arrays[f"prolongation_{name}"][index] = value
    with pytest.raises(ProlongationError, match=message):
        Prolongation.from_arrays(arrays)


def test_arrays_of_another_form_are_refused(arrays):
    for name in arrays:
        with pytest.raises(ProlongationError, match=f"there is no array {name}"):
            Prolongation.from_arrays({key: array for key, array in arrays.items() if key != name})
        with pytest.raises(ProlongationError, match=f"{name} must be a"):
            Prolongation.from_arrays(arrays | {name: arrays[name][None]})
        with pytest.raises(ProlongationError, match=f"{name} must be a"):
            Prolongation.from_arrays(arrays | {name: arrays[name].astype(complex)})
    with pytest.raises(ProlongationError, match="prolongation_indices for"):
        Prolongation.from_arrays(arrays | {"prolongation_weights": arrays["prolongation_weights"][:-1]})
