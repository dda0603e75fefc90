"""Point cache 2: the positions of every frame and nothing else, as Blender, 3ds Max and Houdini play them on a mesh."""

from __future__ import annotations

import struct
from collections.abc import Iterator

from numpy.typing import NDArray

_HEADER = struct.Struct("<12siiffi")


def point_cache(frames: NDArray) -> Iterator[bytes]:
    """Encode shapes (n, V, 3) as samples one frame apart, from frame 0, in pieces; positions are float32.

    The mesh itself, with its vertices in the same order, comes from another file.
    """
    yield _HEADER.pack(b"POINTCACHE2\0", 1, frames.shape[1], 0.0, 1.0, len(frames))
    for frame in frames:
        yield frame.astype("<f4").tobytes()
