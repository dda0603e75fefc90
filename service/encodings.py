"""Shapes and their sequences as bytes: the project's mesh formats, and those only a service needs."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from geometry.animated_gltf import animated_glb
from geometry.formats import MESH_FORMATS, MeshFormat, npz
from geometry.mesh import FloatArray, IntArray
from service.latent_space import Codes
from service.shape_model import Diagnostics, Shape

OCTET_STREAM = "application/octet-stream"


def dump_json(content: Any) -> bytes:
    """JSON, with NumPy arrays as nested lists; what isn't finite becomes null."""
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def float32(array: NDArray) -> NDArray[np.float32]:
    """Contiguous float32: the precision of everything that leaves."""
    return np.ascontiguousarray(array, dtype=np.float32)


def _mesh_json(vertices: FloatArray, faces: IntArray) -> bytes:
    return dump_json({"vertices": float32(vertices), "faces": np.ascontiguousarray(faces)})


#: Formats of one shape; the first is the default.
SHAPE_FORMATS = {**MESH_FORMATS, "json": MeshFormat("application/json", _mesh_json)}


@dataclass(frozen=True)
class Frames:
    """The frames of an animation, ready to be encoded.

    Attributes:
        shapes: one a frame.
        faces: (F, 3).
        positions: (n,) where on the path each frame lies.
        codes: (n, m).
    """

    shapes: Sequence[Shape]
    faces: IntArray
    positions: FloatArray
    codes: Codes

    @property
    def vertices(self) -> FloatArray:
        """(n, V, 3)."""
        return np.stack([shape.vertices for shape in self.shapes])


@dataclass(frozen=True)
class SequenceFormat:
    """A file format for a whole animation.

    Attributes:
        media_type: as IANA has it.
        encode: a sequence to the file's bytes, and facts for the diagnostics.
    """

    media_type: str
    encode: Callable[[Frames], tuple[bytes, dict[str, Any]]]


def diagnostics_arrays(diagnostics: Sequence[Diagnostics]) -> dict[str, NDArray]:
    """Diagnostics of n shapes as arrays (n,), for NPZ files."""
    return {
        "status": np.array([str(d.status) for d in diagnostics]),
        "iterations": np.array([d.iterations for d in diagnostics]),
        "residual": np.array([d.residual for d in diagnostics]),
        "flipped_faces": np.array([d.flipped_faces for d in diagnostics]),
        "inside_bounds": np.array([d.inside_bounds for d in diagnostics]),
    }


def worst(diagnostics: Sequence[Diagnostics]) -> dict[str, Any]:
    """One summary of several diagnostics: the largest numbers, and the first status that isn't good."""
    bad = [d.status for d in diagnostics if d.status != "converged"]
    return {
        "status": bad[0] if bad else diagnostics[0].status,
        "iterations": max(d.iterations for d in diagnostics),
        "residual": max(d.residual for d in diagnostics),
        "flipped_faces": max(d.flipped_faces for d in diagnostics),
        "inside_bounds": all(d.inside_bounds for d in diagnostics),
        "model": diagnostics[0].model,
    }


def json_line(k: int, t: float, shape: Shape, faces: IntArray | None) -> bytes:
    """One frame as a line of JSON; the first also carries the faces."""
    line: dict[str, Any] = {"frame": k, "t": t}
    if faces is not None:
        line["faces"] = np.ascontiguousarray(faces)
    line |= {"vertices": float32(shape.vertices), "diagnostics": asdict(shape.diagnostics)}
    return dump_json(line) + b"\n"


def _glb(frames: Frames) -> tuple[bytes, dict[str, Any]]:
    animated = animated_glb(frames.vertices, frames.faces)
    return animated.data, {"targets": animated.targets, "max_vertex_error": animated.max_vertex_error}


def _npz(frames: Frames) -> tuple[bytes, dict[str, Any]]:
    arrays = diagnostics_arrays([shape.diagnostics for shape in frames.shapes])
    return npz(
        vertices=float32(frames.vertices),
        faces=frames.faces.astype(np.int32),
        t=frames.positions,
        latents=frames.codes,
        **arrays,
    ), {}


def _zip(frames: Frames) -> tuple[bytes, dict[str, Any]]:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for k, shape in enumerate(frames.shapes):
            # ZipInfo's default date keeps the bytes the same from day to day.
            entry = zipfile.ZipInfo(f"frame-{k:04d}.obj")
            content = MESH_FORMATS["obj"].encode(shape.vertices, frames.faces)
            archive.writestr(entry, content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue(), {}


#: Formats of a whole animation but for JSON lines, which are streamed; the first is the default.
SEQUENCE_FORMATS = {
    "glb": SequenceFormat("model/gltf-binary", _glb),
    "npz": SequenceFormat(OCTET_STREAM, _npz),
    "zip": SequenceFormat("application/zip", _zip),
}
JSON_LINES = "application/jsonl"
