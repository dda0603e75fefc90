"""Read the shapes of a collection as they stand in their files: a folder of meshes, or one NPZ."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.counted import counted
from shapespace.files.gltf_document import can_be_posed
from shapespace.files.limits import in_words
from shapespace.files.npz import read_mesh_npz
from shapespace.files.reading import MORPH_FORMATS, READ_FORMATS, read_arrays, read_morph_file
from shapespace.mesh.triangle_mesh import MeshError, PlaceError, on_shared_vertices
from shapespace.training.collection.checks import (
    TOLERANCES,
    ShapeSource,
    check_finite,
    mesh_arrays,
    refusing,
    same_connectivity,
)
from shapespace.training.collection.faults import Fault, Faults, IngestError
from shapespace.training.collection.large_arrays import stacked
from shapespace.training.collection.listing import MIN_SHAPES, TOO_FEW, MeshFiles, data_files, extension, mesh_files
from shapespace.training.collection.part_names import difference
from shapespace.training.runs.progress import progress

#: What to do about a file that has only the first faces of another.
_LACKING = "copy it again if the copy was cut short, or else export it with all faces"
#: What to do about coordinates that are not finite.
_NOT_FINITE = "correct that vertex, or leave the shape out"


@dataclass(frozen=True, eq=False)
class FileShapes:
    """Shapes as they stand in their files, all with the same faces."""

    sources: tuple[ShapeSource, ...]  # the n shapes' files and names
    vertices: FloatArray  # (n, N, 3)
    faces: IntArray  # (F, 3)
    paths: tuple[Path, ...] = ()  # the shapes' files; one file if its morph targets are the shapes
    triangles_only: bool = False  # whether no file says which vertices its triangles share, as in STL
    notes: tuple[str, ...] = ()  # sentences on what is left out
    faults: tuple[Fault, ...] = ()  # of all other shapes

    def only(self, kept: Sequence[int]) -> FileShapes:
        """Leave out all shapes but some."""
        sources = tuple(self.sources[k] for k in kept)
        paths = tuple(self.paths[k] for k in kept) if len(self.paths) == len(self.sources) else self.paths
        return replace(self, sources=sources, vertices=self.vertices[list(kept)], paths=paths)


def read_shapes(path: Path, file: str | None = None) -> FileShapes:
    """Read a folder of mesh files in natural order (pose2 before pose10), one NPZ, or one file of morph targets.

    A folder whose only mesh is a glTF file is read like that file.

    Args:
        path: the folder or file.
        file: name of the file to read from each folder in ``path``, see `listing.mesh_files`.

    Raises:
        IngestError: nothing to read, fewer than 3 shapes, or no file that can be read.
    """
    if not path.exists():
        raise IngestError(Fault(str(path), "no such file or folder"))
    if not path.is_file() and not path.is_dir():
        remedy = "name the folder that holds the meshes, or one NPZ"
        raise IngestError(Fault(str(path), "is neither a file nor a folder", remedy))
    if path.is_dir():
        only = None if file else _only_gltf(path)
        return _read_morphs(only) if only else _read_folder(path, file)
    if file:
        raise IngestError(
            Fault(
                str(path), "is a file", "--file NAME is for a folder with one folder per subject, each with that file"
            )
        )
    return _read_morphs(path) if extension(path) in MORPH_FORMATS else _read_npz(path)


def _only_gltf(folder: Path) -> Path | None:
    """Return the mesh file of a folder that holds one, if its format has morph targets."""
    meshes = [p for p in data_files(folder) if extension(p) in READ_FORMATS]
    return meshes[0] if len(meshes) == 1 and extension(meshes[0]) in MORPH_FORMATS else None


class _UnlikeError(IngestError):
    """A readable file whose faces are not the same as in another file."""


def _read_folder(folder: Path, file: str | None) -> FileShapes:
    found = mesh_files(folder, file)
    # STL doesn't say which vertices triangles share. A file of another format does, so its faces count for all files.
    order = sorted(range(len(found.paths)), key=lambda k: extension(found.paths[k]) == "stl")
    shapes, unlike = _read_like_one(found, order)
    if 2 * len(unlike) >= len(found.paths):  # then the first file is probably the odd one
        others, still = _read_like_one(found, [k for k in order if k in unlike])
        if len(still) < len(unlike):
            shapes = others
    return replace(shapes, notes=(*found.left_out, *_pose_notes(shapes.paths)))


def _read_like_one(found: MeshFiles, candidates: Sequence[int]) -> tuple[FileShapes, list[int]]:
    """Read files that must have the faces of one of them: of the first candidate that can be read.

    Returns:
        The shapes, with the faults of all other files; and the indices of the files with other faces.

    Raises:
        IngestError: no candidate can be read; with the faults of all.
    """
    unreadable = Faults(*found.faults)
    for template in candidates:
        with unreadable.gathered():
            vertices, faces = _read_mesh(found.sources[template])
            break
    else:
        unreadable.refuse()
    faults, kept, unlike = Faults(*found.faults), list[int](), list[int]()
    stl = [extension(path) == "stl" for path in found.paths]

    def shapes() -> Iterator[FloatArray]:
        for k, source in enumerate(progress(found.sources, "reading", "file")):
            shape = vertices
            if k != template:
                like = found.sources[template]
                try:
                    shape = _read_like(source, like, vertices, faces, triangles_only=stl[k] and not stl[template])
                except IngestError as error:
                    faults.found += error.faults
                    unlike.extend([k] if isinstance(error, _UnlikeError) else [])
                    continue
            kept.append(k)
            yield shape

    array = stacked(len(found.paths), shapes())[: len(kept)]
    sources, paths = tuple(found.sources[k] for k in kept), tuple(found.paths[k] for k in kept)
    return FileShapes(sources, array, faces, paths, all(stl[k] for k in kept), faults=tuple(faults.found)), unlike


def _read_like(
    source: ShapeSource, template: ShapeSource, vertices: FloatArray, faces: IntArray, *, triangles_only: bool
) -> FloatArray:
    """Read the vertices of a file that must have the faces of a template, vertices (V, 3) and faces (F, 3).

    With ``triangles_only`` the file doesn't say which vertices triangles share, and the template does.
    """
    own_vertices, own_faces = _read_mesh(source, finite=False)
    faults = Faults()
    with faults.gathered(), refusing(source, remedy=_NOT_FINITE):
        check_finite(own_vertices)
    if faults.found and len(own_faces) == len(faces):
        faults.refuse()
    path, other = Path(source.label), Path(template.label)
    try:
        _refuse_cut_short(path, len(own_vertices), own_faces, len(vertices), faces)
        with refusing(source, remedy=f"export it like {template.file}", always=True):
            corners = own_vertices[own_faces]
            if triangles_only:
                return _on_shared_vertices(corners, faces, len(vertices), template.file)
            if len(own_faces) == len(faces) and not np.array_equal(own_faces, faces):
                # Exporters split vertices along sharp edges and seams, in each pose where they like.
                with suppress(MeshError):
                    shape = _on_shared_vertices(corners, faces, len(vertices), template.file)
                    # The other way round too: vertices that this file shares have to coincide in the template.
                    _on_shared_vertices(vertices[faces], own_faces, len(own_vertices), source.file)
                    return shape
            _refuse_cut_short(other, len(vertices), faces, len(own_vertices), own_faces)
            same_connectivity(own_vertices, own_faces, vertices, faces, template.file)
    except IngestError as error:
        found = error.faults
        if why := difference(path, other):
            what = f"has other faces than {template.file}: {why}"
            found = (Fault(source.label, what, f"export it like {template.file}"),)
        raise _UnlikeError(*faults.found, *found) from error
    return own_vertices


def _read_mesh(source: ShapeSource, *, finite: bool = True) -> tuple[FloatArray, IntArray]:
    """Read the vertices (V, 3) and faces (F, 3) of one file; ``finite`` as for `mesh_arrays`."""
    path = Path(source.label)
    remedy = _unfinished(path) or "export it again, or leave it out"
    with refusing(source, remedy=remedy):
        vertices, faces = mesh_arrays(*read_arrays(path), finite=False)
    if finite:
        with refusing(source, remedy=_NOT_FINITE):
            check_finite(vertices)
    return vertices, faces


def _pose_notes(paths: Sequence[Path]) -> list[str]:
    """Return a sentence on glTF files with sliders or joints, if any: each describes more shapes than one."""
    posed = [path.name for path in paths if extension(path) in ("glb", "gltf") and can_be_posed(path)]
    if not posed:
        return []
    more = f" and {len(posed) - 3} more" if len(posed) > 3 else ""
    sentence = (
        f"{', '.join(posed[:3])}{more}: with sliders (morph targets) or joints (a skin); each file gives one shape, "
        "at the present state of its sliders and joints"
    )
    return [sentence]


def _unfinished(path: Path) -> str:
    """Return what to do about an OBJ file whose last line isn't finished, as after an interrupted copy."""
    if extension(path) != "obj" or not path.is_file():
        return ""
    last = ""
    with suppress(OSError), path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 200))
        last = file.read().decode(errors="replace")
    if last[-1:] in ("\n", "\r", "") or not last.replace("\n", "").replace("\r", "").isprintable():
        return ""
    return "its last line is not complete: the file may be cut short; copy it again"


