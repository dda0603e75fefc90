"""Reading a collection: mesh files in correspondence, or one NPZ; checked, and welded in the same way for all shapes.

Correspondence means the same faces in the same order. Triangles of STL files correspond by their order, and so do their
corners. Faces keep their winding, even where it is inside out, so that served shapes fit the user's files.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.spatial import KDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.attributes.reading import FORMATS
from shapespace.files.formats import READ_FORMATS, read_arrays
from shapespace.files.npz_reading import load_npz
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, PlaceError, TriangleMesh, diagonal, face_areas
from shapespace.training.collection import parts as separate_parts
from shapespace.training.collection.large_arrays import some_vertices, stacked
from shapespace.training.collection.parts import MeshPart
from shapespace.training.collection.warnings import Placements, suspicions
from shapespace.training.runs.progress import progress

MIN_SHAPES = 3
#: Separates the name of an NPZ file from that of a shape in it.
_SHAPE = ": shape "
TOO_FEW = f"has {{}} shapes; at least {MIN_SHAPES} are needed"

#: Vertices closer than this share of the bounding box's diagonal coincide; float32 rounds a coordinate to 6e-8 of it.
WELD_TOLERANCE = 1e-6
#: Vertices on borders that are closer than this share of it were probably meant to be one vertex.
SEAM_TOLERANCE = 1e-4

#: Extensions of files that accompany meshes: buffers of glTF, materials of OBJ, and textures.
_BESIDE = ("bin", "mtl", "png", "jpg", "jpeg")

#: A volume below this share of area^(3/2) (a ball has 0.094) is too small to tell inside from outside.
CLEAR_VOLUME = 1e-3


class IngestError(ValueError):
    """A collection that can't be used: one line with the file, the fault and, where there is one, the remedy."""


@dataclass(frozen=True)
class Warned:
    """One oddity of one shape; see suspicions.Suspicion.

    Attributes:
        name: of the shape.
        sentence: with its file in front.
        grave: whether it has to be accepted by name.
    """

    name: str
    sentence: str
    grave: bool


@dataclass(frozen=True, eq=False)
class MeshCollection:
    """Shapes in correspondence, each a valid TriangleMesh, in the user's units.

    Attributes:
        names: of the n shapes: stems of their files in natural order (pose2 before pose10), or the NPZ's own.
        vertices: (n, V, 3) positions as in the files; a large array lies on disk, so read it shape by shape.
        faces: (F, 3) of every shape, in the order of the files.
        file_vertices: (N,) which vertex each of a file's vertices has become, −1 for those in no face. None where there
            are no files.
        notes: what was found in the files and handled, one sentence each.
        warnings: what is odd about single shapes.
        central: the shape with the least mean square distance from the others, after rigid alignment.
        places: for each shape its file, and the number that this gives its first vertex; none where there are no files.
        parts: where there are several, the shell and those that ride along with it; faces of one part share edges.
    """

    names: tuple[str, ...]
    vertices: FloatArray
    faces: IntArray
    file_vertices: IntArray | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[Warned, ...] = ()
    central: int = 0
    places: tuple[tuple[str, int], ...] = ()
    parts: tuple[MeshPart, ...] = ()

    @property
    def shell_faces(self) -> IntArray:
        """(G, 3) faces that the model computes with, in the numbers of all vertices."""
        return self.faces[self.parts[0].faces] if self.parts else self.faces

    def index(self, name: str | None) -> int:
        """Index of the shape of that name, or of the most central one for None; IngestError if there is none."""
        if name is not None and name not in self.names:
            raise IngestError(f"no shape is called {name!r}; there are {', '.join(self.names[:8])} …")
        return self.central if name is None else self.names.index(name)

    def require_accepted(self, accepted: Sequence[str]) -> None:
        """Refuse shapes that are in another unit or order, unless they are among those accepted.

        Args:
            accepted: names of shapes, or files of theirs.

        Raises:
            IngestError: naming each such shape, or a name that no shape has.
        """
        names = {name if name in self.names else Path(name).stem for name in accepted}
        if unknown := names - set(self.names):
            raise IngestError(f"--accept: no shape is called {', '.join(sorted(unknown))}")
        grave = [warned for warned in self.warnings if warned.grave and warned.name not in names]
        if grave:
            files = " ".join(shlex.quote(warned.name) for warned in grave)
            raise IngestError(
                "\n  ".join(["these shapes would spoil the model:", *(warned.sentence for warned in grave)])
                + f"\nMend or remove them; or take them as they are, with --accept {files}"
            )


