"""Shapes beside one at rest, as the morph targets of a GLB: a set of sliders for programs that know no networks."""

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
    """Encode a shape and others that weights of 1 lead to.

    Args:
        rest: (V, 3), in any unit.
        ends: (n, V, 3).
        names: of these, which go into the mesh's ``extras.targetNames``, where Blender, three.js and others look.
        faces: (F, 3).
        surface: of the mesh, where its file had more than triangles.
        extras: of the ``asset``.
    """
    document = GltfBuilder(rest, faces, "shape", surface=surface, joined=True)
    normals = document.normals(rest)
    document.add_targets((end - rest for end in ends), (document.normals(end) - normals for end in ends), names)
    if extras:
        document.tree["asset"]["extras"] = dict(extras)
    return document.glb()
