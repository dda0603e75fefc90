from __future__ import annotations

import pytest
import trimesh

from shapespace.mesh.triangle_mesh import TriangleMesh


@pytest.fixture(scope="module")
def ellipsoid() -> TriangleMesh:
    """A long ellipsoid of 162 vertices."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    return TriangleMesh.from_arrays(ball.vertices * [3, 1, 1], ball.faces)
