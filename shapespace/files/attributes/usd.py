"""Attributes of a USD mesh: writer."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from shapespace.mesh.attributes import Labels, MeshAttributes, SurfaceMaterial, linear


def add_surface(
    stage: Any, mesh: Any, surface: MeshAttributes, pictures: Mapping[str, str] = MappingProxyType({})
) -> None:
    """Add texture coordinates, materials and names of parts to a mesh that has the polygons of ``surface``.

    Args:
        stage: stage of the mesh.
        mesh: a UsdGeom.Mesh.
        surface: the attributes.
        pictures: paths of textures by name. Other textures are left out, because a single layer has no other files.

    Raises:
        ImportError: ``usd-core`` is not installed.
    """
    from pxr import Gf, Sdf, Tf, UsdGeom, UsdShade, Vt

    primvars = UsdGeom.PrimvarsAPI(mesh)
    if surface.uv is not None and surface.uv_corners is not None:
        coordinates = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        # Corners without coordinates get one more entry.
        rows = np.vstack([surface.uv, np.zeros((1, 2))]).astype(np.float32)
        coordinates.Set(Vt.Vec2fArray.FromNumpy(rows if (surface.uv_corners < 0).any() else rows[:-1]))
        indices = np.where(surface.uv_corners < 0, len(surface.uv), surface.uv_corners)
        coordinates.SetIndices(Vt.IntArray.FromNumpy(indices.astype(np.int32)))
    if surface.colors is not None:
        shown = mesh.GetDisplayColorPrimvar()
        shown.SetInterpolation(UsdGeom.Tokens.vertex)
        shown.Set(Vt.Vec3fArray.FromNumpy(linear(surface.colors).astype(np.float32)))

    def path(folder: Any, name: str) -> Any:
        """Return a path in a folder that is not taken."""
        word = Tf.MakeValidIdentifier(name)
        taken = {child.GetName() for child in stage.GetPrimAtPath(folder).GetChildren()}
        numbered = (f"{word}_{k}" for k in range(2, len(taken) + 3))
        return folder.AppendChild(next(new for new in (word, *numbered) if new not in taken))

    def shader(material: SurfaceMaterial, place: Any) -> Any:
        made = UsdShade.Material.Define(stage, place)
        made.GetPrim().SetDisplayName(material.name)
        look = UsdShade.Shader.Define(stage, place.AppendChild("surface"))
        look.CreateIdAttr("UsdPreviewSurface")
        *color, opacity = material.color
        base = look.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        base.Set(Gf.Vec3f(*color))
        for name, value in (("opacity", opacity), ("metallic", material.metallic), ("roughness", material.roughness)):
            look.CreateInput(name, Sdf.ValueTypeNames.Float).Set(value)
        made.CreateSurfaceOutput().ConnectToSource(look.ConnectableAPI(), "surface")
        if material.texture is not None and material.texture in pictures:
            reader = UsdShade.Shader.Define(stage, place.AppendChild("st"))
            reader.CreateIdAttr("UsdPrimvarReader_float2")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
            found = UsdShade.Shader.Define(stage, place.AppendChild("texture"))
            found.CreateIdAttr("UsdUVTexture")
            found.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(pictures[material.texture])
            found.CreateInput("scale", Sdf.ValueTypeNames.Float4).Set(Gf.Vec4f(*color, 1))
            for side in ("wrapS", "wrapT"):
                found.CreateInput(side, Sdf.ValueTypeNames.Token).Set("repeat")
            at = found.CreateInput("st", Sdf.ValueTypeNames.Float2)
            at.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float2))
            base.ConnectToSource(found.CreateOutput("rgb", Sdf.ValueTypeNames.Float3))
        return made

    def subset(name: str, of: np.ndarray, k: int, family: str) -> Any:
        faces = Vt.IntArray.FromNumpy(np.flatnonzero(of == k).astype(np.int32))
        place = path(mesh.GetPath(), name).name
        made = UsdGeom.Subset.CreateGeomSubset(mesh, place, UsdGeom.Tokens.face, faces, family)
        made.GetPrim().SetDisplayName(name)
        return made

    labels: dict[str, Labels | None] = {"object": surface.objects, "group": surface.groups}
    for family, given in labels.items():
        if given and len(given.names) > (family == "object"):
            for k, name in enumerate(given.names):
                subset(name, given.of, k, family)
    if surface.objects:
        mesh.GetPrim().SetDisplayName(surface.objects.names[0])
    if surface.material_of is not None:
        binding = UsdShade.Tokens.materialBind
        for k, material in enumerate(surface.materials):
            made = shader(material, path(mesh.GetPath(), material.name))
            part = subset(material.name, surface.material_of, k, binding)
            UsdShade.MaterialBindingAPI.Apply(part.GetPrim()).Bind(made)
