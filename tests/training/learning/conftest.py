"""Small meshes, with samples of their shapes."""

import numpy as np
import pytest
import trimesh

from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.layers import Scaling
from tests.training.learning.fake_device import fake_device

__all__ = ["fake_device"]


@pytest.fixture
def ball() -> TriangleMesh:
    sphere = trimesh.creation.icosphere(2)
    return TriangleMesh.from_arrays(sphere.vertices, sphere.faces)


@pytest.fixture
def sheet() -> TriangleMesh:
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    quads = [(i + 5 * j, i + 1 + 5 * j, i + 6 + 5 * j, i + 5 + 5 * j) for i in range(4) for j in range(3)]
    faces = [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))]
    return TriangleMesh.from_arrays(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), faces)


def scaling(mesh: TriangleMesh, samples: np.ndarray) -> Scaling:
    return Scaling.of(nric(mesh.vertices, mesh.connectivity), WeightedNorm.of(mesh, 1.0).squared, samples)


def noisy(mesh: TriangleMesh, count: int, size: float = 0.05) -> np.ndarray:
    rng = np.random.default_rng(3)
    return nric(mesh.vertices + size * rng.normal(size=(count, *mesh.vertices.shape)), mesh.connectivity)
