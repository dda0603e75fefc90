"""Checks of single meshes and of shapes in correspondence; each refusal is one line with the file and the fault."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, PlaceError, TriangleMesh, diagonal, face_areas
from shapespace.training.collection.faults import Fault, Faults, IngestError

#: A volume below this share of area^(3/2) is too small to tell inside from outside; a ball has 0.094.
CLEAR_VOLUME = 1e-3


@dataclass(frozen=True)
class Tolerances:
    """Distances between vertices, as shares of the diagonal of the shape's bounding box."""

    weld: float = 1e-6  # vertices that are closer coincide; storing a coordinate as float32 moves it by up to 6e-8
    seam: float = 1e-4  # border vertices that are closer were probably meant to be one vertex


TOLERANCES = Tolerances()


@dataclass(frozen=True)
class ShapeSource:
    """The place that a shape was read from."""

    label: str  # the file's path, followed by the shape's name if the file holds several shapes
    name: str  # the shape's name
    # Number that the file gives to its first vertex and its first face: 1 in OBJ, 0 in all other formats.
    first: int = 0
    folder: Path | None = None  # folder of the collection, if each shape has a folder in it

    @classmethod
    def of_file(cls, path: Path, name: str | None = None, folder: Path | None = None) -> ShapeSource:
        """Return the source of a shape with its own file, or with a name and its own folder in the collection's."""
        return cls(str(path), name or path.stem, int(path.suffix.lower() == ".obj"), folder)

    @property
    def file(self) -> str:
        """The label without the collection's folder."""
        return Path(self.label).relative_to(self.folder).as_posix() if self.folder else Path(self.label).name

    @property
    def counted(self) -> str:
        """The end of a sentence that names vertices or faces by number."""
        return f" (counted from {self.first})"


@contextmanager
def refusing(
    source: ShapeSource, numbers: IntArray | None = None, remedy: str = "export it again", *, always: bool = False
) -> Iterator[None]:
    """Turn a MeshError into an IngestError about a file.

    Args:
        source: the shape that is checked.
        numbers: (V,) index that the file gives each vertex; the same one if left out.
        remedy: what to do, unless the error says it.
        always: whether the remedy is added to what the error says.
    """
    try:
        yield
    except PlaceError as error:
        fault = Fault.of(source.label, error.numbered(source.first, numbers), remedy, always=always)
        raise IngestError(fault._replace(what=fault.what + source.counted)) from error
    except MeshError as error:
        raise IngestError(Fault.of(source.label, str(error), remedy, always=always)) from error


def mesh_arrays(vertices: np.ndarray, faces: np.ndarray, *, finite: bool = True) -> tuple[FloatArray, IntArray]:
    """Check the arrays of one mesh and return them as float64 and int64.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        finite: whether coordinates are checked too, as by `check_finite`.

    Raises:
        MeshError: a wrong shape or type, no faces, a vertex number out of range, or a coordinate that isn't finite.
    """
    if vertices.ndim == 3:
        raise MeshError(
            f"vertices are of shape {vertices.shape}; if this NPZ holds all shapes, name the file instead of its folder"
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
    if finite:
        check_finite(vertices)
    return vertices.astype(np.float64), faces.astype(np.int64)


def check_finite(vertices: np.ndarray) -> None:
    """Raise MeshError if a coordinate of the vertices (V, 3) isn't finite."""
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        sentence = "vertex {vertex} has a coordinate that is not finite"
        raise PlaceError(sentence, {"vertex": [int(bad[0])]})


#: Exporters split vertices where normals or texture coordinates differ.
_SPLIT = (
    "; vertices that are split at texture seams or by flat shading do no harm if all files have the same faces "
    "in the same order"
)


def same_connectivity(
    vertices: FloatArray, faces: IntArray, other_vertices: FloatArray, other_faces: IntArray, other: str
) -> None:
    """Check that a mesh has the same number of vertices and the same faces as the mesh in the file ``other``.

    Raises:
        MeshError: the meshes differ.
    """
    if (len(vertices), len(faces)) != (len(other_vertices), len(other_faces)):
        advice = _SPLIT if len(faces) == len(other_faces) else ""
        raise MeshError(
            f"has {len(vertices)} vertices and {len(faces)} faces, but {other} has {len(other_vertices)} and "
            f"{len(other_faces)}; all meshes need the same connectivity{advice}"
        )
    differing = np.flatnonzero((faces != other_faces).any(axis=1))
    if len(differing):
        k = int(differing[0])
        raise PlaceError(
            f"face {{face}} joins vertices {{here}}, but in {other} {{there}}; all meshes need the same connectivity, "
            "in the same order",
            {"face": [k], "here": faces[k].tolist(), "there": other_faces[k].tolist()},
        )


def check_meshes(
    sources: Sequence[ShapeSource], vertices: FloatArray, faces: IntArray, numbers: IntArray, faults: Faults
) -> list[int]:
    """Check that shapes (n, V, 3), each vertex in a face (F, 3), are valid meshes; ``numbers`` (V,) are the files'.

    Returns:
        Indices of the valid shapes. A face without area is among the faults of the others.

    Raises:
        IngestError: the faces form no oriented manifold.
    """
    with refusing(sources[0], numbers, "correct the surface there, in all files", always=True):
        connectivity = Connectivity(faces, vertices.shape[1])
    valid = []
    for k, (source, shape) in enumerate(zip(sources, vertices, strict=True)):
        with faults.gathered(), refusing(source, numbers, "move its corners apart, or remove the face in all files"):
            TriangleMesh(shape, connectivity)
            valid.append(k)
    return valid


def check_different(path: Path, vertices: FloatArray) -> None:
    """Check that shapes (n, V, 3) are not all equal up to rigid motion.

    Raises:
        IngestError: all are equal.
    """
    tolerance = TOLERANCES.weld * diagonal(vertices[0])
    if all(np.abs(align(shape, vertices[0]) - vertices[0]).max() <= tolerance for shape in vertices):
        raise IngestError(
            Fault(
                str(path),
                f"all {len(vertices)} shapes are the same, apart from position and rotation",
                "export each shape as a separate mesh, because animations inside a file are not read",
            )
        )


def orientation_notes(sources: Sequence[ShapeSource], vertices: FloatArray, faces: IntArray) -> list[str]:
    """Return a note if closed shapes (n, V, 3) are wound inside out, else nothing.

    Raises:
        IngestError: some shapes are wound inside out and others are not.
    """
    used, local = np.unique(faces, return_inverse=True)
    if not Connectivity(local.reshape(-1, 3), len(used)).is_closed:
        return []
    sides = []
    for shape in vertices:
        shape = shape - shape.mean(axis=0)
        a, b, c = (shape[faces[:, k]] for k in range(3))
        volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6
        sides.append(np.sign(volume) * (abs(volume) > CLEAR_VOLUME * face_areas(shape, faces).sum() ** 1.5))
    outwards, inwards = ([k for k, side in enumerate(sides) if side == sign] for sign in (1, -1))
    if outwards and inwards:
        odd, most = sorted((outwards, inwards), key=len)
        what = f"is inside out, like a mirror image, compared with {sources[most[0]].label} and most others"
        raise IngestError(*(Fault(sources[k].label, what, "mirror it back") for k in odd))
    note = "faces are wound inside out, so normals point inwards; the model's answers have the same orientation"
    return [note] if inwards else []