@dataclass(frozen=True)
class _Raw:
    """Shapes as they stand in their files, with the same faces.

    Attributes:
        labels: where each shape comes from, for messages.
        names: of the shapes.
        vertices: (n, V, 3).
        faces: (F, 3).
        soup: whether all are triangles that share no vertices, as in STL files.
    """

    labels: Sequence[str]
    names: Sequence[str]
    vertices: FloatArray
    faces: IntArray
    soup: bool = False


def read_collection(path: Path, wanted: Sequence[str] = ()) -> MeshCollection:
    """Read a folder of OBJ, PLY, STL, OFF, glTF or NPZ files, or one NPZ of ``vertices`` (n, V, 3) and ``faces``.

    Vertices that coincide in every shape become one, since exporters split them along seams of texture or shading and
    STL has no shared ones; those that coincide in some shapes only stay apart. Vertices in no face are dropped. Files
    of other kinds and subfolders are ignored.

    Args:
        path: of the folder or file.
        wanted: names of the parts to keep, see parts.choose.

    Raises:
        IngestError: nothing to read, fewer than 3 shapes, an unreadable file, different connectivity, an edge with more
            than two faces or with oppositely oriented ones, a face without area, a coordinate that isn't finite,
            several parts that none rides along with another, or shapes that are all equal or partly mirrored. Vertices
            and faces are numbered as the file does, OBJ from 1.
    """
    if not path.exists():
        raise IngestError(f"{path}: no such file or folder")
    raw = _read_folder(path) if path.is_dir() else _read_npz(path)
    used = np.unique(raw.faces)
    vertices, faces = some_vertices(raw.vertices, used), np.searchsorted(used, raw.faces)
    with _refusing(raw.labels[0], used):
        connectivity = Connectivity(faces, len(used))
    for label, shape in zip(raw.labels, vertices, strict=True):
        with _refusing(label, used):
            TriangleMesh(shape, connectivity)
    tolerance = WELD_TOLERANCE * diagonal(vertices[0])
    if all(np.abs(align(shape, vertices[0]) - vertices[0]).max() <= tolerance for shape in vertices):
        raise IngestError(
            f"{path}: all {len(vertices)} shapes are equal up to where they stand and how they are turned; poses and "
            "morph targets inside a file are not read, export each shape as a mesh of its own"
        )

    weld, kept_pairs, notes = _welding(vertices, raw.labels)
    faces = weld[faces]
    thin = np.flatnonzero((faces == np.roll(faces, 1, axis=1)).any(axis=1))
    if len(thin):
        with _refusing(raw.labels[0]):
            raise PlaceError(
                "face {face} is degenerate: in every shape two of its vertices coincide (to "
                f"{WELD_TOLERANCE:g} of the mesh's size); collapse that edge in all meshes",
                {"face": [int(thin[0])]},
            )
    kept = np.unique(faces)
    vertices, faces = some_vertices(vertices, kept), np.searchsorted(kept, faces)
    with _refusing(raw.labels[0], used[kept]):
        connectivity = Connectivity(faces, len(kept))
    seams = _seams(vertices, connectivity)
    if raw.vertices.shape[1] > len(used):
        notes.append(f"dropped {raw.vertices.shape[1] - len(used)} vertices that belong to no face")
    if len(kept) < len(used):
        notes.append(f"welded {len(used)} vertices into {len(kept)}: the others coincide with these in every shape")
    parts, left_out = _parts(raw, path, wanted, vertices, connectivity, kept_pairs, seams)
    if parts:
        notes.append(separate_parts.kept(parts, left_out))
    if left_out:
        chosen = np.sort(np.concatenate([part.faces for part in parts]))
        remaining = np.unique(faces[chosen])
        vertices, faces = some_vertices(vertices, remaining), np.searchsorted(remaining, faces[chosen])
        connectivity, kept = Connectivity(faces, len(remaining)), kept[remaining]
        parts = [MeshPart(part.name, np.searchsorted(chosen, part.faces)) for part in parts]
    if len(seams):
        notes.append(
            f"{len(seams)} pairs of border vertices almost coincide in every shape, to {SEAM_TOLERANCE:g} of the size, "
            "and the surface stays open there: merge them in all meshes if it is meant to be closed"
        )
    shell = faces[parts[0].faces] if parts else faces
    used_by_shell, local = np.unique(shell, return_inverse=True)
    if Connectivity(local.reshape(-1, 3), len(used_by_shell)).is_closed:
        notes += _orientation(vertices, shell, raw.labels)
    number = np.full(len(used), -1)
    number[kept] = np.arange(len(kept))
    file_vertices = np.full(raw.vertices.shape[1], -1)
    file_vertices[used] = number[weld]
    placements = Placements(vertices)
    warnings = []
    for found in suspicions(vertices, connectivity, [Path(label).name for label in raw.labels], placements):
        label = raw.labels[found.shape]
        vertex = used[kept][found.vertex] + _first_number(label)
        sentence = f"{label}: {found.sentence.replace('{vertex}', f'{vertex}{_counted(label)}')}"
        warnings.append(Warned(raw.names[found.shape], sentence, found.grave))
    places = tuple((Path(label).name, _first_number(label)) for label in raw.labels)
    return MeshCollection(
        tuple(raw.names),
        vertices,
        faces,
        file_vertices,
        tuple(notes),
        tuple(warnings),
        placements.central,
        places,
        tuple(parts) if len(parts) > 1 else (),
    )


