"""Reading one mesh file of any format, with the vertices in the order of the file.

This module imports no writer, because the process that reads uploads should start fast and need little memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from shapespace.files.archives import Place
from shapespace.files.gltf_reading import MorphShapes, read_gltf, read_morph_shapes
from shapespace.files.limits import UNLIMITED, Limits, in_words, read_plain, reason
from shapespace.files.npz import read_mesh_npz
from shapespace.files.pcd_reading import read_pcd
from shapespace.files.ply_reading import read_ply
from shapespace.files.point_text_reading import read_point_text
from shapespace.files.polygon_reading import read_obj, read_off, read_stl
from shapespace.files.recognition import FormatError, decide
from shapespace.files.vtk_reading import read_vtk
from shapespace.files.vtk_xml_reading import read_vtp
from shapespace.mesh.triangle_mesh import MeshError

#: Media type of formats that have none registered at IANA.
OCTET_STREAM = "application/octet-stream"
#: Media types of the mesh formats that can be read, by name.
READ_FORMATS = {
    "glb": "model/gltf-binary",
    "gltf": "model/gltf+json",
    "obj": "model/obj",
    "ply": OCTET_STREAM,
    "stl": "model/stl",
    "npz": OCTET_STREAM,
    "off": OCTET_STREAM,
    "vtk": OCTET_STREAM,
    "vtu": OCTET_STREAM,
    "vtp": OCTET_STREAM,
}
#: Media types of the formats of point clouds, which may have no faces.
SCAN_FORMATS = READ_FORMATS | {
    "xyz": OCTET_STREAM,
    "pts": OCTET_STREAM,
    "csv": "text/csv",
    "txt": "text/plain",
    "pcd": OCTET_STREAM,
}
#: Formats whose files can hold a collection as morph targets.
MORPH_FORMATS = ("glb", "gltf")
_READERS = {"obj": read_obj, "off": read_off, "ply": read_ply, "stl": read_stl, "vtk": read_vtk}
_READERS |= {"vtu": read_vtp, "vtp": read_vtp}


def read_arrays(
    source: bytes | bytearray | memoryview | Path,
    format: str | None = None,
    limits: Limits = UNLIMITED,
    *,
    points: bool = False,
    beside: Place | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    r"""Read one mesh as it is in its file: vertices (V, 3) and faces (F, 3), nothing merged and nothing checked.

    An STL file has three vertices for each face. With a path, the buffers that lie beside a glTF file are found too.

    A damaged or hostile file can take long, or as much memory as there is. Read files of untrusted clients in a process
    with limits, as the server does (`shapespace.service.limits.sandbox`).

    Args:
        source: content of the file, or its path.
        format: one of READ_FORMATS; by default the first bytes decide, then the extension of the path.
        limits: largest numbers of vertices and faces. A larger mesh is refused.
        points: whether points without faces are accepted. The format can then be one of SCAN_FORMATS.
        beside: place of the content, if it is not given as a path: the buffers of a glTF file lie there.

    Raises:
        MeshError: the file is unreadable, too large, or doesn't hold exactly one mesh.

    >>> content = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"
    >>> vertices, faces = read_arrays(content, "obj")
    >>> vertices.shape, faces.tolist()
    ((3, 3), [[0, 1, 2]])
    """
    beside = source if isinstance(source, Path) else beside
    if isinstance(source, Path):
        source = _content(source)
    data = memoryview(source)
    format = format.lower() if format else _decided(data, SCAN_FORMATS if points else READ_FORMATS, beside)
    # The caller decides whether coordinates that are not finite are a fault.
    with _refusing(format), np.errstate(all="ignore"):
        vertices, faces = _read(data, format, limits, points=points, beside=beside)
    if data and not vertices.size:  # of an empty file the caller says that it is empty
        raise MeshError(f"not a readable {format} file: it holds no vertices")
    return vertices, faces


def read_morph_file(path: Path) -> MorphShapes:
    """Return the shapes of a file of MORPH_FORMATS whose morph targets are the shapes, see `read_morph_shapes`.

    Raises:
        MeshError: the file is unreadable, or two targets of a mesh have one name.
    """
    data = memoryview(_content(path))
    format = _decided(data, MORPH_FORMATS, path)
    with _refusing(format), np.errstate(all="ignore"):
        return read_morph_shapes(data, binary=format == "glb", beside=path)


def _content(path: Path) -> bytes:
    try:
        return read_plain(path)
    except OSError as error:
        hint = "; name the files in it, as in *.ply" if path.is_dir() else ""
        raise MeshError(f"can't be read: {in_words(error, named=False)}{hint}") from error


@contextmanager
def _refusing(format: str) -> Iterator[None]:
    """Raise every exception of a reader as MeshError."""
    try:
        yield
    except (MeshError, MemoryError):
        raise
    except Exception as error:  # damaged files raise exceptions of many classes
        raise MeshError(f"not a readable {format} file: {reason(error)}") from error


def _read(
    data: memoryview, format: str, limits: Limits, *, points: bool, beside: Place | None
) -> tuple[np.ndarray, np.ndarray]:
    match format:
        case "glb" | "gltf":
            return read_gltf(data, limits, binary=format == "glb", beside=beside)
        case "npz":
            needed = ("vertices",) if points else ("vertices", "faces")
            arrays = read_mesh_npz(data, limits=limits, needed=needed)
            return arrays["vertices"], arrays.get("faces", np.zeros((0, 3), np.int64))
        case "xyz" | "pts" | "csv" | "txt" if points:
            return read_point_text(data, limits)
        case "pcd" if points:
            return read_pcd(data, limits)
        case _ if format in _READERS:
            return _READERS[format](data, limits)
        case _:
            known = ", ".join(SCAN_FORMATS if points else READ_FORMATS)
            raise FormatError(f"not a readable {format} file: there is no such format; these can be read: {known}")


def _decided(data: memoryview, formats: Iterable[str], path: Place | None) -> str:
    """Return the format of a file that names none; raises FormatError with the formats that can be read."""
    try:
        return decide(data, [*formats], path.name if path else "").name
    except FormatError as error:
        raise FormatError(f"{error}; these can be read: {', '.join(formats)}") from None
