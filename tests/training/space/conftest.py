from __future__ import annotations

import numpy as np
import pytest
import trimesh

from shapespace.mesh.triangle_mesh import TriangleMesh


@pytest.fixture(scope="module")
def ellipsoid() -> TriangleMesh:
    """A long ellipsoid of 162 vertices."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    return TriangleMesh.from_arrays(ball.vertices * [3, 1, 1], ball.faces)


@pytest.fixture(scope="module")
def blends(ellipsoid: TriangleMesh) -> tuple[TriangleMesh, np.ndarray]:
    """The ellipsoid at unit area, and 12 blend shapes (12, V, 3): sums of three local displacements."""
    size, rng = np.sqrt(ellipsoid.area), np.random.default_rng(5)
    x = ellipsoid.vertices / size
    centres = x[[3, 60, 120]]
    bumps = np.exp(-((np.linalg.norm(x - centres[:, None], axis=2) / 0.15) ** 2))[:, :, None]
    fields = 0.17 * bumps * rng.normal(size=(3, 1, 3))
    weights = rng.uniform(-1, 1, (12, 3))
    return ellipsoid.with_vertices(x), x + np.tensordot(weights, fields, axes=1)
