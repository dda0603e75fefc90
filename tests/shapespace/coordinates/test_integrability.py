import numpy as np
import pytest

from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import NRICJacobian, nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from tests.shapespace.conftest import grid_faces


def cylinder(turn: float, n: int = 10, m: int = 5) -> np.ndarray:
    """Vertices of a strip of one column more than the cylinder, rolled so that n columns span this angle."""
    u, v = np.meshgrid(np.arange(n + 1) * turn / n, np.arange(m) / m, indexing="ij")
    radius = 2 * np.pi / turn
    return np.stack([radius * np.cos(u), radius * np.sin(u), v], -1)


@pytest.fixture(params=["mesh", "annulus", "pants"])
def surface(request, mesh):
    """The shared meshes, and two with several boundary loops."""
    if request.param == "mesh":
        return mesh
    rng = np.random.default_rng(3)
    if request.param == "annulus":
        vertices = cylinder(2 * np.pi)[:-1].reshape(-1, 3)
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
    assert np.abs(conditions(nric(surface.vertices, surface.connectivity))).max() < 1e-13
    assert np.abs(conditions(off)).max() > 1e-2


def test_there_are_loops_for_handles_and_for_boundaries(surface, conditions):
    connectivity = surface.connectivity
    generators = (2 if connectivity.is_closed else 1) - connectivity.euler_characteristic
    assert len(conditions(np.ones(2 * connectivity.edge_count))) == 3 * len(conditions.vertices) + 6 * generators


def test_the_jacobian_has_the_slope_of_a_derivative(surface, conditions, off, rng, slope):
    direction = rng.standard_normal(len(off)) * np.concatenate([off[: len(off) // 2], np.ones(len(off) // 2)])
    direction[surface.connectivity.edge_count :] *= surface.connectivity.interior
    here, change = conditions(off), conditions.jacobian(off) @ direction
    assert slope(lambda h: conditions(off + h * direction) - here - h * change, 1e-3) == pytest.approx(2, abs=0.1)


def test_the_kernel_is_the_tangent_space_of_immersed_meshes(surface, conditions):
    connectivity = surface.connectivity
    jacobian = conditions.jacobian(nric(surface.vertices, connectivity)).toarray()
    tangents = NRICJacobian(connectivity)(surface.vertices).toarray()
    assert np.abs(jacobian @ tangents).max() < 1e-11 * np.abs(tangents).max()
    there = np.concatenate([np.ones(connectivity.edge_count, dtype=bool), connectivity.interior])
    values = np.linalg.svd(jacobian[:, there], compute_uv=False)
    rank = int((values > 1e-9 * values[0]).sum())
    assert there.sum() - rank == 3 * connectivity.vertex_count - 6


def test_a_cylinder_that_does_not_close_fails_along_its_loop_only():
    """The conditions at vertices hold: each star of faces is that of a cylinder of a larger radius."""
    n, m = 10, 5
    closed = TriangleMesh.from_arrays(
        cylinder(2 * np.pi)[:-1].reshape(-1, 3), grid_faces(n, m, around_u=True, around_v=False)
    )
    opened = cylinder(1.8 * np.pi)
    rolled = TriangleMesh.from_arrays(opened.reshape(-1, 3), grid_faces(n + 1, m, around_u=False, around_v=False))
    z, connectivity = nric(rolled.vertices, rolled.connectivity), closed.connectivity
    # Copy z to the cylinder's edges, with columns modulo n, from columns that have all edges.
    found = {tuple(edge): k for k, edge in enumerate(rolled.edges.tolist())}
    e_rolled = rolled.connectivity.edge_count
    target = np.zeros(2 * connectivity.edge_count)
    for k, (i, j) in enumerate(closed.edges.tolist()):
        columns = [i // m, j // m]
        if max(columns) - min(columns) > 1:
            columns[columns.index(0)] = n
        shift = 1 - min(columns)  # all columns are alike; take the one at 1
        pair = sorted((c + shift) * m + vertex % m for c, vertex in zip(columns, (i, j), strict=True))
        same = found[tuple(pair)]
        target[k], target[connectivity.edge_count + k] = z[same], z[e_rolled + same]
    q = Integrability(connectivity)(target)
    assert np.abs(q[:-6]).max() < 1e-12
    assert np.abs(q[-6:]).max() > 0.1


def test_q_is_finite_where_a_triangle_is_impossible(mesh):
    connectivity = mesh.connectivity
    z = nric(mesh.vertices, connectivity)
    z[connectivity.face_edges[5, 1]] *= 10
    assert np.isfinite(Integrability(connectivity)(z)).all()
