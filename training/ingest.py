"""Reading a collection: mesh files in correspondence, or one NPZ; checked, and welded in the same way for all shapes.

Correspondence means the same faces in the same order. Triangles of STL files correspond by their order, and so do their
corners. Faces keep their winding, even where it is inside out: what leaves the system then fits what the user has.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from geometry.formats import load_npz, read_arrays
from geometry.mesh import (
    Connectivity,
    EdgeError,
    FloatArray,
    IntArray,
    MeshError,
    TriangleMesh,
    align,
    diagonal,
    face_areas,
)

FORMATS = ("obj", "ply", "stl", "off", "gltf", "glb", "npz")
MIN_SHAPES = 3
TOO_FEW = f"has {{}} shapes; at least {MIN_SHAPES} are needed"

#: Vertices nearer than this part of the bounding box's diagonal coincide; float32 keeps 6e-8 of a coordinate.
WELD_TOLERANCE = 1e-6

#: Volumes below this part of area^(3/2) (a ball: 0.094) say nothing about inside and outside.
CLEAR_VOLUME = 1e-3


class IngestError(ValueError):
    """A collection that can't be used: one line with the file, the fault and, where there is one, the remedy."""


@dataclass(frozen=True, eq=False)
class MeshCollection:
    """Shapes in correspondence, each a valid TriangleMesh of one component, in the user's units.

    Attributes:
        names: of the n shapes: stems of their files in natural order (pose2 before pose10), or the NPZ's own.
        vertices: (n, V, 3) positions as in the files.
        faces: (F, 3) of every shape, in the order of the files.
        file_vertices: (N,) which vertex each of a file's vertices has become, −1 for those in no face. None where there
            are no files.
        notes: what was met and dealt with, a sentence each.
    """

    names: tuple[str, ...]
    vertices: FloatArray
    faces: IntArray
    file_vertices: IntArray | None = None
    notes: tuple[str, ...] = ()

    def index(self, name: str | None) -> int:
        """Index of the shape of that name, or of the first for None; IngestError if there is none."""
        if name is not None and name not in self.names:
            raise IngestError(f"no shape is called {name!r}; there are {', '.join(self.names[:8])} …")
        return 0 if name is None else self.names.index(name)


@dataclass(frozen=True)
class _Raw:
    """Shapes as they stand in their files, with the same faces; labels name their origin in messages."""

    labels: Sequence[str]
    names: Sequence[str]
    vertices: FloatArray
    faces: IntArray
    soup: bool = False


def read_collection(path: Path) -> MeshCollection:
    """Read a folder of OBJ, PLY, STL, OFF, glTF or NPZ files, or one NPZ of ``vertices`` (n, V, 3) and ``faces``.

    Vertices that coincide in every shape become one, since exporters split them along seams of texture or shading and
    STL has no shared ones; those that coincide in some shapes only stay apart. Vertices in no face are dropped. The
    other files of a folder and its folders are ignored.

    Raises:
        IngestError: nothing to read, fewer than 3 shapes, an unreadable file, different connectivity, an edge with more
            than two faces or with oppositely oriented ones, a face without area, a coordinate that isn't finite,
            several components, or shapes that are all equal or partly mirrored. Vertices and faces count from 0.
    """
    if not path.exists():
        raise IngestError(f"{path}: no such file or folder")
    raw = _read_folder(path) if path.is_dir() else _read_npz(path)
    used = np.unique(raw.faces)
    vertices, faces = raw.vertices[:, used], np.searchsorted(used, raw.faces)
    with _refusing(raw.labels[0], used):
        connectivity = Connectivity(faces, len(used))
    for label, shape in zip(raw.labels, vertices, strict=True):
        with _refusing(label, used):
            TriangleMesh(shape, connectivity)
    if np.ptp(align(vertices, vertices[0]), axis=0).max() <= WELD_TOLERANCE * diagonal(vertices[0]):
        raise IngestError(
            f"{path}: all {len(vertices)} shapes are equal but for where they stand; poses and morph targets inside a "
            "file are not read, export each shape as a mesh of its own"
        )

    weld, kept_pairs, notes = _welding(vertices, raw.labels)
    faces = weld[faces]
    thin = np.flatnonzero((faces == np.roll(faces, 1, axis=1)).any(axis=1))
    if len(thin):
        raise IngestError(
            f"{raw.labels[0]}: face {thin[0]} is degenerate: in every shape two of its vertices coincide (to "
            f"{WELD_TOLERANCE:g} of the mesh's size); collapse that edge in all meshes"
        )
    kept = np.unique(faces)
    vertices, faces = vertices[:, kept], np.searchsorted(kept, faces)
    with _refusing(raw.labels[0], used[kept]):
        connectivity = Connectivity(faces, len(kept))
    _refuse_components(raw, connectivity, kept_pairs)
    if raw.vertices.shape[1] > len(used):
        notes.append(f"dropped {raw.vertices.shape[1] - len(used)} vertices that belong to no face")
    if len(kept) < len(used):
        notes.append(f"welded {len(used)} vertices into {len(kept)}: the others coincide with these in every shape")
    if connectivity.is_closed:
        notes += _orientation(vertices, faces, raw.labels)
    file_vertices = np.full(raw.vertices.shape[1], -1)
    file_vertices[used] = np.searchsorted(kept, weld)
    return MeshCollection(tuple(raw.names), vertices, faces, file_vertices, tuple(notes))


