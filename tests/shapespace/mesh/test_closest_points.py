"""Closest points on triangles, compared with trimesh's in every region around a triangle."""

import numpy as np
import trimesh
from trimesh.triangles import closest_point

from shapespace.mesh.closest_points import MeshProximity, VertexFaces, closest_barycentric


def test_nearest_points_of_triangles_are_trimeshs(rng: np.random.Generator) -> None:
    corners, points = rng.standard_normal((5000, 3, 3)), 2 * rng.standard_normal((5000, 3))
    weights = closest_barycentric(points, corners)
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    assert (weights > -1e-12).all()
    # Inside, on each side and at each corner.
    assert len(np.unique(weights > 1e-12, axis=0)) == 7
    np.testing.assert_allclose(np.einsum("nk,nkx->nx", weights, corners), closest_point(corners, points), atol=1e-9)


def test_a_triangle_without_area_has_nearest_points_too() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    place = closest_barycentric(np.array([2.0, 1, 0]), line) @ line
    np.testing.assert_allclose(place, [2, 0, 0])
    assert (closest_barycentric(np.ones(3), np.zeros((3, 3))) >= 0).all()


def test_a_surface_is_found_from_points_around_it(rng: np.random.Generator) -> None:
    ball = trimesh.creation.icosphere(3)
    surface = MeshProximity(ball.vertices, VertexFaces(ball.faces, len(ball.vertices)))
    points = rng.standard_normal((200, 3)) + ball.vertices[:200]
    found = surface.closest(points)
    every = np.stack([closest_point(ball.triangles, np.tile(point, (len(ball.faces), 1))) for point in points])
    away = np.linalg.norm(every - points[:, None], axis=-1).min(axis=1)
    np.testing.assert_allclose(found.distances, away, rtol=0.01, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(found.places - points, axis=1), found.distances)
    # Normals point outwards.
    np.testing.assert_allclose(surface.vertex_normals, ball.vertices, atol=0.02)


def test_rows_hold_the_faces_around_each_vertex() -> None:
    box = trimesh.creation.box()
    rows = VertexFaces(box.faces, 8)
    for vertex in range(8):
        assert set(rows.around[vertex]) == set(np.flatnonzero((box.faces == vertex).any(axis=1)))
