"""Mesh files: writing every format the project offers, and reading them back with the vertices in order."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.gltf_reading import read_gltf
from shapespace.files.limits import UNLIMITED, Limits, clipped
from shapespace.files.npz_reading import load_npz
from shapespace.files.polygon_reading import read_obj, read_off, read_ply, read_stl, read_xyz
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError

if TYPE_CHECKING:
    from shapespace.files.colouring import Colouring

#: Media type of formats that have none registered at IANA.
OCTET_STREAM = "application/octet-stream"


class Encode(Protocol):
    """Writes a file."""

    def __call__(
        self,
        vertices: FloatArray,
        faces: IntArray,
        colouring: Colouring | None = None,
        surface: MeshAttributes | None = None,
        /,
    ) -> bytes:
        """Encode vertices (V, 3) in any unit and faces (F, 3), with what the surface has; positions are float32."""


@dataclass(frozen=True)
class MeshFormat:
    """A file format.

    Attributes:
        media_type: as IANA has it; OCTET_STREAM without a registration.
        encode: a mesh, with the colours of its vertices or without, to the file's bytes.
        coloured: whether files can carry colours; where not, ``encode`` leaves them out.
        polygons: whether faces are those of the surface, where there is one; otherwise they are triangles.
    """

    media_type: str
    encode: Encode
    coloured: bool = True
    polygons: bool = False


def _glb(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    from shapespace.files.gltf_writing import GltfBuilder

    return GltfBuilder(vertices, faces, colouring=colouring, surface=surface).glb()


def _gltf(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    from shapespace.files.gltf_writing import GltfBuilder

    return GltfBuilder(vertices, faces, colouring=colouring, surface=surface).gltf()


def _obj(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    from shapespace.files.attributes.obj import write_obj

    return write_obj(vertices, surface or MeshAttributes.of_triangles(faces), colouring).encode()


def _obj_zip(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    from shapespace.files.archives import zip_pieces
    from shapespace.files.attributes.obj import obj_files, write_obj

    shown = surface or MeshAttributes.of_triangles(faces)
    files = obj_files(shown, "shape")
    text = write_obj(vertices, shown, colouring, "shape.mtl" if files else None)
    members = {"shape.obj": text.encode(), **files}
    return b"".join(zip_pieces((name, [content]) for name, content in members.items()))


def _ply(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    from shapespace.files.attributes.ply import write_ply

    return write_ply(vertices, surface or MeshAttributes.of_triangles(faces), colouring)


def _stl(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    import trimesh

    content = trimesh.Trimesh(vertices.astype(np.float32), faces, process=False).export(file_type="stl")
    return content if isinstance(content, bytes) else str(content).encode()


def _npz(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    colours = {}
    if colouring:
        colours = {
            "color_quantity": np.array(str(colouring.quantity)),
            "color_range": np.array(colouring.ends),
            "color_values": colouring.values.astype(np.float32),
        }
    return npz(vertices=vertices.astype(np.float32), faces=faces.astype(np.int32), **colours)


def _usd(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    from shapespace.files.usd import still_usd

    return still_usd(vertices, faces, colouring, surface)


def _usdz(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    from shapespace.files.usd import still_usd

    return still_usd(vertices, faces, colouring, surface, packed=True)


#: Every mesh format by its name, which is also the extension of its files. The first is the default.
MESH_FORMATS: dict[str, MeshFormat] = {
    "glb": MeshFormat("model/gltf-binary", _glb),
    "gltf": MeshFormat("model/gltf+json", _gltf),
    "obj": MeshFormat("model/obj", _obj, polygons=True),
    "ply": MeshFormat(OCTET_STREAM, _ply, polygons=True),
    "stl": MeshFormat("model/stl", _stl, coloured=False),
    "npz": MeshFormat(OCTET_STREAM, _npz),
}
#: An archive of an OBJ file with its materials and textures beside it, which is not read.
OBJ_ZIP = MeshFormat("application/zip", _obj_zip, polygons=True)
#: What the package ``usd-core`` writes, where it is installed; files are binary layers, which are not read.
USD_FORMATS = {
    "usd": MeshFormat(OCTET_STREAM, _usd, polygons=True),
    "usdz": MeshFormat("model/vnd.usdz+zip", _usdz, polygons=True),
}
#: Media types of the formats that can be read, by name.
READ_FORMATS = {name: format.media_type for name, format in MESH_FORMATS.items()} | {"off": OCTET_STREAM}
#: The same for point clouds, which may do without faces.
SCAN_FORMATS = READ_FORMATS | {"xyz": OCTET_STREAM}


def npz(**arrays: np.ndarray) -> bytes:
    """Arrays as the bytes of a compressed NPZ file; equal arrays give equal bytes."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def read_arrays(
    source: bytes | bytearray | memoryview | Path,
    format: str | None = None,
    limits: Limits = UNLIMITED,
    *,
    points: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Read one mesh as it stands in its file: vertices (V, 3) and faces (F, 3), nothing merged and nothing checked.

    STL has three vertices a face. A path also finds the buffers that lie beside a glTF file.

    Args:
        source: the file's bytes, or its path.
        format: one of READ_FORMATS; by default the path's extension.
        limits: where reading ends without a mesh; they bound its time and memory, whatever the bytes are.
        points: whether points without faces will do; then one of SCAN_FORMATS.

    Raises:
        MeshError: unreadable, too large, or not exactly one mesh; with the reason.

    >>> import numpy as np
    >>> corners, faces = np.eye(4, 3), np.array([[0, 1, 2], [0, 3, 1], [1, 3, 2], [2, 3, 0]])
    >>> content = MESH_FORMATS["obj"].encode(corners, faces)
    >>> vertices, triangles = read_arrays(content, "obj")
    >>> bool((vertices == corners).all() and (triangles == faces).all())
    True
    """
    beside = source if isinstance(source, Path) else None
    if isinstance(source, Path):
        format = format or source.suffix.lstrip(".").lower()
        try:
            source = source.read_bytes()
        except OSError as error:
            raise MeshError(f"can't be read: {error.strerror}") from error
    data = memoryview(source)
    try:
        # Whether coordinates that are not finite are a fault is for the caller to decide.
        with np.errstate(all="ignore"):
            match format:
                case "glb" | "gltf":
                    return read_gltf(data, limits, binary=format == "glb", beside=beside)
                case "npz":
                    arrays = load_npz(data, limits=limits, needed=("vertices",) if points else ("vertices", "faces"))
                    return arrays["vertices"], arrays.get("faces", np.zeros((0, 3), np.int64))
                case "xyz" if points:
                    return read_xyz(data, limits)
                case _:
                    return _READERS[str(format)](data, limits)
    except MeshError:
        raise
    except Exception as error:  # bytes from outside may raise anything
        raise MeshError(f"not a readable {format} file: {clipped(error, 300)}") from error


_READERS = {"obj": read_obj, "off": read_off, "ply": read_ply, "stl": read_stl}