def normalised(collection: MeshCollection, reference: int) -> tuple[FloatArray, float]:
    """Scale so that the reference shape has unit area, about the origin; centres stay where they are.

    Returns:
        Vertices (n, V, 3) and the scale in the user's units: ``collection.vertices == scale * vertices``.
    """
    scale = float(np.sqrt(face_areas(collection.vertices[reference], collection.faces).sum()))
    return collection.vertices / scale, scale


def _natural(path: Path) -> tuple[list[str | int], str]:
    pieces = re.split(r"(\d+)", path.stem.casefold())
    return [int(piece) if k % 2 else piece for k, piece in enumerate(pieces)], path.name


def _extension(path: Path) -> str:
    return path.suffix.lstrip(".").lower()


def _read_folder(folder: Path) -> _Raw:
    files = [path for path in folder.iterdir() if not path.name.startswith(".") and not path.is_dir()]
    paths = sorted((path for path in files if _extension(path) in FORMATS), key=_natural)
    if not paths:
        others = sorted({path.suffix or path.name for path in files})
        found = f"only {', '.join(others[:8])}" if others else "it has no files"
        raise IngestError(f"{folder}: holds no meshes ({found}); these can be read: {', '.join(FORMATS)}")
    if len(paths) < MIN_SHAPES:
        hint = (
            "; an NPZ with a whole collection is named itself, not its folder" if _extension(paths[0]) == "npz" else ""
        )
        raise IngestError(f"{folder}: {TOO_FEW.format(len(paths))}{hint}")
    by_name: dict[str, Path] = {}
    for path in paths:
        if path.stem in by_name:
            raise IngestError(f"{path}: {by_name[path.stem].name} has the same name; remove or rename one of them")
        by_name[path.stem] = path

    meshes = []
    for path in paths:
        with _refusing(str(path)):
            meshes.append(_checked(*read_arrays(path)))
    # Triangles of an STL file fit on the shared vertices of any other format.
    soups = [_extension(path) == "stl" for path in paths]
    first = soups.index(False) if False in soups else 0
    vertices, faces = meshes[first]
    shapes = []
    for path, soup, (v, f) in zip(paths, soups, meshes, strict=True):
        with _refusing(str(path)):
            if soup and not soups[first]:
                shapes.append(_on_shared_vertices(v[f], faces, len(vertices), paths[first].name))
            else:
                _compare(v, f, vertices, faces, paths[first].name)
                shapes.append(v)
    return _Raw([str(path) for path in paths], list(by_name), np.stack(shapes), faces, all(soups))


def _read_npz(path: Path) -> _Raw:
    if _extension(path) != "npz":
        raise IngestError(f"{path}: one file is a collection only as .npz; name the folder that holds the meshes")
    with _refusing(str(path)):
        try:
            arrays = load_npz(path.read_bytes())
        except OSError as error:
            raise MeshError(f"can't be read: {error.strerror}") from error
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
    labels = [f"{path}: shape {name}" for name in names]
    checked = []
    for label, shape in zip(labels, shapes, strict=True):
        with _refusing(label):
            checked.append(_checked(shape, arrays["faces"]))
    return _Raw(labels, names.tolist(), np.stack([vertices for vertices, _ in checked]), checked[0][1])


@contextmanager
def _refusing(label: str, numbers: IntArray | None = None) -> Iterator[None]:
    """Turn a MeshError into an IngestError about that file; ``numbers`` are the vertices' indices there."""
    try:
        yield
    except EdgeError as error:
        i, j = error.edge if numbers is None else numbers[list(error.edge)].tolist()
        raise IngestError(f"{label}: {EdgeError(error.sentence, (i, j))}") from error
    except MeshError as error:
        raise IngestError(f"{label}: {error}") from error


