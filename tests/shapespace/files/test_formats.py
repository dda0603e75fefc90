"""Mesh files: written here and read by other libraries, and the reverse."""

import io
import resource
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import UsdGeom

from shapespace.files.animated_gltf import DENSE_FRAMES, FRAMES_PER_SECOND, animated_glb
from shapespace.files.colouring import Colouring, Quantity
from shapespace.files.formats import MESH_FORMATS
from shapespace.files.gltf_writing import surface_normals
from shapespace.files.point_cache import point_cache
from shapespace.files.reading import read_arrays
from shapespace.files.usd import animated_usd
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError, TriangleMesh, vertex_normals
from shapespace.training.collection.generators import freaky_torus
from tests.meshes import read_mesh
from tests.sequences import read_point_cache, read_usd
from tests.service.glb import GLB
from tests.shapespace.conftest import MESHES

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def cube() -> TriangleMesh:
    faces = np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])
    return TriangleMesh.from_arrays(CUBE, faces)


def loaded(data: bytes, format: str) -> trimesh.Trimesh:
    mesh = trimesh.load_mesh(io.BytesIO(data), file_type=format, process=False, maintain_order=True)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


@pytest.mark.parametrize("format", sorted(MESH_FORMATS.keys() - {"npz", "stl"}))
@pytest.mark.parametrize("size", [1e-4, 1.0, 2e5])
def test_others_read_what_we_write(format: str, size: float) -> None:
    mesh = freaky_torus.reference()
    found = loaded(MESH_FORMATS[format].encode(size * mesh.vertices, mesh.faces), format)
    np.testing.assert_allclose(found.vertices, size * mesh.vertices, atol=1e-6 * size)
    assert np.array_equal(found.faces, mesh.faces)
    assert found.volume > 0, "wound inside out"


def test_stl_keeps_the_order_of_faces() -> None:
    mesh = freaky_torus.reference()
    found = loaded(MESH_FORMATS["stl"].encode(mesh.vertices, mesh.faces), "stl")
    np.testing.assert_allclose(found.triangles, mesh.vertices[mesh.faces], atol=1e-6)


@pytest.mark.parametrize("format", sorted(MESH_FORMATS.keys() - {"stl"}))
def test_we_read_what_we_write(format: str, tmp_path: Path) -> None:
    mesh = freaky_torus.reference()
    path = tmp_path / f"torus.{format}"
    path.write_bytes(MESH_FORMATS[format].encode(mesh.vertices, mesh.faces))
    for found in (read_mesh(path), read_mesh(path.read_bytes(), format)):
        assert np.array_equal(found.vertices.astype(np.float32), mesh.vertices.astype(np.float32))
        assert np.array_equal(found.faces, mesh.faces)


