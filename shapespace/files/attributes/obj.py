"""Attributes of OBJ and MTL files: reader and writer."""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.archives import zip_pieces
from shapespace.files.attributes.textures import Textures, beside
from shapespace.files.colouring import Colouring
from shapespace.files.gltf_writing import surface_normals
from shapespace.files.limits import clipped, label, read_plain
from shapespace.files.polygon_reading import OBJ_FACE, OBJ_VERTEX, Lines, joined_lines, whole
from shapespace.mesh.attributes import NONE, Labels, MeshAttributes, SurfaceMaterial, labelled
from shapespace.mesh.triangle_mesh import MeshError

#: Normals that agree to this number of decimals are equal.
_NORMAL_DECIMALS = 3
#: The lines that OBJ and MTL should have.
_WANTED = f"{OBJ_VERTEX}; {OBJ_FACE}, where a corner may be a/b/c"
_MTL_WANTED = "Kd has three numbers, and d, Tr, Pm and Pr have one, with decimal points"
#: Options of a map in MTL, with their largest number of values.
_MAP_OPTIONS = {b"-blendu": 1, b"-blendv": 1, b"-boost": 1, b"-mm": 2, b"-o": 3, b"-s": 3, b"-t": 3, b"-texres": 1}
_MAP_OPTIONS |= {b"-clamp": 1, b"-bm": 1, b"-imfchan": 1, b"-type": 1, b"-cc": 1, b"-colorspace": 1}


def read(path: Path, faults: list[str]) -> MeshAttributes:
    """Read the attributes of an OBJ file; appends a sentence to ``faults`` for everything left out."""
    uv, normals, colors, starts, corners = array("d"), array("d"), array("d"), [0], array("q")
    uv_corners, shading, smoothing = array("q"), array("q"), array("q")
    objects, groups, materials = list[str | None](), list[str | None](), list[str | None]()
    current: dict[bytes, str | None] = {b"o": None, b"g": None, b"usemtl": None}
    libraries, smooth, told, points = list[str](), 0, False, 0
    with Lines(joined_lines(memoryview(path.read_bytes())), _WANTED) as lines:
        for line in lines:
            keyword, *values = line.split(None, 1)
            keyword = keyword.lower() if keyword in (b"V", b"F", b"Fo") else keyword
            rest = values[0].partition(b"#")[0].strip() if values else b""
            if keyword == b"v":
                row = rest.split()
                points += 1
                if len(row) >= 6:
                    colors.extend(float(value) for value in row[-3:])
            elif keyword == b"vt":
                row = rest.split()
                uv.extend((float(row[0]), float(row[1]) if len(row) > 1 else 0.0))
            elif keyword == b"vn":
                normals.extend(float(value) for value in rest.split()[:3])
            elif keyword in (b"f", b"fo"):
                if len(rest.split()) < 3:  # a point or a line
                    continue
                counts = points, len(uv) // 2, len(normals) // 3
                for corner in rest.split():
                    numbers = [_number(text, count) for text, count in zip(corner.split(b"/"), counts, strict=False)]
                    v, t, n = numbers + [NONE] * (3 - len(numbers))
                    corners.append(v)
                    uv_corners.append(t)
                    shading.append(n)
                starts.append(len(corners))
                smoothing.append(smooth)
                objects.append(current[b"o"])
                groups.append(current[b"g"])
                materials.append(current[b"usemtl"])
            elif keyword == b"s":
                smooth, told = int(rest) if rest.isdigit() else 0, True
            elif keyword in current:
                current[keyword] = label(values[0].decode(errors="replace")) if values else None
            elif keyword == b"mtllib" and values:
                libraries.append(values[0].decode(errors="replace").strip())
    if not len(starts) > 1:
        raise MeshError("it has no faces")
    # One smoothing group for all faces is the default.
    told = told and (0 in smoothing or len(set(smoothing)) > 1)
    coordinates = np.array(uv).reshape(-1, 2)
    of_uv = np.array(uv_corners)
    if not (of_uv >= 0).any():
        if len(coordinates):
            faults.append(f"its {len(coordinates)} texture coordinates are left out: no face refers to them")
        coordinates, of_uv = None, None  # type: ignore[assignment]
    textures = Textures(faults)
    labels = labelled(materials)
    of_file = _read_libraries(path, libraries, textures, labels, faults) if labels else {}
    return MeshAttributes(
        starts=np.array(starts),
        corners=np.array(corners),
        uv=coordinates,
        uv_corners=of_uv,
        shading=_shading(np.diff(starts), np.array(shading), normals, np.array(smoothing), told=told),
        normals=told or len(normals) > 0,
        colors=_colors(colors, points, faults),
        objects=labelled(objects),
        groups=labelled(groups),
        material_of=labels.of if labels else None,
        materials=tuple(of_file.get(name, SurfaceMaterial(name)) for name in labels.names) if labels else (),
        textures=textures.files,
    )