def _refuse_cut_short(path: Path, count: int, faces: IntArray, other_count: int, others: IntArray) -> None:
    """Refuse an OBJ file that is the beginning of another one: the format doesn't say how much a file holds."""
    if extension(path) != "obj" or not path.is_file():
        return
    # The last face may have lost digits.
    if count <= other_count and len(faces) < len(others) and np.array_equal(faces[:-1], others[: len(faces) - 1]):
        what = f"it ends after {count} of {other_count} vertices and {len(faces)} of {len(others)} faces"
        raise IngestError(Fault(str(path), f"seems to be cut short: {what}", _unfinished(path) or _LACKING))


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
    if extension(path) != "npz":
        what = (
            f"is {'one mesh' if extension(path) in READ_FORMATS else 'no mesh'}; a single file can hold a collection "
            "only as .npz, or as .glb or .gltf with a morph target for each shape"
        )
        raise IngestError(Fault(str(path), what, "name the folder that holds the meshes"))
    with refusing(ShapeSource.of_file(path)):
        arrays = _npz_arrays(path)
    sources = tuple(ShapeSource(f"{path}: shape {name}", name) for name in arrays["names"].tolist())

    with refusing(sources[0]):
        mesh_arrays(arrays["vertices"][0], arrays["faces"], finite=False)
    faults, kept = Faults(), list[ShapeSource]()

    def checked() -> Iterator[FloatArray]:
        for source, shape in zip(sources, arrays["vertices"], strict=True):
            with faults.gathered(), refusing(source, remedy=_NOT_FINITE):
                vertices = mesh_arrays(shape, arrays["faces"])[0]
                kept.append(source)
                yield vertices

    vertices = stacked(len(sources), checked())[: len(kept)]
    if not kept:
        faults.refuse()
    return FileShapes(tuple(kept), vertices, arrays["faces"].astype(np.int64), faults=tuple(faults.found))


def _read_morphs(path: Path) -> FileShapes:
    with refusing(ShapeSource(str(path), path.stem)):
        found = read_morph_file(path)
        if len(found.names) < MIN_SHAPES:
            raise MeshError(
                f"{TOO_FEW.format(counted(len(found.names), 'shape'))}: the base, and each morph target that moves "
                "vertices"
            )
    sources = tuple(ShapeSource(f"{path}: shape {name}", name) for name in found.names)
    for source, shape in zip(sources, found.vertices, strict=True):
        with refusing(source):
            mesh_arrays(shape, found.faces)
    return FileShapes(sources, found.vertices, found.faces, (path,))


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
        raise MeshError(TOO_FEW.format(counted(len(shapes), "shape")))
    names = arrays.get("names", np.arange(len(shapes)))
    if names.shape != (len(shapes),) or names.dtype.kind not in "Uiu":
        raise MeshError(f"names must be ({len(shapes)},) strings, not {names.dtype} of shape {names.shape}")
    names = names.astype(str)
    values, counts = np.unique(names, return_counts=True)
    if (counts > 1).any():
        raise MeshError(f"two shapes are called {values[counts.argmax()]!s}; give each its own name")
    return {"vertices": shapes, "faces": arrays["faces"], "names": names}
