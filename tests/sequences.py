"""Reading sequences of shapes by their specifications, independently of the code that wrote them."""

import struct
from pathlib import Path
from typing import Any

import numpy as np


def read_point_cache(data: bytes) -> np.ndarray:
    """(n, V, 3) positions of a PC2 file."""
    signature, version, points, start, rate, samples = struct.unpack_from("<12siiffi", data)
    assert (signature, version, start, rate) == (b"POINTCACHE2\0", 1, 0, 1)
    assert len(data) == 32 + 12 * points * samples
    return np.frombuffer(data, "<f4", offset=32).reshape(samples, points, 3)


def read_usd(path: Path) -> tuple[np.ndarray, Any]:
    """(n, V, 3) positions of the default prim at the time codes from start to end, and the stage."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    times = np.arange(stage.GetStartTimeCode(), stage.GetEndTimeCode() + 1)
    assert mesh.GetPointsAttr().GetTimeSamples() == times.tolist()
    return np.array([mesh.GetPointsAttr().Get(t) for t in times]), stage
