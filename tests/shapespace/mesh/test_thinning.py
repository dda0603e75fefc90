"""Thinning: the target number of vertices, the same topology, and no fold or sliver in any shape."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from shapespace.mesh import coarsening
from shapespace.mesh.thinning import _Round, thin
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.mesh.triangle_quality import folded_pairs, normals_and_sides, squared_sines
from tests.meshes import euler_characteristic


def bent(opened: bool, subdivisions: int = 4) -> tuple[TriangleMesh, np.ndarray]:
    """A ball, or one with a round hole, and three shapes of it: bent ellipsoids."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    faces = np.array(ball.faces)
    if opened:
        faces = faces[ball.vertices[faces].mean(axis=1)[:, 2] < 0.8]
    used, local = np.unique(faces, return_inverse=True)
    x, y, z = ball.vertices[used].T
    shapes = np.stack([np.stack([3 * x, y, z + a * x**2], axis=1) for a in (0, 0.5, 1)])
    return TriangleMesh.from_arrays(shapes[0], local.reshape(-1, 3)), shapes


@pytest.mark.parametrize("opened", [False, True])
def test_thinning_keeps_the_topology_and_the_shapes(opened: bool) -> None:
    mesh, shapes = bent(opened)
    kept, faces = thin(mesh.connectivity, shapes, 1000)
    assert len(kept) == 1000
    assert (np.diff(kept) > 0).all()
    thinned = Connectivity(faces, 1000)
    assert euler_characteristic(thinned) == euler_characteristic(mesh.connectivity)
    assert thinned.is_closed == mesh.connectivity.is_closed == (not opened)
    normals, squares = normals_and_sides(shapes[:, kept].swapaxes(0, 1)[faces.T])
    assert np.rad2deg(np.arcsin(np.sqrt(squared_sines(normals, squares).min()))) > 9.9
    assert not len(folded_pairs(thinned, normals))
    # It is the same surface: the centres of its faces are close to fine vertices.
    for shape in shapes:
        away = KDTree(shape).query(shape[kept][faces].mean(axis=1))[0]
        assert away.max() < 0.05 * mesh.diagonal


def test_stretched_triangles_are_no_reason_to_stop() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    shapes = np.stack([ball.vertices * [a, 1, 1] for a in (3.0, 4.0)])
    kept, faces = thin(Connectivity(ball.faces, len(ball.vertices)), shapes, 300)
    assert len(kept) == 300
    normals, squares = normals_and_sides(shapes[:, kept].swapaxes(0, 1)[faces.T])
    assert np.rad2deg(np.arcsin(np.sqrt(squared_sines(normals, squares).min()))) > 2.4


def test_sharp_edges_are_not_folded_over() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    shapes = np.stack([ball.vertices * [2, 1, flat] for flat in (0.2, 0.12)])
    connectivity = Connectivity(ball.faces, len(ball.vertices))
    assert not len(folded_pairs(connectivity, normals_and_sides(shapes.swapaxes(0, 1)[ball.faces.T])[0]))
    kept, faces = thin(connectivity, shapes, 900)
    assert len(kept) < 2000
    normals, _ = normals_and_sides(shapes[:, kept].swapaxes(0, 1)[faces.T])
    assert not len(folded_pairs(Connectivity(faces, len(kept)), normals))


@pytest.mark.parametrize("width", [1, 3])
def test_a_flat_strip_keeps_its_outline(width: int) -> None:
    columns = width + 1
    x, y = (a.ravel().astype(float) for a in np.meshgrid(np.arange(80), np.arange(columns), indexing="ij"))
    corner = np.arange(80 * columns).reshape(80, columns)[:-1, :-1].ravel()
    faces = np.concatenate([corner[:, None] + [0, columns, columns + 1], corner[:, None] + [0, columns + 1, 1]])
    shape = np.stack([x, y, 0 * x], axis=1)
    strip = TriangleMesh.from_arrays(shape, faces)
    kept, left = thin(strip.connectivity, shape[None], 40)
    assert len(kept) < 0.8 * len(shape)
    thinned = TriangleMesh.from_arrays(shape[kept], left)
    assert euler_characteristic(thinned.connectivity) == 1
    assert thinned.area == pytest.approx(strip.area)


def test_sheets_that_touch_at_vertices_stay_together() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    count, shared = len(ball.vertices), np.arange(12)
    other = np.arange(count) + count
    other[shared] = shared
    vertices = np.concatenate([ball.vertices, 1.1 * ball.vertices])
    used, local = np.unique(np.concatenate([ball.faces, other[ball.faces]]), return_inverse=True)
    connectivity = Connectivity(local.reshape(-1, 3), len(used))
    kept, _ = thin(connectivity, vertices[used][None], 300)
    assert len(kept) == 300
    assert np.isin(shared, used[kept]).all()


@pytest.mark.parametrize(
    ("faces", "allowed"),
    [
        ([[0, 1, 2], [0, 2, 3], [0, 3, 1], [3, 2, 1]], set()),  # a tetrahedron
        # A strip: only edges of its boundary, none across it.
        ([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5]], {(0, 1), (0, 2), (1, 3), (2, 4), (3, 5), (4, 5)}),
        ([[0, 1, 2]], set()),
    ],
)
def test_no_collapse_changes_the_topology(faces: list[list[int]], allowed: set[tuple[int, int]]) -> None:
    count = np.max(faces) + 1
    mesh = _Round(np.array(faces), np.zeros((count, 1, 3)))
    found = {(u, v) for u, v in mesh.half_edges(np.arange(count)).tolist()}
    assert found == allowed | {(v, u) for u, v in allowed}


def test_a_vertex_where_sheets_touch_never_goes() -> None:
    fans = [[0, 1, 2], [0, 2, 3], [0, 4, 5], [0, 5, 6]]
    mesh = _Round(np.array(fans), np.zeros((7, 1, 3)))
    assert all(0 not in mesh.apart(np.random.default_rng(seed)) for seed in range(20))


def test_what_cannot_be_collapsed_stays() -> None:
    tetrahedron = Connectivity([[0, 1, 2], [0, 2, 3], [0, 3, 1], [3, 2, 1]], 4)
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    kept, faces = thin(tetrahedron, corners[None], 2)
    assert kept.tolist() == [0, 1, 2, 3]
    assert np.array_equal(faces, tetrahedron.faces)


def test_a_large_mesh_is_coarsened_as_well_by_way_of_a_thinned_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coarsening, "THINNING", coarsening.Thinning(vertices=1500, left=800))
    mesh, shapes = bent(False)
    target = 100
    assert len(mesh.vertices) > max(coarsening.THINNING.vertices, coarsening.THINNING.ratio * target)
    found = coarsening.coarsen(mesh, target, shapes)
    assert len(found.fine_index) == target
    assert found.folds == 0
    assert np.rad2deg(found.smallest_angle) > 9
    coarse = Connectivity(found.faces, target)
    assert coarse.is_closed
    assert euler_characteristic(coarse) == 2
    for shape in shapes:
        middles = shape[found.fine_index][found.faces].mean(axis=1)
        assert KDTree(shape).query(middles)[0].max() < 0.08 * mesh.diagonal