class Intruder:
    """An object that creates a file when it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple:
        return Path.touch, (self.mark,)


def test_pickles_are_refused_and_not_run(tmp_path: Path) -> None:
    file = io.BytesIO()
    harm = np.array([Intruder(tmp_path / "harm")], dtype=object)
    np.savez(file, vertices=CUBE, faces=SIDES[:, :3], more=harm)
    with pytest.raises(MeshError, match="pickled objects"):
        read_arrays(file.getvalue(), "npz")
    assert not (tmp_path / "harm").exists()


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="no such file or folder"):
        read_arrays(tmp_path / "none.obj")


def test_normals_point_outwards_with_unit_length() -> None:
    torus = freaky_torus.reference()
    normals = vertex_normals(torus.vertices, torus.faces)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-12)
    corners = cube()
    at_corners = vertex_normals(corners.vertices, corners.faces)
    assert (np.sign(at_corners) == np.sign(corners.vertices - 0.5)).all()


def test_a_vertex_whose_faces_cancel_still_has_a_unit_normal() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    normals = surface_normals(vertices, MeshAttributes.of_triangles(np.array([[0, 1, 2], [0, 2, 1]])))
    np.testing.assert_array_equal(np.linalg.norm(normals, axis=1), 1)


def test_equal_meshes_give_equal_bytes() -> None:
    mesh = freaky_torus.reference()
    for format in MESH_FORMATS.values():
        assert format.encode(mesh.vertices, mesh.faces) == format.encode(mesh.vertices.copy(), mesh.faces.copy())


@pytest.mark.parametrize("format", [name for name, format in MESH_FORMATS.items() if format.coloured])
def test_others_read_our_colours(format: str) -> None:
    mesh = freaky_torus.reference()
    colouring = Colouring(Quantity.STRETCH, mesh.vertices[:, 0], 0.5)
    data = MESH_FORMATS[format].encode(mesh.vertices, mesh.faces, colouring)
    plain = MESH_FORMATS[format].encode(mesh.vertices, mesh.faces)
    for a, b in zip(read_arrays(data, format), read_arrays(plain, format), strict=True):
        assert np.array_equal(a, b), "colours may not change positions"
    if format == "npz":
        with np.load(io.BytesIO(data)) as arrays:
            assert arrays["color_quantity"] == "stretch"
            assert arrays["color_range"].tolist() == [-0.5, 0.5]
            np.testing.assert_allclose(arrays["color_values"], colouring.values, atol=1e-7)
        return
    if format in {"glb", "gltf"}:  # trimesh ignores colours of a mesh with a material
        scene = trimesh.load_scene(io.BytesIO(data), file_type=format, process=False)
        (found,) = scene.geometry.values()
        np.testing.assert_allclose(found.visual.vertex_attributes["color"], colouring.linear, atol=1e-6)
        assert found.visual.material.baseColorFactor is None
        assert found.visual.material.metallicFactor == 0
    else:
        colours = loaded(data, format).visual.vertex_colors
        np.testing.assert_allclose(colours[:, :3], 255 * colouring.srgb, atol=1)
        assert (colours[:, 3] == 255).all()
    if format == "glb":
        assert GLB(data).tree["meshes"][0]["extras"]["color"] == colouring.legend
    if format == "ply":
        assert b"property float stretch" in data


def test_a_point_cache_holds_every_frame() -> None:
    frames = freaky_torus.vertices(np.linspace([0, 0, 1, 1], [1, 2, 3, 1], 7))
    np.testing.assert_array_equal(read_point_cache(b"".join(point_cache(frames))), frames.astype(np.float32))


def test_usd_holds_every_frame_with_its_normals(tmp_path: Path) -> None:
    faces = freaky_torus.connectivity().faces
    frames = freaky_torus.vertices(np.linspace([0, 0, 1, 1], [1, 2, 3, 1], 7))
    path = tmp_path / "animation.usdc"
    path.write_bytes(b"".join(animated_usd(frames, faces)))
    found, stage = read_usd(path)
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    np.testing.assert_array_equal(found, frames.astype(np.float32))
    assert np.array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), faces)
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    assert mesh.GetSubdivisionSchemeAttr().Get() == "none", "viewers would subdivide and smooth the shape"
    assert stage.GetTimeCodesPerSecond() == FRAMES_PER_SECOND
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1, "the default is centimetres, and other programs scale"
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(mesh.GetNormalsAttr().Get(k), vertex_normals(frame, faces), atol=1e-5)
        np.testing.assert_allclose(mesh.GetExtentAttr().Get(k), [frame.min(axis=0), frame.max(axis=0)], atol=1e-6)
    assert path.read_bytes() == b"".join(animated_usd(frames, faces))


def test_few_frames_are_exact_and_many_are_within_the_tolerance() -> None:
    assert DENSE_FRAMES == 64, "as docs/reference/http.md says"
    faces = freaky_torus.connectivity().faces
    for count in (DENSE_FRAMES, DENSE_FRAMES + 1):
        codes = np.linspace([0, 0, 1, 1], [0.5, 0.3, 1.1, 1], count)
        frames = freaky_torus.vertices(codes)
        animated = animated_glb(frames, faces)
        diagonal = np.linalg.norm(np.ptp(frames.reshape(-1, 3), axis=0))
        if count == DENSE_FRAMES:
            assert animated.targets == count - 1
            assert animated.max_vertex_error < 1e-7
        else:
            assert 1 < animated.targets < 20
            assert animated.max_vertex_error < 1.1e-4 * diagonal


@pytest.mark.parametrize("size", [1.0, 1.25, 1.125, 1.0625])  # each makes the JSON three bytes longer
def test_both_parts_of_a_glb_begin_at_multiples_of_four_bytes(size: float) -> None:
    data = animated_glb(size * CUBE[None], cube().faces).data
    (json_length,) = struct.unpack_from("<I", data, 12)
    assert json_length % 4 == 0
    assert len(data) % 4 == 0
    np.testing.assert_array_equal(GLB(data).positions, size * CUBE)


def test_usd_without_room_for_its_file_is_an_error_of_the_disk() -> None:
    frames = np.repeat(cube().vertices[None], 20, axis=0)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, hard))
    try:
        with pytest.raises(OSError, match="can't write"):
            next(animated_usd(frames, cube().faces))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_where_an_animation_takes_place_does_not_matter() -> None:
    codes = np.linspace([0, 0, 1, 1], [0.5, 0.3, 1.1, 1], DENSE_FRAMES + 1)
    frames, faces = freaky_torus.vertices(codes), freaky_torus.connectivity().faces
    here, there = animated_glb(frames, faces), animated_glb(frames + np.array([16, 0, 0]), faces)
    assert there.targets == here.targets
    assert there.max_vertex_error == pytest.approx(here.max_vertex_error, rel=0.1)


def test_weights_of_what_goes_both_ways_lie_between_0_and_1() -> None:
    # Blender and other programs clamp weights outside.
    count = DENSE_FRAMES + 6
    swing = np.sin(np.linspace(0, 4 * np.pi, count))
    codes = np.stack([swing, 0.3 * swing, 1 + 0.2 * swing**2, 1 - 0.1 * swing], axis=1)
    frames = freaky_torus.vertices(codes)
    animated = animated_glb(frames, freaky_torus.connectivity().faces)
    glb = GLB(animated.data)
    weights = glb.array(glb.tree["animations"][0]["samplers"][0]["output"])
    assert weights.min() >= 0
    assert weights.max() <= 1
    assert animated.targets == len(glb.primitive["targets"]) == len(glb.tree["meshes"][0]["weights"])
    shown = np.stack([glb.key(k) for k in range(count)])
    error = np.linalg.norm(shown - frames, axis=-1).max()
    assert error == pytest.approx(animated.max_vertex_error, rel=1e-2)
    assert error < 1.1e-4 * np.linalg.norm(np.ptp(frames.reshape(-1, 3), axis=0))
    for k in (0, 1, count // 2, count - 1):
        off = glb.key(k, "NORMAL") - vertex_normals(frames[k], freaky_torus.connectivity().faces)
        assert np.abs(off).max() < 0.02, "normals are animated too"


def test_more_ways_to_move_than_targets_leave_an_error_that_is_told(rng: np.random.Generator) -> None:
    mesh, count = MESHES["sheet"](), 3 * DENSE_FRAMES
    frames = mesh.vertices + 0.01 * rng.standard_normal((count, *mesh.vertices.shape))
    animated = animated_glb(frames, mesh.faces)
    glb = GLB(animated.data)
    error = max(np.linalg.norm(glb.key(k) - frames[k], axis=-1).max() for k in range(count))
    assert error == pytest.approx(animated.max_vertex_error, rel=1e-3)
    assert 1e-4 * mesh.diagonal < error < 0.05


def test_a_basis_never_has_more_targets_than_frames(rng: np.random.Generator) -> None:
    # Vectors with both signs take two targets each.
    mesh, count = MESHES["sheet"](), DENSE_FRAMES + 2
    frames = mesh.vertices + 0.01 * rng.standard_normal((count, *mesh.vertices.shape))
    animated = animated_glb(frames, mesh.faces)
    assert animated.targets == count - 1
    assert animated.max_vertex_error < 1e-7


def test_frames_that_stand_still_make_a_file_too() -> None:
    mesh = cube()
    for count in (1, 3, DENSE_FRAMES + 2):
        animated = animated_glb(np.repeat(mesh.vertices[None], count, axis=0), mesh.faces)
        assert animated.max_vertex_error == 0
        np.testing.assert_array_equal(loaded(animated.data, "glb").vertices, CUBE)
