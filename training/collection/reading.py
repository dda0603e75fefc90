"""Read the shapes of a collection as they stand in their files: a folder of meshes, or one NPZ."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.archives import natural_order
from shapespace.files.limits import in_words
from shapespace.files.npz import read_mesh_npz
from shapespace.files.reading import READ_FORMATS, read_arrays
from shapespace.mesh.triangle_mesh import MeshError, PlaceError, on_shared_vertices
from shapespace.training.collection.checks import (
    TOLERANCES,
    IngestError,
    ShapeSource,
    mesh_arrays,
    refusing,
    same_connectivity,
)
from shapespace.training.collection.large_arrays import stacked
from shapespace.training.collection.part_names import difference
from shapespace.training.runs.progress import progress

#: With fewer shapes a mean and modes say nothing about a collection.
MIN_SHAPES = 3
TOO_FEW = f"has {{}} shapes; at least {MIN_SHAPES} are needed"

#: Extensions of files that accompany meshes: buffers of glTF, materials of OBJ, and textures.
_COMPANIONS = ("bin", "mtl", "png", "jpg", "jpeg")


@dataclass(frozen=True, eq=False)
class FileShapes:
    """Shapes as they stand in their files, all with the same faces."""

    sources: tuple[ShapeSource, ...]  # the n shapes' files and names
    vertices: FloatArray  # (n, N, 3)
    faces: IntArray  # (F, 3)
    paths: tuple[Path, ...] = ()  # the shapes' files, if each shape has one
    triangles_only: bool = False  # whether no file says which vertices its triangles share, as in STL


def read_shapes(path: Path) -> FileShapes:
    """Read a folder of mesh files in natural order (pose2 before pose10), or one NPZ.

    Raises:
        IngestError: nothing to read, fewer than 3 shapes, an unreadable file, or files with different faces.
    """
    if not path.exists():
        raise IngestError(f"{path}: no such file or folder")
    if not path.is_file() and not path.is_dir():
        raise IngestError(f"{path}: is neither a file nor a folder; name the folder that holds the meshes, or one NPZ")
    return _read_folder(path) if path.is_dir() else _read_npz(path)


def data_files(path: Path) -> list[Path]:
    """Return the files that a collection is read from, sorted; none if the path doesn't exist."""
    if not path.is_dir():
        return [path] if path.is_file() else []
    return sorted(
        p for p in path.iterdir() if _extension(p) in (*READ_FORMATS, *_COMPANIONS) and p.is_file() and p.name[0] != "."
    )


def _extension(path: Path) -> str:
    return path.suffix.lstrip(".").lower()


def _mesh_files(folder: Path) -> list[Path]:
    """List the mesh files of a folder in natural order, at least 3 and with different names."""
    files = [path for path in folder.iterdir() if not path.name.startswith(".") and not path.is_dir()]
    paths = sorted(
        (path for path in files if _extension(path) in READ_FORMATS),
        key=lambda path: (natural_order(path.stem), path.name),
    )
    if not paths:
        others = sorted({path.suffix or path.name for path in files})
        found = f"only {', '.join(others[:8])}" if others else "it has no files"
        raise IngestError(f"{folder}: holds no meshes ({found}); these can be read: {', '.join(READ_FORMATS)}")
    if len(paths) < MIN_SHAPES:
        npz = _extension(paths[0]) == "npz"
        hint = "; where an NPZ holds the whole collection, name that file, not its folder" if npz else ""
        raise IngestError(f"{folder}: {TOO_FEW.format(len(paths))}{hint}")
    by_name: dict[str, Path] = {}
    for path in paths:
        if path.stem in by_name:
            raise IngestError(f"{path}: {by_name[path.stem].name} has the same name; remove or rename one of them")
        by_name[path.stem] = path
    return paths


def _read_folder(folder: Path) -> FileShapes:
    paths = _mesh_files(folder)
    # STL doesn't say which vertices triangles share. A file of another format does, so its faces count for all files.
    stl = [_extension(path) == "stl" for path in paths]
    template = stl.index(False) if False in stl else 0
    vertices, faces = _read_mesh(paths[template])

    def shapes() -> Iterator[FloatArray]:
        for k, path in enumerate(progress(paths, "reading", "file")):
            if k == template:
                yield vertices
            else:
                yield _read_like(path, paths[template], vertices, faces, triangles_only=stl[k] and not stl[template])

    shape_array = stacked(len(paths), shapes())
    return FileShapes(tuple(map(ShapeSource.of_file, paths)), shape_array, faces, tuple(paths), all(stl))


