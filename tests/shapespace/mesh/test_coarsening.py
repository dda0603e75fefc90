"""Coarsening all shapes to one connectivity: preserved properties and refused collapses."""

import numpy as np
import pytest
import trimesh
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from shapespace.mesh import coarsening
from shapespace.mesh.coarsening import ANGLE_LIMITS, Coarsening, coarsen
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, TriangleMesh, face_areas, face_normals
from tests.meshes import euler_characteristic
from tests.shapespace.conftest import MESHES, TETRAHEDRON, bent, grid_faces


def fine_mesh(name: str) -> TriangleMesh:
    """Several times as fine as the meshes of the other tests, without symmetries."""
    mesh = MESHES[name]()
    v, f = mesh.vertices, mesh.faces
    while len(v) < 250:
        v, f = trimesh.remesh.subdivide(v, f)
    v = v + 0.01 * mesh.diagonal / np.sqrt(len(v)) * np.random.default_rng(7).standard_normal(v.shape)
    return TriangleMesh.from_arrays(v, f)


@pytest.fixture(params=MESHES, scope="module")
def fine(request: pytest.FixtureRequest) -> TriangleMesh:
    return fine_mesh(request.param)


@pytest.fixture(scope="module")
def quarter(fine: TriangleMesh) -> Coarsening:
    """A quarter of the vertices, in all poses."""
    return coarsen(fine, len(fine.vertices) // 4, poses(fine))


def poses(mesh: TriangleMesh) -> np.ndarray:
    return np.stack([bent(mesh.vertices, angle) for angle in (0.3, 1.0, 2.0)])


def angles(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Angles (…, F, 3) of shapes (…, V, 3), by the law of cosines."""
    corners = vertices[..., faces, :]
    a, b, c = (np.linalg.norm(corners[..., i, :] - corners[..., j, :], axis=-1) for i, j in ((1, 2), (2, 0), (0, 1)))
    opposite = ((a, b, c), (b, c, a), (c, a, b))
    return np.stack([np.arccos((q * q + r * r - p * p) / (2 * q * r)) for p, q, r in opposite], axis=-1)


def neighbour_cosines(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    connectivity = Connectivity(faces, vertices.shape[-2])
    i, j = connectivity.edge_faces[connectivity.interior].T
    normals = face_normals(vertices, faces)
    return (normals[..., i, :] * normals[..., j, :]).sum(-1)


def parts(edges: np.ndarray, count: int) -> np.ndarray:
    """(count,) index of the connected component of each vertex."""
    graph = csr_array((np.ones(len(edges)), tuple(edges.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def loops(connectivity: Connectivity) -> int:
    rim = connectivity.edges[~connectivity.interior]
    return len(np.unique(parts(rim, connectivity.vertex_count)[rim]))


def test_the_topology_is_kept(fine, quarter):
    found = quarter
    assert found.reason == ""
    assert len(found.fine_index) == len(fine.vertices) // 4
    assert (np.diff(found.fine_index) > 0).all()
    coarse = Connectivity(found.faces, len(found.fine_index))  # manifold and oriented, or it raises
    assert euler_characteristic(coarse) == euler_characteristic(fine.connectivity)
    assert loops(coarse) == loops(fine.connectivity)
    assert parts(coarse.edges, coarse.vertex_count).max() == 0


def test_no_shape_gets_a_sliver_or_a_fold_or_another_place(fine, quarter):
    everything = np.concatenate([fine.vertices[None], poses(fine)])
    kept = everything[:, quarter.fine_index]
    smallest = angles(kept, quarter.faces).min()
    assert quarter.smallest_angle == pytest.approx(smallest, rel=1e-9)
    assert smallest > np.deg2rad(5.9)
    assert neighbour_cosines(kept, quarter.faces).min() > np.cos(np.deg2rad(140))
    areas = face_areas(kept, quarter.faces).sum(axis=1)
    np.testing.assert_allclose(areas, face_areas(everything, fine.faces).sum(axis=1), rtol=0.06)


def test_the_same_again():
    fine = MESHES["sheet"]()
    first, second = (coarsen(fine, 30, poses(fine)) for _ in range(2))
    assert np.array_equal(first.faces, second.faces)
    assert np.array_equal(first.fine_index, second.fine_index)


def test_a_boundary_keeps_its_outline():
    mesh = flat_sheet(25, 13)
    found = coarsen(mesh, 60, np.empty((0, len(mesh.vertices), 3)))
    kept = mesh.vertices[found.fine_index]
    assert face_areas(kept, found.faces).sum() == pytest.approx(24 * 12, rel=1e-9)
    assert {(0, 0), (24, 0), (0, 12), (24, 12)} <= {(a, b) for a, b, _ in kept.tolist()}


def flat_sheet(n: int, m: int) -> TriangleMesh:
    x, y = np.meshgrid(np.arange(float(n)), np.arange(float(m)), indexing="ij")
    flat = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    return TriangleMesh.from_arrays(flat, grid_faces(n, m, around_u=False, around_v=False))


def sheet_with_a_wrinkle() -> tuple[TriangleMesh, np.ndarray]:
    """A flat sheet, and a shape in which one strip of it is bent up to a low ridge."""
    mesh = flat_sheet(21, 9)
    ridge = mesh.vertices.copy()
    ridge[:, 2] = 0.5 * np.maximum(0, 3 - np.abs(ridge[:, 0] - 10))
    return mesh, ridge


def test_what_bends_in_any_shape_is_kept():
    mesh, ridge = sheet_with_a_wrinkle()
    blind = coarsen(mesh, 30, ridge[None][:0])
    seeing = coarsen(mesh, 30, np.stack([mesh.vertices, ridge, mesh.vertices]))

    def area(found: Coarsening) -> float:
        return face_areas(ridge[found.fine_index], found.faces).sum()

    exact = face_areas(ridge, mesh.faces).sum()
    assert exact - area(seeing) < 0.01 * exact
    assert exact - area(seeing) < 0.5 * (exact - area(blind)), (
        "the test needs a ridge that is lost when the shape isn't given"
    )


@pytest.mark.parametrize("name", MESHES)
def test_limits_hold_however_few_vertices_are_asked_for(name):
    """The shapes are squeezed, each in another direction, and pleated; the reference isn't."""
    fine = MESHES[name]()
    x, y, z = fine.vertices.T
    pleats = np.stack([x, y, z + 0.15 * np.abs(np.mod(4 * x, 2) - 1)], axis=1)
    thin = [fine.vertices * stretch for stretch in ([1, 0.2, 1], [0.2, 1, 1], [1, 1, 0.2])]
    everything = np.stack([fine.vertices, pleats, *thin])
    before = angles(everything, fine.faces).min(), neighbour_cosines(everything, fine.faces).min()
    found = coarsen(fine, 8, everything[1:])
    kept = everything[:, found.fine_index]
    assert len(found.fine_index) < len(fine.vertices) / 2
    assert angles(kept, found.faces).min() >= min(np.deg2rad(1.5), before[0]) - 1e-9
    assert neighbour_cosines(kept, found.faces).min() >= min(np.cos(np.deg2rad(140)), before[1]) - 1e-9


def test_a_sliver_in_any_shape_is_refused_as_long_as_there_are_others(fine):
    squeezed = np.stack([fine.vertices * stretch for stretch in ([1, 0.5, 1], [0.5, 1, 1], [1, 1, 0.5])])
    found = coarsen(fine, 30, squeezed)
    assert found.reason == ""
    assert angles(squeezed[:, found.fine_index], found.faces).min() >= np.deg2rad(ANGLE_LIMITS[0]) - 1e-9


def test_a_face_that_would_turn_over_in_one_shape_alone_is_refused():
    """A spike that only one shape has: without its tip, every face there would turn by more than 60 degrees."""
    mesh, tip = flat_sheet(21, 9), 10 * 9 + 4
    spiked = mesh.vertices.copy()
    spiked[tip, 2] = 2.5
    found = coarsen(mesh, 12, spiked[None])
    assert tip in found.fine_index


def annulus() -> TriangleMesh:
    t, r = np.meshgrid(np.arange(24) * np.pi / 12, np.linspace(1, 2, 5), indexing="ij")
    vertices = np.stack([r * np.cos(t), r * np.sin(t), 0.1 * r * np.sin(3 * t)], -1).reshape(-1, 3)
    return TriangleMesh.from_arrays(vertices, grid_faces(24, 5, around_u=True, around_v=False))


@pytest.mark.parametrize("mesh", [MESHES["torus"](), MESHES["sheet"](), annulus()], ids=["torus", "sheet", "annulus"])
def test_topology_ends_it_where_shape_does_not(mesh, monkeypatch):
    monkeypatch.setattr("shapespace.mesh.decimation.Decimation._keeps_shape", lambda *_, **__: True)
    monkeypatch.setattr("shapespace.mesh.decimation.Decimation.heal", lambda *_: None)
    found = coarsen(mesh, 1, np.empty((0, *mesh.vertices.shape)))
    coarse = Connectivity(found.faces, len(found.fine_index))
    assert euler_characteristic(coarse) == euler_characteristic(mesh.connectivity)
    assert loops(coarse) == loops(mesh.connectivity)
    assert len({tuple(sorted(face)) for face in found.faces.tolist()}) == len(found.faces)
    assert len(found.fine_index) <= 12


def test_a_flat_tetrahedron_does_not_become_two_faces_back_to_back():
    corners = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [1.0, 1.2, 0]])
    mesh = TriangleMesh.from_arrays(corners, TETRAHEDRON)
    assert len(coarsen(mesh, 3, corners[None]).fine_index) == 4


