import numpy as np
import pytest

from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import NRICJacobian, nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from tests.meshes import euler_characteristic
from tests.shapespace.conftest import grid_faces


@pytest.fixture(params=["mesh", "annulus", "pants"])
def surface(request, mesh):
    """The shared meshes, and two with several boundary loops."""
    if request.param == "mesh":
        return mesh
    rng = np.random.default_rng(3)
    if request.param == "annulus":
        u, v = np.meshgrid(np.arange(10) * np.pi / 5, np.arange(5) / 5, indexing="ij")
        vertices = np.stack([np.cos(u), np.sin(u), v], -1).reshape(-1, 3)
        return TriangleMesh.from_arrays(
            vertices + 0.02 * rng.standard_normal(vertices.shape), grid_faces(10, 5, around_u=True, around_v=False)
        )
    x, y = np.meshgrid(np.arange(13.0), np.arange(9.0), indexing="ij")
    faces = grid_faces(13, 9, around_u=False, around_v=False).reshape(12, 8, 2, 3)
    faces[3:5, 3:5] = faces[8:10, 3:5] = -1
    faces = faces.reshape(-1, 3)
    used, faces = np.unique(faces[faces[:, 0] >= 0], return_inverse=True)
    vertices = np.stack([x, y, 0.1 * x * y], -1).reshape(-1, 3)[used]
    return TriangleMesh.from_arrays(vertices + 0.1 * rng.standard_normal(vertices.shape), faces.reshape(-1, 3))


@pytest.fixture
def conditions(surface):
    return Integrability(surface.connectivity)


@pytest.fixture
def off(surface, rng):
    """Lengths and angles of no surface."""
    connectivity = surface.connectivity
    z, e = nric(surface.vertices, connectivity), connectivity.edge_count
    change = np.concatenate([z[:e], connectivity.interior]) * rng.standard_normal(2 * e)
    return z + 1e-2 * change


def test_immersed_surfaces_meet_all_conditions_and_others_do_not(surface, conditions, off):
    assert np.abs(conditions.at_vertices(nric(surface.vertices, surface.connectivity))).max() < 1e-13
    assert np.abs(conditions.at_vertices(off)).max() > 1e-2


def test_the_jacobian_has_the_slope_of_a_derivative(surface, conditions, off, rng, slope):
    direction = rng.standard_normal(len(off)) * np.concatenate([off[: len(off) // 2], np.ones(len(off) // 2)])
    direction[surface.connectivity.edge_count :] *= surface.connectivity.interior
    here, change = conditions.at_vertices(off).ravel(), conditions.jacobian(off) @ direction
    assert slope(
        lambda h: conditions.at_vertices(off + h * direction).ravel() - here - h * change, 1e-3
    ) == pytest.approx(2, abs=0.1)


def test_the_kernel_is_the_tangent_space_of_immersed_meshes(surface, conditions):
    connectivity = surface.connectivity
    jacobian = conditions.jacobian(nric(surface.vertices, connectivity)).toarray()
    tangents = NRICJacobian(connectivity)(surface.vertices).toarray()
    assert np.abs(jacobian @ tangents).max() < 1e-11 * np.abs(tangents).max()
    there = np.concatenate([np.ones(connectivity.edge_count, dtype=bool), connectivity.interior])
    values = np.linalg.svd(jacobian[:, there], compute_uv=False)
    rank = int((values > 1e-9 * values[0]).sum())
    assert there.sum() - rank >= 3 * connectivity.vertex_count - 6
    if euler_characteristic(connectivity) == 1 + connectivity.is_closed:  # simply connected: no further conditions
        assert there.sum() - rank == 3 * connectivity.vertex_count - 6


def test_q_is_finite_where_a_triangle_is_impossible(mesh):
    connectivity = mesh.connectivity
    z = nric(mesh.vertices, connectivity)
    z[connectivity.face_edges[5, 1]] *= 10
    assert np.isfinite(Integrability(connectivity).at_vertices(z)).all()
