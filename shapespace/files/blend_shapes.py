"""Blend shapes: a rest shape and further shapes as morph targets of a GLB, for programs that run no networks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.gltf_writing import GltfBuilder
from shapespace.mesh.attributes import MeshAttributes


def blend_shapes_glb(
    rest: FloatArray,
    ends: FloatArray,
    names: Sequence[str],
    faces: IntArray,
    surface: MeshAttributes | None = None,
    extras: Mapping[str, Any] | None = None,
) -> bytes:
    """Encode a rest shape, and shapes that a weight of 1 of their morph target leads to.

    Args:
        rest: (V, 3) rest shape, in any unit.
        ends: (n, V, 3) shapes of the morph targets.
        names: names of the morph targets. They go into ``extras.targetNames`` of the mesh, where Blender and three.js
            look for them.
        faces: (F, 3).
        surface: polygons, texture coordinates and materials of the mesh, if any.
        extras: ``extras`` of the file's ``asset``.
    """
    document = GltfBuilder(rest, faces, "shape", surface=surface, joined=True)
    normals = document.normals(rest)
    document.add_targets((end - rest for end in ends), (document.normals(end) - normals for end in ends), names)
    if extras:
        document.tree["asset"]["extras"] = dict(extras)
    return document.glb()
