"""The meshes of a collection in correspondence: the result of reading files, and of a generator."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import face_areas
from shapespace.training.collection.faults import Fault, IngestError
from shapespace.training.collection.large_arrays import stacked
from shapespace.training.collection.parts import MeshPart, PartSize
from shapespace.training.collection.warnings import CollectionWarning


@dataclass(frozen=True, eq=False)
class MeshCollection:
    """Shapes in correspondence, each a valid TriangleMesh, in the user's units."""

    # The n shapes' names: the names of their files in natural order (pose2 before pose10), or the NPZ's own.
    names: tuple[str, ...]
    vertices: FloatArray  # (n, V, 3) positions as in the files. A large array lies on disk, so read it shape by shape.
    faces: IntArray  # (F, 3) of every shape, in the order of the files
    # (N,) index here of each vertex of a file, −1 for vertices that were left out. None if there are no files.
    file_vertices: IntArray | None = None
    notes: tuple[str, ...] = ()  # what was found in the files and handled, one sentence each
    warnings: tuple[CollectionWarning, ...] = ()  # single shapes that look wrong
    central: int = 0  # index of the shape with the least mean square distance from the others, after rigid alignment
    # For each shape its file, and the number that the file gives its first vertex. Empty if there are no files.
    places: tuple[tuple[str, int], ...] = ()
    # If there are several, the shell and then the attached parts. Edges join the faces of one part.
    parts: tuple[MeshPart, ...] = ()
    part_sizes: tuple[PartSize, ...] = ()  # of all parts that the files have, if there are several
    kept_alone: str | None = None  # own name of the part that is kept alone because not all can be kept

    @property
    def shell_faces(self) -> IntArray:
        """(G, 3) faces that the model computes with, as indices of all vertices."""
        return self.faces[self.parts[0].faces] if self.parts else self.faces

    def index(self, name: str | None) -> int:
        """Return the index of a shape by its name or file, or of the most central one for None.

        Raises IngestError if there is no such shape.
        """
        if name is None:
            return self.central
        if (known := self._named(name)) not in self.names:
            raise IngestError(Fault("", f"no shape is called {name!r}", f"there are {', '.join(self.names[:8])} …"))
        return self.names.index(known)

    def _named(self, given: str) -> str:
        """Return the name of the shape that a user calls by its name or file; a name of no shape if there is none."""
        by_file = {file: name for name, (file, _) in zip(self.names, self.places, strict=False)}
        return given if given in self.names else by_file.get(given, Path(given).stem)

    def require_accepted(self, accepted: Sequence[str]) -> None:
        """Refuse shapes with a grave warning, unless the user accepts them by their names or files.

        Raises:
            IngestError: with each such shape, or with a name that no shape has.
        """
        names = {self._named(name) for name in accepted}
        if unknown := names - set(self.names):
            raise IngestError(Fault("", f"--accept: no shape is called {', '.join(sorted(unknown))}"))
        grave = [warning for warning in self.warnings if warning.grave and self.names[warning.shape] not in names]
        if grave:
            files = " ".join(shlex.quote(self.names[warning.shape]) for warning in grave)
            lines = ["these shapes would make the model worse:", *(warning.sentence for warning in grave)]
            remedy = f"\nCorrect or remove them, or use them as they are with --accept {files}"
            raise IngestError(Fault("", "\n  ".join(lines) + remedy))

    def grave_faults(self) -> list[Fault]:
        """Return the grave warnings as faults."""
        found = []
        for warning in self.warnings:
            if warning.grave:
                place, _, sentence = warning.sentence.partition(": ")
                fault = Fault.of(place, sentence, "correct it")
                accept = f"or use it as it is with run --accept {shlex.quote(self.names[warning.shape])}"
                found.append(fault._replace(remedy=f"{fault.remedy} ({accept})"))
        return found


def normalised(collection: MeshCollection, reference: int) -> tuple[FloatArray, float]:
    """Scale all shapes about the origin, so that the reference's shell has unit area; they are not centred.

    Returns:
        Vertices (n, V, 3) and the scale in the user's units: ``collection.vertices == scale * vertices``.
    """
    scale = float(np.sqrt(face_areas(collection.vertices[reference], collection.shell_faces).sum()))
    return stacked(len(collection.vertices), (shape / scale for shape in collection.vertices)), scale
