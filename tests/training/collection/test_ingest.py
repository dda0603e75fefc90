"""Collections of mesh files: what counts as one, the order of files and vertices, and one-line refusals."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.files.formats import MESH_FORMATS, VTK_FORMATS
from shapespace.files.reading import READ_FORMATS
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.training.collection.faults import IngestError
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.mesh_collection import MeshCollection, normalised

NAMES = ("pose1", "pose2", "pose10")
BALL = trimesh.creation.icosphere(subdivisions=1)
FACES = np.array(BALL.faces)
#: Three ellipsoids without symmetries, exact in float32, far from the origin.
SHAPES = np.stack(
    [
        BALL.vertices * [a, 2, 1] + 0.05 * np.random.default_rng(0).standard_normal((42, 3)) + [5, 0, 0]
        for a in (1, 1.5, 3)
    ]
).astype(np.float32).astype(np.float64)  # fmt: skip


def encoded(vertices: np.ndarray, faces: np.ndarray, format: str) -> bytes:
    if format == "off":
        return trimesh.Trimesh(vertices, faces, process=False).export(file_type="off").encode()
    return (MESH_FORMATS | VTK_FORMATS)[format.replace("vtu", "vtp")].encode(vertices, faces)


def write(
    folder: Path,
    shapes: np.ndarray | Sequence[np.ndarray] = SHAPES,
    faces: np.ndarray = FACES,
    formats: Sequence[str] = ("obj", "obj", "obj"),
) -> Path:
    folder.mkdir(exist_ok=True)
    for name, vertices, format in zip(NAMES, shapes, formats, strict=False):
        (folder / f"{name}.{format}").write_bytes(encoded(vertices, faces, format))
    return folder


def sheet(n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n², 3) and faces of a square of unit cells."""
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    a = (x * n + y)[:-1, :-1].ravel()
    faces = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    return np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float), faces


