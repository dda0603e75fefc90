"""Arguments of the library's operations: arrays, meshes and paths of files, brought to one form."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.reading import read_arrays
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.correspondence import InvalidMeshError, Matched, match
from shapespace.model.decoder import Decoder
from shapespace.model.options import Target

#: A mesh in memory, or the path of a mesh file.
MeshLike = ArrayLike | TriangleMesh | str | os.PathLike[str]
#: Points, points and faces, a mesh, or the path of a file.
ScanLike = MeshLike | tuple[ArrayLike, ArrayLike]


def matched(decoder: Decoder, mesh: MeshLike) -> Matched:
    """Return a mesh in the model's vertex order; raises MeshError or InvalidMeshError."""
    if isinstance(mesh, TriangleMesh):
        return match(decoder, mesh.vertices, mesh.faces)
    if isinstance(mesh, str | os.PathLike):
        return match(decoder, *read_arrays(Path(mesh)))
    vertices = np.asarray(mesh, dtype=np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise InvalidMeshError(f"vertices must be (V, 3), not {vertices.shape}")
    return match(decoder, vertices, np.empty((0, 3), np.int64))


def listed_targets(
    targets: Mapping[int, ArrayLike] | Sequence[Target], sigma: float | Mapping[int, float] | None
) -> list[Target]:
    """Return targets as a list, with the standard deviation ``sigma`` where they have none."""
    if isinstance(targets, Mapping):
        targets = [Target(int(v), np.asarray(place, dtype=np.float64).tolist()) for v, place in targets.items()]
    sigmas = sigma if isinstance(sigma, Mapping) else {target.vertex: sigma for target in targets}
    return [each if each.sigma is not None else replace(each, sigma=sigmas.get(each.vertex)) for each in targets]


def points_and_faces(scan: ScanLike) -> tuple[FloatArray, IntArray]:
    """Return the points and faces of a scan; no faces if it has none."""
    if isinstance(scan, TriangleMesh):
        return scan.vertices, scan.faces
    if isinstance(scan, str | os.PathLike):
        points, faces = read_arrays(Path(scan), points=True)
    elif isinstance(scan, tuple):
        points, faces = (np.asarray(part) for part in scan)
    else:
        points, faces = np.asarray(scan), np.empty((0, 3))
    return points.astype(np.float64, copy=False), faces.reshape(-1, 3).astype(np.int64, copy=False)
