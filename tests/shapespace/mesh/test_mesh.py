"""Connectivity, validation and rigid alignment."""

import re
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.mesh.rigid_motion import align, aligned_change
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, TriangleMesh, diagonal, face_areas, face_normals
from tests.meshes import euler_characteristic
from tests.shapespace.conftest import MESHES, TETRAHEDRON

CORNERS = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]


def sides(face):
    """Directed sides of a face; side k is opposite to corner k."""
    a, b, c = (int(v) for v in face)
    return [(b, c), (c, a), (a, b)]


# ---------------------------------------------------------------- connectivity


def test_edges_are_sorted_pairs_in_lexicographic_order(mesh):
    expected = sorted({tuple(sorted(side)) for face in mesh.faces for side in sides(face)})
    assert [(int(i), int(j)) for i, j in mesh.edges] == expected
    assert all(i < j for i, j in expected)
    assert all(a < b for a, b in pairwise(expected))


def test_every_face_and_edge_find_each_other(mesh):
    c = mesh.connectivity
    around = {}
    for f, face in enumerate(c.faces):
        for k, side in enumerate(sides(face)):
            assert tuple(c.edges[c.face_edges[f, k]]) == tuple(sorted(side))
            around[side] = f, int(face[k])
    for e, (i, j) in enumerate(c.edges.tolist()):
        (left, above), (right, below) = around.get((i, j), (-1, -1)), around.get((j, i), (-1, -1))
        assert c.edge_faces[e].tolist() == [left, right]
        assert c.edge_opposite[e].tolist() == [above, below]
        assert c.interior[e] == (left >= 0 and right >= 0)
    inner = [e for e in range(c.edge_count) if c.interior[e]]
    assert c.hinge_edges.tolist() == inner
    assert c.hinges.tolist() == [[*c.edges[e], *c.edge_opposite[e]] for e in inner]
    assert np.array_equal(c.hinge_corners, c.hinges.T)
    assert np.array_equal(c.edge_ends, c.edges.T)


@pytest.mark.parametrize(("name", "characteristic", "boundary"), [("closed", 2, 0), ("sheet", 1, 32), ("torus", 0, 0)])
def test_topology(name, characteristic, boundary):
    c = MESHES[name]().connectivity
    assert euler_characteristic(c) == characteristic
    assert (~c.interior).sum() == boundary
    assert c.is_closed == (boundary == 0)


def test_order_of_faces_and_corners_does_not_change_the_edges(mesh, rng):
    turned = np.array([np.roll(face, rng.integers(3)) for face in rng.permutation(mesh.faces)])
    assert np.array_equal(Connectivity(turned, len(mesh.vertices)).edges, mesh.edges)


CONNECTIVITY_REFUSALS = {
    "no faces": ([], 0, "faces must be a non-empty (F, 3) array of vertex indices, not of shape (0,)"),
    "empty table": (np.empty((0, 3), int), 0, "faces must be a non-empty (F, 3) array"),
    "one row": ([0, 1, 2], 3, "not of shape (3,)"),
    "quads": ([[0, 1, 2, 3]], 4, "not of shape (1, 4)"),
    "real indices": ([[0.0, 1.0, 2.0]], 3, "faces must be integers, not float64"),
    "truth values": (np.ones((1, 3), bool), 3, "faces must be integers, not bool"),
    "index too large": ([[0, 1, 3]], 3, "faces name vertices 0 to 3, but there are 3 vertices"),
    "negative index": ([[0, 1, -1]], 3, "faces name vertices -1 to 1, but there are 3 vertices"),
    "corners 0 and 1": ([[0, 1, 2], [1, 1, 0]], 3, "face 1 names the same vertex twice"),
    "corners 1 and 2": ([[0, 1, 2], [0, 1, 1]], 3, "face 1 names the same vertex twice"),
    "corners 2 and 0": ([[0, 1, 0]], 2, "face 0 names the same vertex twice"),
    "lonely vertices": ([[0, 2, 4]], 5, "vertex 1 belongs to no face (2 such vertices)"),
    "three faces at an edge": (
        [[0, 1, 2], [1, 0, 3], [0, 1, 4]],
        5,
        "edge (0, 1) has 3 faces; at most two are allowed",
    ),
    "same face twice": ([[0, 1, 2], [0, 1, 2]], 3, "the two faces at edge (0, 1) are oriented oppositely"),
    "one face turned over": ([*TETRAHEDRON[:3], [0, 2, 3]], 4, "the two faces at edge (0, 2) are oriented oppositely"),
    "turned over, against the order": (
        [[2, 1, 0], [3, 2, 1]],
        4,
        "the two faces at edge (1, 2) are oriented oppositely",
    ),
}


