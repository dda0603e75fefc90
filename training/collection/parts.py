"""Meshes of several parts: the model computes with one, the shell; the other parts are attached to it."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.counted import counted
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
    own: str = ""  # a name that no other part has: ``name``, followed by a number where several parts share it


class PartSize(NamedTuple):
    """The size of a part, which helps to choose among parts."""

    own: str  # see MeshPart
    vertices: int
    area: float  # share of the first shape's area


class PartSelection(NamedTuple):
    """The parts that a collection keeps, and all that there are."""

    kept: list[MeshPart]  # the shell and then the attached parts; empty if there is one part and none is wanted by name
    left_out: list[MeshPart]
    sizes: list[PartSize]  # of all parts, those with the most vertices first
    why: str = ""  # why not all are kept, where the largest one is kept alone


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
    equal: float = 0.999  # parts with this share of the largest area count as equally large


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
    files: FileShapes,
    wanted: Sequence[str],
    shapes: NumberedShapes,
    welded: FloatArray,
    seams: IntArray,
    *,
    alone: bool = False,
) -> PartSelection:
    """Choose the shell and the attached parts.

    Args:
        files: the files as they were read.
        wanted: names of the parts to keep, first the shell's; none keeps all, the largest as the shell.
        shapes: the welded shapes.
        welded: (n,) share of the first shape's coinciding pairs of vertices that coincide in each shape.
        seams: (k, 2) pairs of vertices on borders that almost coincide.
        alone: whether the largest part is kept alone, where none is wanted by name and not all can be kept. Of equally
            large ones this is the first in the file.

    Raises:
        IngestError: files list their faces or parts in different orders, no part has a wanted name, or a part is too
            large to be attached.
    """
    apart = separate(shapes.connectivity)
    if len(apart) == 1 and not wanted:
        return PartSelection([], [], [])
    _check_triangle_order(files, welded)
    names = part_names(apart, _check_part_order(files))
    parts = [MeshPart(*each) for each in zip(names, apart, _own_names(names), strict=True)]
    areas = _areas(parts, shapes)
    why = ""
    with refusing(files.sources[0], remedy=""):
        try:
            kept = _choose(parts, wanted, shapes, areas)
        except MeshError as error:
            reason = str(error)
            if not wanted and (touching := _seams_between(apart, shapes, seams)):
                reason = (
                    f"has {len(apart)} parts that almost meet: {counted(touching, 'pair')} of vertices on their "
                    f"borders are less than {TOLERANCES.seam:g} of the mesh's size apart; merge these vertices in all "
                    "meshes, or move the parts apart"
                )
            if wanted or not alone:
                raise MeshError(reason) from error
            kept, why = [_largest(parts, areas)], reason
    whole = sum(areas.values())
    sizes = [PartSize(part.own, len(np.unique(shapes.faces[part.faces])), areas[part.own] / whole) for part in parts]
    left_out = [part for part in parts if not any(part is each for each in kept)]
    return PartSelection(kept, left_out, sorted(sizes, key=lambda size: -size.vertices), why)


def parts_note(parts: PartSelection) -> str:
    """Return a sentence on what becomes of the parts."""
    (shell, *attached), left_out = parts.kept, parts.left_out
    sentence = f"{len(parts.sizes)} separate parts: the model predicts {_sized(shell)}"
    if attached:
        sentence += f"; attached to it: {listed([part.name for part in attached])}"
    if left_out:
        sentence += f"; left out: {listed([part.name for part in left_out])}"
    if parts.why:
        sentence += f". The model can't keep all parts, because the mesh {parts.why}"
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
    if template is None:
        return None
    odd = [(path, reordered(path, template)) for path in files.paths if path != template]
    faults = [
        Fault(str(path), f"{why}, unlike those of {template.name}", "export it like the others")
        for path, why in odd
        if why
    ]
    if faults:
        raise IngestError(*faults)
    return template


def _own_names(names: Sequence[str]) -> list[str]:
    """Number names that several parts share: "body" becomes "body 1" and "body 2"."""
    taken, own = set(names), []
    for name in names:
        alone = name
        if names.count(name) > 1:
            alone = next(each for k in itertools.count(1) if (each := f"{name} {k}") not in taken)
            taken.add(alone)
        own.append(alone)
    return own


def _areas(parts: Sequence[MeshPart], shapes: NumberedShapes) -> dict[str, float]:
    """Return the area of each part in the first shape, by its own name."""
    areas = face_areas(shapes.vertices[0], shapes.faces)
    return {part.own: float(areas[part.faces].sum()) for part in parts}


def _largest(parts: Sequence[MeshPart], areas: Mapping[str, float]) -> MeshPart:
    """Return the part with the largest area; of equally large ones the first in the file."""
    most = max(areas[part.own] for part in parts)
    return next(part for part in parts if areas[part.own] >= LIMITS.equal * most)


def _choose(
    parts: Sequence[MeshPart], wanted: Sequence[str], shapes: NumberedShapes, areas: Mapping[str, float]
) -> list[MeshPart]:
    """Return the shell and the attached parts. Raises MeshError, see `select_parts`."""
    for name in wanted:
        if not any(name in (part.name, part.own) for part in parts):
            known = listed(list(dict.fromkeys(part.name for part in parts)))
            raise MeshError(f"has no part {name!r}, which collection.parts names; its parts are {known}")
    kept = [part for part in parts if not wanted or {part.name, part.own} & {*wanted}]
    shell = _largest([part for part in kept if not wanted or wanted[0] in (part.name, part.own)], areas)
    attached = [part for part in kept if part is not shell]
    if len(attached) >= LIMITS.count:
        raise MeshError(
            f"has {len(kept)} separate parts, but at most {LIMITS.count} are allowed; join them in all meshes, or "
            "name the parts to keep in collection.parts (init lists them all)"
        )
    for part in attached:
        share = areas[part.own] / areas[shell.own]
        if share > LIMITS.area and not _keeps_its_form(shapes.vertices, np.unique(shapes.faces[part.faces])):
            raise MeshError(
                f"has {len(kept)} separate parts, and {_sized(part)} is too large to be attached to {_sized(shell)}: "
                "it "
                f"has {share:.0%} of the area and changes its shape; train one model for each, with "
                'collection.parts = ["NAME"], or join them in all meshes'
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
