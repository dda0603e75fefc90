"""Writer of USD: a shape, or an animation with time samples. It needs the package ``usd-core``."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.animated_gltf import FRAMES_PER_SECOND
from shapespace.files.colouring import Colouring
from shapespace.files.gltf_writing import picture_type, surface_normals
from shapespace.mesh.attributes import Labels, MeshAttributes, SurfaceMaterial, linear, srgb

#: Bytes of the file that are yielded at once, and frames that are in memory at once.
_PIECE, _FRAMES_AT_ONCE = 2**20, 32
#: Modification time of all files in a package: noon UTC on the second day that ZIP can represent, which exists in every
#: time zone.
_TIME = 315_662_400
#: Colour of the default material of the glTF writer.
_COLOUR = (0.72, 0.76, 0.82)


@cache
def usd_installed() -> bool:
    """Return whether ``usd-core`` is installed, without importing it, which is slow. Looked for once."""
    return find_spec("pxr") is not None


def still_usd(
    vertices: FloatArray,
    faces: IntArray,
    colouring: Colouring | None = None,
    surface: MeshAttributes | None = None,
    *,
    packed: bool = False,
) -> bytes:
    """Write one mesh as USD; see `MeshFormat.encode`, and `animated_usd` for ``packed`` and errors."""
    colourings = [colouring] if colouring else []
    return b"".join(_pieces(vertices[None], faces, surface, None, colourings, packed=packed))


def animated_usd(
    frames: NDArray[np.floating],
    faces: IntArray,
    surface: MeshAttributes | None = None,
    fps: float = FRAMES_PER_SECOND,
    colourings: Sequence[Colouring] = (),
    *,
    packed: bool = False,
) -> Iterator[bytes]:
    """Yield an animation as a binary USD layer, in pieces. Time code k shows frame k; y is up and lengths are metres.

    Points are float32. Normals at the vertices and extents are sampled too.

    Args:
        frames: (n, V, 3) positions.
        faces: (F, 3).
        surface: polygons, materials and textures, if any.
        fps: time codes per second.
        colourings: colours for each frame, instead of materials, or empty.
        packed: whether to put the layer and its textures into a USDZ package, which phones open.

    Raises:
        ImportError: ``usd-core`` is not installed.
        OSError: a temporary file can't be written.
    """
    return _pieces(frames, faces, surface, fps, colourings, packed=packed)


def _pieces(
    frames: NDArray[np.floating],
    faces: IntArray,
    surface: MeshAttributes | None,
    fps: float | None,
    colourings: Sequence[Colouring],
    *,
    packed: bool,
) -> Iterator[bytes]:
    """Yield a file, with time samples if ``fps`` is given; otherwise of the only frame."""
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

    name = "shape" if fps is None else "animation"
    # The writer of binary layers needs a path.
    with TemporaryDirectory(prefix="shapespace-") as folder:
        path = Path(folder, f"{name}.usdc")
        try:
            stage = Usd.Stage.CreateNew(str(path))
        except Tf.ErrorException as error:
            raise OSError(f"can't write {path}") from error
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        if fps is not None:
            stage.SetTimeCodesPerSecond(fps)
            stage.SetFramesPerSecond(fps)
            stage.SetStartTimeCode(0)
            stage.SetEndTimeCode(len(frames) - 1)
        mesh = UsdGeom.Mesh.Define(stage, f"/{name}")
        stage.SetDefaultPrim(mesh.GetPrim())
        shown = surface or MeshAttributes.of_triangles(faces)
        if colourings:
            shown = replace(shown, colors=srgb(colourings[0].linear), material_of=None, materials=(), textures={})
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(shown.sizes.astype(np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(shown.corners.astype(np.int32)))
        mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*_COLOUR)])
        apart = shown.shading is not None
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.faceVarying if apart else UsdGeom.Tokens.vertex)
        textures = {}
        if packed:
            for number, (name, data) in enumerate(shown.textures.items()):
                # The name in the user's file may not be a valid name of a file here.
                textures[name] = f"{number}.{picture_type(data).partition('/')[2]}"
                Path(folder, textures[name]).write_bytes(data)
        _add_surface(stage, mesh, shown, textures)
        points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
        colors = mesh.GetDisplayColorPrimvar()
        frames = frames.astype(np.float32, copy=False)
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            # One change notification at the end, instead of three for each frame.
            with Sdf.ChangeBlock():
                for k, frame in enumerate(frames[start : start + _FRAMES_AT_ONCE], start):
                    box = np.stack([frame.min(axis=0), frame.max(axis=0)])
                    around = surface_normals(frame.astype(np.float64), shown).astype(np.float32)
                    around = around[shown.normal_corners] if apart else around
                    written = [(points, frame), (normals, around), (extent, box)]
                    if colourings and fps is not None:
                        written.append((colors, colourings[k].linear.astype(np.float32)))
                    for attribute, rows in written:
                        time = Usd.TimeCode.Default() if fps is None else Usd.TimeCode(k)
                        attribute.Set(Vt.Vec3fArray.FromNumpy(rows), time)
            try:
                stage.GetRootLayer().Save()  # saved frames are in the file, no longer in memory
            except Tf.ErrorException as error:
                raise OSError(f"can't write {path}") from error
        del stage, mesh, points, normals, extent, colors
        if packed:
            package = Path(folder, f"{name}.usdz")
            # The layer has to be first. The place of the writer depends on the version of USD.
            writer = getattr(Sdf, "ZipFileWriter", None) or Usd.ZipFileWriter
            archive = writer.CreateNew(str(package))
            for member in (path, *(Path(folder, picture) for picture in textures.values())):
                # A package has the times of its files. Equal shapes should give equal bytes.
                os.utime(member, (_TIME, _TIME))
                if not archive.AddFile(str(member), member.name):
                    raise OSError(f"can't write {package}")
            if not archive.Save():
                raise OSError(f"can't write {package}")
            path = package
        with path.open("rb") as file:
            yield from iter(lambda: file.read(_PIECE), b"")


def _add_surface(stage: Any, mesh: Any, surface: MeshAttributes, pictures: Mapping[str, str]) -> None:
    """Add texture coordinates, materials and names of parts to a mesh that has the polygons of ``surface``.

    Only textures with a path in ``pictures`` are kept, because a single layer has no other files.
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