def data_files(path: Path) -> list[Path]:
    """The files that a collection is read from, sorted; of a path that isn't there none."""
    if not path.is_dir():
        return [path] if path.exists() else []
    return sorted(
        p for p in path.iterdir() if _extension(p) in (*READ_FORMATS, *_BESIDE) and p.is_file() and p.name[0] != "."
    )


def normalised(collection: MeshCollection, reference: int) -> tuple[FloatArray, float]:
    """Scale all shapes about the origin, so that the reference's shell has unit area; they are not centred.

    Returns:
        Vertices (n, V, 3) and the scale in the user's units: ``collection.vertices == scale * vertices``.
    """
    scale = float(np.sqrt(face_areas(collection.vertices[reference], collection.shell_faces).sum()))
    return stacked(len(collection.vertices), (shape / scale for shape in collection.vertices)), scale


def _natural(path: Path) -> tuple[list[str | int], str]:
    pieces = re.split(r"(\d+)", path.stem.casefold())
    return [int(piece) if k % 2 else piece for k, piece in enumerate(pieces)], path.name


def _extension(path: Path) -> str:
    return path.suffix.lstrip(".").lower()


def _read_folder(folder: Path) -> _Raw:
    files = [path for path in folder.iterdir() if not path.name.startswith(".") and not path.is_dir()]
    paths = sorted((path for path in files if _extension(path) in READ_FORMATS), key=_natural)
    if not paths:
        others = sorted({path.suffix or path.name for path in files})
        found = f"only {', '.join(others[:8])}" if others else "it has no files"
        raise IngestError(f"{folder}: holds no meshes ({found}); these can be read: {', '.join(READ_FORMATS)}")
    if len(paths) < MIN_SHAPES:
        hint = (
            "; where an NPZ holds the whole collection, name that file, not its folder"
            if _extension(paths[0]) == "npz"
            else ""
        )
        raise IngestError(f"{folder}: {TOO_FEW.format(len(paths))}{hint}")
    by_name: dict[str, Path] = {}
    for path in paths:
        if path.stem in by_name:
            raise IngestError(f"{path}: {by_name[path.stem].name} has the same name; remove or rename one of them")
        by_name[path.stem] = path

    # A file of another format knows which vertices triangles share; those of STL files are put onto them.
    soups = [_extension(path) == "stl" for path in paths]
    first = soups.index(False) if False in soups else 0
    vertices, faces = _read(paths[first])

    def shapes() -> Iterator[FloatArray]:
        for k, path in enumerate(progress(paths, "reading", "file")):
            if k == first:
                yield vertices
                continue
            try:
                v, f = _read(path, len(vertices), faces)
                with _refusing(str(path)):
                    if soups[k] and not soups[first]:
                        v = _on_shared_vertices(v[f], faces, len(vertices), paths[first].name)
                    else:
                        _refuse_cut_short(paths[first], len(vertices), faces, len(v), f)
                        _compare(v, f, vertices, faces, paths[first].name)
            except IngestError as error:
                if why := separate_parts.difference(path, paths[first]):
                    raise IngestError(f"{path}: has other faces than {paths[first].name}: {why}") from error
                raise
            yield v

    return _Raw([str(path) for path in paths], list(by_name), stacked(len(paths), shapes()), faces, all(soups))