def _number(text: bytes, count: int) -> int:
    """Return an index that counts from 0, or NONE for no text; negative numbers count back from ``count``."""
    if not text:
        return NONE
    (number,) = whole([text])
    if number == 0 or number < -count:
        raise ValueError
    return number - 1 if number > 0 else count + number


def _shading(
    sizes: np.ndarray, of_normal: np.ndarray, normals: array[float], smoothing: np.ndarray, *, told: bool
) -> np.ndarray | None:
    """Return labels of corners, see `MeshAttributes.shading`, from normals, or else from smoothing groups."""
    if (of_normal >= 0).all():
        values = np.array(normals).reshape(-1, 3).round(_NORMAL_DECIMALS)
        labels = np.unique(values, axis=0, return_inverse=True)[1].reshape(-1)[of_normal]
        return np.unique(labels, return_inverse=True)[1]
    if not told:
        return None
    # Polygons of group 0 are flat.
    flat = smoothing.max() + 1 + np.arange(len(sizes))
    labels = np.unique(np.where(smoothing == 0, flat, smoothing), return_inverse=True)[1]
    return np.repeat(labels, sizes)


def _colors(values: array[float], points: int, faults: list[str]) -> FloatArray | None:
    if not values:
        return None
    colors = np.array(values).reshape(-1, 3)
    if len(colors) != points:
        faults.append(f"its vertex colours are left out: {len(colors)} of {points} vertices have one")
        return None
    # Some programs write values from 0 to 255.
    return np.clip(colors / 255 if colors.max() > 1 else colors, 0, 1)


def _read_libraries(
    path: Path, names: list[str], textures: Textures, wanted: Labels, faults: list[str]
) -> dict[str, SurfaceMaterial]:
    """Return the materials of MTL files that the surface uses, by name."""
    found: dict[str, SurfaceMaterial] = {}
    for name in names:
        whole = [beside(path.parent, name)]
        for library in whole if whole[0].is_file() else [beside(path.parent, part) for part in name.split()]:
            try:
                found |= _read_library(library, textures, set(wanted.names))
            except OSError as error:
                faults.append(f"the materials of {clipped(library.name)} are left out: {error.strerror}")
            except (ValueError, IndexError) as error:
                faults.append(f"the materials of {clipped(library.name)} are left out: {clipped(error)}")
    return found


def _read_library(path: Path, textures: Textures, wanted: set[str]) -> dict[str, SurfaceMaterial]:
    found: dict[str, SurfaceMaterial] = {}
    name, look = "", dict[str, float | tuple[float, ...] | str]()

    def end() -> None:
        if name in wanted and name not in found:
            texture = look.pop("texture", None)
            kept = None if texture is None else textures.add_file(path.parent, str(texture), name)
            color = look.pop("color", (1.0, 1.0, 1.0))
            opacity = look.pop("opacity", 1.0)
            found[name] = SurfaceMaterial(name, (*color, opacity), texture=kept, **look)  # type: ignore[arg-type, misc]

    with Lines(joined_lines(memoryview(read_plain(path))), _MTL_WANTED) as lines:
        for line in lines:
            keyword, *values = line.split(None, 1)
            if keyword == b"newmtl":
                end()
                name, look = label(values[0].decode(errors="replace")) or "", {}
            elif keyword == b"Kd":
                r, g, b = (_share(value) for value in values[0].split()[:3])
                look["color"] = (r, g, b)
            elif keyword in (b"d", b"Tr"):
                share = _share(values[0].split()[-1])
                look["opacity"] = share if keyword == b"d" else 1 - share
            elif keyword in (b"Pm", b"Pr"):
                look["metallic" if keyword == b"Pm" else "roughness"] = _share(values[0])
            elif keyword == b"map_Kd":
                look["texture"] = _map(values[0])
    end()
    return found


def _share(text: bytes) -> float:
    return min(1.0, max(0.0, float(text)))


def _map(text: bytes) -> str:
    """Return the file of a map, which follows its options and may contain spaces."""
    words = text.split()
    while len(words) > 1 and words[0] in _MAP_OPTIONS:
        most, words = _MAP_OPTIONS[words[0]], words[1:]
        while most and len(words) > 1 and (most == 1 or _is_number(words[0])):
            most, words = most - 1, words[1:]
    return b" ".join(words).decode(errors="replace")


