"""The generator, compared with a second implementation of the formula as the paper prints it."""

import cmath
import math

import numpy as np
import pytest

from shapespace.coordinates.nric import dihedral_angles, nric
from shapespace.training.collection.generators import freaky_torus

# The paper's parameters and resolution.
A_R = A_r = 1.0
B_R = B_r = 0.5
R, r, H, EPSILON = 0.375, 0.125, 0.075, 0.05
N, M = 64, 32


def tau(eta, a, b, t):
    half = eta / 2
    return (
        a * math.cos(half) * cmath.cos(t - half) - b * math.sin(half) * cmath.sin(t - half),
        a * math.sin(half) * cmath.cos(t - half) + b * math.cos(half) * cmath.sin(t - half),
    )


def f(alpha, beta, u, v):
    large, small = tau(alpha, A_R, B_R, u), tau(beta, A_r, B_r, v)
    return (R * large[0] + r * cmath.cos(u) * small[0], R * large[1] + r * cmath.sin(u) * small[0], r * small[1])


def normal(alpha, beta, u, v):
    """Unit normal, with derivatives by complex steps instead of formulas."""
    h = 1e-30
    by_u = [x.imag / h for x in f(alpha, beta, complex(u, h), v)]
    by_v = [x.imag / h for x in f(alpha, beta, u, complex(v, h))]
    cross = [by_u[i - 2] * by_v[i - 1] - by_u[i - 1] * by_v[i - 2] for i in range(3)]
    length = math.hypot(*cross)
    return [x / length for x in cross]


def plain(alpha, beta):
    """The torus without its bump, (N, M, 3)."""
    grid = [[f(alpha, beta, 2 * math.pi * i / N, 2 * math.pi * j / M) for j in range(M)] for i in range(N)]
    return np.real(grid)


def transcribed(alpha, beta, gamma, zeta):
    centre = [x.real for x in f(alpha, beta, gamma, zeta)]
    n = normal(alpha, beta, gamma, zeta)
    shape = plain(alpha, beta)
    for i in range(N):
        for j in range(M):
            squared = sum((shape[i, j, k] - centre[k]) ** 2 for k in range(3))
            for k in range(3):
                shape[i, j, k] += H * math.exp(-squared / EPSILON**2) * n[k]
    return shape


@pytest.fixture
def codes():
    return np.random.default_rng(11).uniform(0, 2 * np.pi, (8, 4))


@pytest.fixture(scope="module")
def reference():
    return freaky_torus.reference()


def volume(vertices, faces):
    return np.linalg.det(vertices[faces]).sum() / 6


def test_shapes_are_those_of_the_paper_at_index_32_i_plus_j(codes):
    shapes = freaky_torus.vertices(codes)
    assert shapes.shape == (8, 2048, 3)
    for code, shape in zip(codes, shapes, strict=True):
        expected = transcribed(*code)
        for i, j in [(0, 0), (0, 1), (1, 0), (17, 5), (63, 31)]:
            np.testing.assert_allclose(shape[32 * i + j], expected[i, j], atol=1e-14)
        np.testing.assert_allclose(shape.reshape(N, M, 3), expected, atol=1e-14)


def test_the_reference_is_the_code_of_zeros(reference):
    np.testing.assert_allclose(reference.vertices.reshape(N, M, 3), transcribed(0, 0, 0, 0), atol=1e-14)
    # The tip of the bump is where the long axes of both ellipses end.
    np.testing.assert_allclose(reference.vertices[0], [R * A_R + r * A_r + H, 0, 0], atol=1e-15)


@pytest.mark.parametrize("latent", range(4))
def test_every_latent_has_the_period_of_a_full_turn(codes, latent):
    shapes = freaky_torus.vertices(codes)
    turn = np.eye(4)[latent] * 2 * np.pi
    for turns in (1, -1, 3):
        np.testing.assert_allclose(freaky_torus.vertices(codes + turns * turn), shapes, atol=1e-13)
    # No shorter period.
    for part in (2, 3):
        assert np.abs(freaky_torus.vertices(codes + turn / part) - shapes).max(axis=(1, 2)).min() > 0.01
    assert pytest.approx(2 * np.pi) == freaky_torus.PERIOD