@pytest.mark.parametrize("name", CONNECTIVITY_REFUSALS)
def test_impossible_faces_are_refused(name):
    faces, count, message = CONNECTIVITY_REFUSALS[name]
    with pytest.raises(MeshError, match=re.escape(message)):
        Connectivity(faces, count)


# ---------------------------------------------------------------- mesh


def changed(vertex, to):
    return [to if i == vertex else corner for i, corner in enumerate(CORNERS)]


MESH_REFUSALS = {
    "flat list": ([0, 1, 2], "vertices must be a (V, 3) array, not of shape (3,)"),
    "planar": ([[0, 0], [1, 0], [0, 1], [1, 1]], "vertices must be a (V, 3) array, not of shape (4, 2)"),
    "too few": (CORNERS[:3], "faces name vertices 0 to 3, but there are 3 vertices"),
    "too many": ([*CORNERS, [1, 1, 1]], "vertex 4 belongs to no face (1 such vertex)"),
    "not a number": (changed(2, [0, np.nan, 0]), "vertex 2 has a coordinate that is not finite"),
    "infinite": (changed(1, [0, 0, -np.inf]), "vertex 1 has a coordinate that is not finite"),
    "needle": (changed(3, [0.5, 0, 0]), "face 1 has no area (1 such face)"),
    "two in one place": (changed(2, CORNERS[0]), "face 0 has no area (2 such faces)"),
    "all in one place": (np.ones((4, 3)), "face 0 has no area (4 such faces)"),
}


@pytest.mark.parametrize("name", MESH_REFUSALS)
def test_impossible_vertices_are_refused(name):
    vertices, message = MESH_REFUSALS[name]
    with pytest.raises(MeshError, match=re.escape(message)):
        TriangleMesh.from_arrays(vertices, TETRAHEDRON)


@pytest.mark.parametrize("shape", [(3, 3), (4, 2), (2, 4, 3), (12,)])
def test_vertices_of_another_mesh_are_refused(shape):
    mesh = TriangleMesh.from_arrays(CORNERS, TETRAHEDRON)
    with pytest.raises(MeshError, match=re.escape(f"vertices must be (4, 3), not {shape}")):
        mesh.with_vertices(np.ones(shape))


def test_a_small_mesh_is_as_good_as_a_large_one():
    """Whether a face has no area is decided relative to the other faces."""
    for scale in (1e-12, 1e12):
        mesh = TriangleMesh.from_arrays(scale * np.array(CORNERS), TETRAHEDRON)
        assert mesh.area == pytest.approx(scale**2 * (1.5 + np.sqrt(3) / 2))


def test_a_mesh_is_frozen():
    vertices, faces = np.array(CORNERS, dtype=float), np.array(TETRAHEDRON)
    mesh = TriangleMesh.from_arrays(vertices, faces)
    vertices[:], faces[:] = 0, 0
    assert mesh.vertices.tolist() == CORNERS
    assert mesh.faces.tolist() == TETRAHEDRON
    c = mesh.connectivity
    for array in (mesh.vertices, c.faces, c.edges, c.face_edges, c.edge_faces, c.edge_opposite, c.interior):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = array[1]


def test_meshes_come_from_mappings_and_share_their_connectivity():
    mesh = TriangleMesh.from_mapping({"vertices": np.float32(CORNERS), "faces": np.uint8(TETRAHEDRON)})
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int64
    other = mesh.with_vertices(2 * mesh.vertices)
    assert other.connectivity is mesh.connectivity
    assert other.area == pytest.approx(4 * mesh.area)
    assert other.diagonal == pytest.approx(2 * np.sqrt(3))
    assert diagonal(np.stack([mesh.vertices, other.vertices])) == pytest.approx([np.sqrt(3), 2 * np.sqrt(3)])