def _read_like(
    path: Path, template: Path, vertices: FloatArray, faces: IntArray, *, triangles_only: bool
) -> FloatArray:
    """Read the vertices of a file that must have the faces of a template, vertices (V, 3) and faces (F, 3).

    With ``triangles_only`` the file doesn't say which vertices triangles share, and the template does.
    """
    try:
        own_vertices, own_faces = _read_mesh(path)
        _refuse_cut_short(path, len(own_vertices), own_faces, len(vertices), faces)
        with refusing(ShapeSource.of_file(path)):
            corners = own_vertices[own_faces]
            if triangles_only:
                return _on_shared_vertices(corners, faces, len(vertices), template.name)
            if len(own_faces) == len(faces) and not np.array_equal(own_faces, faces):
                # Exporters split vertices along sharp edges and seams, in each pose where they like.
                with suppress(MeshError):
                    shape = _on_shared_vertices(corners, faces, len(vertices), template.name)
                    # The other way round too: vertices that this file shares have to coincide in the template.
                    _on_shared_vertices(vertices[faces], own_faces, len(own_vertices), path.name)
                    return shape
            _refuse_cut_short(template, len(vertices), faces, len(own_vertices), own_faces)
            same_connectivity(own_vertices, own_faces, vertices, faces, template.name)
    except IngestError as error:
        if why := difference(path, template):
            raise IngestError(f"{path}: has other faces than {template.name}: {why}") from error
        raise
    return own_vertices


def _read_mesh(path: Path) -> tuple[FloatArray, IntArray]:
    """Read the vertices (V, 3) and faces (F, 3) of one file."""
    try:
        with refusing(ShapeSource.of_file(path)):
            return mesh_arrays(*read_arrays(path))
    except IngestError as error:
        raise IngestError(f"{error}{_unfinished(path)}") from error


def _unfinished(path: Path) -> str:
    """Return the end of a sentence about an OBJ file whose last line isn't finished, as after an interrupted copy."""
    if _extension(path) != "obj" or not path.is_file():
        return ""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 200))
        last = file.read().decode(errors="replace")
    if last[-1:] in ("\n", "\r", "") or not last.replace("\n", "").replace("\r", "").isprintable():
        return ""
    return f"; its last line, {last.splitlines()[-1][-60:]!r}, has no end: if the file is cut short, copy it again"


def _refuse_cut_short(path: Path, count: int, faces: IntArray, other_count: int, others: IntArray) -> None:
    """Refuse an OBJ file that is the beginning of another one: the format doesn't say how much a file holds."""
    if _extension(path) != "obj" or not path.is_file():
        return
    # The last face may have lost digits.
    if count <= other_count and len(faces) < len(others) and np.array_equal(faces[:-1], others[: len(faces) - 1]):
        raise IngestError(
            f"{path}: is cut short, it seems: it ends after {count} of {other_count} vertices and {len(faces)} of "
            f"{len(others)} faces{_unfinished(path) or '; copy it again'}"
        )


def _on_shared_vertices(corners: FloatArray, faces: IntArray, vertex_count: int, other: str) -> FloatArray:
    """Find the vertices (V, 3) of separate triangles (F, 3, 3) that have the faces of another file, in its order."""
    if len(corners) != len(faces):
        raise MeshError(
            f"has {len(corners)} faces, but {other} has {len(faces)}; all meshes need the same connectivity"
        )
    vertices, torn = on_shared_vertices(corners, faces, vertex_count, TOLERANCES.weld)
    if len(torn):
        raise PlaceError(
            f"face {{face}} is not where it is in {other}: STL files must list the faces in the same order",
            {"face": [int(torn[0])]},
        )
    return vertices


def _read_npz(path: Path) -> FileShapes:
    if _extension(path) != "npz":
        raise IngestError(f"{path}: one file is a collection only as .npz; name the folder that holds the meshes")
    with refusing(ShapeSource.of_file(path)):
        arrays = _npz_arrays(path)
    sources = tuple(ShapeSource(f"{path}: shape {name}", name) for name in arrays["names"].tolist())

    def checked() -> Iterator[FloatArray]:
        for source, shape in zip(sources, arrays["vertices"], strict=True):
            with refusing(source):
                yield mesh_arrays(shape, arrays["faces"])[0]

    return FileShapes(sources, stacked(len(sources), checked()), arrays["faces"].astype(np.int64))


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    """Read ``vertices`` (n, V, 3), ``faces`` (F, 3) and ``names`` (n,) of an NPZ; names default to numbers from 0."""
    try:
        arrays = read_mesh_npz(memoryview(path.read_bytes()), ("vertices", "faces", "names"))
    except OSError as error:
        raise MeshError(f"can't be read: {in_words(error, named=False)}") from error
    shapes = arrays["vertices"]
    if shapes.ndim != 3 or shapes.shape[2] != 3:
        raise MeshError(f"vertices must be an (n, V, 3) array, not of shape {shapes.shape}")
    if len(shapes) < MIN_SHAPES:
        raise MeshError(TOO_FEW.format(len(shapes)))
    names = arrays.get("names", np.arange(len(shapes)))
    if names.shape != (len(shapes),) or names.dtype.kind not in "Uiu":
        raise MeshError(f"names must be ({len(shapes)},) strings, not {names.dtype} of shape {names.shape}")
    names = names.astype(str)
    values, counts = np.unique(names, return_counts=True)
    if (counts > 1).any():
        raise MeshError(f"two shapes are called {values[counts.argmax()]!s}; each needs a name of its own")
    return {"vertices": shapes, "faces": arrays["faces"], "names": names}