def _read(path: Path, vertex_count: int = 0, faces: IntArray | None = None) -> tuple[FloatArray, IntArray]:
    """One file's mesh; the number of vertices and the faces of another file tell whether this one ends too early."""
    try:
        with _refusing(str(path)):
            found = _checked(*read_arrays(path))
    except IngestError as error:
        raise IngestError(f"{error}{_unfinished(path)}") from error
    if faces is not None:
        _refuse_cut_short(path, len(found[0]), found[1], vertex_count, faces)
    return found


def _unfinished(path: Path) -> str:
    """The end of a sentence about an OBJ file whose last line isn't finished, as after an interrupted copy."""
    if _extension(path) != "obj" or not path.is_file():
        return ""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 200))
        last = file.read().decode("latin-1")
    if last[-1:] in ("\n", "\r", ""):
        return ""
    return f"; its last line, {last.splitlines()[-1][-60:]!r}, has no end: if the file is cut short, copy it again"


def _refuse_cut_short(path: Path, count: int, faces: IntArray, other_count: int, others: IntArray) -> None:
    """IngestError for an OBJ file that is the beginning of another: such files don't say how much they hold."""
    if _extension(path) != "obj" or not path.is_file():
        return
    # The last face may have lost digits.
    if count <= other_count and len(faces) < len(others) and np.array_equal(faces[:-1], others[: len(faces) - 1]):
        raise IngestError(
            f"{path}: is cut short, it seems: it ends after {count} of {other_count} vertices and {len(faces)} of "
            f"{len(others)} faces{_unfinished(path) or '; copy it again'}"
        )


def _read_npz(path: Path) -> _Raw:
    if _extension(path) != "npz":
        raise IngestError(f"{path}: one file is a collection only as .npz; name the folder that holds the meshes")
    with _refusing(str(path)):
        try:
            arrays = load_npz(memoryview(path.read_bytes()), ("vertices", "faces", "names"))
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
    labels = [f"{path}{_SHAPE}{name}" for name in names]

    def checked() -> Iterator[FloatArray]:
        for label, shape in zip(labels, shapes, strict=True):
            with _refusing(label):
                yield _checked(shape, arrays["faces"])[0]

    return _Raw(labels, names.tolist(), stacked(len(labels), checked()), arrays["faces"].astype(np.int64))


def _first_number(label: str) -> int:
    """What a file calls its first vertex and its first face."""
    return int(_extension(Path(label.partition(_SHAPE)[0])) == "obj")


def _counted(label: str) -> str:
    return f" (counted from {_first_number(label)})"


@contextmanager
def _refusing(label: str, numbers: IntArray | None = None) -> Iterator[None]:
    """Turn a MeshError into an IngestError about that file; ``numbers`` are the vertices' indices there."""
    try:
        yield
    except PlaceError as error:
        raise IngestError(f"{label}: {error.numbered(_first_number(label), numbers)}{_counted(label)}") from error
    except MeshError as error:
        raise IngestError(f"{label}: {error}") from error


