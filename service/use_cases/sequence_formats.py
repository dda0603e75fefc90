"""The file formats of an animation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.animated_gltf import FRAMES_PER_SECOND, animated_glb
from shapespace.files.archives import Buffer, zip_pieces
from shapespace.files.attributes.obj import obj_faces, obj_files, obj_vertices
from shapespace.files.colouring import Colouring
from shapespace.files.npz import npz_pieces
from shapespace.files.point_cache import point_cache
from shapespace.files.reading import OCTET_STREAM
from shapespace.files.usd import animated_usd
from shapespace.mesh.attributes import MeshAttributes
from shapespace.model.latent_space import Codes
from shapespace.model.shape import Diagnostics, Shape
from shapespace.service.use_cases.shape_formats import catch_write_errors, diagnostics_arrays, dump_json, float32


@dataclass(frozen=True)
class Frames:
    """The frames of an animation, ready to be written.

    Attributes:
        vertices: (n, V, 3) float32, in the units of the training meshes.
        diagnostics: of each frame.
        faces: (F, 3) vertex indices.
        positions: (n,) position t of each frame on the path.
        codes: (n, m).
        surface: attributes of the mesh, if its training file had more than triangles.
        fps: frames per second.
        colourings: of each frame; empty for none.
        name: of the animation, for formats that hold one.
    """

    vertices: NDArray[np.float32]
    diagnostics: Sequence[Diagnostics]
    faces: IntArray
    positions: FloatArray
    codes: Codes
    surface: MeshAttributes | None = None
    fps: float = FRAMES_PER_SECOND
    colourings: Sequence[Colouring] = ()
    name: str = "animation"


@dataclass(frozen=True)
class SequenceFormat:
    """A file format for a whole animation.

    Files hold triangles or ``polygons``. If they are ``timed``, they hold the time of a frame, and colours that change.
    """

    media_type: str
    polygons: bool = False
    timed: bool = False


def json_line(k: int, t: float, shape: Shape, faces: IntArray | None) -> bytes:
    """Return one frame as JSON in one line, with the faces if they are given."""
    line: dict[str, Any] = {"frame": k, "t": t}
    if faces is not None:
        line["faces"] = np.ascontiguousarray(faces)
    line |= {"vertices": float32(shape.vertices), "diagnostics": asdict(shape.diagnostics)}
    return dump_json(line)


def encode_frames(frames: Frames, format: str) -> tuple[Iterator[Buffer], dict[str, Any]]:
    """Return an animation in one of SEQUENCE_FORMATS: the file in pieces, and members for the diagnostics."""
    shown = frames.vertices, frames.faces, frames.surface, frames.fps, frames.colourings
    match format:
        case "glb":
            animated = animated_glb(*shown, name=frames.name)
            return iter([animated.data]), {"targets": animated.targets, "max_vertex_error": animated.max_vertex_error}
        case "npz":
            arrays: dict[str, NDArray] = {
                "faces": frames.faces.astype(np.int32),
                "t": frames.positions,
                "latents": frames.codes,
            }
            return npz_pieces(vertices=frames.vertices, **arrays, **diagnostics_arrays(frames.diagnostics)), {}
        case "zip":
            return _obj_pieces(frames), {}
        case "pc2":
            return point_cache(frames.vertices), {}
        case "usd" | "usdz":
            return _with_write_errors(animated_usd(*shown, packed=format == "usdz")), {}
        case _:
            raise ValueError(f"no format {format}")


def _with_write_errors(pieces: Iterator[Buffer]) -> Iterator[Buffer]:
    with catch_write_errors():
        yield from pieces


def _obj_pieces(frames: Frames) -> Iterator[Buffer]:
    surface = frames.surface or MeshAttributes.of_triangles(frames.faces)
    beside = obj_files(surface, "frames")
    head, faces = "mtllib frames.mtl\n" if beside else "", obj_faces(surface)

    def members() -> Iterator[tuple[str, list[bytes]]]:
        for k, vertices in enumerate(frames.vertices):
            text = head + obj_vertices(vertices.astype(np.float64), surface=surface) + faces
            yield f"frame-{k:04d}.obj", [text.encode()]
        for name, content in beside.items():
            yield name, [content]

    return zip_pieces(members())


JSON_LINES = "application/jsonl"
#: Formats of a whole animation except JSON lines, which are streamed; the first is the default.
SEQUENCE_FORMATS = {
    "glb": SequenceFormat("model/gltf-binary", timed=True),
    "npz": SequenceFormat(OCTET_STREAM),
    "zip": SequenceFormat("application/zip", polygons=True),
    "pc2": SequenceFormat(OCTET_STREAM),
    "usd": SequenceFormat(OCTET_STREAM, polygons=True, timed=True),
    "usdz": SequenceFormat("model/vnd.usdz+zip", polygons=True, timed=True),
}
#: Media types of all formats of a whole animation, by name.
MEDIA_TYPES = {name: format.media_type for name, format in SEQUENCE_FORMATS.items()} | {"jsonl": JSON_LINES}
