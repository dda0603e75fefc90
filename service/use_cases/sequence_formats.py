"""Sequences of shapes as bytes: every format of an animation."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.animated_gltf import animated_glb
from shapespace.files.archives import Buffer, npz_pieces, zip_pieces
from shapespace.files.formats import OCTET_STREAM, obj_faces, obj_vertices
from shapespace.files.point_cache import point_cache
from shapespace.files.usd import animated_usd, usd_installed
from shapespace.model.decoder import Diagnostics, Shape
from shapespace.model.latent_space import Codes
from shapespace.service.use_cases.shape_formats import diagnostics_arrays, dump_json, float32


class NoRoomError(OSError):
    """No room for a temporary file."""


@dataclass(frozen=True)
class Frames:
    """The frames of an animation, ready to be encoded.

    Attributes:
        vertices: (n, V, 3) float32.
        diagnostics: one a frame.
        faces: (F, 3).
        positions: (n,) where on the path each frame lies.
        codes: (n, m).
    """

    vertices: NDArray[np.float32]
    diagnostics: Sequence[Diagnostics]
    faces: IntArray
    positions: FloatArray
    codes: Codes


@dataclass(frozen=True)
class SequenceFormat:
    """A file format for a whole animation.

    Attributes:
        media_type: as IANA has it.
        encode: a sequence to the pieces of the file, and facts for the diagnostics.
    """

    media_type: str
    encode: Callable[[Frames], tuple[Iterator[Buffer], dict[str, Any]]]


def json_line(k: int, t: float, shape: Shape, faces: IntArray | None) -> bytes:
    """One frame as a line of JSON; the first also carries the faces."""
    line: dict[str, Any] = {"frame": k, "t": t}
    if faces is not None:
        line["faces"] = np.ascontiguousarray(faces)
    line |= {"vertices": float32(shape.vertices), "diagnostics": asdict(shape.diagnostics)}
    return dump_json(line) + b"\n"


def _glb(frames: Frames) -> tuple[Iterator[Buffer], dict[str, Any]]:
    animated = animated_glb(frames.vertices, frames.faces)
    return iter([animated.data]), {"targets": animated.targets, "max_vertex_error": animated.max_vertex_error}


def _npz(frames: Frames) -> tuple[Iterator[Buffer], dict[str, Any]]:
    arrays = diagnostics_arrays(frames.diagnostics)
    return npz_pieces(
        vertices=frames.vertices,
        faces=frames.faces.astype(np.int32),
        t=frames.positions,
        latents=frames.codes,
        **arrays,
    ), {}


def _point_cache(frames: Frames) -> tuple[Iterator[Buffer], dict[str, Any]]:
    return point_cache(frames.vertices), {}


def _usd(frames: Frames) -> tuple[Iterator[Buffer], dict[str, Any]]:
    def pieces() -> Iterator[Buffer]:
        try:
            yield from animated_usd(frames.vertices, frames.faces)
        except OSError:
            raise NoRoomError(
                "The server has no room for the temporary file that USD takes. Ask for another format, or give it a "
                "folder for such files that can be written to (TMPDIR)."
            ) from None

    return pieces(), {}


def _zip(frames: Frames) -> tuple[Iterator[Buffer], dict[str, Any]]:
    faces = obj_faces(frames.faces)
    objs = ([(obj_vertices(vertices) + faces).encode()] for vertices in frames.vertices)
    return zip_pieces((f"frame-{k:04d}.obj", obj) for k, obj in enumerate(objs)), {}


JSON_LINES = "application/jsonl"
#: Formats of a whole animation but for JSON lines, which are streamed; the first is the default.
SEQUENCE_FORMATS = {
    "glb": SequenceFormat("model/gltf-binary", _glb),
    "npz": SequenceFormat(OCTET_STREAM, _npz),
    "zip": SequenceFormat("application/zip", _zip),
    "pc2": SequenceFormat(OCTET_STREAM, _point_cache),
    "usd": SequenceFormat(OCTET_STREAM, _usd),
}
#: Media types of all formats of a whole animation by name.
MEDIA_TYPES = {name: format.media_type for name, format in SEQUENCE_FORMATS.items()} | {"jsonl": JSON_LINES}
#: Why a format may be missing.
UNAVAILABLE = {"usd": "This server can't write USD, for which it needs the package usd-core: pip install usd-core"}


def sequence_types() -> dict[str, str]:
    """Media types of the formats of a whole animation that this server can write, by name."""
    return {name: media_type for name, media_type in MEDIA_TYPES.items() if name != "usd" or usd_installed()}