def test_areas_and_normals_follow_the_orientation():
    mesh = TriangleMesh.from_arrays(CORNERS, TETRAHEDRON)
    slanted = np.sqrt(3) / 2
    np.testing.assert_allclose(mesh.face_areas, [0.5, 0.5, slanted, 0.5])
    outward = np.array([[0, 0, -1], [0, -1, 0], [1 / np.sqrt(3)] * 3, [-1, 0, 0]])
    np.testing.assert_allclose(face_normals(mesh.vertices, mesh.faces), outward, atol=1e-15)
    by_area = face_normals(mesh.vertices, mesh.faces, normalised=False)
    np.testing.assert_allclose(by_area, 2 * mesh.face_areas[:, None] * outward, atol=1e-15)
    many = np.stack([mesh.vertices, 3 * mesh.vertices])
    np.testing.assert_allclose(face_areas(many, mesh.faces), [mesh.face_areas, 9 * mesh.face_areas])
    np.testing.assert_allclose(face_normals(many, mesh.faces), [outward, outward], atol=1e-15)


def test_the_normals_of_a_closed_surface_sum_to_zero(mesh):
    total = face_normals(mesh.vertices, mesh.faces, normalised=False).sum(axis=0)
    assert np.linalg.norm(total) < 1e-12 or not mesh.connectivity.is_closed


# ---------------------------------------------------------------- alignment


def misfit(x, y):
    return np.linalg.norm(x - y)


def test_a_rigid_motion_is_undone(mesh, move):
    for _ in range(10):
        np.testing.assert_allclose(align(move(mesh.vertices), mesh.vertices), mesh.vertices, atol=1e-13)


def test_alignment_is_the_best_rigid_motion(mesh, pose, move, rng):
    x = move(pose + 0.1 * rng.standard_normal(pose.shape))
    found = align(x, mesh.vertices)
    y = mesh.vertices - mesh.vertices.mean(axis=0)
    _, best = Rotation.align_vectors(y, x - x.mean(axis=0))
    assert misfit(found, mesh.vertices) == pytest.approx(best, rel=1e-9)
    assert misfit(found, mesh.vertices) <= misfit(x, mesh.vertices)
    np.testing.assert_allclose(found.mean(axis=0), mesh.vertices.mean(axis=0), atol=1e-13)
    # It is a rigid motion: all distances are preserved.
    np.testing.assert_allclose(
        np.linalg.norm(found[1:] - found[:-1], axis=1), np.linalg.norm(x[1:] - x[:-1], axis=1), atol=1e-13
    )


def test_alignment_never_reflects(mesh, move):
    """A reflection would fit perfectly."""
    mirrored = move(mesh.vertices * [-1, 1, 1])
    found = align(mirrored, mesh.vertices)
    assert misfit(found, mesh.vertices) > 0.01 * mesh.diagonal
    ends, origin = [0, len(found) // 3, len(found) // 2], len(found) - 1

    def handedness(vertices):
        return np.linalg.det(vertices[ends] - vertices[origin])

    assert handedness(found) == pytest.approx(handedness(mirrored))
    assert handedness(found) == pytest.approx(-handedness(mesh.vertices))


def test_changes_of_an_aligned_shape_are_those_of_differences(pose, move, rng):
    target, fields, h = move(pose), rng.standard_normal((3, *pose.shape)), 1e-5
    found = aligned_change(pose, fields, target)
    for field, change in zip(fields, found, strict=True):
        difference = (align(pose + h * field, target) - align(pose - h * field, target)) / (2 * h)
        assert change == pytest.approx(difference, abs=1e-6)


def test_aligning_many_is_aligning_each(mesh, pose, move):
    shapes = np.stack([move(pose), move(mesh.vertices), move(mesh.vertices * [1, 1, -1])])
    together = align(shapes, mesh.vertices)
    for shape, found in zip(shapes, together, strict=True):
        np.testing.assert_allclose(found, align(shape, mesh.vertices), atol=1e-13)
    # Each shape to a target of its own, too.
    for shape, target, found in zip(shapes, shapes[::-1], align(shapes, shapes[::-1]), strict=True):
        np.testing.assert_allclose(found, align(shape, target), atol=1e-13)
