"""Mesh attributes as bundles and runs store them: arrays by name, an entry with names, and textures as files."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from shapespace.bundle.schema import SURFACE, AttributesEntry, MaterialEntry
from shapespace.files.attributes.textures import ALL, BEGINNINGS, LARGEST
from shapespace.mesh.attributes import Labels, MeshAttributes, SurfaceMaterial
from shapespace.mesh.triangle_mesh import MeshError


def surface_arrays(surface: MeshAttributes) -> dict[str, NDArray]:
    """Return the arrays of mesh attributes, by the names that `from_entry` reads."""
    found = {
        "starts": surface.starts,
        "corners": surface.corners,
        "uv": surface.uv,
        "uv_corners": surface.uv_corners,
        "shading": surface.shading,
        "colors": surface.colors,
        "object_of": surface.objects.of if surface.objects else None,
        "group_of": surface.groups.of if surface.groups else None,
        "material_of": surface.material_of,
    }
    return {SURFACE + name: array for name, array in found.items() if array is not None}


def surface_entry(surface: MeshAttributes) -> AttributesEntry:
    """Return the entry of mesh attributes in a manifest."""
    return AttributesEntry(
        objects=list(surface.objects.names) if surface.objects else [],
        groups=list(surface.groups.names) if surface.groups else [],
        materials=[MaterialEntry(**vars(material)) for material in surface.materials],
        normals=surface.normals,
    )


def from_entry(entry: AttributesEntry, arrays: Mapping[str, NDArray], textures: Mapping[str, bytes]) -> MeshAttributes:
    """Return mesh attributes from an entry, its arrays and its textures.

    This function does not check whether the arrays fit each other and the mesh; `MeshAttributes.check` does. Raises
    MeshError if an array is missing, or a texture is too large or no picture.
    """

    def whole(name: str) -> NDArray | None:
        array = arrays.get(SURFACE + name)
        return None if array is None else array.astype(np.int64)

    def real(name: str) -> NDArray | None:
        array = arrays.get(SURFACE + name)
        return None if array is None else array.astype(np.float64)

    def labels(names: list[str], of: NDArray | None, kind: str) -> Labels | None:
        if bool(names) != (of is not None):
            raise MeshError(f"there are names of {kind} without polygons that have them, or the reverse")
        return None if of is None else Labels(tuple(names), of)

    starts, corners = whole("starts"), whole("corners")
    if starts is None or corners is None:
        raise MeshError(f"there is no array {SURFACE}{'starts' if starts is None else 'corners'}")
    for name in entry.textures:
        data = textures.get(name, b"")
        if not data.startswith(BEGINNINGS):
            raise MeshError(f"{name} is neither PNG nor JPEG")
        if len(data) > LARGEST:
            raise MeshError(f"{name} has more than {LARGEST >> 20} MiB")
    if sum(len(textures[name]) for name in entry.textures) > ALL:
        raise MeshError(f"textures have more than {ALL >> 20} MiB together")
    return MeshAttributes(
        starts=starts,
        corners=corners,
        uv=real("uv"),
        uv_corners=whole("uv_corners"),
        shading=whole("shading"),
        normals=entry.normals,
        colors=real("colors"),
        objects=labels(entry.objects, whole("object_of"), "objects"),
        groups=labels(entry.groups, whole("group_of"), "groups"),
        material_of=whole("material_of"),
        materials=tuple(SurfaceMaterial(**vars(material)) for material in entry.materials),
        textures={name: textures[name] for name in entry.textures},
    )
