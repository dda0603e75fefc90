"""Mesh files: writing every format the project offers, and reading them back with the vertices in order."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from geometry.gltf import Document
from geometry.mesh import FloatArray, IntArray, MeshError, TriangleMesh


@dataclass(frozen=True)
class MeshFormat:
    """A file format.

    Attributes:
        media_type: as IANA has it; formats without a registration are ``application/octet-stream``.
        encode: vertices (V, 3) in any unit and faces (F, 3) to the file's bytes. Positions are float32.
    """

    media_type: str
    encode: Callable[[FloatArray, IntArray], bytes]


def _glb(vertices: FloatArray, faces: IntArray) -> bytes:
    return Document(vertices, faces).glb()


def _gltf(vertices: FloatArray, faces: IntArray) -> bytes:
    return Document(vertices, faces).gltf()


def _obj(vertices: FloatArray, faces: IntArray) -> bytes:
    # Nine significant digits hold a float32 whatever the unit; trimesh writes a fixed number of decimals.
    positions = map("v %.9g %.9g %.9g\n".__mod__, map(tuple, vertices.astype(np.float32).tolist()))
    triangles = map("f %d %d %d\n".__mod__, map(tuple, (faces + 1).tolist()))
    return "".join([*positions, *triangles]).encode()


def _npz(vertices: FloatArray, faces: IntArray) -> bytes:
    return npz(vertices=vertices.astype(np.float32), faces=faces.astype(np.int32))


def _trimesh(extension: str) -> Callable[[FloatArray, IntArray], bytes]:
    def encode(vertices: FloatArray, faces: IntArray) -> bytes:
        import trimesh

        mesh = trimesh.Trimesh(vertices.astype(np.float32), faces, process=False)
        content = mesh.export(file_type=extension)
        return content if isinstance(content, bytes) else str(content).encode()

    return encode


#: Every mesh format by its name, which is also the extension of its files. The first is the default.
MESH_FORMATS: dict[str, MeshFormat] = {
    "glb": MeshFormat("model/gltf-binary", _glb),
    "gltf": MeshFormat("model/gltf+json", _gltf),
    "obj": MeshFormat("model/obj", _obj),
    "ply": MeshFormat("application/octet-stream", _trimesh("ply")),
    "stl": MeshFormat("model/stl", _trimesh("stl")),
    "npz": MeshFormat("application/octet-stream", _npz),
}


def npz(**arrays: np.ndarray) -> bytes:
    """Arrays as the bytes of a compressed NPZ file; equal arrays give equal bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def read_mesh(source: bytes | Path, format: str | None = None) -> TriangleMesh:
    """Read one triangle mesh, vertices and faces in the order of the file, nothing merged.

    Args:
        source: the file's bytes, or its path.
        format: ``glb``, ``gltf``, ``obj``, ``ply``, ``stl``, ``off`` or ``npz``; by default the path's
            extension.

    Raises:
        MeshError: unreadable, not exactly one mesh, or not a valid TriangleMesh; with the reason.
    """
    if isinstance(source, Path):
        format = format or source.suffix.lstrip(".").lower()
        try:
            source = source.read_bytes()
        except OSError as error:
            raise MeshError(f"can't be read: {error.strerror}") from error
    try:
        vertices, faces = _READERS[format](source) if format in _READERS else _read_trimesh(source, format)
    except MeshError:
        raise
    except Exception as error:  # parsers of foreign bytes fail in every way there is
        raise MeshError(f"not a readable {format} file: {error}") from error
    return TriangleMesh.from_arrays(vertices, faces)


def _read_npz(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        return arrays["vertices"], arrays["faces"]


def _read_obj(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    # By hand: where there are texture coordinates, trimesh splits and shuffles the vertices.
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for line in data.decode(errors="replace").splitlines():
        keyword, *values = line.split() or [""]
        if keyword == "v":
            vertices.append([float(value) for value in values[:3]])
        elif keyword == "f":
            numbers = [int(value.split("/")[0]) for value in values]
            first, *others = (n - 1 if n > 0 else len(vertices) + n for n in numbers)
            faces += [[first, a, b] for a, b in pairwise(others)]
    return np.array(vertices).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)


_READERS = {"npz": _read_npz, "obj": _read_obj}


def _read_trimesh(data: bytes, format: str | None) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    scene = trimesh.load_scene(io.BytesIO(data), file_type=format, process=False, skip_materials=True)
    if len(scene.geometry) != 1:
        raise MeshError(f"holds {len(scene.geometry)} meshes; send a file with exactly one")
    mesh = scene.to_mesh()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