def _is_number(text: bytes) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def obj_vertices(
    vertices: FloatArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> str:
    """Return the vertex lines of an OBJ file, with colours after the positions, and the lines of normals.

    These lines depend on the shape; the lines of `obj_faces` do not.
    """
    # Nine significant digits represent a float32 in any unit. A fixed number of decimals would not.
    comment, rows, colors = "", vertices.astype(np.float32), None
    if colouring:
        comment, colors = f"# color {json.dumps(colouring.legend)}\n", colouring.srgb
    elif surface:
        colors = surface.colors
    line = "v %.9g %.9g %.9g\n" if colors is None else "v %.9g %.9g %.9g %.4g %.4g %.4g\n"
    # One format operation for all lines is twice as fast as one for each line.
    text = comment + _lines(line, rows if colors is None else np.hstack([rows, colors]))
    if surface and surface.normals:
        text += _lines("vn %.4f %.4f %.4f\n", surface_normals(vertices, surface))
    return text


def _lines(line: str, rows: np.ndarray) -> str:
    return line * len(rows) % tuple(rows.ravel().tolist())


def obj_faces(surface: MeshAttributes) -> str:
    """Return the lines of texture coordinates, faces, and names of objects, groups and materials."""
    uv = "" if surface.uv is None else _lines("vt %.9g %.9g\n", surface.uv.astype(np.float32))
    lines = _face_lines(surface)
    named = {
        "o": surface.objects,
        "g": surface.groups,
        "usemtl": None
        if surface.material_of is None
        else Labels(tuple(material.name for material in surface.materials), surface.material_of),
    }
    # In reverse order, because each keyword is put in front of the line.
    for keyword, labels in reversed(named.items()):
        if labels:
            for k in np.flatnonzero(np.diff(labels.of, prepend=NONE)).tolist():
                name = "" if labels.of[k] == NONE else f" {labels.names[labels.of[k]]}"
                lines[k] = f"{keyword}{name}\n{lines[k]}"
    # Without normals and smoothing groups, Blender shows flat faces.
    smooth = "" if surface.normals else "s 1\n"
    return uv + smooth + "".join(lines.tolist())


def _face_lines(surface: MeshAttributes) -> NDArray:
    """Return a line for each polygon, (P,)."""
    corners, form = [surface.corners + 1], "%d"
    if surface.uv_corners is not None:
        corners, form = [*corners, surface.uv_corners + 1], "%d/%d"
    if surface.normals:
        corners, form = [*corners, surface.normal_corners + 1], f"{form}{'//' if form == '%d' else '/'}%d"
    numbers = np.stack(corners, axis=1)
    lines = polygon_lines(surface, numbers, lambda size: "f " + " ".join([form] * size) + "\n")
    if surface.uv_corners is not None:
        lacking = np.flatnonzero(np.minimum.reduceat(surface.uv_corners, surface.starts[:-1]) < 0)
        for k in lacking.tolist():
            some = numbers[surface.starts[k] : surface.starts[k + 1]].tolist()
            words = ("/".join([str(v), str(t or ""), *map(str, rest)]).rstrip("/") for v, t, *rest in some)
            lines[k] = f"f {' '.join(words)}\n"
    return lines


def polygon_lines(surface: MeshAttributes, numbers: NDArray, line: Callable[[int], str]) -> NDArray:
    """Return a line for each polygon, (P,), from numbers (C, k) and a format for each number of corners."""
    lines = np.empty(len(surface.sizes), object)
    for size in np.unique(surface.sizes).tolist():
        chosen = np.flatnonzero(surface.sizes == size)
        rows = numbers[surface.starts[chosen][:, None] + np.arange(size)]
        lines[chosen] = _lines(line(size), rows.reshape(len(chosen), -1)).splitlines(keepends=True)
    return lines


def write_obj(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as OBJ without materials; see `MeshFormat.encode`."""
    shown = surface or MeshAttributes.of_triangles(faces)
    return (obj_vertices(vertices, colouring, shown) + obj_faces(shown)).encode()


def write_obj_zip(
    vertices: FloatArray, faces: IntArray, colouring: Colouring | None = None, surface: MeshAttributes | None = None
) -> bytes:
    """Write one mesh as a ZIP archive of OBJ, MTL and textures; see `MeshFormat.encode`."""
    files = obj_files(surface, "shape") if surface else {}
    head = b"mtllib shape.mtl\n" if files else b""
    members = {"shape.obj": head + write_obj(vertices, faces, colouring, surface), **files}
    return b"".join(zip_pieces((name, [content]) for name, content in members.items()))


def _material(material: SurfaceMaterial) -> Iterator[str]:
    *color, opacity = material.color
    yield f"newmtl {material.name}\n"
    yield "Kd {:.6g} {:.6g} {:.6g}\n".format(*color)
    yield f"d {opacity:.6g}\nPm {material.metallic:.6g}\nPr {material.roughness:.6g}\n"
    if material.texture is not None:
        yield f"map_Kd {material.texture}\n"


def obj_files(surface: MeshAttributes, stem: str) -> Mapping[str, bytes]:
    """Return the MTL file and the textures that go with an OBJ file, by name; empty without materials."""
    if not surface.materials:
        return {}
    library = "\n".join("".join(_material(material)) for material in surface.materials)
    return {f"{stem}.mtl": library.encode(), **surface.textures}
