"""Attributes of a glTF scene. The format has no polygons except triangles."""

from __future__ import annotations

import base64
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.files.attributes.textures import Textures
from shapespace.files.gltf_document import Accessor
from shapespace.files.gltf_reading import PlacedPrimitive, Scene, open_scene
from shapespace.files.limits import UNLIMITED, label
from shapespace.mesh.attributes import NONE, MeshAttributes, SurfaceMaterial, labelled, srgb

#: Component types of texture coordinates and colours: bytes and shorts stand for fractions (3.7.2.1).
_REAL = (5121, 5123, 5126)
#: Normals that agree to this number of decimals are equal.
_NORMAL_DECIMALS = 3


def read(path: Path, faults: list[str]) -> MeshAttributes:
    """Read the attributes of a GLB or glTF file; appends a sentence to ``faults`` for everything left out."""
    binary = path.suffix.lower() == ".glb"
    scene = open_scene(memoryview(path.read_bytes()), UNLIMITED, binary=binary, beside=path)
    corners = scene.corners.ravel()
    parts = np.repeat(np.arange(len(scene.parts)), [len(part.faces(scene.buffers)) for part in scene.parts])
    uv = _attribute(scene, "TEXCOORD_0", ("VEC2",))
    normals = _attribute(scene, "NORMAL", ("VEC3",), (5126,))
    colors = _attribute(scene, "COLOR_0", ("VEC3", "VEC4"))
    numbers = [part.primitive.get("material") for part in scene.parts]
    textures = Textures(faults)
    used = sorted({number for number in numbers if number is not None})
    materials: list[SurfaceMaterial] = []
    for number in used:
        material = _material(scene, number, path, textures)
        # Other formats identify materials by name.
        taken = material.name in {known.name for known in materials}
        materials.append(replace(material, name=f"{material.name[:80]} {number}") if taken else material)
    names = [label(part.mesh.get("name", "")) for part in scene.parts]
    surface = MeshAttributes.of_triangles(scene.faces)
    return MeshAttributes(
        starts=surface.starts,
        corners=surface.corners,
        uv=None if uv is None else uv * [1, -1] + [0, 1],
        uv_corners=None if uv is None else corners,
        shading=None if normals is None else np.unique(_labels(normals)[corners], return_inverse=True)[1],
        normals=normals is not None,
        colors=None if colors is None else srgb(np.clip(colors[scene.first, :3], 0, 1)),
        objects=labelled([names[k] for k in parts.tolist()]),
        material_of=np.array([NONE if k is None else used.index(k) for k in numbers])[parts] if used else None,
        materials=tuple(materials),
        textures=textures.files,
    )


def _labels(normals: FloatArray) -> np.ndarray:
    labels: np.ndarray = np.unique(normals.round(_NORMAL_DECIMALS), axis=0, return_inverse=True)[1].reshape(-1)
    return labels


def _attribute(
    scene: Scene, name: str, kinds: tuple[str, ...], components: tuple[int, ...] = _REAL
) -> FloatArray | None:
    """Return an attribute of the listed vertices of a scene; None if a primitive doesn't have it."""
    if not all(name in part.primitive["attributes"] for part in scene.read):
        return None

    def values(part: PlacedPrimitive) -> FloatArray:
        index = part.primitive["attributes"][name]
        given = scene.document.accessors[index].get("type")
        kind = given if given in kinds else kinds[0]
        found = Accessor.of(scene.document, index, kind, components).real(scene.buffers)
        if name == "NORMAL" and part.place is not None:
            found = found @ np.linalg.inv(part.place[:3, :3])
        return found[:, :3]

    return np.concatenate([values(part) for part in scene.read])


def _material(scene: Scene, number: int, path: Path, textures: Textures) -> SurfaceMaterial:
    tree = scene.document.tree
    given = tree["materials"][number]
    look: Mapping[str, Any] = given.get("pbrMetallicRoughness", {})
    name = label(given.get("name", "")) or f"material {number}"
    texture = None
    if "baseColorTexture" in look:
        source = tree["textures"][look["baseColorTexture"]["index"]].get("source")
        if source is not None:
            texture = _picture(scene, tree["images"][source], source, path, textures, name)
    r, g, b, a = (min(1.0, max(0.0, float(x))) for x in look.get("baseColorFactor", (1, 1, 1, 1)))
    metallic, roughness = (min(1.0, max(0.0, float(look.get(f"{of}Factor", 1)))) for of in ("metallic", "roughness"))
    return SurfaceMaterial(name, (r, g, b, a), metallic, roughness, texture)


def _picture(
    scene: Scene, image: Mapping[str, Any], source: int, path: Path, textures: Textures, material: str
) -> str | None:
    uri = image.get("uri")
    content: Callable[[], bytes]
    if uri is not None and not uri.startswith("data:"):
        return textures.add_file(path.parent, unquote(uri), material)
    if uri is not None:

        def content() -> bytes:
            text = scene.buffers.text(uri)
            return base64.b64decode(bytes(text).partition(b",")[2], validate=True)

    else:
        view = scene.document.views[image["bufferView"]]

        def content() -> bytes:
            start = view.get("byteOffset", 0)
            return bytes(scene.buffers.read(view["buffer"], start, start + view["byteLength"]))

    return textures.add(source, str(image.get("name") or f"texture-{source}"), content, material)
