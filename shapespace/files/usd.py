"""A shape as a USD file, or a sequence of shapes with time samples; needs the package ``usd-core``."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.animated_gltf import FRAMES_PER_SECOND
from shapespace.files.attributes.usd import add_surface
from shapespace.files.colouring import Colouring
from shapespace.files.gltf_writing import picture_type, surface_normals
from shapespace.mesh.attributes import MeshAttributes, srgb

_PIECE, _FRAMES_AT_ONCE = 2**20, 32
#: Modification time of all files in a package: noon UTC on the second day that ZIP can represent, so that it is
#: representable in every time zone.
_TIME = 315_662_400
#: The colour of the glTF writer's material.
_COLOUR = (0.72, 0.76, 0.82)


def usd_installed() -> bool:
    """Whether ``usd-core`` is installed, found out without importing it, which is slow."""
    return find_spec("pxr") is not None


def still_usd(
    vertices: FloatArray,
    faces: IntArray,
    colouring: Colouring | None = None,
    surface: MeshAttributes | None = None,
    *,
    packed: bool = False,
) -> bytes:
    """Encode a shape (V, 3) with faces (F, 3); arguments and errors as `animated_usd` has them.

    Args:
        vertices: (V, 3).
        faces: (F, 3).
        colouring: of the vertices, instead of materials.
        surface: with polygons, materials and textures.
        packed: see `animated_usd`.
    """
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
    """Encode shapes (n, V, 3), with the polygons of their surface where there is one, as a binary USD layer, in pieces.

    Time code k shows frame k, y up and in metres as glTF is. Points are float32. Normals
    at the vertices and extents are sampled with them.

    Args:
        frames: (n, V, 3).
        faces: (F, 3).
        surface: with polygons, materials and textures.
        fps: time codes in a second.
        colourings: of each frame, instead of materials, or of none.
        packed: whether the layer comes in a USDZ package, as phones want it, with the textures beside it.

    Raises:
        ImportError: ``usd-core`` is not installed.
        OSError: there is no room for a temporary file.
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
    """Of a file with time samples; of one frame without any where it has no frames in a second."""
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

    name = "shape" if fps is None else "animation"
    # The writer of binary layers takes nothing but a path.
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
                # As short as they can be: what the file called them may be no name for a file here.
                textures[name] = f"{number}.{picture_type(data).partition('/')[2]}"
                Path(folder, textures[name]).write_bytes(data)
        add_surface(stage, mesh, shown, textures)
        points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
        colors = mesh.GetDisplayColorPrimvar()
        frames = frames.astype(np.float32, copy=False)
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            # One notification at the end, instead of three for each frame.
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
                stage.GetRootLayer().Save()  # what is saved is in the file and no longer in memory
            except Tf.ErrorException as error:
                raise OSError(f"can't write {path}") from error
        del stage, mesh, points, normals, extent, colors
        if packed:
            package = Path(folder, f"{name}.usdz")
            # The layer first. Versions of USD differ in where they have the writer.
            writer = getattr(Sdf, "ZipFileWriter", None) or Usd.ZipFileWriter
            archive = writer.CreateNew(str(package))
            for member in (path, *(Path(folder, picture) for picture in textures.values())):
                # Equal shapes give equal bytes, but for this: a package has the times of its files.
                os.utime(member, (_TIME, _TIME))
                if not archive.AddFile(str(member), member.name):
                    raise OSError(f"can't write {package}")
            if not archive.Save():
                raise OSError(f"can't write {package}")
            path = package
        with path.open("rb") as file:
            yield from iter(lambda: file.read(_PIECE), b"")