def _checked(vertices: np.ndarray, faces: np.ndarray) -> tuple[FloatArray, IntArray]:
    """The arrays of one mesh, in double precision; MeshError where they can't be those of a mesh."""
    if vertices.ndim == 3:
        raise MeshError(
            f"vertices are of shape {vertices.shape}; where an NPZ holds the whole collection, name that file"
        )
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        raise MeshError(f"vertices must be a (V, 3) array of numbers, not {vertices.dtype} of shape {vertices.shape}")
    if not len(faces):
        raise MeshError("has no faces")
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise MeshError(f"faces must be an (F, 3) array of vertex indices, not {faces.dtype} of shape {faces.shape}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        sentence = f"faces name vertices {{lowest}} to {{highest}}, but there are {len(vertices)} vertices"
        raise PlaceError(sentence, {"lowest": [int(faces.min())], "highest": [int(faces.max())]})
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise PlaceError("vertex {vertex} has a coordinate that is not finite", {"vertex": [int(bad[0])]})
    return vertices.astype(np.float64), faces.astype(np.int64)


def _compare(vertices: FloatArray, faces: IntArray, vertices_0: FloatArray, faces_0: IntArray, other: str) -> None:
    if (len(vertices), len(faces)) != (len(vertices_0), len(faces_0)):
        raise MeshError(
            f"has {len(vertices)} vertices and {len(faces)} faces, but {other} has {len(vertices_0)} and "
            f"{len(faces_0)}; all meshes need the same connectivity"
        )
    differing = np.flatnonzero((faces != faces_0).any(axis=1))
    if len(differing):
        k = int(differing[0])
        raise PlaceError(
            f"face {{face}} joins vertices {{here}}, but in {other} {{there}}; all meshes need the same connectivity, "
            "in the same order",
            {"face": [k], "here": faces[k].tolist(), "there": faces_0[k].tolist()},
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
        raise PlaceError(
            f"face {{face}} is not where it is in {other}: STL files must list the faces in the same order",
            {"face": [int(torn[0])]},
        )
    return vertices


def _welding(vertices: FloatArray, labels: Sequence[str]) -> tuple[IntArray, FloatArray, list[str]]:
    """Which vertices of shapes (n, V, 3) coincide in every one of them.

    Returns:
        For each vertex the first one that it coincides with, (V,); the share of the first shape's coinciding pairs that
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


def _seams(vertices: FloatArray, connectivity: Connectivity) -> IntArray:
    """(k, 2) vertices of the border that no edge joins and that almost coincide in every shape (n, V, 3)."""
    border = np.unique(connectivity.edges[~connectivity.interior])
    if not len(border):
        return np.zeros((0, 2), int)
    tolerance = SEAM_TOLERANCE * diagonal(vertices)
    pairs = border[KDTree(vertices[0][border]).query_pairs(tolerance[0], output_type="ndarray")].reshape(-1, 2)
    for shape, radius in zip(vertices, tolerance, strict=True):
        pairs = pairs[np.linalg.norm(shape[pairs[:, 0]] - shape[pairs[:, 1]], axis=1) <= radius]
    joined = connectivity.edges @ [connectivity.vertex_count, 1]
    pairs.sort(axis=1)
    seams: IntArray = pairs[~np.isin(pairs @ [connectivity.vertex_count, 1], joined)]
    return seams


def _parts(
    raw: _Raw,
    path: Path,
    wanted: Sequence[str],
    vertices: FloatArray,
    connectivity: Connectivity,
    kept_pairs: FloatArray,
    seams: IntArray,
) -> tuple[list[MeshPart], list[MeshPart]]:
    """The shell and what rides along, and what is left out; nothing where there is one part."""
    apart = separate_parts.separate(connectivity)
    if len(apart) == 1 and not wanted:
        return [], []
    odd, label = int(kept_pairs.argmin()), raw.labels[0]
    if raw.soup and kept_pairs[odd] < 0.5:
        raise IngestError(
            f"{raw.labels[odd]}: its triangles don't meet where those of {label} do; STL files must list the "
            "faces in the same order"
        )
    files = [path / Path(each).name for each in raw.labels] if path.is_dir() else []
    source = next((file for file in files if _extension(file) in FORMATS), None)
    for file in files:
        if source and file != source and (fault := separate_parts.reordered(file, source)):
            raise IngestError(f"{file}: {fault}, unlike those of {source.name}; export it like the others")
    named = separate_parts.named(apart, source)
    with _refusing(label):
        try:
            chosen = separate_parts.choose(named, wanted, vertices, connectivity.faces)
        except MeshError as error:
            of_vertex = np.zeros(connectivity.vertex_count, int)
            for k, faces in enumerate(apart):
                of_vertex[connectivity.faces[faces]] = k
            across = of_vertex[seams[:, 0]] != of_vertex[seams[:, 1]]
            if not across.any() or wanted:
                raise
            raise MeshError(
                f"has {len(apart)} parts that almost meet: {across.sum()} pairs of vertices on their borders are less "
                f"than {SEAM_TOLERANCE:g} of the mesh's size apart; merge them in all meshes, or take them apart"
            ) from error
    return chosen, [part for part in named if not any(part is each for each in chosen)]


def _orientation(vertices: FloatArray, faces: IntArray, labels: Sequence[str]) -> list[str]:
    """A note where closed shapes are wound inside out; IngestError where some are and others are not."""
    sides = []
    for shape in vertices:
        shape = shape - shape.mean(axis=0)
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