def _checked(vertices: np.ndarray, faces: np.ndarray) -> tuple[FloatArray, IntArray]:
    """The arrays of one mesh, in double precision; MeshError where they can't be those of a mesh."""
    if vertices.ndim == 3:
        raise MeshError(f"vertices are of shape {vertices.shape}: an NPZ with a whole collection is named itself")
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        raise MeshError(f"vertices must be a (V, 3) array of numbers, not {vertices.dtype} of shape {vertices.shape}")
    if not len(faces):
        raise MeshError("has no faces")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise MeshError(f"faces must be an (F, 3) array of vertex indices, not {faces.dtype} of shape {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"faces name vertices {faces.min()} to {faces.max()}, but there are {len(vertices)} vertices")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise MeshError(f"vertex {bad[0]} has a coordinate that is not finite")
    return vertices.astype(np.float64), faces.astype(np.int64)


def _compare(vertices: FloatArray, faces: IntArray, vertices_0: FloatArray, faces_0: IntArray, other: str) -> None:
    if (len(vertices), len(faces)) != (len(vertices_0), len(faces_0)):
        raise MeshError(
            f"has {len(vertices)} vertices and {len(faces)} faces, but {other} has {len(vertices_0)} and "
            f"{len(faces_0)}; all meshes need the same connectivity"
        )
    differing = np.flatnonzero((faces != faces_0).any(axis=1))
    if len(differing):
        k = differing[0]
        raise MeshError(
            f"face {k} joins vertices {tuple(faces[k].tolist())}, but in {other} {tuple(faces_0[k].tolist())}; all "
            "meshes need the same connectivity, in the same order"
        )


def _on_shared_vertices(corners: FloatArray, faces: IntArray, vertex_count: int, other: str) -> FloatArray:
    """Vertices (V, 3) of triangles (F, 3, 3) that are the faces of another file, in the same order."""
    if len(corners) != len(faces):
        raise MeshError(
            f"has {len(corners)} faces, but {other} has {len(faces)}; all meshes need the same connectivity"
        )
    # Vertices in no face are dropped later; until then they are anywhere.
    vertices = np.zeros((vertex_count, 3))
    vertices[faces] = corners
    apart = np.linalg.norm(vertices[faces] - corners, axis=-1).max(axis=1)
    torn = np.flatnonzero(apart > WELD_TOLERANCE * diagonal(corners.reshape(-1, 3)))
    if len(torn):
        raise MeshError(
            f"face {torn[0]} is not where it is in {other}: STL files must list the faces in the same order"
        )
    return vertices


def _welding(vertices: FloatArray, labels: Sequence[str]) -> tuple[IntArray, FloatArray, list[str]]:
    """Which vertices of shapes (n, V, 3) coincide in every one of them.

    Returns:
        For each vertex the first one that it coincides with, (V,); the part of the first shape's coinciding pairs that
        coincide in each shape too, (n,); and a note on those that don't in every shape.
    """
    tolerance = WELD_TOLERANCE * diagonal(vertices)
    pairs = KDTree(vertices[0]).query_pairs(tolerance[0], output_type="ndarray")
    near = np.ones(len(pairs), dtype=bool)
    kept = np.ones(len(vertices))
    for k, (shape, radius) in enumerate(zip(vertices, tolerance, strict=True)):
        here = np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1) <= radius
        kept[k] = here.mean() if len(pairs) else 1
        near &= here
    i, j = pairs[near].T
    count = vertices.shape[1]
    graph = sparse.coo_array((np.ones(len(i)), (i, j)), shape=(count, count))
    _, group = sparse.csgraph.connected_components(graph, directed=False)
    _, first = np.unique(group, return_index=True)
    note = f"{(~near).sum()} pairs of vertices coincide in {labels[0]} but not in every shape: they stay apart"
    return first[group], kept, [] if near.all() else [note]


def _refuse_components(raw: _Raw, connectivity: Connectivity, kept_pairs: FloatArray) -> None:
    """Faces hang together where they share an edge: a common vertex alone is a hinge, not a surface."""
    left, right = connectivity.edge_faces[connectivity.interior].T
    count = len(connectivity.faces)
    graph = sparse.coo_array((np.ones(len(left)), (left, right)), shape=(count, count))
    parts, part = sparse.csgraph.connected_components(graph, directed=False)
    if parts == 1:
        return
    odd = int(kept_pairs.argmin())
    if raw.soup and kept_pairs[odd] < 0.5:
        raise IngestError(
            f"{raw.labels[odd]}: its triangles don't meet where those of {raw.labels[0]} do; STL files must list the "
            "faces in the same order"
        )
    raise IngestError(
        f"{raw.labels[0]}: has {parts} separate parts, where one is required: faces 0 and {part.argmax()} are in "
        f"different ones, and {np.bincount(part).max()} of {count} faces in the largest; join or delete the others"
    )


def _orientation(vertices: FloatArray, faces: IntArray, labels: Sequence[str]) -> list[str]:
    """A note where closed shapes are wound inside out; IngestError where some are and others are not."""
    sides = []
    for shape in vertices - vertices.mean(axis=1, keepdims=True):
        a, b, c = (shape[faces[:, k]] for k in range(3))
        volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6
        sides.append(np.sign(volume) * (abs(volume) > CLEAR_VOLUME * face_areas(shape, faces).sum() ** 1.5))
    outwards, inwards = ([k for k, side in enumerate(sides) if side == sign] for sign in (1, -1))
    if outwards and inwards:
        odd, most = sorted((outwards, inwards), key=len)
        raise IngestError(
            f"{labels[odd[0]]}: is inside out, compared with {labels[most[0]]} and most others, like a mirror image; "
            "mirror it back"
        )
    return ["faces are wound inside out, normals point inwards; they stay so in all that is written"] if inwards else []
