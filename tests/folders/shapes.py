"""The bundled figure in a few poses, at several resolutions, and changes of meshes and files."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.thinning import thin
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.training.collection.generators import figure

#: The joints that move; few, so that a few modes describe all shapes.
BENDS = {"left elbow": 1.2, "right arm raise": 0.8, "head turn": 0.6, "left leg swing": 0.7}

Meshes = tuple[np.ndarray, np.ndarray]


def _angles(count: int, seed: int) -> np.ndarray:
    angles = np.zeros((count, len(figure.ANGLES)))
    columns = [list(figure.ANGLES).index(name) for name in BENDS]
    rng = np.random.default_rng(seed)
    angles[1:, columns] = rng.uniform(0, 1, (count - 1, len(BENDS))) * list(BENDS.values())
    return angles


def full(count: int, seed: int = 0) -> Meshes:
    """Vertices (n, 4601, 3) and faces."""
    return figure.pose(_angles(count, seed)), figure.rest().faces


@cache
def _few(target: int) -> Meshes:
    vertices, faces = full(6)
    return thin(Connectivity(faces, vertices.shape[1]), vertices, target)


def figures(count: int = 10, seed: int = 0, target: int = 600) -> Meshes:
    """Vertices (n, 600, 3) and faces."""
    vertices, _ = full(count, seed)
    kept, faces = _few(target)
    return vertices[:, kept], faces.copy()


def subdivided(meshes: Meshes) -> Meshes:
    """Meshes with each triangle split into four."""
    vertices, faces = meshes
    connectivity = Connectivity(faces, vertices.shape[1])
    middles = vertices[:, connectivity.edges].mean(axis=2)
    (a, b, c), (x, y, z) = faces.T, (connectivity.face_edges + vertices.shape[1]).T
    corners = (a, z, y), (b, x, z), (c, y, x), (x, y, z)
    return np.concatenate([vertices, middles], axis=1), np.concatenate([np.stack(t, axis=1) for t in corners])


def large(count: int) -> Meshes:
    """Vertices (n, 160 thousand, 3) and faces."""
    vertices, faces = subdivided(full(count))
    kept, faces = thin(Connectivity(faces, vertices.shape[1]), vertices[:4], 10_000)
    return subdivided(subdivided((vertices[:, kept], faces)))


def head(count: int = 10) -> Meshes:
    """An open surface: the head, turned a little in each shape."""
    angles = np.zeros((count, len(figure.ANGLES)))
    names = list(figure.ANGLES)
    angles[:, names.index("head nod")] = np.linspace(-0.2, 0.2, count)
    angles[:, names.index("head tilt")] = np.linspace(0.1, -0.1, count) ** 2
    vertices, faces = figure.pose(angles), figure.rest().faces
    faces = faces[vertices[0][faces].mean(axis=1)[:, 1] > 1.5]
    used, local = np.unique(faces, return_inverse=True)
    return vertices[:, used], local.reshape(-1, 3)


def twins(meshes: Meshes, seam: np.ndarray, distance: float) -> Meshes:
    """Give faces at x > 0 copies of the seam's vertices, at a distance given as a share of the diagonal."""
    vertices, faces = meshes
    left = vertices[0][faces].mean(axis=1)[:, 0] > 0
    twin = np.arange(vertices.shape[1])
    twin[seam] = vertices.shape[1] + np.arange(len(seam))
    size = np.linalg.norm(np.ptp(vertices[0], axis=0))
    vertices = np.concatenate([vertices, vertices[:, seam] + [distance * size, 0, 0]], axis=1)
    return vertices, np.where(left[:, None], twin[faces], faces)


def seam(meshes: Meshes) -> np.ndarray:
    """The vertices between the faces at x > 0 and the others."""
    vertices, faces = meshes
    left = vertices[0][faces].mean(axis=1)[:, 0] > 0
    return np.intersect1d(faces[left], faces[~left])


def write(
    folder: Path, meshes: Meshes, format: str = "obj", names: Sequence[str] | None = None, *, first: int = 0
) -> None:
    """Write a file for each shape: pose0, pose1 and so on."""
    folder.mkdir(parents=True, exist_ok=True)
    for k, shape in enumerate(meshes[0], first):
        name = names[k] if names else f"pose{k}"
        data = MESH_FORMATS[format].encode(shape, meshes[1])
        (folder / f"{name}.{format}").write_bytes(data)
