"""The names that mesh files give their parts: objects, groups or materials."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from shapespace.arrays import IntArray
from shapespace.files.attributes.reading import FORMATS, read_attributes
from shapespace.mesh.attributes import Labels, MeshAttributes
from shapespace.training.collection.listing import extension


def may_have_names(path: Path) -> bool:
    """Whether the format of a file can name parts."""
    return extension(path) in FORMATS


def part_names(parts: Sequence[IntArray], path: Path | None) -> list[str]:
    """Return a name for each part, given by its faces (k,): the file's object, group or material.

    The first of these three that tells parts apart counts. Parts without a name are numbered: "part 1", "part 2" and so
    on, and so are all parts without a file.
    """
    numbered = [f"part {k + 1}" for k in range(len(parts))]
    firsts = np.array([faces[0] for faces in parts])
    for labels in _labels(path):
        of = [int(labels.of[first]) for first in firsts] if firsts.max() < len(labels.of) else []
        if len(set(of)) > 1:
            return [labels.names[k] if k >= 0 else name for k, name in zip(of, numbered, strict=True)]
    return numbered


def difference(path: Path, other: Path) -> str:
    """Return how the names of a file's parts differ from another file's; empty if they don't, or if names don't say."""
    own, others = (_object_names(file) for file in (path, other))
    if not own or not others or own == others:
        return ""
    missing, more = ([name for name in a if name not in b] for a, b in ((others, own), (own, others)))
    if missing and more:
        return ""  # each file has names of its own
    if missing:
        return f"it has no part {listed(missing)}"
    if more:
        return f"its part {listed(more)} is not in {other.name}"
    return f"its parts come in another order: {listed(own)}"


def reordered(path: Path, other: Path) -> str:
    """Return how a file orders parts differently from another file that has the same parts; empty if it doesn't."""
    own, others = (_object_names(file) for file in (path, other))
    return difference(path, other) if sorted(own) == sorted(others) else ""


def listed(names: Sequence[str]) -> str:
    """Quote the first eight names."""
    return ", ".join(map(repr, names[:8])) + (", …" if len(names) > 8 else "")


def _labels(path: Path | None) -> list[Labels]:
    """Return the objects, groups and materials of a file's triangles, as far as it has them."""
    attributes = _attributes(path) if path else None
    if attributes is None:
        return []
    flat = attributes.triangulated
    materials = None
    if flat.material_of is not None:
        materials = Labels(tuple(material.name for material in flat.materials), flat.material_of)
    return [labels for labels in (flat.objects, flat.groups, materials) if labels]


def _attributes(path: Path) -> MeshAttributes | None:
    if not may_have_names(path):
        return None
    try:
        return read_attributes(path)[0]
    except OSError:
        return None


def _object_names(path: Path) -> list[str]:
    """Return the names of a file's objects, or else of its groups, in the order of the faces."""
    attributes = _attributes(path)
    labels = attributes and (attributes.objects or attributes.groups)
    if not labels:
        return []
    return [labels.names[k] if k >= 0 else "" for k, _ in itertools.groupby(labels.of.tolist())]
