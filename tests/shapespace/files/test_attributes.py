"""What files have beside triangles: read from files of other programs, and written for them."""

from __future__ import annotations

import io
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from shapespace.files.animated_gltf import animated_glb
from shapespace.files.attributes.reading import read_attributes
from shapespace.files.attributes.textures import LARGEST
from shapespace.files.formats import MESH_FORMATS, OBJ_ZIP
from shapespace.files.limits import Limits
from shapespace.files.reading import read_arrays
from shapespace.mesh.attributes import Labels, MeshAttributes, SurfaceMaterial
from shapespace.mesh.triangle_mesh import MeshError
from tests.service.glb import GLB, khronos_report
from tests.surfaces import ball, corner_uv, parse_obj, png, same_corners, write_files

VERTICES, SURFACE = ball(1)
CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "balls").mkdir()
    path = tmp_path / "balls" / "ball.obj"
    write_files(path, VERTICES, SURFACE)
    return path


def same(found: MeshAttributes | None, wanted: MeshAttributes) -> None:
    """Assert that two surfaces agree in everything that OBJ and MTL can express."""
    assert found
    for name in ("starts", "corners", "uv_corners", "material_of"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
    np.testing.assert_allclose(found.uv, wanted.uv, atol=1e-7)
    for labels, expected in ((found.objects, wanted.objects), (found.groups, wanted.groups)):
        assert labels
        assert expected
        assert np.array(labels.names)[labels.of].tolist() == np.array(expected.names)[expected.of].tolist()
    assert [replace(m, texture=None) for m in found.materials] == [replace(m, texture=None) for m in wanted.materials]
    pictures = [[s.textures.get(m.texture or "") for m in s.materials] for s in (found, wanted)]
    assert pictures[0] == pictures[1]


def cube(lines: list[str], faces: list[str], tmp_path: Path) -> tuple[MeshAttributes | None, list[str]]:
    """Attributes and notes read from a cube with further lines before its faces."""
    points = [f"v {x} {y} {z}" for x, y, z in CUBE]
    path = tmp_path / "cube.obj"
    path.write_text("\n".join([*points, *lines, *faces]) + "\n")
    return read_attributes(path)


PLAIN = ["f " + " ".join(str(v + 1) for v in side) for side in SIDES]


def test_a_file_of_others_is_read_whole(file: Path) -> None:
    found, faults = read_attributes(file)
    assert not faults
    same(found, SURFACE)
    assert np.array_equal(SURFACE.triangles, read_arrays(file)[1]), (
        "polygons are split into the same triangles as for the model"
    )


def test_an_archive_of_obj_comes_back_whole(tmp_path: Path) -> None:
    data = OBJ_ZIP.encode(VERTICES, SURFACE.triangles, None, SURFACE)
    assert data == OBJ_ZIP.encode(VERTICES.copy(), SURFACE.triangles.copy(), None, SURFACE)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        archive.extractall(tmp_path)
        assert sorted(archive.namelist()) == ["shape.mtl", "shape.obj", "skin.png"]
    found, faults = read_attributes(tmp_path / "shape.obj")
    assert not faults
    same(found, SURFACE)
    scene = trimesh.load_scene(tmp_path / "shape.obj", process=False)
    looks = {mesh.visual.material.name: mesh.visual.material for mesh in scene.geometry.values()}
    assert looks["skin"].image.size == (4, 4)
    np.testing.assert_allclose(looks["cap"].diffuse[:3], np.array([0.1, 0.2, 0.3]) * 255, atol=1)


def test_obj_by_itself_names_no_files() -> None:
    text = MESH_FORMATS["obj"].encode(VERTICES, SURFACE.triangles, None, SURFACE).decode()
    found = parse_obj(text)
    assert not found["mtllib"]
    np.testing.assert_allclose(found["v"], VERTICES, atol=1e-7)
    for k, (vertices, coordinates, _, names) in enumerate(found["polygons"]):
        start, stop = SURFACE.starts[k : k + 2]
        assert vertices == SURFACE.corners[start:stop].tolist()
        np.testing.assert_allclose(np.array(found["vt"])[coordinates], SURFACE.uv[SURFACE.uv_corners[start:stop]])
        assert names == {
            "s": "1",
            "o": "Bar",
            "g": SURFACE.groups.names[SURFACE.groups.of[k]],
            "usemtl": SURFACE.materials[SURFACE.material_of[k]].name,
        }
    triangles = MESH_FORMATS["obj"].encode(VERTICES, SURFACE.triangles, None, SURFACE.triangulated).decode()
    cut = parse_obj(triangles)["polygons"]
    assert [polygon[0] for polygon in cut] == SURFACE.triangles.tolist()
    assert [polygon[3] for polygon in cut] == [found["polygons"][k][3] for k in SURFACE.triangle_polygons]


@pytest.mark.parametrize("format", ["glb", "gltf"])
def test_others_see_texture_and_materials_in_gltf(format: str) -> None:
    data = MESH_FORMATS[format].encode(VERTICES, SURFACE.triangles, None, SURFACE)
    scene = trimesh.load_scene(io.BytesIO(data), file_type=format, process=False)
    seen = {}
    for mesh in scene.geometry.values():
        seen |= corners_seen(mesh, mesh.visual.material.name)
    same_corners(seen, corner_uv(SURFACE))
    looks = {mesh.visual.material.name: mesh.visual.material for mesh in scene.geometry.values()}
    assert looks["skin"].baseColorTexture.size == (4, 4)
    assert looks["cap"].baseColorTexture is None
    np.testing.assert_allclose(looks["cap"].baseColorFactor[:3], np.array([0.1, 0.2, 0.3]) * 255, atol=1)
    # Our reader merges the vertices that were split.
    limits = Limits(len(SURFACE.split.vertex), len(SURFACE.triangles))  # those of both materials are the same
    vertices, faces = read_arrays(data, format, limits)
    np.testing.assert_allclose(vertices, VERTICES, atol=1e-6)
    assert {tuple(face) for face in faces.tolist()} == {tuple(face) for face in SURFACE.triangles.tolist()}


def corners_seen(mesh: trimesh.Trimesh, material: str) -> dict:
    """As `corner_uv`, of a mesh that trimesh has read; vertices are identified by their positions."""
    apart, vertices = KDTree(VERTICES).query(mesh.vertices)
    assert apart.max() < 1e-6
    uv = mesh.visual.uv[mesh.faces]
    return {tuple(face): (material, at) for face, at in zip(vertices[mesh.faces].tolist(), uv, strict=True)}


def test_the_khronos_validator_finds_nothing_in_a_textured_animation(tmp_path: Path) -> None:
    frames = np.stack([VERTICES, VERTICES * [1, 1, 2], VERTICES * [2, 1, 1]])
    path = tmp_path / "animation.glb"
    path.write_bytes(animated_glb(frames, SURFACE.triangles, SURFACE).data)
    # Texture coordinates without a texture are no error.
    told = {message["code"] for message in khronos_report(path)["issues"]["messages"]}
    assert told == {"UNUSED_OBJECT"}
    glb = GLB(path.read_bytes())
    rows = glb.array(glb.primitive["attributes"]["_VERTEX"]).astype(int)
    assert len(rows) > len(VERTICES)
    assert (np.diff(rows) >= 0).all(), "vertices are in the file's order"
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(glb.key(k), frame[rows], atol=1e-6)
    assert len(glb.tree["meshes"][0]["primitives"]) == 2
    normals = glb.key(1, "NORMAL")
    still = GLB(MESH_FORMATS["glb"].encode(frames[1], SURFACE.triangles, None, SURFACE))
    np.testing.assert_allclose(normals, still.array(still.primitive["attributes"]["NORMAL"]), atol=1e-5)


def test_gltf_goes_round(tmp_path: Path) -> None:
    first, second = tmp_path / "first.glb", tmp_path / "second.gltf"
    first.write_bytes(MESH_FORMATS["glb"].encode(VERTICES, SURFACE.triangles, None, SURFACE))
    found, faults = read_attributes(first)
    assert not faults
    assert found
    second.write_bytes(MESH_FORMATS["gltf"].encode(*read_arrays(first), None, found))
    again, _ = read_attributes(second)
    assert again
    assert again.materials == found.materials == SURFACE.materials
    assert again.textures == SURFACE.textures
    assert again.objects
    assert again.objects.names == ("Bar",)
    for surface in (found, again):
        same_corners(corner_uv(surface), corner_uv(SURFACE))


def test_ply_keeps_polygons_and_texture_coordinates(tmp_path: Path) -> None:
    path = tmp_path / "ball.ply"
    one_chart = replace(SURFACE, uv=VERTICES[:, :2], uv_corners=SURFACE.corners)
    path.write_bytes(MESH_FORMATS["ply"].encode(VERTICES, SURFACE.triangles, None, one_chart))
    found, _ = read_attributes(path)
    assert found
    np.testing.assert_array_equal(found.starts, SURFACE.starts)
    np.testing.assert_array_equal(found.corners, SURFACE.corners)
    other = trimesh.load_mesh(path, process=False)
    assert len(other.faces) == len(SURFACE.triangles)
    places = {tuple(row) for row in np.hstack([VERTICES, VERTICES[:, :2]]).round(5).tolist()}
    assert {tuple(row) for row in np.hstack([other.vertices, other.visual.uv]).round(5).tolist()} == places

    # Seams: texture coordinates as lists of the faces, which others read if all faces have the same size.
    triangles = SURFACE.triangulated
    path.write_bytes(MESH_FORMATS["ply"].encode(VERTICES, SURFACE.triangles, None, triangles))
    found, _ = read_attributes(path)
    assert found
    unnamed = replace(SURFACE, material_of=None, materials=())
    same_corners(corner_uv(found), corner_uv(unnamed))
    other = trimesh.load_mesh(path, process=False, fix_texture=True)
    same_corners(corners_seen(other, ""), corner_uv(unnamed))
    # Faces of several sizes and seams: text, which every reader can read, without texture coordinates.
    path.write_bytes(MESH_FORMATS["ply"].encode(VERTICES, SURFACE.triangles, None, SURFACE))
    assert len(trimesh.load_mesh(path, process=False).faces) == len(SURFACE.triangles)


@pytest.mark.parametrize("flat", ["vn", "s off"])
def test_sharp_edges_stay_sharp(flat: str, tmp_path: Path) -> None:
    if flat == "vn":
        normals = ["vn -1 0 0", "vn 1 0 0", "vn 0 -1 0", "vn 0 1 0", "vn 0 0 -1", "vn 0 0 1"]
        faces = ["f " + " ".join(f"{v + 1}//{k + 1}" for v in side) for k, side in enumerate(SIDES)]
        found, faults = cube(normals, faces, tmp_path)
    else:
        found, faults = cube(["s off"], PLAIN, tmp_path)
    assert found
    assert not faults
    stretched = CUBE * [2, 1, 1]
    glb = GLB(MESH_FORMATS["glb"].encode(stretched, found.triangles, None, found))
    assert len(glb.positions) == 24
    normals = glb.array(glb.primitive["attributes"]["NORMAL"])
    a, b, c = (glb.positions[glb.faces[:, k]] for k in range(3))
    by_face = np.cross(b - a, c - a)
    np.testing.assert_allclose(
        normals[glb.faces],
        np.repeat((by_face / np.linalg.norm(by_face, axis=1)[:, None])[:, None], 3, axis=1),
        atol=1e-6,
    )
    text = parse_obj(MESH_FORMATS["obj"].encode(stretched, found.triangles, None, found).decode())
    assert len(text["v"]) == 8
    assert np.abs(np.array(text["vn"])).max(axis=1).tolist() == [1] * 24
    for vertices, _, normals_of, _ in text["polygons"]:
        assert len({tuple(text["vn"][n]) for n in normals_of}) == 1, vertices


def test_smooth_files_stay_smooth_across_welded_seams(tmp_path: Path) -> None:
    found, _ = cube(["s 1"], PLAIN, tmp_path)
    assert found
    assert found.welded(np.arange(8)).shading is None
    assert not found.normals
    # Without "s 1", Blender shows the faces that were smooth as flat ones.
    assert b"\ns 1\nf " in MESH_FORMATS["obj"].encode(CUBE, found.triangles, None, found)
    assert len(GLB(MESH_FORMATS["glb"].encode(CUBE, found.triangles, None, found)).positions) == 8


def test_vertex_colours_come_back(tmp_path: Path) -> None:
    colours = np.random.default_rng(0).integers(0, 256, (len(VERTICES), 3)) / 255
    surface = MeshAttributes(starts=SURFACE.starts, corners=SURFACE.corners, colors=colours)
    for format in ("obj", "ply", "glb", "gltf"):
        path = tmp_path / f"ball.{format}"
        path.write_bytes(MESH_FORMATS[format].encode(VERTICES, SURFACE.triangles, None, surface))
        found, _ = read_attributes(path)
        assert found
        np.testing.assert_allclose(found.colors, colours, atol=1e-3)
    other = trimesh.load_mesh(tmp_path / "ball.ply", process=False)
    np.testing.assert_array_equal(other.visual.vertex_colors[:, :3], np.rint(colours * 255))


def test_plain_triangles_have_no_surface(tmp_path: Path) -> None:
    triangles = [f"f {a + 1} {b + 1} {c + 1}" for side in SIDES for a, b, c in (side[:3], side[[0, 2, 3]])]
    assert cube([], triangles, tmp_path) == (None, [])
    found, _ = cube([], PLAIN, tmp_path)
    assert found
    assert found.sizes.tolist() == [4] * 6


def test_faces_of_which_some_have_no_texture_coordinates_keep_those_of_the_others(tmp_path: Path) -> None:
    faces = ["f 1/1 2/2 4/3 3/4", *PLAIN[1:]]
    found, faults = cube(["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"], faces, tmp_path)
    assert found
    assert not faults
    text = MESH_FORMATS["obj"].encode(CUBE, found.triangles, None, found).decode()
    polygons = parse_obj(text)["polygons"]
    assert polygons[0][1] == [0, 1, 2, 3]
    assert all(polygon[1] == [None] * 4 for polygon in polygons[1:])
    assert read_arrays(MESH_FORMATS["glb"].encode(CUBE, found.triangles, None, found), "glb")[0].shape == (8, 3)


def test_corners_with_and_without_texture_coordinates_and_normals_go_round(tmp_path: Path) -> None:
    normals = ["vn -1 0 0", "vn 1 0 0", "vn 0 -1 0", "vn 0 1 0", "vn 0 0 -1", "vn 0 0 1"]
    faces = [f"f {' '.join(f'{v + 1}/{v % 4 + 1 if k else str()}/{k + 1}' for v in s)}" for k, s in enumerate(SIDES)]
    found, _ = cube(["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", *normals], faces, tmp_path)
    assert found
    path = tmp_path / "again.obj"
    path.write_bytes(MESH_FORMATS["obj"].encode(CUBE, found.triangles, None, found))
    again, faults = read_attributes(path)
    assert again
    assert not faults
    np.testing.assert_array_equal(again.uv_corners, found.uv_corners)
    np.testing.assert_array_equal(again.normal_corners, found.normal_corners)
    assert (again.uv_corners[:4] == -1).all()


@pytest.mark.parametrize(
    ("lines", "faces", "says"),
    [
        (["vt 0 0", "vt 1 1"], PLAIN, "its 2 texture coordinates are left out: no face refers to them"),
        (["vt 0 0"], ["f 1/1 2/2 4/1 3/1", *PLAIN[1:]], "left out: a texture coordinate is numbered -1 to 1"),
        (["vt 0 nan"], ["f 1/1 2/1 4/1 3/1", *PLAIN[1:]], "left out: a texture coordinate is not finite"),
        (["mtllib none.mtl", "usemtl skin"], PLAIN, "the materials of none.mtl are left out: No such file"),
        (["mtllib gone.mtl", "usemtl skin"], PLAIN, "texture gone.png of material skin is left out: No such file"),
        (["mtllib huge.mtl", "usemtl skin"], PLAIN, "texture huge.png of material skin is left out: it has 16.0 MiB"),
        (["mtllib text.mtl", "usemtl skin"], PLAIN, "texture text.png of material skin is left out: it is neither PNG"),
        (["mtllib odd.mtl", "usemtl skin"], PLAIN, "materials of odd.mtl are left out: line 2 can't be read"),
        (["mtllib zero.mtl", "usemtl skin"], PLAIN, "the materials of zero.mtl are left out: it is a device or a pipe"),
        (["mtllib pipe.mtl", "usemtl skin"], PLAIN, "the materials of pipe.mtl are left out: it is a device or a pipe"),
        (["mtllib link.mtl", "usemtl skin"], PLAIN, "link.png of material skin is left out: it is a device or a pipe"),
    ],
)
def test_what_can_t_be_kept_is_left_out_with_a_sentence(
    lines: list[str], faces: list[str], says: str, tmp_path: Path
) -> None:
    os.mkfifo(tmp_path / "pipe.mtl")
    for name in ("zero.mtl", "link.png"):
        (tmp_path / name).symlink_to("/dev/zero")
    for name in ("gone", "huge", "text", "link"):
        (tmp_path / f"{name}.mtl").write_text(f"newmtl skin\nmap_Kd {name}.png\n")
    (tmp_path / "odd.mtl").write_text("newmtl skin\nKd x\n")
    (tmp_path / "huge.png").write_bytes(png() + bytes(LARGEST))
    (tmp_path / "text.png").write_text("no picture")
    found, faults = cube(lines, faces, tmp_path)
    (fault,) = faults
    assert says in fault
    assert "\n" not in fault
    assert found is None or not found.textures


@pytest.mark.parametrize("name", [r"C:\art\skin.png", "{outside}/skin.png", "../skin.png", "-s 2 2 maps/skin.png"])
def test_pictures_are_taken_from_the_folder_only(name: str, file: Path) -> None:
    library = file.with_name("balls.mtl")
    library.write_text(f"newmtl skin\nmap_Kd {name.format(outside=file.parents[1])}\n")
    (file.parents[1] / "skin.png").write_bytes(png(1))
    if "maps" not in name:
        found, (fault,) = read_attributes(file)
        assert found
        assert "the texture skin.png of material skin is left out: No such file" in fault
        (file.parent / "skin.png").write_bytes(png())
    found, faults = read_attributes(file)
    assert not faults
    assert found
    assert found.textures == {"skin.png": png()}


def test_a_picture_of_gltf_that_is_not_there_is_left_out(tmp_path: Path) -> None:
    path = tmp_path / "ball.gltf"
    tree = json.loads(MESH_FORMATS["gltf"].encode(VERTICES, SURFACE.triangles, None, SURFACE))
    tree["images"] = [{"uri": "none.png"}]
    path.write_text(json.dumps(tree))
    found, (fault,) = read_attributes(path)
    assert found
    assert "the texture none.png of material skin is left out: No such file" in fault
    assert [material.texture for material in found.materials] == [None, None]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"starts": np.array([0, 2, 4])}, "fewer than three corners"),
        ({"starts": np.array([0, 3])}, "begin at the first corner and end at the last"),
        ({"corners": np.array([0, 1, 2, 3])}, "not those of the triangles"),
        ({"uv_corners": np.array([0, 1, 2, 4])}, "numbered 0 to 4, but there are 4"),
        ({"uv_corners": np.array([0, 1, 2])}, "not one for each"),
        ({"uv": np.full((4, 2), np.inf)}, "not finite"),
        ({"uv": None}, "there are 0"),
        ({"shading": np.array([0, 0, 0, -1])}, "no shading label"),
        ({"colors": np.full((4, 3), 2.0)}, "numbers from 0 to 1"),
        ({"groups": Labels(("a",), np.array([1]))}, "a group is numbered 1 to 1, but there are 1"),
        ({"materials": (SurfaceMaterial("a", texture="none.png"),)}, "has no file none.png"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(change: dict, says: str) -> None:
    square = MeshAttributes(
        starts=np.array([0, 4]), corners=np.array([0, 1, 3, 2]), uv=np.eye(4, 2), uv_corners=np.arange(4)
    )
    triangles = np.array([[0, 1, 3], [0, 3, 2]])
    square.check(4, triangles)
    with pytest.raises(MeshError, match=says):
        replace(square, **change).check(4, triangles)
