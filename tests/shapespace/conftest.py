"""Meshes on which laws are tested: closed, with boundary, of genus 1, each nearly flat and strongly bent."""

import numpy as np
import pytest
import trimesh

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import unwrap
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.space import ShellSpace


def grid_faces(n: int, m: int, *, around_u: bool, around_v: bool) -> np.ndarray:
    i, j = np.meshgrid(np.arange(n - (not around_u)), np.arange(m - (not around_v)), indexing="ij")
    a, b = i * m + j, (i + 1) % n * m + j
    c, d = (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m
    return np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=2).reshape(-1, 3)


def closed() -> TriangleMesh:
    ball = trimesh.creation.icosphere(subdivisions=1)
    return TriangleMesh.from_arrays(ball.vertices * [2, 1, 1], ball.faces)


def sheet() -> TriangleMesh:
    x, y = np.meshgrid(np.linspace(-1, 1, 12), np.linspace(-0.4, 0.4, 6), indexing="ij")
    vertices = np.stack([x, y, 0.05 * np.sin(2 * x + y)], -1).reshape(-1, 3)
    return TriangleMesh.from_arrays(vertices, grid_faces(12, 6, around_u=False, around_v=False))


def torus() -> TriangleMesh:
    u, v = np.meshgrid(np.arange(16) * np.pi / 8, np.arange(8) * np.pi / 4, indexing="ij")
    ring = 1 + 0.4 * np.cos(v)
    vertices = np.stack([ring * np.cos(u), ring * np.sin(u), 0.4 * np.sin(v)], -1).reshape(-1, 3)
    return TriangleMesh.from_arrays(vertices, grid_faces(16, 8, around_u=True, around_v=True))


TETRAHEDRON = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]


def hinge(angle: float = 0.0, length: float = 2.0) -> TriangleMesh:
    """Two triangles of height 1 at a common edge along x, folded by an angle; positive is convex."""
    tip = [length / 2, np.cos(angle), -np.sin(angle)]
    return TriangleMesh.from_arrays([[0, 0, 0], [length, 0, 0], tip, [length / 2, -1, 0]], [[0, 1, 2], [1, 0, 3]])


MESHES = {"closed": closed, "sheet": sheet, "torus": torus}


def bent(vertices: FloatArray, angle: float) -> FloatArray:
    """Roll the x axis onto an arc of this angle."""
    x, y, z = vertices.T
    radius = np.ptp(x) / angle
    return np.stack([(radius - z) * np.sin(x / radius), y, radius - (radius - z) * np.cos(x / radius)], axis=1)


@pytest.fixture(params=MESHES)
def mesh(request: pytest.FixtureRequest, rng: np.random.Generator) -> TriangleMesh:
    """A mesh without symmetries, which hide mistakes, and with an area other than 1."""
    plain = MESHES[request.param]()
    size = plain.diagonal / np.sqrt(len(plain.vertices))
    return plain.with_vertices(plain.vertices + 0.04 * size * rng.standard_normal(plain.vertices.shape))


@pytest.fixture(params=[0.1, 1.3], ids=["nearly-flat", "strongly-bent"])
def pose(request: pytest.FixtureRequest, mesh: TriangleMesh) -> FloatArray:
    """Another shape of the mesh, (V, 3), bent a little or strongly."""
    return bent(mesh.vertices, request.param)


@pytest.fixture
def space(mesh: TriangleMesh) -> ShellSpace:
    return ShellSpace(mesh, Material(eta=1e-3))


@pytest.fixture
def velocity(space: ShellSpace, mesh: TriangleMesh, pose: FloatArray) -> FloatArray:
    """A tangent vector at the mesh, (V, 3), that points towards the pose."""
    z = space.nric(mesh.vertices)
    return space.project(mesh.vertices, unwrap(space.nric(pose), z) - z)


def turned(vertices: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The vertices after a random rigid motion."""
    q, r = np.linalg.qr(rng.standard_normal((3, 3)))
    q *= np.sign(np.diag(r))
    q[:, 0] *= np.linalg.det(q)
    return vertices @ q.T + rng.standard_normal(3)


@pytest.fixture
def move(rng: np.random.Generator):
    """A function that moves a shape rigidly."""
    return lambda vertices: turned(vertices, rng)


@pytest.fixture
def slope():
    """The order at which the remainder of a Taylor expansion shrinks, from values at h and h/10."""

    def order(remainder, h: float = 1e-2) -> float:
        large, small = (np.abs(remainder(x)).max() for x in (h, h / 10))
        return float(np.log10(large / small))

    return order
