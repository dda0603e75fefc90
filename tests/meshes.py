"""Mesh files as the checked meshes that they hold."""

from __future__ import annotations

from pathlib import Path

from shapespace.files.formats import read_arrays
from shapespace.mesh.triangle_mesh import TriangleMesh


def read_mesh(source: bytes | Path, format: str | None = None) -> TriangleMesh:
    """Arguments and errors as ``read_arrays`` and ``TriangleMesh.from_arrays`` have them."""
    return TriangleMesh.from_arrays(*read_arrays(source, format))