def test_slivers_of_the_fine_mesh_are_healed(rng):
    mesh = fine_mesh("closed")
    hit = rng.permutation(len(mesh.vertices))[:5]
    spoiled = mesh.vertices.copy()
    for v in hit:
        face = mesh.faces[(mesh.faces == v).any(axis=1)][0]
        others = spoiled[face[face != v]]
        spoiled[v] = 0.999 * others.mean(axis=0) + 0.001 * spoiled[v]
    shapes = np.stack([spoiled])
    assert angles(spoiled, mesh.faces).min() < np.deg2rad(0.5)
    found = coarsen(mesh, int(0.85 * len(mesh.vertices)), shapes)
    assert found.reason == ""
    assert np.rad2deg(found.smallest_angle) > 3


@pytest.mark.parametrize(("subdivisions", "seed"), [(3, 0), pytest.param(4, 2, marks=pytest.mark.long)])
def test_a_crumpled_place_smaller_than_a_coarse_face_is_cleared_away(subdivisions, seed):
    """A place like the corner of a mouth: in some shapes many small faces are folded onto one another."""
    ball = trimesh.creation.icosphere(subdivisions)
    mesh = TriangleMesh.from_arrays(ball.vertices, ball.faces)
    size = 2**-subdivisions
    place = np.linalg.norm(mesh.vertices - mesh.vertices[100], axis=1) < 2.4 * size
    shapes = np.repeat(mesh.vertices[None], 8, axis=0)
    shapes[:, place] += 0.8 * size * np.random.default_rng(seed).standard_normal((8, place.sum(), 3))
    folded = np.cos(np.deg2rad(140))
    assert (neighbour_cosines(shapes, mesh.faces) < folded).sum() > 10
    found = coarsen(mesh, {3: 40, 4: 150}[subdivisions], shapes)
    assert found.reason == ""
    assert neighbour_cosines(shapes[:, found.fine_index], found.faces).min() > folded
    assert np.rad2deg(found.smallest_angle) > 5


