"""A sequence of shapes as one USD file with time samples; needs the package ``usd-core``."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import IntArray
from shapespace.files.animated_gltf import FRAMES_PER_SECOND
from shapespace.files.gltf_writing import picture_type, surface_normals
from shapespace.files.surfaces.usd import add_surface
from shapespace.mesh.surface import Surface

_PIECE, _FRAMES_AT_ONCE = 2**20, 32
#: The colour of the glTF writer's material.
_COLOUR = (0.72, 0.76, 0.82)


def usd_installed() -> bool:
    """Whether ``usd-core`` is installed, found out without importing it, which is slow."""
    return find_spec("pxr") is not None


def animated_usd(
    frames: NDArray[np.floating],
    faces: IntArray,
    surface: Surface | None = None,
    fps: float = FRAMES_PER_SECOND,
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
        packed: whether the layer comes in a USDZ package, as phones want it, with the textures beside it.

    Raises:
        ImportError: ``usd-core`` is not installed.
        OSError: there is no room for a temporary file.
    """
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdUtils, Vt

    # The writer of binary layers takes nothing but a path.
    with TemporaryDirectory(prefix="shapespace-") as folder:
        path = Path(folder, "animation.usdc")
        try:
            stage = Usd.Stage.CreateNew(str(path))
        except Tf.ErrorException as error:
            raise OSError(f"can't write {path}") from error
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(frames) - 1)
        mesh = UsdGeom.Mesh.Define(stage, "/animation")
        stage.SetDefaultPrim(mesh.GetPrim())
        shown = surface or Surface.of_triangles(faces)
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
        frames = frames.astype(np.float32, copy=False)
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            # One notification at the end, instead of three for each frame.
            with Sdf.ChangeBlock():
                for k, frame in enumerate(frames[start : start + _FRAMES_AT_ONCE], start):
                    box = np.stack([frame.min(axis=0), frame.max(axis=0)])
                    around = surface_normals(frame.astype(np.float64), shown).astype(np.float32)
                    around = around[shown.normal_corners] if apart else around
                    for attribute, rows in ((points, frame), (normals, around), (extent, box)):
                        attribute.Set(Vt.Vec3fArray.FromNumpy(rows), k)
            try:
                stage.GetRootLayer().Save()  # what is saved is in the file and no longer in memory
            except Tf.ErrorException as error:
                raise OSError(f"can't write {path}") from error
        del stage, mesh, points, normals, extent
        if packed:
            package = Path(folder, "animation.usdz")
            # With what it refers to.
            if not UsdUtils.CreateNewUsdzPackage(str(path), str(package)):
                raise OSError(f"can't write {package}")
            path = package
        with path.open("rb") as file:
            yield from iter(lambda: file.read(_PIECE), b"")
