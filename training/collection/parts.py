"""Meshes of several parts: one is the shell that the model computes with, the others ride along with it."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.attributes.reading import FORMATS, read_attributes
from shapespace.mesh.attributes import Labels, MeshAttributes
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, diagonal, face_areas

#: A part with more than this share of the shell's area may only be carried along if it moves rigidly.
LARGE = 0.2
#: It moves rigidly if each of its shapes is within this mean distance, a share of its diagonal, of one of them moved
#: rigidly.
RIGID = 0.005
#: Most parts: each takes time in every answer.
MOST = 100


class MeshPart(NamedTuple):
    """A part of a mesh.

    Attributes:
        name: its object's, group's or material's in the file, where these tell parts apart.
        faces: (k,) numbers of its faces.
    """

    name: str
    faces: IntArray


def separate(connectivity: Connectivity) -> list[IntArray]:
    """The faces of each part, in the order of their first ones; faces of one part are joined by edges, not vertices."""
    left, right = connectivity.edge_faces[connectivity.interior].T
    count = len(connectivity.faces)
    graph = sparse.coo_array((np.ones(len(left)), (left, right)), shape=(count, count))
    parts, of = sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(of, kind="stable")
    found = np.split(order, np.cumsum(np.bincount(of, minlength=parts))[:-1])
    return sorted(found, key=lambda faces: int(faces[0]))


def named(parts: Sequence[IntArray], path: Path | None) -> list[MeshPart]:
    """Parts with the names that a file has for them; those without are numbered from 1.

    Args:
        parts: as `separate` gives them.
        path: of a mesh file whose triangles they number, if there is one.
    """
    numbered = [f"part {k + 1}" for k in range(len(parts))]
    firsts = np.array([faces[0] for faces in parts])
    for labels in _labels(path):
        of = [int(labels.of[first]) for first in firsts] if firsts.max() < len(labels.of) else []
        if len(set(of)) > 1:
            names = [labels.names[k] if k >= 0 else name for k, name in zip(of, numbered, strict=True)]
            return [MeshPart(name, faces) for name, faces in zip(names, parts, strict=True)]
    return [MeshPart(name, faces) for name, faces in zip(numbered, parts, strict=True)]


def _labels(path: Path | None) -> list[Labels]:
    """What tells the triangles of a file apart: objects, groups, materials."""
    surface = _surface(path)
    if surface is None:
        return []
    flat = surface.triangulated
    materials = None
    if flat.material_of is not None:
        materials = Labels(tuple(material.name for material in flat.materials), flat.material_of)
    return [labels for labels in (flat.objects, flat.groups, materials) if labels]


def _surface(path: Path | None) -> MeshAttributes | None:
    if path is None or path.suffix.lstrip(".").lower() not in FORMATS:
        return None
    try:
        return read_attributes(path)[0]
    except OSError:
        return None


def choose(parts: Sequence[MeshPart], wanted: Sequence[str], shapes: FloatArray, faces: IntArray) -> list[MeshPart]:
    """The shell, and the parts that ride along.

    Args:
        parts: of the mesh.
        wanted: names of those to keep, the shell's first; none keeps all, the largest as the shell.
        shapes: (n, V, 3).
        faces: (F, 3).

    Raises:
        MeshError: no part has a name that is wanted, or one that would ride along is too large for that.
    """
    known = list(dict.fromkeys(part.name for part in parts))
    for name in wanted:
        if name not in known:
            raise MeshError(f"has no part {name!r}, as collection.parts asks for; its parts are {_some(known)}")
    kept = [part for part in parts if not wanted or part.name in wanted]
    areas = face_areas(shapes[0], faces)
    sizes = {id(part): float(areas[part.faces].sum()) for part in kept}
    shell = max((part for part in kept if not wanted or part.name == wanted[0]), key=lambda part: sizes[id(part)])
    riders = [part for part in kept if part is not shell]
    if len(riders) >= MOST:
        raise MeshError(
            f"has {len(kept)} separate parts, where {MOST} are allowed; join them in all meshes, or keep some only, by "
            "collection.parts"
        )
    for part in riders:
        share = sizes[id(part)] / sizes[id(shell)]
        if share > LARGE and not _keeps_its_form(shapes, np.unique(faces[part.faces])):
            raise MeshError(
                f"has {len(kept)} separate parts, of which {_one(part)} is too large to ride along with "
                f"{_one(shell)}: it has {share:.0%} of the area and changes its form, and lengths and angles don't see "
                'how two surfaces lie to each other. Train one model each, as by collection.parts = ["NAME"], or join '
                "them in all meshes"
            )
    return [shell, *riders]


def _one(part: MeshPart) -> str:
    return f"{part.name!r} ({len(part.faces)} faces)"


def _some(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names[:8])) + (", …" if len(names) > 8 else "")


def _keeps_its_form(shapes: FloatArray, vertices: IntArray) -> bool:
    first = shapes[0][vertices]
    most = RIGID * float(diagonal(first))
    return all(
        np.linalg.norm(align(first, shape[vertices]) - shape[vertices], axis=1).mean() <= most for shape in shapes
    )


def kept(parts: Sequence[MeshPart], left_out: Sequence[MeshPart]) -> str:
    """One sentence on what becomes of the parts, the shell first."""
    shell, *riders = parts
    sentence = f"{len(parts) + len(left_out)} separate parts: the model computes with {_one(shell)}"
    if riders:
        sentence += f"; {_some([part.name for part in riders])} {'rides' if len(riders) == 1 else 'ride'} along"
    if left_out:
        sentence += f"; {_some([part.name for part in left_out])} left out"
    return sentence


def difference(path: Path, other: Path) -> str:
    """How the parts of a file differ from another's, as far as names tell; nothing where they don't."""
    own, others = (_names(file) for file in (path, other))
    if not own or not others or own == others:
        return ""
    missing, more = ([name for name in a if name not in b] for a, b in ((others, own), (own, others)))
    if missing and more:
        return ""  # names that go with the file
    if missing:
        return f"it has no part {_some(missing)}"
    if more:
        return f"its part {_some(more)} is not in {other.name}"
    return f"its parts come in another order: {_some(own)}"


def reordered(path: Path, other: Path) -> str:
    """That a file has the parts of another in another order, though with the same faces; else nothing."""
    own, others = (_names(file) for file in (path, other))
    return difference(path, other) if sorted(own) == sorted(others) else ""


def _names(path: Path) -> list[str]:
    """Of a file's objects, or of its groups, in the order of the faces."""
    surface = _surface(path)
    labels = surface and (surface.objects or surface.groups)
    if not labels:
        return []
    return [labels.names[k] if k >= 0 else "" for k, _ in itertools.groupby(labels.of.tolist())]
