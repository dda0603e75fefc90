"""A ball of triangles and quads with texture, materials and names; OBJ files of it, not by our writers."""

import struct
import zlib
from pathlib import Path

import numpy as np
import trimesh

from shapespace.mesh.attributes import Labels, MeshAttributes, SurfaceMaterial


def png(seed: int = 0, size: int = 4, color: tuple[int, int, int] | None = None) -> bytes:
    """A PNG picture of a few pixels, of one colour or of random ones."""
    pixels = np.random.default_rng(seed).integers(0, 256, (size, size, 3), np.uint8)
    if color:
        pixels[:] = color
    return png_of(size, 8, 2, b"".join(b"\0" + row.tobytes() for row in pixels))


def png_of(size: int, bits: int, kind: int, rows: bytes) -> bytes:
    """A square PNG picture of rows with a filter byte each; ``kind`` is PNG's colour type."""

    def chunk(name: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = struct.pack(">IIBBBBB", size, size, bits, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def ball(subdivisions: int = 3) -> tuple[np.ndarray, MeshAttributes]:
    """An icosphere of triangles and quads, with 20 charts that are separate in the texture.

    Returns:
        Vertices (V, 3), and the surface; five charts are of a material without texture.
    """
    sphere = trimesh.creation.icosphere(subdivisions, 1.0)
    # Each triangle was split into four; the last two of these are joined to a quad.
    first, second, third, middle = sphere.faces.reshape(-1, 4, 3).transpose(1, 0, 2)
    quads = np.hstack([middle[:, [2, 0, 1]], third[:, 2:]])
    corners = np.hstack([first, second, quads]).ravel()
    polygons = 3 * len(first)
    charts = np.arange(polygons) // (polygons // 20)
    sizes = np.tile([3, 3, 4], len(first))
    keys = np.repeat(charts, sizes) * len(sphere.vertices) + corners
    used, uv_corners = np.unique(keys, return_inverse=True)
    chart, vertex = divmod(used, len(sphere.vertices))
    places = sphere.vertices[vertex]
    uv = np.stack([chart % 5 + 0.5 + places[:, 0] / 3, chart // 5 + 0.5 + places[:, 1] / 3], axis=1) / [5, 4]
    starts = np.concatenate([[0], np.cumsum(sizes)])
    left = np.minimum.reduceat(sphere.vertices[corners, 0], starts[:-1]) < 0
    return sphere.vertices, MeshAttributes(
        starts=starts,
        corners=corners,
        uv=uv,
        uv_corners=uv_corners,
        objects=Labels(("Bar",), np.zeros(polygons, int)),
        groups=Labels(("left", "right"), np.where(left, 0, 1)),
        material_of=np.where(charts >= 15, 1, 0),
        materials=(
            SurfaceMaterial("skin", (0.9, 0.8, 0.7, 1.0), texture="skin.png"),
            SurfaceMaterial("cap", (0.1, 0.2, 0.3, 1.0)),
        ),
        textures={"skin.png": png()},
    )


def with_parts(body: tuple[np.ndarray, MeshAttributes]) -> tuple[np.ndarray, MeshAttributes]:
    """A ball with two separate parts, an eye before it and a nail after it in the file's order.

    Returns:
        Vertices (V, 3) of the eye, a small ball half inside on the left; the body; and the nail, a square of quads that
        is above the body on the right. And the surface.
    """
    eye, eye_surface = ball(1)
    x, y = np.meshgrid(np.linspace(0.5, 0.7, 4), np.linspace(-0.1, 0.1, 3), indexing="ij")
    nail = np.stack([x, y, 1.03 * np.sqrt(1 - x**2 - y**2)], axis=-1).reshape(-1, 3)
    numbers = np.arange(12).reshape(4, 3)
    quads = np.stack([numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:]], axis=-1).reshape(-1)
    pieces = [(0.1 * eye + [-0.97, 0, 0], eye_surface, "Eye"), (*body, "Bar"), (nail, None, "Nail")]
    starts, corners, uv, uv_corners, of, groups, materials = [np.zeros(1, int)], [], [], [], [], [], []
    vertices = uvs = ends = 0
    for k, (places, surface, _) in enumerate(pieces):
        sizes = np.full(len(quads) // 4, 4) if surface is None else surface.sizes
        own_uv = (nail[:, :2] + 1) / 2 if surface is None else surface.uv
        starts.append(ends + np.cumsum(sizes))
        corners.append(vertices + (quads if surface is None else surface.corners))
        uv_corners.append(uvs + (quads if surface is None else surface.uv_corners))
        uv.append(own_uv)
        of.append(np.full(len(sizes), k))
        groups.append(surface.groups.of if surface else np.ones(len(sizes), int))
        materials.append(surface.material_of if k == 1 else np.full(len(sizes), k // 2))
        vertices, uvs, ends = vertices + len(places), uvs + len(own_uv), ends + int(sizes.sum())
    whole = MeshAttributes(
        starts=np.concatenate(starts),
        corners=np.concatenate(corners),
        uv=np.concatenate(uv),
        uv_corners=np.concatenate(uv_corners),
        objects=Labels(tuple(name for *_, name in pieces), np.concatenate(of)),
        groups=body[1].groups and Labels(body[1].groups.names, np.concatenate(groups)),
        material_of=np.concatenate(materials),
        materials=body[1].materials,
        textures=body[1].textures,
    )
    return np.concatenate([places for places, *_ in pieces]), whole


def write_files(path: Path, vertices: np.ndarray, surface: MeshAttributes) -> None:
    """Write an OBJ file with its materials and textures in the same folder."""
    lines = [f"mtllib {path.parent.name}.mtl"]
    lines += ["v {!r} {!r} {!r}".format(*row) for row in vertices.tolist()]
    lines += ["vt {!r} {!r}".format(*row) for row in surface.uv.tolist()]
    before = None
    for k, (start, stop) in enumerate(zip(surface.starts[:-1], surface.starts[1:], strict=True)):
        names = (
            f"o {surface.objects.names[surface.objects.of[k]]}",
            f"g {surface.groups.names[surface.groups.of[k]]}",
            f"usemtl {surface.materials[surface.material_of[k]].name}",
        )
        lines += [name for name in names if name not in (before or ())]
        before = names
        pairs = zip(surface.corners[start:stop] + 1, surface.uv_corners[start:stop] + 1, strict=True)
        lines.append("f " + " ".join(f"{v}/{t}" for v, t in pairs))
    path.write_text("\n".join(lines) + "\n")
    library = [
        "newmtl skin",
        "Ns 10",
        "Kd 0.9 0.8 0.7",
        "map_Kd -s 1 1 1 maps/skin.png",
        "newmtl cap",
        "Kd 0.1 0.2 0.3",
    ]
    path.with_name(f"{path.parent.name}.mtl").write_text("\n".join(library) + "\n")
    path.with_name("maps").mkdir(exist_ok=True)
    (path.parent / "maps" / "skin.png").write_bytes(surface.textures["skin.png"])


def parse_obj(text: str) -> dict:
    """Contents of an OBJ file by keyword; polygons as (vertices, texture coordinates, normals, names)."""
    found: dict = {"v": [], "vt": [], "vn": [], "polygons": [], "mtllib": []}
    names: dict[str, str] = {}
    for line in filter(None, text.splitlines()):
        keyword, *words = line.split()
        if keyword in ("v", "vt", "vn"):
            found[keyword].append([float(word) for word in words])
        elif keyword == "f":
            corners = [[*word.split("/"), "", ""][:3] for word in words]
            columns = [[int(word) - 1 if word else None for word in column] for column in zip(*corners, strict=True)]
            found["polygons"].append((*columns, dict(names)))
        elif keyword == "mtllib":
            found["mtllib"] += words
        elif keyword != "#":
            names[keyword] = " ".join(words)
    return found


def corner_uv(surface: MeshAttributes) -> dict[tuple[int, ...], tuple[str, np.ndarray]]:
    """For the vertices of each triangle, the name of its material and texture coordinates (3, 2)."""
    uv = surface.uv[surface.uv_corners[surface.triangle_corners]]
    named = surface.material_of is not None
    names = [surface.materials[surface.material_of[k]].name if named else "" for k in surface.triangle_polygons]
    return {tuple(t): (name, at) for t, name, at in zip(surface.triangles.tolist(), names, uv, strict=True)}


def same_corners(found: dict, wanted: dict) -> None:
    """Assert that the results of `corner_uv` for two surfaces agree."""
    assert found.keys() == wanted.keys()
    for triangle, (name, uv) in wanted.items():
        assert found[triangle][0] == name
        np.testing.assert_allclose(found[triangle][1], uv, atol=1e-6)
