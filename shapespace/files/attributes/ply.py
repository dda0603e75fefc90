"""Attributes of PLY files: reader and writer."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.attributes.obj import polygon_lines
from shapespace.files.colouring import Colouring
from shapespace.files.limits import UNLIMITED
from shapespace.files.ply_reading import open_table
from shapespace.mesh.attributes import NONE, MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError

#: Names of texture coordinates, and of colours.
_UV = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"), ("texture_s", "texture_t"))
_RGB = ("red", "green", "blue")


def read(path: Path, faults: list[str]) -> MeshAttributes:
    """Read the attributes of a PLY file; appends a sentence to ``faults`` for everything left out."""
    elements, table = open_table(memoryview(path.read_bytes()), UNLIMITED)
    at_vertices: FloatArray | None = None
    colors: FloatArray | None = None
    normals = False
    for element in elements:
        names = [p.name for p in element.properties]
        if element.name == "vertex":
            uv = next((pair for pair in _UV if set(pair) <= set(names)), ())
            rgb = _RGB if set(_RGB) <= set(names) else ()
            normals = "nx" in names
            values = table.columns(element, [names.index(name) for name in ("x", *uv, *rgb)])
            at_vertices = values[:, 1:3] if uv else None
            if rgb:
                bytes_ = element.properties[names.index("red")].type.kind in "ui"
                colors = np.clip(values[:, -3:] / (255 if bytes_ else 1), 0, 1)
        elif element.name == "face":
            wanted = [element.corners]
            if "texcoord" in names and element.properties[names.index("texcoord")].length is not None:
                wanted.append(names.index("texcoord"))
            starts, corners, at_corners = [0], list[NDArray](), list[NDArray]()
            for polygon, *coordinates in table.lists(element, wanted):
                if len(polygon) < 3:  # a point or a line
                    continue
                corners.append(np.array(polygon).astype(np.int64))
                starts.append(starts[-1] + len(polygon))
                if coordinates:
                    at_corners.append(_at_corners(np.array(coordinates[0]).astype(np.float64), len(polygon)))
            if at_vertices is not None and len(at_corners):
                at_vertices = None  # coordinates at corners are more precise
            return _surface(np.array(starts), np.concatenate(corners), at_vertices, at_corners, colors, normals=normals)
        else:
            table.skip(element)
    raise MeshError("it has no faces")


def _at_corners(values: FloatArray, count: int) -> FloatArray:
    """Return texture coordinates (count, 2) of a face, NaN if it has none."""
    return values.reshape(count, 2) if len(values) else np.full((count, 2), np.nan)


def _surface(
    starts: NDArray,
    corners: NDArray,
    at_vertices: FloatArray | None,
    at_corners: list[FloatArray],
    colors: FloatArray | None,
    *,
    normals: bool,
) -> MeshAttributes:
    uv, of_uv = at_vertices, None if at_vertices is None else corners
    if at_corners:
        values = np.concatenate(at_corners)
        there = ~np.isnan(values).any(axis=1)
        uv, found = np.unique(values[there], axis=0, return_inverse=True)
        of_uv = np.full(len(corners), NONE)
        of_uv[there] = found.reshape(-1)
        if not there.any():
            uv, of_uv = None, None
    return MeshAttributes(starts=starts, corners=corners, uv=uv, uv_corners=of_uv, colors=colors, normals=normals)


def write_ply(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as PLY, as text if faces have different numbers of corners; see `MeshFormat.encode`.

    Texture coordinates are at the vertices. If a vertex has several, they are at the corners of the faces. They are
    left out if the faces then have different numbers of corners.
    """
    surface = surface or MeshAttributes.of_triangles(faces)
    fields: list[tuple[str, str, str, NDArray]] = [
        (name, "float", "<f4", column) for name, column in zip("xyz", vertices.T, strict=True)
    ]
    uv = _of_vertices(surface)
    if uv is not None:
        fields += [(name, "float", "<f4", column) for name, column in zip("st", uv.T, strict=True)]
    colors = surface.colors
    if colouring:
        fields.append((str(colouring.quantity), "float", "<f4", colouring.values))
        colors = colouring.srgb
    if colors is not None:
        rgba = np.hstack([np.rint(255 * colors), np.full((len(vertices), 1), 255)])
        fields += [(name, "uchar", "u1", column) for name, column in zip((*_RGB, "alpha"), rgba.T, strict=True)]
    rows = np.empty(len(vertices), [(name, kind) for name, _, kind, _ in fields])
    for name, _, _, column in fields:
        rows[name] = column
    # Many readers read binary faces, and other lists of a face, only if all faces have equally many corners.
    mixed = surface.sizes.min() < surface.sizes.max()
    lists: list[tuple[str, str, NDArray]] = [("vertex_indices", "int", surface.corners[:, None].astype("<i4"))]
    if surface.uv is not None and surface.uv_corners is not None and uv is None and not mixed:
        values = np.where(surface.uv_corners[:, None] >= 0, surface.uv[surface.uv_corners], 0)
        lists.append(("texcoord", "float", values.astype("<f4")))
    longest = int(surface.sizes.max()) * max(array.shape[1] for _, _, array in lists)
    length = ("uchar", "u1") if longest < 256 else ("int", "<i4")
    head = ["ply", f"format {'ascii' if mixed else 'binary_little_endian'} 1.0", f"element vertex {len(vertices)}"]
    head += [f"property {kind} {name}" for name, kind, _, _ in fields]
    head += [f"element face {len(surface.sizes)}"]
    head += [f"property list {length[0]} {kind} {name}" for name, kind, _ in lists]
    if mixed:
        line = " ".join("%d" if kind == "u1" else "%.9g" for _, _, kind, _ in fields) + "\n"
        text = line * len(rows) % tuple(value for row in rows.tolist() for value in row)
        lines = polygon_lines(surface, surface.corners[:, None], lambda size: f"{size}{' %d' * size}\n")
        body = (text + "".join(lines.tolist())).encode()
    else:
        body = rows.tobytes() + _face_rows(surface, lists, length[1])
    return "\n".join([*head, "end_header\n"]).encode() + body


def _of_vertices(surface: MeshAttributes) -> FloatArray | None:
    """Return texture coordinates (V, 2) if each vertex has exactly one, otherwise None."""
    if surface.uv is None or surface.uv_corners is None or (surface.uv_corners < 0).any():
        return None
    one = np.empty(surface.corners.max() + 1, np.int64)
    one[surface.corners] = surface.uv_corners
    found: FloatArray = surface.uv[one]
    return found if np.array_equal(found[surface.corners], surface.uv[surface.uv_corners]) else None


def _face_rows(surface: MeshAttributes, lists: list[tuple[str, str, NDArray]], length: str) -> bytes:
    """Return binary rows of faces with equally many corners."""
    count = len(surface.sizes)
    pieces: list[NDArray] = []
    for _, _, array in lists:
        values = array.reshape(count, -1)
        pieces += [np.full((count, 1), values.shape[1], length).view(np.uint8), values.view(np.uint8)]
    return np.hstack(pieces).tobytes()