def whiskered() -> tuple[TriangleMesh, np.ndarray]:
    """A ball that ends in a long whisker, of rings with eight vertices, and shapes whose whisker bends and thins."""
    polar = np.linspace(0, np.pi, 22)[1:-1]
    profile = np.stack([np.cos(polar), np.sin(polar)], axis=1)[::-1]
    thread = np.stack([np.linspace(1.02, 3, 30), np.full(30, 4e-3)], axis=1)
    profile = np.concatenate([profile, thread])
    turn = np.arange(8) * np.pi / 4
    x, radius = profile[:, :1], profile[:, 1:]
    rings = np.stack([x + 0 * turn, radius * np.cos(turn), radius * np.sin(turn)], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([rings, [[-1, 0, 0], [3.01, 0, 0]]])
    n, tips = len(profile), len(rings)
    tube = grid_faces(n, 8, around_u=False, around_v=True)[:, ::-1]
    k = np.arange(8)
    first = np.stack([np.full(8, tips), (k + 1) % 8, k], axis=1)
    last = np.stack([np.full(8, tips + 1), (n - 1) * 8 + k, (n - 1) * 8 + (k + 1) % 8], axis=1)
    mesh = TriangleMesh.from_arrays(vertices, np.concatenate([tube, first, last]))
    shapes = []
    for bend, width in ((0.2, 1.0), (-0.1, 0.3), (0.3, 0.5)):
        shape, beyond = vertices.copy(), np.maximum(vertices[:, 0] - 1, 0)
        shape[:, 1:] *= np.where(beyond > 0, width, 1)[:, None]
        shape[:, 2] += bend * beyond**2
        shapes.append(shape)
    return mesh, np.stack(shapes)


def test_a_thin_part_is_left_to_the_fine_mesh_where_it_would_be_all_slivers():
    mesh, shapes = whiskered()
    found = coarsen(mesh, 80, shapes)
    kept = np.concatenate([mesh.vertices[None], shapes])[:, found.fine_index]
    areas = face_areas(kept, found.faces)
    assert found.specks == 0
    assert found.smallest_area == pytest.approx((areas / areas.mean(axis=1, keepdims=True)).min())
    assert found.smallest_area > 0.009
    assert (areas / areas.mean(axis=0)).min() > 0.09
    assert angles(kept, found.faces).min() > np.deg2rad(1.4)
    # This costs few vertices, and the reason says so.
    assert 70 <= len(found.fine_index) <= 80
    assert bool(found.reason) == (len(found.fine_index) != 80)


def test_what_cannot_be_reached_is_said():
    tetrahedron = trimesh.creation.icosphere(subdivisions=1)
    mesh = TriangleMesh.from_arrays(tetrahedron.vertices, tetrahedron.faces)
    found = coarsen(mesh, 2, mesh.vertices[None])
    assert len(found.fine_index) >= 4
    assert found.reason.startswith(f"{len(found.fine_index)} vertices instead of 2")
    assert euler_characteristic(Connectivity(found.faces, len(found.fine_index))) == 2


def test_nothing_to_do():
    fine = MESHES["torus"]()
    found = coarsen(fine, len(fine.vertices), poses(fine))
    assert np.array_equal(found.fine_index, np.arange(len(fine.vertices)))
    assert found.reason == ""


def test_sheets_that_touch_at_a_vertex_stay_together():
    """Two balls that share a vertex: removing it would tear them apart."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    count, touch = len(ball.vertices), 7
    second = 2 * ball.vertices[touch] - ball.vertices
    faces = np.concatenate([ball.faces, ball.faces[:, ::-1] + count])
    faces[faces == count + touch] = touch
    used, faces = np.unique(faces, return_inverse=True)
    vertices = np.concatenate([ball.vertices, second])[used]
    mesh = TriangleMesh.from_arrays(vertices, faces.reshape(-1, 3))
    found = coarsen(mesh, 60, np.empty((0, len(vertices), 3)))
    assert touch in found.fine_index
    assert parts(Connectivity(found.faces, len(found.fine_index)).edges, len(found.fine_index)).max() == 0


def test_bad_shapes_are_refused():
    fine = MESHES["sheet"]()
    shapes = poses(fine)
    with pytest.raises(MeshError, match=r"shapes must be \(n, "):
        coarsen(fine, 10, shapes[:, 1:])
    with pytest.raises(MeshError, match=r"shapes must be \(n, "):
        coarsen(fine, 10, shapes[0])
    shapes[1, 3, 2] = np.nan
    with pytest.raises(MeshError, match="shape 1 has a coordinate that is not finite"):
        coarsen(fine, 10, shapes)


@pytest.mark.parametrize(
    ("folds", "shrinkage", "taken"),
    [
        ((0, 0, 0), (0.5, 0.5, 0.5), 0),
        ((0, 0, 0), (0.46, 0.5, 0.4), 0),
        ((0, 0, 0), (0.2, 0.5, 0.6), 2),
        ((1, 0, 0), (0.9, 0.3, 0.2), 1),
        ((3, 2, 4), (0.9, 0.1, 0.9), 1),
    ],
)
def test_the_evenest_is_taken_whose_faces_keep_their_areas(monkeypatch, folds, shrinkage, taken):
    def pretended(fine, target, shapes, weight):
        k = coarsening.MOTION_WEIGHTS.index(weight)
        return Coarsening(np.full(3, k), np.array([[0, 1, 2]]), 1.0, folds[k], shrinkage[k])

    monkeypatch.setattr(coarsening, "_coarsen", pretended)
    mesh, ridge = sheet_with_a_wrinkle()
    assert coarsen(mesh, 30, ridge[None]).fine_index[0] == taken


def test_what_is_left_of_the_smallest_face_is_told():
    fine = MESHES["torus"]()
    shapes = np.stack([fine.vertices, 0.5 * fine.vertices])
    found = coarsen(fine, 40, shapes)
    areas = face_areas(np.concatenate([fine.vertices[None], shapes])[:, found.fine_index], found.faces)
    assert found.shrinkage == pytest.approx((areas / np.exp(np.log(areas).mean(axis=0))).min())
    assert found.shrinkage == pytest.approx(4 ** (-2 / 3))


def test_the_folds_that_are_left_are_counted():
    mesh = flat_sheet(11, 5)
    vertices = mesh.vertices.copy()
    vertices[:, 2] += 3.0 * np.abs(np.mod(np.arange(len(vertices)), 2))
    found = coarsen(mesh, len(mesh.vertices), np.stack([mesh.vertices, vertices]))
    kept = np.stack([mesh.vertices, vertices])[:, found.fine_index]
    cosines = neighbour_cosines(kept, found.faces)
    assert found.folds == (cosines < np.cos(np.deg2rad(140))).any(axis=0).sum()
    assert found.folds > 0


def test_evenly_spaced_shapes_stand_for_a_large_collection(fine, monkeypatch):
    shapes = np.stack([bent(fine.vertices, angle) for angle in np.linspace(0.2, 2, 9)])
    few = coarsen(fine, 40, shapes[[0, 4, 8]])
    monkeypatch.setattr(coarsening, "MOST_CHECKED", 3 * len(fine.vertices) + 2)
    found = coarsen(fine, 40, shapes)
    assert found.faces.tolist() == few.faces.tolist()
    assert found.smallest_angle == few.smallest_angle
