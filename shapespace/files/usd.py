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
from shapespace.files.gltf_writing import vertex_normals

_PIECE, _FRAMES_AT_ONCE = 2**20, 32
#: The colour of the glTF writer's material.
_COLOUR = (0.72, 0.76, 0.82)


def usd_installed() -> bool:
    """Whether ``usd-core`` is installed, found out without importing it, which is slow."""
    return find_spec("pxr") is not None


def animated_usd(frames: NDArray[np.floating], faces: IntArray) -> Iterator[bytes]:
    """Encode shapes (n, V, 3) as a binary USD layer, in pieces.

    Time code k shows frame k, y up and in metres as glTF is. Points are float32. Normals
    at the vertices and extents are sampled with them.

    Raises:
        ImportError: ``usd-core`` is not installed.
        OSError: there is no room for a temporary file.
    """
    from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

    # The writer of binary layers takes nothing but a path.
    with TemporaryDirectory(prefix="shapespace-") as folder:
        path = Path(folder, "animation.usdc")
        try:
            stage = Usd.Stage.CreateNew(str(path))
        except Tf.ErrorException as error:
            raise OSError(f"can't write {path}") from error
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(FRAMES_PER_SECOND)
        stage.SetFramesPerSecond(FRAMES_PER_SECOND)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(len(frames) - 1)
        mesh = UsdGeom.Mesh.Define(stage, "/animation")
        stage.SetDefaultPrim(mesh.GetPrim())
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.astype(np.int32).ravel()))
        mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*_COLOUR)])
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        points, normals, extent = mesh.CreatePointsAttr(), mesh.CreateNormalsAttr(), mesh.CreateExtentAttr()
        frames = frames.astype(np.float32, copy=False)
        for start in range(0, len(frames), _FRAMES_AT_ONCE):
            # One notification at the end, instead of three for each frame.
            with Sdf.ChangeBlock():
                for k, frame in enumerate(frames[start : start + _FRAMES_AT_ONCE], start):
                    box = np.stack([frame.min(axis=0), frame.max(axis=0)])
                    around = vertex_normals(frame.astype(np.float64), faces).astype(np.float32)
                    for attribute, rows in ((points, frame), (normals, around), (extent, box)):
                        attribute.Set(Vt.Vec3fArray.FromNumpy(rows), k)
            try:
                stage.GetRootLayer().Save()  # what is saved is in the file and no longer in memory
            except Tf.ErrorException as error:
                raise OSError(f"can't write {path}") from error
        del stage, mesh, points, normals, extent
        with path.open("rb") as file:
            yield from iter(lambda: file.read(_PIECE), b"")
