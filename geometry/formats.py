"""Mesh files: writing every format the project offers, and reading them back with the vertices in order."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from geometry.colouring import Colouring
from geometry.gltf import Document
from geometry.mesh import FloatArray, IntArray, MeshError

#: Formats that IANA doesn't know.
OCTET_STREAM = "application/octet-stream"


class Encode(Protocol):
    """Writes a file."""

    def __call__(self, vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, /) -> bytes:
        """Encode vertices (V, 3) in any unit and faces (F, 3); positions are float32."""


@dataclass(frozen=True)
class MeshFormat:
    """A file format.

    Attributes:
        media_type: as IANA has it; OCTET_STREAM without a registration.
        encode: a mesh, with the colours of its vertices or without, to the file's bytes.
        coloured: whether files can carry colours; where not, ``encode`` leaves them out.
    """

    media_type: str
    encode: Encode
    coloured: bool = True


def _glb(vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None) -> bytes:
    return Document(vertices, faces, colouring=colouring).glb()


def _gltf(vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None) -> bytes:
    return Document(vertices, faces, colouring=colouring).gltf()


def _obj(vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None) -> bytes:
    return (obj_vertices(vertices, colouring) + obj_faces(faces)).encode()


def obj_vertices(vertices: FloatArray, colouring: Colouring | None = None) -> str:
    """The positions (V, 3) of an OBJ file, with colours behind them as most readers know them."""
    # Nine significant digits hold a float32 whatever the unit; trimesh writes a fixed number of decimals.
    comment, line, rows = "", "v %.9g %.9g %.9g\n", vertices.astype(np.float32)
    if colouring:
        comment = f"# color {json.dumps(colouring.legend)}\n"
        line, rows = "v %.9g %.9g %.9g %.4g %.4g %.4g\n", np.hstack([rows, colouring.srgb])
    # All at once is twice as fast as line by line.
    return comment + line * len(rows) % tuple(rows.ravel().tolist())


def obj_faces(faces: IntArray) -> str:
    """The faces (F, 3) of an OBJ file."""
    return "f %d %d %d\n" * len(faces) % tuple((faces + 1).ravel().tolist())


def _ply(vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None) -> bytes:
    return _exported("ply", vertices, faces, colouring)


def _stl(vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None) -> bytes:
    return _exported("stl", vertices, faces, None)


def _exported(extension: str, vertices: FloatArray, faces: IntArray, colouring: Colouring | None) -> bytes:
    import trimesh

    colours = {}
    if colouring:
        values = {str(colouring.quantity): colouring.values.astype(np.float32)}
        colours = {"vertex_colors": colouring.srgb_bytes, "vertex_attributes": values}
    mesh = trimesh.Trimesh(vertices.astype(np.float32), faces, process=False, **colours)  # type: ignore[arg-type]
    content = mesh.export(file_type=extension)
    return content if isinstance(content, bytes) else str(content).encode()


def _npz(vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None) -> bytes:
    colours = {}
    if colouring:
        colours = {
            "color_quantity": np.array(str(colouring.quantity)),
            "color_range": np.array([-colouring.limit, colouring.limit]),
            "color_values": colouring.values.astype(np.float32),
        }
    return npz(vertices=vertices.astype(np.float32), faces=faces.astype(np.int32), **colours)


#: Every mesh format by its name, which is also the extension of its files. The first is the default.
MESH_FORMATS: dict[str, MeshFormat] = {
    "glb": MeshFormat("model/gltf-binary", _glb),
    "gltf": MeshFormat("model/gltf+json", _gltf),
    "obj": MeshFormat("model/obj", _obj),
    "ply": MeshFormat(OCTET_STREAM, _ply),
    "stl": MeshFormat("model/stl", _stl, coloured=False),
    "npz": MeshFormat(OCTET_STREAM, _npz),
}


def npz(**arrays: np.ndarray) -> bytes:
    """Arrays as the bytes of a compressed NPZ file; equal arrays give equal bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def read_arrays(source: bytes | Path, format: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Read one mesh as it stands in its file: vertices (V, 3) and faces (F, 3), nothing merged and nothing checked.

    STL has three vertices a face. A path also finds the buffers that lie beside a glTF file.

    Args:
        source: the file's bytes, or its path.
        format: ``glb``, ``gltf``, ``obj``, ``ply``, ``stl``, ``off`` or ``npz``; by default the path's
            extension.

    Raises:
        MeshError: unreadable, or not exactly one mesh; with the reason.
    """
    beside = source if isinstance(source, Path) else None
    if isinstance(source, Path):
        format = format or source.suffix.lstrip(".").lower()
        try:
            source = source.read_bytes()
        except OSError as error:
            raise MeshError(f"can't be read: {error.strerror}") from error
    try:
        return _READERS[format](source) if format in _READERS else _read_trimesh(source, format, beside)
    except MeshError:
        raise
    except Exception as error:  # parsers of foreign bytes fail in every way there is
        why = " ".join(str(error).split())
        if isinstance(error, ImportError):  # trimesh took broken binary data for text in some encoding, to be guessed
            why = "damaged, or another kind of file"
        elif isinstance(error, FileNotFoundError):
            why = f"it needs {why}, which is not beside it"
        raise MeshError(f"not a readable {format} file: {why}") from error


def _read_npz(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    arrays = load_npz(data)
    return arrays["vertices"], arrays["faces"]


def load_npz(data: bytes) -> dict[str, np.ndarray]:
    """The arrays of an NPZ file that holds at least ``vertices`` and ``faces``.

    Raises:
        MeshError: no NPZ file, pickled objects (which could run code), or without those two; with the reason.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = dict(file)
    except Exception as error:  # NumPy, zipfile and zlib each have their own
        pickled = "pickle" in str(error) and data[:2] == b"PK"
        why = "it holds pickled objects, save plain arrays instead" if pickled else "damaged, or another kind of file"
        raise MeshError(f"not a readable npz file: {why}") from error
    missing = {"vertices", "faces"} - arrays.keys()
    if missing:
        raise MeshError(f"holds no array '{min(missing)}', only {', '.join(sorted(arrays)) or 'nothing'}")
    return arrays


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


def _read_trimesh(data: bytes, format: str | None, beside: Path | None) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    # PLY with texture coordinates would be split along its seams, and shuffled.
    options: dict[str, Any] = {"fix_texture": False} if format == "ply" else {}
    if format == "gltf":
        json.loads(data)  # where that fails, trimesh looks for other files and complains about those
    # Coordinates that aren't finite are for the caller to judge.
    with np.errstate(all="ignore"):
        scene = trimesh.load_scene(
            io.BytesIO(data),
            file_type=format,
            resolver=trimesh.resolvers.FilePathResolver(str(beside)) if beside else None,
            process=False,
            skip_materials=True,
            **options,
        )
    meshes = [g for g in scene.geometry.values() if isinstance(g, trimesh.Trimesh)]
    if not meshes:  # where it can guess encodings, trimesh takes broken binary data for text that says nothing
        raise MeshError(f"not a readable {format} file: damaged, or without a mesh")
    # A glTF mesh has a primitive for each of its materials.
    if len(meshes) != 1 and not all(m.metadata.get("from_gltf_primitive") for m in meshes):
        raise MeshError(f"holds {len(meshes)} meshes; a file needs exactly one")
    mesh = scene.to_mesh()
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
