"""The file formats of one shape, and JSON."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.colouring import Colouring
from shapespace.files.formats import MESH_FORMATS, OBJ_ZIP, USD_FORMATS, VTK_FORMATS, MeshFormat
from shapespace.files.usd import usd_installed
from shapespace.files.vtk_writing import vtk_installed
from shapespace.mesh.attributes import MeshAttributes, Topology
from shapespace.model.exact_shapes import ExactShape
from shapespace.model.shape import Diagnostics, Quality
from shapespace.service.refusals import RefusedError

#: Bytes in which values are counted at once; counting ends after the piece in which they exceed the limit.
_PIECE = 2**16
#: Numbers in diagnostics, of which a summary has the largest.
_FIGURES = ("iterations", "residual", "flipped_faces", "integrability")


def dump_json(content: Any) -> bytes:
    """Return JSON, with NumPy arrays as nested lists and null for numbers that are not finite."""
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def holds_more_values(text: bytes, most: int) -> bool:
    """Return whether JSON holds more values than ``most``, by counting separators, without parsing."""
    count = 0
    for start in range(0, len(text), _PIECE):
        piece = text[start : start + _PIECE]
        count += sum(map(piece.count, (b",", b":", b"[", b"{")))
        if count > most:
            return True
    return False


def float32(array: NDArray) -> NDArray[np.float32]:
    """Return an array as contiguous float32, the precision of all answers."""
    return np.ascontiguousarray(array, dtype=np.float32)


def _mesh_json(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    content: dict[str, Any] = {"vertices": float32(vertices), "faces": np.ascontiguousarray(faces)}
    if colouring:
        content["color"] = {**colouring.legend, "values": float32(colouring.values)}
    return dump_json(content)


#: Formats of one shape; the first is the default.
SHAPE_FORMATS = {
    **MESH_FORMATS,
    "zip": OBJ_ZIP,
    "json": MeshFormat("application/json", _mesh_json),
    **USD_FORMATS,
    **VTK_FORMATS,
}
#: Reason why a format may be missing on a server.
UNAVAILABLE = dict.fromkeys(
    USD_FORMATS, "This server can't write USD, because it lacks the package usd-core: pip install usd-core"
) | dict.fromkeys(
    VTK_FORMATS, 'This server can\'t write VTK files, because it lacks the package vtk: pip install "shapespace[vtk]"'
)


@contextmanager
def catch_write_errors() -> Iterator[None]:
    """Raise RefusedError if USD cannot write its temporary file."""
    try:
        yield
    except OSError:
        raise RefusedError(
            "no-room",
            "The server has no room for the temporary file of USD. Ask for another format, or set TMPDIR of the "
            "server to a writable folder.",
        ) from None


def writable(media_types: Mapping[str, str]) -> dict[str, str]:
    """Return the formats that this server can write, with their media types."""
    missing = {*(() if usd_installed() else USD_FORMATS), *(() if vtk_installed() else VTK_FORMATS)}
    return {name: kind for name, kind in media_types.items() if name not in missing}


def with_topology(surface: MeshAttributes | None, topology: Topology) -> MeshAttributes | None:
    """Return the attributes of a mesh with polygons or cut into triangles."""
    return surface.triangulated if surface and topology is Topology.TRIANGLES else surface


def diagnostics_arrays(diagnostics: Sequence[Diagnostics]) -> dict[str, NDArray]:
    """Return the diagnostics of n shapes as arrays (n,), for NPZ files."""
    return {
        "status": np.array([str(d.status) for d in diagnostics]),
        **{name: np.array([getattr(d, name) for d in diagnostics]) for name in _FIGURES},
        "plausibility": np.array([d.plausibility for d in diagnostics], dtype=np.float64),
        "inside_bounds": np.array([d.inside_bounds for d in diagnostics]),
        "quality": np.array([str(d.quality) for d in diagnostics]),
    }


def json_pieces(members: Mapping[str, Iterable[Any]]) -> Iterator[bytes]:
    """Yield an object of lists as JSON, one element at a time, because all together may be large."""
    opening = b"{"
    for name, elements in members.items():
        yield opening + dump_json(name) + b":["
        for k, element in enumerate(elements):
            yield (b"," if k else b"") + dump_json(element)
        opening = b"],"
    yield b"]}"


def exponential_lists(exponentials: Sequence[ExactShape]) -> dict[str, list[Any]]:
    """Return the exponentials of n codes as lists (n,), for JSON."""
    return {
        "exact": [e.vertices for e in exponentials],
        "distance": [None if e.vertices is None else {"mean": e.mean, "max": e.max} for e in exponentials],
        "exact_status": [e.status for e in exponentials],
    }


def exponential_arrays(exponentials: Sequence[ExactShape], vertex_count: int) -> dict[str, NDArray]:
    """Return the exponentials of n codes as arrays, for NPZ files; NaN for codes without one."""
    missing = np.full((vertex_count, 3), np.nan, np.float32)
    return {
        "exact": np.stack([missing if e.vertices is None else e.vertices for e in exponentials]),
        "distance_mean": np.array([e.mean for e in exponentials], dtype=np.float64),
        "distance_max": np.array([e.max for e in exponentials], dtype=np.float64),
        "exact_status": np.array([str(e.status) for e in exponentials]),
    }


def summarise(diagnostics: Sequence[Diagnostics]) -> dict[str, Any]:
    """Summarise diagnostics: the largest numbers, the first bad status, and the least accurate quality."""
    qualities = {d.quality for d in diagnostics}
    bad = [d.status for d in diagnostics if d.status != "converged"]
    return {
        "status": bad[0] if bad else diagnostics[0].status,
        **{name: max(getattr(d, name) for d in diagnostics) for name in _FIGURES},
        "plausibility": max((d.plausibility for d in diagnostics if d.plausibility is not None), default=None),
        "inside_bounds": all(d.inside_bounds for d in diagnostics),
        "model": diagnostics[0].model,
        "quality": next(each for each in (Quality.DRAFT, Quality.AUTO, Quality.FULL) if each in qualities),
    }