def split_at(faces: np.ndarray, vertex: int, count: int) -> np.ndarray:
    """Faces whose second half uses vertex ``count`` instead of ``vertex``, as exporters split seams."""
    split = faces.copy()
    half = split[len(split) // 2 :]
    half[half == vertex] = count
    return split


def moved(shape: int, vertex: int, to: object) -> np.ndarray:
    shapes = SHAPES.copy()
    shapes[shape, vertex] = to
    return shapes


def same_surfaces(found: MeshCollection, shapes: np.ndarray = SHAPES, faces: np.ndarray = FACES) -> None:
    np.testing.assert_allclose(found.vertices[:, found.faces], shapes[:, faces], rtol=0, atol=1e-6)


def split(shape: np.ndarray, faces: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The mesh with some corners on vertices of their own, and all vertices in another order."""
    corners = faces.ravel().copy()
    alone = rng.random(len(corners)) < 0.5
    corners[alone] = len(shape) + np.arange(alone.sum())
    vertices = np.concatenate([shape, shape[faces.ravel()[alone]]])
    order = rng.permutation(len(vertices))
    return vertices[order], np.argsort(order)[corners].reshape(-1, 3)


@pytest.mark.parametrize("formats", [("glb", "glb", "glb"), ("obj", "ply", "off"), ("stl", "glb", "npz")])
def test_vertices_may_be_split_and_numbered_otherwise_in_each_file(formats: tuple[str, ...], tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    for name, shape, format in zip(NAMES, SHAPES, formats, strict=True):
        (tmp_path / f"{name}.{format}").write_bytes(encoded(*split(shape, FACES, rng), format))
    found = read_collection(tmp_path)
    assert found.vertices.shape == (3, 42, 3)
    same_surfaces(found)


def test_split_vertices_do_not_hide_other_faces(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    write(tmp_path, formats=["obj", "obj", "glb"])
    vertices, faces = split(SHAPES[1], FACES, rng)
    (tmp_path / "pose2.obj").write_bytes(encoded(vertices, np.roll(faces, 1, axis=0), "obj"))
    with pytest.raises(
        IngestError, match=r"pose2\.obj: has \d+ vertices and 80 faces, but .*if all files have the same faces"
    ):
        read_collection(tmp_path)


@pytest.mark.parametrize("format", READ_FORMATS)
def test_every_format_gives_the_same_surfaces(format: str, tmp_path: Path) -> None:
    found = read_collection(write(tmp_path, formats=[format] * 3))
    assert found.names == NAMES
    assert found.vertices.shape == (3, 42, 3)
    assert found.vertices.dtype == np.float64
    same_surfaces(found)
    if format != "stl":
        assert np.array_equal(found.faces, FACES)
        assert np.array_equal(found.file_vertices, np.arange(42))
        assert not found.notes


@pytest.mark.parametrize("formats", [("obj", "ply", "glb"), ("stl", "off", "npz"), ("stl", "stl", "gltf")])
def test_formats_mix_and_other_files_are_ignored(formats: tuple[str, ...], tmp_path: Path) -> None:
    write(tmp_path, formats=formats)
    for name in ("README.md", "skin.png", "pose1.mtl", ".pose0.obj", "buffer.bin", "no extension"):
        (tmp_path / name).write_bytes(b"not a mesh")
    write(tmp_path / "folder.obj", moved(0, 0, 0))
    (tmp_path / f"pose1.{formats[0]}").rename(tmp_path / f"pose1.{formats[0].upper()}")
    found = read_collection(tmp_path)
    assert found.names == NAMES
    same_surfaces(found)
    assert np.array_equal(found.faces, FACES), "faces of STL get the other files' vertices"


def test_names_are_in_natural_order(tmp_path: Path) -> None:
    names = ["a2", "A10", "b", "b1x2", "b1x10", "b007", "b8"]
    for k, name in enumerate(reversed(names)):
        (tmp_path / f"{name}.obj").write_bytes(encoded(SHAPES[0] * (1 + k), FACES, "obj"))
    found = read_collection(tmp_path)
    assert found.names == tuple(names)
    np.testing.assert_allclose(found.vertices[:, 0, 0] / SHAPES[0, 0, 0], np.arange(len(names), 0, -1), rtol=1e-6)


@pytest.mark.parametrize("named", [True, False])
def test_one_npz_is_a_collection(named: bool, tmp_path: Path) -> None:
    path = tmp_path / "poses.npz"
    names = {"names": np.array(["z", "y", "x"])} if named else {}
    np.savez(path, vertices=SHAPES.astype(np.float32), faces=FACES.astype(np.uint32), **names)  # type: ignore[arg-type]
    found = read_collection(path)
    assert found.names == (("z", "y", "x") if named else ("0", "1", "2"))
    np.testing.assert_array_equal(found.vertices, SHAPES)
    assert np.array_equal(found.faces, FACES)


@pytest.mark.parametrize("format", ["obj", "glb", "ply"])
def test_seams_are_welded_and_unused_vertices_dropped(format: str, tmp_path: Path) -> None:
    # Vertex 42 is a copy of 7; 43 is in no face, and in another place in each shape.
    extra = np.random.default_rng(1).standard_normal((3, 1, 3))
    shapes = np.concatenate([SHAPES, SHAPES[:, 7:8], extra], axis=1)
    found = read_collection(write(tmp_path, shapes, split_at(FACES, 7, 42), [format] * 3))
    np.testing.assert_allclose(found.vertices, SHAPES, atol=1e-6)
    assert np.array_equal(found.faces, FACES)
    assert np.array_equal(found.file_vertices, [*range(42), 7, -1])
    assert [re.sub(r"\D+", " ", note).split() for note in found.notes] == [["1"], ["43", "42"]]


@pytest.mark.parametrize("touching", [0, 2])
def test_vertices_that_coincide_in_one_shape_only_stay_apart(touching: int, tmp_path: Path) -> None:
    flat, faces = sheet()
    shapes = np.stack([flat * [1, s, 1] for s in (1, 2, 3)])
    shapes[touching, 0] = shapes[touching, 4] = [1, 2, 3]  # two corners coincide
    found = read_collection(write(tmp_path, shapes, faces))
    assert found.vertices.shape == (3, 25, 3)
    same_surfaces(found, shapes, faces)
    assert len(found.notes) == (touching == 0), "only coincidences in the first shape are noted"


def test_vertices_a_hair_apart_are_welded_but_not_more(tmp_path: Path) -> None:
    faces = split_at(FACES, 7, 42)
    for part, count in ((3e-7, 42), (1e-5, 43)):
        shapes = np.concatenate([SHAPES, SHAPES[:, 7:8] + [0, 0, part * 5]], axis=1)
        np.savez(tmp_path / "poses.npz", vertices=shapes, faces=faces)
        assert read_collection(tmp_path / "poses.npz").vertices.shape[1] == count


def test_rough_meshes_pass(tmp_path: Path) -> None:
    flat, faces = sheet()
    shapes = np.stack([flat, flat * [1, 1.3, 1], flat * [2, 1, 1]])
    shapes[1, 20:] = shapes[1, 10:15] + [1e-3, 0, 1e-3]  # the last row is folded onto the one before
    shapes[2, 6] = shapes[2, 7] + [0, 1e-4, 0]  # slivers
    same_surfaces(read_collection(write(tmp_path, shapes, faces)), shapes, faces)


def test_a_winding_that_is_inside_out_is_kept_and_told(tmp_path: Path) -> None:
    found = read_collection(write(tmp_path, faces=FACES[:, ::-1]))
    assert np.array_equal(found.faces, FACES[:, ::-1])
    assert len(found.notes) == 1
    assert "inside out" in found.notes[0]


def test_the_reference_gets_unit_area_and_the_scale_undoes_it(tmp_path: Path) -> None:
    found = read_collection(write(tmp_path))
    vertices, scale = normalised(found, 1)
    assert face_areas(vertices[1], found.faces).sum() == pytest.approx(1, rel=1e-12)
    np.testing.assert_allclose(scale * vertices, found.vertices, rtol=1e-12)
    assert scale > 1


def test_shapes_are_found_by_name(tmp_path: Path) -> None:
    found = read_collection(write(tmp_path))
    assert [found.index(name) for name in ("pose1", "pose2", "pose10")] == [0, 1, 2]
    assert found.index("pose2.ply") == 1, "by its file"
    with pytest.raises(IngestError, match="no shape is called 'pose3'; there are pose1, pose2, pose10"):
        found.index("pose3")
    for shape in found.vertices:
        TriangleMesh.from_arrays(shape, found.faces)


def bad_file(name: str, data: bytes) -> Callable[[Path], Path]:
    """Three files, the second in the format of the bad one; where this has the second's name, it takes its place."""

    def build(folder: Path) -> Path:
        write(folder, formats=("obj", name.rpartition(".")[2], "obj"))
        (folder / name).write_bytes(data)
        return folder

    return build


def bad_npz(**arrays: np.ndarray | None) -> Callable[[Path], Path]:
    def build(folder: Path) -> Path:
        path = folder / "poses.npz"
        every = {"vertices": SHAPES, "faces": FACES, **arrays}
        np.savez(path, **{name: array for name, array in every.items() if array is not None})  # type: ignore[arg-type]
        return path

    return build


def written(*arguments: object, **named: object) -> Callable[[Path], Path]:
    return lambda folder: write(folder, *arguments, **named)  # type: ignore[arg-type]


def with_other(name: str, vertices: np.ndarray, faces: np.ndarray) -> Callable[[Path], Path]:
    """A folder of three OBJ files, or STL files if ``name`` is one, with one file replaced."""
    format = name.rpartition(".")[2]

    def build(folder: Path) -> Path:
        write(folder, formats=[format] * 3)
        (folder / name).write_bytes(encoded(vertices, faces, format))
        return folder

    return build


def ball_and(vertices: Sequence[Sequence[float]], faces: Sequence[Sequence[int]]) -> Callable[[Path], Path]:
    """The collection with further vertices, numbered from 42, in every shape, and further faces."""
    more = np.repeat(np.array(vertices, dtype=float).reshape(1, -1, 3), 3, axis=0)
    return written(np.concatenate([SHAPES, more], axis=1), np.concatenate([FACES, faces]))


def third_face(seam: bool) -> Callable[[Path], Path]:
    """A third face on edge A–B, or on its copy across a seam; two unused vertices first shift the numbers."""

    def build(folder: Path) -> Path:
        shapes = np.concatenate([np.zeros((3, 2, 3)), SHAPES, SHAPES[:, [A, B]], np.full((3, 1, 3), 9.0)], axis=1)
        edge = [44, 45] if seam else [A + 2, B + 2]
        return write(folder, shapes, np.concatenate([FACES + 2, [[*edge, 46]]]))

    return build


def unknown_extensions(folder: Path) -> Path:
    for name in ("README.md", "dancer.fbx", ".hidden.obj"):
        (folder / name).touch()
    return folder


def two_collections(folder: Path) -> Path:
    for name in ("fine.npz", "coarse.npz"):
        np.savez(folder / name, vertices=SHAPES, faces=FACES)
    return folder


A, B, C = FACES[0].tolist()
SWAPPED = FACES[[1, 0, *range(2, len(FACES))]]
TURNED = np.concatenate([FACES[:7], FACES[7:8, ::-1], FACES[8:]])
#: Two vertices of face 5 stand almost in one place in every shape.
NEARLY_ONE = SHAPES.copy()
NEARLY_ONE[:, FACES[5, 0]] = SHAPES[:, FACES[5, 1]] + 1e-7 * (SHAPES[:, FACES[5, 0]] - SHAPES[:, FACES[5, 1]])
GLB, STL = (encoded(SHAPES[1], FACES, format) for format in ("glb", "stl"))
REFUSALS: dict[str, tuple[Callable[[Path], Path | None], str]] = {
    "path that isn't there": (lambda folder: folder / "none", r"none: no such file or folder"),
    "empty folder": (lambda folder: folder, r"holds no meshes \(it has no files\).* obj, ply"),
    "unknown extensions only": (unknown_extensions, r"holds no meshes \(only \.fbx, \.md\).* obj, ply"),
    "two shapes": (written(SHAPES[:2]), r"has 2 shapes; at least 3"),
    "two collections in one folder": (two_collections, r"has 2 shapes; at least 3.*one NPZ .* name that file"),
    "one file": (lambda folder: write(folder) / "pose1.obj", r"pose1\.obj: .*name the folder"),
    "one name twice": (bad_file("pose10.ply", b""), r"pose10\.ply: pose10\.obj has the same name"),
    "GLB cut short": (bad_file("pose2.glb", GLB[:-40]), r"pose2\.glb: not a readable glb file"),
    "STL cut short": (bad_file("pose2.stl", STL[:-30]), r"pose2\.stl: not a readable stl file: damaged"),
    "PLY that is none": (bad_file("pose2.ply", b"hello"), r"pose2\.ply: not a readable ply file"),
    "glTF that is none": (bad_file("pose2.gltf", b"{"), r"pose2\.gltf: not a readable gltf file: Expecting"),
    "glTF without its buffer": (
        bad_file(
            "pose2.gltf",
            b'{"asset": {"version": "2.0"}, "meshes": [], "buffers": [{"byteLength": 4, "uri": "pose2.bin"}]}',
        ),
        r"pose2\.gltf: not a readable gltf file: it needs pose2\.bin, which is not beside it",
    ),
    "empty OBJ": (bad_file("pose2.obj", b""), r"pose2\.obj: has no faces"),
    "OBJ without faces": (bad_file("pose2.obj", b"v 0 0 0\n" * 42), r"pose2\.obj: has no faces"),
    "OBJ with letters": (bad_file("pose2.obj", b"v 0 zero 0\n"), r"pose2\.obj: not a readable obj file"),
    "OBJ that names a vertex too many": (
        bad_file("pose2.obj", encoded(SHAPES[1], FACES, "obj") + b"f 1 2 43\n"),
        r"pose2\.obj: faces name vertices 1 to 43, but there are 42 vertices \(counted from 1\)",
    ),
    "dangling link": (
        lambda folder: (write(folder) / "pose3.obj").symlink_to("gone.obj"),
        r"pose3\.obj: can't be read: there is no such file",
    ),
    "pickle": (bad_file("pose2.npz", b"\x80\x04]\x94."), r"pose2\.npz: not a readable npz file"),
    "NaN in text": (written(moved(1, 7, [0, np.nan, 0])), r"vertex 8 has a coord.* not finite \(counted from 1"),
    "infinity in STL": (
        bad_file("pose2.stl", STL[:96] + np.float32(np.inf).tobytes() + STL[100:]),
        r"pose2\.stl: vertex 0 has a coordinate that is not finite",
    ),
    "another vertex": (
        with_other("pose2.obj", np.concatenate([SHAPES[1], [[0, 0, 0]]]), FACES),
        r"pose2\.obj: has 43 vertices and 80 faces, but pose1\.obj has 42 and 80",
    ),
    "a face less": (
        with_other("pose10.stl", SHAPES[2], FACES[:-1]),
        r"pose10\.stl: has 237 vertices and 79 faces, but pose1\.stl has 240 and 80",
    ),
    "other faces": (
        with_other("pose2.obj", SHAPES[1], SWAPPED),
        rf"pose2\.obj: face 1 joins vertices .*, but in pose1\.obj \({A + 1}, {B + 1}, {C + 1}\)",
    ),
    "STL in another order": (
        with_other("pose2.stl", SHAPES[1], FACES[np.random.default_rng(0).permutation(len(FACES))]),
        r"pose2\.stl: its triangles don't meet where those of .*pose1\.stl do",
    ),
    "STL in another order beside OBJ": (
        bad_file("pose2.stl", encoded(SHAPES[1], SWAPPED, "stl")),
        r"pose2\.stl: face \d+ is not where it is in pose1\.obj",
    ),
    "STL of fewer faces beside OBJ": (
        bad_file("pose2.stl", encoded(SHAPES[1], FACES[:-1], "stl")),
        r"pose2\.stl: has 79 faces, but pose1\.obj has 80",
    ),
    "three faces at an edge, numbered as in the file": (
        third_face(seam=False),
        rf"pose1\.obj: edge \({min(A, B) + 3}, {max(A, B) + 3}\) has 3 faces",
    ),
    "three faces at a seam, numbered as in the file": (
        third_face(seam=True),
        rf"pose1\.obj: edge \({min(A, B) + 3}, {max(A, B) + 3}\) has 3 faces",
    ),
    "three faces at an edge of STL": (
        lambda folder: write(
            folder,
            np.concatenate([SHAPES, np.full((3, 1, 3), 9.0)], axis=1),
            np.concatenate([FACES, [[A, B, 42]]]),
            ["stl"] * 3,
        ),
        r"pose1\.stl: edge \(\d+, \d+\) has 3 faces",
    ),
    "one face turned over": (written(faces=TURNED), r"pose1\.obj: the two faces at edge \(\d+, \d+\) are oriented opp"),
    "face without area": (
        written(moved(1, A, SHAPES[1, B]), formats=["npz"] * 3),
        r"pose2\.npz: face 0 has no area .*counted from 0",
    ),
    "face that names a vertex twice": (ball_and([], [[A, B, B]]), r"pose1\.obj: face 81 names the same vertex twice"),
    "edge of no length in every shape": (
        bad_npz(vertices=NEARLY_ONE),
        r"shape 0: face \d+ has no area: in every shape",
    ),
    "one shape at several places": (
        written(SHAPES[[0, 0, 0]] @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]] + [[[0, 0, 0]], [[3, 0, 0]], [[0, 0.5, 7]]]),
        r"all 3 shapes are the same, apart from position",
    ),
    "a mirror image": (
        written(SHAPES * [[[1, 1, 1]], [[1, -1, 1]], [[1, 1, 1]]]),
        r"pose2\.obj: is inside out, like a mirror image, compared with .*pose1\.obj",
    ),
    "NPZ of a collection among others": (
        lambda folder: bad_npz()(write(folder)).parent,
        r"poses\.npz: vertices are of shape \(3, 42, 3\); if this NPZ .* name the file",
    ),
    "NPZ without faces": (bad_npz(faces=None, triangles=FACES), r"holds no array 'faces', only triangles, vertices"),
    "NPZ of one shape": (bad_npz(vertices=SHAPES[0]), r"poses\.npz: vertices must be an \(n, V, 3\) array"),
    "NPZ of two shapes": (bad_npz(vertices=SHAPES[:2]), r"poses\.npz: has 2 shapes; at least 3"),
    "NPZ of no shapes": (bad_npz(vertices=np.zeros((0, 0, 3))), r"poses\.npz: has 0 shapes; at least 3"),
    "NPZ of letters": (bad_npz(vertices=np.full((3, 42, 3), "a")), r"vertices must be a \(V, 3\) array of numbers"),
    "NPZ with fractional faces": (bad_npz(faces=FACES + 0.5), r"faces must be an \(F, 3\) array of vertex indices"),
    "NPZ with quads": (bad_npz(faces=np.zeros((4, 4), dtype=int)), r"faces must be an \(F, 3\) array .*\(4, 4\)"),
    "NPZ with NaN": (bad_npz(vertices=moved(2, 5, np.nan)), r"poses\.npz: shape 2: vertex 5 .* not finite"),
    "NPZ with objects": (bad_npz(names=np.array([{}, {}, {}])), r"poses\.npz: not a readable npz file: .*pickled"),
    "NPZ with a name twice": (bad_npz(names=np.array(["a", "b", "a"])), r"poses\.npz: two shapes are called a"),
    "NPZ with a name too few": (bad_npz(names=np.array(["a", "b"])), r"poses\.npz: names must be \(3,\) strings"),
}  # fmt: skip


@pytest.mark.parametrize("fault", REFUSALS)
def test_bad_input_is_refused_in_one_line(fault: str, tmp_path: Path) -> None:
    build, says = REFUSALS[fault]
    folder = tmp_path / "meshes"
    folder.mkdir()
    path = build(folder) or folder
    with pytest.raises(IngestError, match=says) as refusal:
        read_collection(path)
    assert str(refusal.value).startswith(str(path))
    assert "\n" not in str(refusal.value)


def test_the_content_of_a_file_decides_its_format(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(1)
    for k in range(3):
        (tmp_path / f"{k}.obj").write_bytes(MESH_FORMATS["ply"].encode(mesh.vertices * [1, 1 + k, 1], mesh.faces))
    found = read_collection(tmp_path)
    assert found.vertices.shape == (3, *mesh.vertices.shape)
    (tmp_path / "2.obj").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")
    with pytest.raises(IngestError, match=r"2.obj: is a PNG picture; these can be read: .*vtp$"):
        read_collection(tmp_path)
