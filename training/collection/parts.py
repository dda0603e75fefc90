"""Meshes of several parts: the model computes with one, the shell; the other parts are attached to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, diagonal, face_areas
from shapespace.training.collection.checks import TOLERANCES, refusing
from shapespace.training.collection.faults import Fault, IngestError
from shapespace.training.collection.part_names import listed, may_have_names, part_names, reordered
from shapespace.training.collection.reading import FileShapes
from shapespace.training.collection.welding import NumberedShapes


class MeshPart(NamedTuple):
    """A part of a mesh."""

    name: str  # the name of its object, group or material in the file, or "part 1" and so on
    faces: IntArray  # (k,) indices of its faces


@dataclass(frozen=True)
class PartLimits:
    """Limits on the parts of a mesh."""

    # Largest area of an attached part that deforms, as a share of the shell's area. Lengths and angles of the shell
    # don't say how two large surfaces lie to each other.
    area: float = 0.2
    # A part keeps its form if each of its shapes is this close to the first one after rigid alignment, on average over
    # the vertices; a share of the part's diagonal.
    rigid: float = 0.005
    count: int = 100  # most parts: each takes time in every answer


LIMITS = PartLimits()


def separate(connectivity: Connectivity) -> list[IntArray]:
    """Return the faces of each part, in the order of their first faces. Edges join the faces of a part."""
    left, right = connectivity.edge_faces[connectivity.interior].T
    count = len(connectivity.faces)
    graph = sparse.coo_array((np.ones(len(left)), (left, right)), shape=(count, count))
    parts, of = sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(of, kind="stable")
    found = np.split(order, np.cumsum(np.bincount(of, minlength=parts))[:-1])
    return sorted(found, key=lambda faces: int(faces[0]))


def select_parts(
    files: FileShapes, wanted: Sequence[str], shapes: NumberedShapes, welded: FloatArray, seams: IntArray
) -> tuple[list[MeshPart], list[MeshPart]]:
    """Choose the shell and the attached parts.

    Args:
        files: the files as they were read.
        wanted: names of the parts to keep, first the shell's; none keeps all, the largest as the shell.
        shapes: the welded shapes.
        welded: (n,) share of the first shape's coinciding pairs of vertices that coincide in each shape.
        seams: (k, 2) pairs of vertices on borders that almost coincide.

    Returns:
        The shell followed by the attached parts, and the parts left out. Both are empty if there is one part and no
        part is wanted by name.

    Raises:
        IngestError: files list their faces or parts in different orders, no part has a wanted name, or a part is too
            large to be attached.
    """
    apart = separate(shapes.connectivity)
    if len(apart) == 1 and not wanted:
        return [], []
    _check_triangle_order(files, welded)
    names = part_names(apart, _check_part_order(files))
    parts = [MeshPart(name, faces) for name, faces in zip(names, apart, strict=True)]
    with refusing(files.sources[0]):
        try:
            chosen = _choose(parts, wanted, shapes)
        except MeshError as error:
            if not wanted and (touching := _seams_between(apart, shapes, seams)):
                raise MeshError(
                    f"has {len(apart)} parts that almost meet: {touching} pairs of vertices on their borders are less "
                    f"than {TOLERANCES.seam:g} of the mesh's size apart; merge them in all meshes, or take them apart"
                ) from error
            raise
    return chosen, [part for part in parts if not any(part is each for each in chosen)]


def parts_note(parts: Sequence[MeshPart], left_out: Sequence[MeshPart]) -> str:
    """Return a sentence on what becomes of the parts, the shell first."""
    shell, *attached = parts
    sentence = f"{len(parts) + len(left_out)} separate parts: the model computes with {_sized(shell)}"
    if attached:
        sentence += f"; attached to it: {listed([part.name for part in attached])}"
    if left_out:
        sentence += f"; left out: {listed([part.name for part in left_out])}"
    return sentence


def _check_triangle_order(files: FileShapes, welded: FloatArray) -> None:
    """Refuse STL files in different orders: corners of triangles that meet in one file don't meet in the other."""
    if files.triangles_only and (welded < 0.5).any():
        what = f"its triangles don't meet where those of {files.sources[0].label} do"
        remedy = "STL files must list the faces in the same order"
        raise IngestError(*(Fault(files.sources[k].label, what, remedy) for k in np.flatnonzero(welded < 0.5)))


def _check_part_order(files: FileShapes) -> Path | None:
    """Return the first file that can name parts, if any; refuse files that list the same parts in another order."""
    template = next((path for path in files.paths if may_have_names(path)), None)
    odd = [(path, reordered(path, template)) for path in files.paths if template and path != template]
    faults = [
        Fault(str(path), f"{why}, unlike those of {template.name}", "export it like the others")
        for path, why in odd
        if why
    ]
    if faults:
        raise IngestError(*faults)
    return template


def _choose(parts: Sequence[MeshPart], wanted: Sequence[str], shapes: NumberedShapes) -> list[MeshPart]:
    """Return the shell and the attached parts. Raises MeshError, see `select_parts`."""
    known = list(dict.fromkeys(part.name for part in parts))
    for name in wanted:
        if name not in known:
            raise MeshError(f"has no part {name!r}, as collection.parts asks for; its parts are {listed(known)}")
    kept = [part for part in parts if not wanted or part.name in wanted]
    areas = face_areas(shapes.vertices[0], shapes.faces)
    sizes = {id(part): float(areas[part.faces].sum()) for part in kept}
    shell = max((part for part in kept if not wanted or part.name == wanted[0]), key=lambda part: sizes[id(part)])
    attached = [part for part in kept if part is not shell]
    if len(attached) >= LIMITS.count:
        raise MeshError(
            f"has {len(kept)} separate parts, where {LIMITS.count} are allowed; join them in all meshes, or keep some "
            "only, by collection.parts"
        )
    for part in attached:
        share = sizes[id(part)] / sizes[id(shell)]
        if share > LIMITS.area and not _keeps_its_form(shapes.vertices, np.unique(shapes.faces[part.faces])):
            raise MeshError(
                f"has {len(kept)} separate parts, of which {_sized(part)} is too large to be attached to "
                f"{_sized(shell)}: it has {share:.0%} of the area and changes its form, and lengths and angles don't "
                'see how two surfaces lie to each other. Train one model each, as by collection.parts = ["NAME"], or '
                "join them in all meshes"
            )
    return [shell, *attached]


def _seams_between(parts: Sequence[IntArray], shapes: NumberedShapes, seams: IntArray) -> int:
    """Count the pairs of almost coinciding vertices that belong to different parts."""
    part_of = np.zeros(shapes.connectivity.vertex_count, int)
    for k, faces in enumerate(parts):
        part_of[shapes.faces[faces]] = k
    return int((part_of[seams[:, 0]] != part_of[seams[:, 1]]).sum())


def _sized(part: MeshPart) -> str:
    return f"{part.name!r} ({len(part.faces)} faces)"


def _keeps_its_form(shapes: FloatArray, vertices: IntArray) -> bool:
    """Whether some vertices move rigidly from the first shape to every other one."""
    first = shapes[0][vertices]
    most = LIMITS.rigid * float(diagonal(first))
    return all(
        np.linalg.norm(align(first, shape[vertices]) - shape[vertices], axis=1).mean() <= most for shape in shapes
    )