def test_the_bump_points_outward(reference, codes):
    edges = reference.edges
    for (alpha, beta, *_), (i, j) in zip(codes, [(0, 0), (20, 12), (50, 30)], strict=False):
        shape = freaky_torus.vertices([[alpha, beta, 2 * np.pi * i / N, 2 * np.pi * j / M]])[0]
        smooth = plain(alpha, beta).reshape(-1, 3)
        assert volume(shape, reference.faces) > volume(smooth, reference.faces)
        at_tip = (edges == 32 * i + j).any(axis=1)
        change = (dihedral_angles(shape, reference.connectivity) - dihedral_angles(smooth, reference.connectivity))[
            at_tip
        ]
        assert change.sum() > 0.5


def test_the_mesh_is_a_closed_torus(reference):
    c = reference.connectivity
    assert (c.vertex_count, c.edge_count, len(c.faces)) == (2048, 6144, 4096)
    assert c.is_closed
    assert (np.bincount(c.edges.ravel()) == 6).all()


def test_every_quad_is_split_along_the_same_diagonal(reference):
    expected = set()
    for i in range(N):
        for j in range(M):
            a, b, c, d = ((i + di) % N * M + (j + dj) % M for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1)))
            expected |= {frozenset((a, b, c)), frozenset((a, c, d))}
    assert {frozenset(face) for face in reference.faces.tolist()} == expected


def test_faces_look_outward(reference, codes):
    for shape in [reference.vertices, *freaky_torus.vertices(codes)]:
        assert volume(shape, reference.faces) > 0
    # Each face alone too: its normal is near that of the smooth surface.
    smooth = plain(0.3, 0).reshape(-1, 3)
    a, b, c = np.moveaxis(smooth[reference.faces], 1, 0)
    n = [normal(0.3, 0, 2 * math.pi * (k // M) / N, 2 * math.pi * (k % M) / M) for k in reference.faces[:, 0]]
    assert ((np.cross(b - a, c - a) * n).sum(axis=1) > 0).all()


def test_the_collection_has_a_reference_of_unit_area(reference, codes):
    collection = freaky_torus.FreakyTorus()
    assert collection.reference.area == pytest.approx(1)
    assert np.array_equal(collection.reference.faces, reference.faces)
    np.testing.assert_allclose(collection.scale * collection.reference.vertices, reference.vertices, atol=1e-15)
    shapes = collection.shapes(codes)
    np.testing.assert_allclose(collection.scale * shapes.vertices, freaky_torus.vertices(codes), atol=1e-15)
    assert shapes.reasons == [""] * len(codes)


def test_its_symmetry_takes_the_shape_of_a_code_to_that_of_the_opposite_code(codes):
    collection = freaky_torus.FreakyTorus()
    connectivity = collection.reference.connectivity
    z, opposite = (nric(collection.shapes(c).vertices, connectivity) for c in (codes, -codes))
    (edges,) = collection.symmetries
    assert sorted(edges) == list(range(connectivity.edge_count))
    np.testing.assert_allclose(z[:, np.concatenate([edges, len(edges) + edges])], opposite, atol=1e-10)


@pytest.mark.parametrize("columns", [1, 24])
def test_columns_move_shapes_and_places_as_they_move_codes(codes, columns):
    """They say where features are: there, a shape moved by some columns of the grid is that of the moved code."""
    collection = freaky_torus.FreakyTorus()
    connectivity, places = collection.reference.connectivity, collection.places
    i, j = np.divmod(np.arange(N * M), M)
    edges = freaky_torus.edge_permutation(connectivity, (i + columns) % N * M + j)
    turn = 2 * np.pi * columns / N * np.array([2, 0, 1, 0])
    np.testing.assert_allclose(np.exp(1j * places.angles[edges]), np.exp(1j * (places.angles + turn)), atol=1e-12)
    np.testing.assert_allclose(places.constants[edges], places.constants, atol=1e-12)
    z, moved = (nric(collection.shapes(c).vertices, connectivity) for c in (codes, codes + turn))
    np.testing.assert_allclose(moved[:, np.concatenate([edges, len(edges) + edges])], z, atol=1e-10)


def test_the_bump_is_where_its_code_is_the_place_of_edges():
    collection = freaky_torus.FreakyTorus()
    code = np.array([[0, 0, 2.0, 4.0]])
    bump = np.linalg.norm(collection.shapes(code).vertices[0] - plain(0, 0).reshape(-1, 3) / collection.scale, axis=1)
    at_edges = bump[collection.reference.connectivity.edges].mean(axis=1)
    highest = collection.places.angles[at_edges.argmax(), 2:]
    np.testing.assert_allclose(highest, code[0, 2:], atol=0.15)
