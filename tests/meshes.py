"""Reading mesh files as checked meshes."""

from pathlib import Path

from shapespace.files.reading import read_arrays
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh


def read_mesh(source: bytes | Path, format: str | None = None) -> TriangleMesh:
    """A file's mesh; arguments and errors are those of ``read_arrays`` and ``TriangleMesh.from_arrays``."""
    return TriangleMesh.from_arrays(*read_arrays(source, format))


def euler_characteristic(connectivity: Connectivity) -> int:
    """V − E + F: 2 − 2g − b of a connected surface with g handles and b boundary loops."""
    return connectivity.vertex_count - connectivity.edge_count + len(connectivity.faces)
