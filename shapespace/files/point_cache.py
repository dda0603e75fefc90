"""Point cache 2 files, which hold only the positions of every frame. Blender, 3ds Max and Houdini read them."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from numpy.typing import NDArray

_HEADER = struct.Struct("<12siiffi")


def point_cache(frames: NDArray) -> Iterator[bytes]:
    """Yield a point cache of shapes (n, V, 3) in pieces, one sample for each frame from frame 0; positions are float32.

    Readers need the mesh from another file, with its vertices in the same order.
    """
    yield _HEADER.pack(b"POINTCACHE2\0", 1, frames.shape[1], 0.0, 1.0, len(frames))
    for frame in frames:
        yield frame.astype("<f4").tobytes()
