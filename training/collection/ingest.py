"""Read a collection: check its files, weld their vertices, choose the parts, and look for shapes that seem wrong.

All shapes have the same faces in the same order. Triangles of STL files correspond by their order, and so do their
corners. Faces keep their winding, even if it is inside out, so that served shapes fit the user's files.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapespace.arrays import IntArray
from shapespace.counted import counted
from shapespace.training.collection.checks import (
    TOLERANCES,
    ShapeSource,
    check_different,
    check_meshes,
    orientation_notes,
    refusing,
)
from shapespace.training.collection.faults import Faults, IngestError, shown
from shapespace.training.collection.listing import MIN_SHAPES
from shapespace.training.collection.mesh_collection import MeshCollection
from shapespace.training.collection.parts import MeshPart, PartSelection, parts_note, select_parts
from shapespace.training.collection.reading import FileShapes, read_shapes
from shapespace.training.collection.warnings import CollectionWarning, Placements, find_warnings
from shapespace.training.collection.welding import (
    Coincidences,
    NumberedShapes,
    find_coincidences,
    find_open_seams,
    weld,
)


def read_collection(
    path: Path, wanted: Sequence[str] = (), file: str | None = None, *, alone: bool = False
) -> MeshCollection:
    """Read a folder of mesh files, one NPZ of ``vertices`` (n, V, 3) and ``faces``, or one file of morph targets.

    Vertices that coincide in every shape become one, see `welding`. Vertices in no face are left out. Files of other
    kinds and subfolders are left out, and the notes name them.

    Args:
        path: the folder or file.
        wanted: names of the parts to keep, see `parts.select_parts`.
        file: name of the file to read from each folder in ``path``, see `listing.mesh_files`.
        alone: whether the largest part is kept alone where not all can be kept, see `parts.select_parts`.

    Raises:
        IngestError: nothing to read, fewer than 3 shapes, an unreadable file, different connectivity, an edge with more
            than two faces or with oppositely oriented ones, a face without area, a coordinate that isn't finite,
            several parts of which one can't be attached to another, or shapes that are all equal or partly mirrored.
            It has all faults of all files. Vertices and faces are numbered as in the file, from 1 in OBJ.
    """
    files = read_shapes(path, file)
    faults = Faults(*files.faults)
    with faults.gathered():
        collection = _checked(path, files, wanted, faults, alone=alone)
        if faults.found:
            faults.found += collection.grave_faults()
    faults.refuse()
    return collection


def _checked(path: Path, files: FileShapes, wanted: Sequence[str], faults: Faults, *, alone: bool) -> MeshCollection:
    """Make a collection of the valid shapes, and add all faults that are found on the way.

    Raises:
        IngestError: nothing more can be checked.
    """
    source = files.sources[0]
    given = NumberedShapes.from_files(files.vertices, files.faces)
    valid = check_meshes(files.sources, given.vertices, given.faces, given.file_numbers, faults)
    if faults.found and len(valid) < MIN_SHAPES:
        raise IngestError(*faults.found)
    if len(valid) < len(files.sources):
        files = files.only(valid)
        given = NumberedShapes.from_files(files.vertices, files.faces)
    check_different(path, given.vertices)

    coincidences = find_coincidences(given.vertices)
    with refusing(source):
        shapes = weld(given, coincidences.first)
    with refusing(source, shapes.file_numbers):
        seams = find_open_seams(shapes)
    notes = [*files.notes, *_welding_notes(files, given, shapes, coincidences)]

    selection = PartSelection([], [], [])
    with faults.gathered():
        selection = select_parts(files, wanted, shapes, coincidences.shares, seams, alone=alone)
    parts = selection.kept
    if parts:
        notes.append(parts_note(selection))
    if selection.left_out:
        shapes, parts = _without_other_parts(shapes, parts)
    notes += _seam_notes(seams)
    shell = shapes.faces[parts[0].faces] if parts else shapes.faces
    with faults.gathered():
        notes += orientation_notes(files.sources, shapes.vertices, shell)
    placements = Placements(shapes.vertices)
    return MeshCollection(
        names=tuple(source.name for source in files.sources),
        vertices=shapes.vertices,
        faces=shapes.faces,
        file_vertices=shapes.file_vertices,
        notes=tuple(notes),
        warnings=tuple(_warnings(files.sources, shapes, placements)),
        central=placements.central,
        places=tuple((source.file, source.first) for source in files.sources),
        parts=tuple(parts) if len(parts) > 1 else (),
        part_sizes=tuple(selection.sizes),
        kept_alone=parts[0].own if selection.why else None,
    )


def _welding_notes(
    files: FileShapes, given: NumberedShapes, welded: NumberedShapes, coincidences: Coincidences
) -> list[str]:
    """Return a sentence each on vertices that stay apart, that were left out, and that were merged."""
    total, used, kept = (shapes.vertices.shape[1] for shapes in (files, given, welded))
    notes = []
    if coincidences.apart:
        notes.append(
            f"did not merge {counted(coincidences.apart, 'pair')} of vertices that coincide in "
            f"{files.sources[0].label} but not in every shape"
        )
    if total > used:
        notes.append(f"left out {counted(total - used, 'vertex', 'vertices')} without a face")
    if used > kept:
        notes.append(f"merged {used} vertices into {kept}, because the others coincide with these in every shape")
    return notes


def _seam_notes(seams: IntArray) -> list[str]:
    note = (
        f"found {counted(len(seams), 'pair')} of border vertices that almost coincide in every shape, to "
        f"{TOLERANCES.seam:g} of the size. "
        "The surface stays open there: if it should be closed, merge these vertices in all meshes"
    )
    return [note] if len(seams) else []


def _without_other_parts(shapes: NumberedShapes, parts: list[MeshPart]) -> tuple[NumberedShapes, list[MeshPart]]:
    """Leave out the faces that are in none of the parts; return the shapes, and the parts with new numbers of faces."""
    chosen = np.sort(np.concatenate([part.faces for part in parts]))
    renumbered = [part._replace(faces=np.searchsorted(chosen, part.faces)) for part in parts]
    return shapes.only(shapes.faces[chosen]), renumbered


def _warnings(
    sources: Sequence[ShapeSource], shapes: NumberedShapes, placements: Placements
) -> list[CollectionWarning]:
    """Find shapes that look wrong; sentences begin with the file and have the file's numbers of vertices."""
    found = find_warnings(shapes.vertices, shapes.connectivity, [source.file for source in sources], placements)
    warnings = []
    for warning in found:
        source = sources[warning.shape]
        vertex = f"{shapes.file_numbers[warning.vertex] + source.first}{source.counted}"
        sentence = f"{shown(source.label)}: {warning.sentence.replace('{vertex}', vertex)}"
        warnings.append(replace(warning, sentence=sentence))
    return warnings
