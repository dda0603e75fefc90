"""Polygons, texture coordinates, colours and materials of the reference's file, for the vertices of the collection."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shapespace.files.attributes.reading import FORMATS, read_attributes
from shapespace.files.limits import in_words
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.training.collection.listing import data_files, extension
from shapespace.training.collection.mesh_collection import MeshCollection


def reference_surface(
    data: Path | None, meshes: MeshCollection, chosen: int
) -> tuple[MeshAttributes | None, list[str]]:
    """Read the mesh attributes of the reference's file, or of the first file whose format has more than triangles.

    One file whose morph targets are the shapes has attributes too. Without mesh files there are none.

    Returns:
        The attributes, if any, and a sentence about each attribute that is left out.
    """
    if data is None or meshes.file_vertices is None:
        return None, []
    names = [name for name, _ in (meshes.places[chosen], *meshes.places)]
    paths = [data / name for name in names] if data.is_dir() else []
    path = next((path for path in (*paths, *data_files(data)) if extension(path) in FORMATS), None)
    if path is None:
        return None, []
    try:
        found, faults = read_attributes(path)
        if found:
            found = found.welded(meshes.file_vertices)
            found.check(meshes.vertices.shape[1], meshes.faces)
    except (OSError, MeshError) as error:
        why = in_words(error, named=False) if isinstance(error, OSError) else error
        found, faults = None, [f"its polygons, texture coordinates and materials are left out: {why}"]
    return found, [f"{path}: {fault}" for fault in faults]


def kept(surface: MeshAttributes) -> str:
    """Return a sentence on the attributes that are kept from a file."""
    sizes = surface.sizes
    counts = {"triangles": (sizes == 3).sum(), "quads": (sizes == 4).sum(), "larger polygons": (sizes > 4).sum()}
    parts = [f"{count} {name}" for name, count in counts.items() if count]
    parts += [] if surface.uv is None else [f"{len(surface.uv)} texture coordinates"]
    parts += [] if surface.colors is None else ["vertex colours"]
    for labels, one in ((surface.objects, "object"), (surface.groups, "group")):
        if labels:
            parts.append(f"{one if len(labels.names) == 1 else one + 's'} {', '.join(labels.names[:4])}")
    if surface.materials:
        parts.append(f"materials {', '.join(material.name for material in surface.materials[:4])}")
    sentence = f"kept for answers: {', '.join(parts)}"
    if surface.textures:
        size = sum(map(len, surface.textures.values())) / 2**20
        sentence += (
            f"; the textures {', '.join(surface.textures)} ({size:.1f} MiB) are copied into the bundle: check that "
            "their licence allows this, and that export.licence agrees"
        )
    return sentence


def texture_bytes(surface: MeshAttributes) -> dict[str, np.ndarray]:
    """Return textures as arrays of bytes, by name."""
    return {name: np.frombuffer(data, np.uint8) for name, data in surface.textures.items()}
