"""Reading glTF as specified: known answers, comparison with other readers, and what is refused."""

import base64
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from shapespace.files.animated_gltf import animated_glb
from shapespace.files.limits import Limits
from shapespace.files.reading import read_arrays
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.training.collection.generators import freaky_torus
from tests.gltf_documents import BINARY, FACES, MATRIX, VERTICES, chain, document, doubling, glb, graph, ring

POINTS = VERTICES.astype(np.float64)


def read(tree: dict[str, Any], data: bytes = BINARY) -> tuple[np.ndarray, np.ndarray]:
    return read_arrays(glb(tree, data), "glb")


def placed(**node: Any) -> np.ndarray:
    return read(document(nodes=[{"mesh": 0, **node}]))[0]


def primitive(mode: int | None, indices: list[int] | None, count: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces read from a primitive of six vertices in a row, with one-byte indices or none."""
    data = np.arange(3 * count, dtype="<f4").tobytes()
    part: dict[str, Any] = {"attributes": {"POSITION": 0}} | ({} if mode is None else {"mode": mode})
    views = [{"buffer": 0, "byteLength": len(data)}]
    accessors = [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": count}]
    if indices is not None:
        part["indices"] = 1
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(indices)})
        accessors.append({"bufferView": 1, "componentType": 5121, "type": "SCALAR", "count": len(indices)})
        data += bytes(indices)
    tree = document(
        buffers=[{"byteLength": len(data)}], bufferViews=views, accessors=accessors, meshes=[{"primitives": [part]}]
    )
    return read(tree, data + bytes(-len(data) % 4))


def numbered(numbers: list[float], kind: int = 5126) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles read from six vertices with `_VERTEX` numbers, the last three where the first are."""
    places = np.tile(np.arange(9, dtype="<f4").reshape(3, 3), (2, 1)).tobytes()
    given = np.array(numbers, {5126: "<f4", 5121: "u1"}[kind]).tobytes()
    tree = document(
        buffers=[{"byteLength": len(places + given)}],
        bufferViews=[
            {"buffer": 0, "byteLength": len(places)},
            {"buffer": 0, "byteOffset": len(places), "byteLength": len(given)},
        ],
        accessors=[
            {"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 6},
            {"bufferView": 1, "componentType": kind, "type": "SCALAR", "count": len(numbers)},
        ],
        meshes=[{"primitives": [{"attributes": {"POSITION": 0, "_VERTEX": 1}}]}],
    )
    return read(tree, places + given + bytes(-len(given) % 4))


@pytest.mark.parametrize("kind", [5126, 5121])
def test_vertices_of_one_number_are_one(kind: int) -> None:
    vertices, faces = numbered([2, 0, 1, 2, 0, 1], kind)
    np.testing.assert_array_equal(vertices, [[3, 4, 5], [6, 7, 8], [0, 1, 2]])
    np.testing.assert_array_equal(faces, [[2, 0, 1], [2, 0, 1]])


@pytest.mark.parametrize(
    ("numbers", "says"),
    [
        ([0, 1, 2, 0, 1, 6], "number no vertex"),
        ([0, 1, 2, 0, 1, -1], "number no vertex"),
        ([0, 1, 2, 0, 1, 1.5], "number no vertex"),
        ([0, 1, 2, 0, 1, np.nan], "number no vertex"),
        ([0, 1, 3, 0, 1, 3], "leaves out the number 2"),
        ([0, 1, 2, 0, 1, 1], "one number to vertices at different positions"),
        ([0, 1, 2], "numbers 3 of 6 vertices"),
    ],
)
def test_numbers_of_vertices_that_can_t_be_are_refused(numbers: list[float], says: str) -> None:
    with pytest.raises(MeshError, match=says):
        numbered(numbers)


def test_an_animation_is_read_at_rest() -> None:
    codes = np.linspace([0, 0, 1, 1], [0.5, 0.3, 1.1, 1], 5)
    frames, faces = freaky_torus.vertices(codes), freaky_torus.connectivity().faces
    vertices, found = read_arrays(animated_glb(frames, faces).data, "glb")
    np.testing.assert_allclose(vertices, frames[0], atol=1e-6)
    assert np.array_equal(found, faces)


def test_matrices_stand_column_by_column() -> None:
    turned = np.array(MATRIX, float).reshape(4, 4).T
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 2]]
    turned[:3, 3] = [5, 6, 7]
    found = placed(matrix=turned.T.ravel().tolist())
    np.testing.assert_array_equal(found, [[5, 6, 7], [5, 7, 7], [4, 6, 7], [5, 6, 9]])


def test_scale_then_rotation_then_translation() -> None:
    q = [0, 0, np.sqrt(0.5), np.sqrt(0.5)]  # a quarter turn about z
    found = placed(scale=[2, 3, 4], rotation=q, translation=[10, 20, 30])
    np.testing.assert_allclose(found, [[10, 20, 30], [10, 22, 30], [7, 20, 30], [10, 20, 34]], atol=1e-14)


@pytest.mark.parametrize("length", [1, 0.3, 7])
def test_rotations_are_those_of_scipy_whatever_the_length_of_their_quaternions(length: float) -> None:
    turn = Rotation.random(rng=np.random.default_rng(3))
    found = placed(rotation=(length * turn.as_quat()).tolist())
    np.testing.assert_allclose(found, turn.apply(POINTS), atol=1e-14)


def test_places_are_those_inside_all_the_nodes_above() -> None:
    nodes = [
        {"children": [1, 2], "translation": [1, 0, 0]},
        {"children": [3], "scale": [2, 2, 2]},
        {"name": "empty"},
        {"mesh": 0, "translation": [0, 1, 0]},
    ]
    vertices, _ = read(document(nodes=nodes))
    np.testing.assert_array_equal(vertices, 2 * (POINTS + np.array([0, 1, 0])) + [1, 0, 0])


def test_what_is_mirrored_keeps_its_outside() -> None:
    mirrored, faces = read(document(nodes=[{"mesh": 0, "scale": [-1, 1, 1]}]))
    np.testing.assert_array_equal(mirrored, POINTS * [-1, 1, 1])
    assert np.array_equal(faces, FACES[:, ::-1])
    _, faces = read(document(nodes=[{"mesh": 0, "scale": [-1, -1, 1]}]))
    assert np.array_equal(faces, FACES)


def test_meshes_are_in_the_order_of_their_nodes() -> None:
    nodes = [{"children": [2, 1]}, {"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}, {"mesh": 0, "scale": [2, 2, 2]}]
    vertices, faces = read(document(nodes=nodes, scenes=[{"nodes": [0, 3]}]))
    np.testing.assert_array_equal(vertices, np.concatenate([POINTS + np.array([3, 0, 0]), POINTS, 2 * POINTS]))
    assert np.array_equal(faces, np.concatenate([FACES, FACES + 4, FACES + 8]))


def test_points_and_lines_are_left_out() -> None:
    part = {"attributes": {"POSITION": 0}, "indices": 1}
    parts = [{"attributes": {"POSITION": 0}, "mode": 0}, part, {"attributes": {}, "mode": 3}]
    vertices, faces = read(document(meshes=[{"primitives": parts}]))
    np.testing.assert_array_equal(vertices, POINTS)
    assert np.array_equal(faces, FACES)


def test_only_the_default_scene_counts() -> None:
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [9, 9, 9]}, {"mesh": 1}]
    meshes = document()["meshes"]
    tree = document(nodes=nodes, meshes=[*meshes, *meshes], scenes=[{"nodes": [1, 2]}, {"nodes": [0]}], scene=1)  # type: ignore[misc]
    np.testing.assert_array_equal(read(tree)[0], POINTS)
    # All meshes of a scene are one mesh of several parts.
    vertices, faces = read(tree | {"scene": 0})
    np.testing.assert_array_equal(vertices, np.concatenate([POINTS + 9, POINTS]))
    assert len(faces) == 2 * len(read(tree)[1])


def test_without_scenes_every_node_counts_and_without_nodes_the_mesh() -> None:
    for more in ({"nodes": [{"children": [1]}, {"mesh": 0}]}, {"nodes": []}):
        tree = document(**more)
        del tree["scenes"], tree["scene"]
        np.testing.assert_array_equal(read(tree)[0], POINTS)


@pytest.mark.parametrize(
    ("mode", "indices", "faces"),
    [
        (None, None, [[0, 1, 2], [3, 4, 5]]),
        (4, [5, 4, 3], [[5, 4, 3]]),
        (5, None, [[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]]),
        (5, [0, 1, 2, 2, 3, 4, 5], [[0, 1, 2], [3, 2, 4], [3, 4, 5]]),
        (6, None, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]),
        (6, [5, 0, 1, 2], [[5, 0, 1], [5, 1, 2]]),
    ],
)
def test_triangles_strips_and_fans(mode: int | None, indices: list[int] | None, faces: list[list[int]]) -> None:
    vertices, found = primitive(mode, indices)
    np.testing.assert_array_equal(vertices, np.arange(18).reshape(6, 3))
    # Faces are equal up to cyclic permutation of their corners.
    assert [min(f[k:] + f[:k] for k in range(3)) for f in found.tolist()] == [
        min(f[k:] + f[:k] for k in range(3)) for f in faces
    ]


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "f4"])
@pytest.mark.parametrize("normalized", [False, True])
def test_components_of_every_kind_as_they_are_and_normalised(kind: str, normalized: bool) -> None:
    number = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}[kind]
    if kind == "f4":
        given = np.array([[0.1, -2, 3e9]] * 3, "<f4")
        expected = given.astype(float)
    else:
        info = np.iinfo(kind)
        given = np.array([[info.min, info.max, 1], [0, 2, 3], [4, 5, info.max // 2]], f"<{kind}")
        expected = np.maximum(given / info.max, -1) if normalized else given.astype(float)
    for stride in (3 * given.itemsize, 16):  # contiguous, and interleaved with other data
        row = np.dtype({"names": ["p"], "formats": [(given.dtype, 3)], "offsets": [0], "itemsize": stride})
        table = np.zeros(3, row)
        table["p"] = given
        data = b"head" + b"\x07" * 8 + table.tobytes() + bytes(-table.nbytes % 4)
        tree = document(
            buffers=[{"byteLength": len(data)}],
            bufferViews=[{"buffer": 0, "byteOffset": 4, "byteLength": len(data) - 4, "byteStride": stride}],
            accessors=[
                {
                    "bufferView": 0,
                    "byteOffset": 8,
                    "componentType": number,
                    "normalized": normalized,
                    "type": "VEC3",
                    "count": 3,
                }
            ],
            meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}],
            extensionsRequired=["KHR_mesh_quantization"],
        )
        vertices, faces = read(tree, data)
        np.testing.assert_array_equal(vertices, expected)
        assert faces.tolist() == [[0, 1, 2]]


def test_data_in_text_are_decoded_from_where_they_are_needed() -> None:
    for before in range(7):
        data = bytes(range(before)) + BINARY + b"behind"
        views = [
            {"buffer": 1, "byteOffset": before, "byteLength": VERTICES.nbytes},
            {"buffer": 1, "byteOffset": before + VERTICES.nbytes, "byteLength": FACES.nbytes},
        ]
        uris = [f"data:;base64,{base64.b64encode(b).decode()}" for b in (b"something else", data)]
        tree = document(
            bufferViews=views,
            buffers=[{"byteLength": 14, "uri": uris[0]}, {"byteLength": len(data), "uri": uris[1]}],
            images=[{"uri": "data:image/png;base64,AAAA"}],
        )
        for text in (json.dumps(tree), json.dumps(tree, indent=4), json.dumps(tree).replace("/", "\\/")):
            vertices, faces = read_arrays(text.encode(), "gltf")
            np.testing.assert_array_equal(vertices, POINTS)
            assert np.array_equal(faces, FACES)


def test_buffers_beside_a_file_and_nowhere_else(tmp_path: Path) -> None:
    (tmp_path / "meshes" / "data").mkdir(parents=True)
    for name in ("meshes/data/a b.bin", "outside.bin"):
        (tmp_path / name).write_bytes(BINARY)
    path = tmp_path / "meshes" / "shape.gltf"

    def from_uri(uri: str) -> np.ndarray:
        tree = document(buffers=[{"byteLength": len(BINARY), "uri": uri}])
        path.write_text(json.dumps(tree))
        return read_arrays(path)[0]

    np.testing.assert_array_equal(from_uri("data/a%20b.bin"), POINTS)
    for uri in (
        "../outside.bin",
        "%2e%2e/outside.bin",
        str(tmp_path / "outside.bin"),
        "file:///etc/passwd",
        "data",
        "",
    ):
        with pytest.raises(MeshError, match="which is not beside it"):
            from_uri(uri)
    (tmp_path / "meshes/data/a b.bin").write_bytes(BINARY[:-1])
    with pytest.raises(MeshError, match="ends before"):
        from_uri("data/a%20b.bin")


def accessor(index: int = 0, **more: Any) -> dict[str, Any]:
    """A document with changed members in the accessor of its positions (0) or indices (1)."""
    given: Any = document()["accessors"]
    given[index] |= more
    return document(accessors=given)


def view(**more: Any) -> dict[str, Any]:
    given: Any = document()["bufferViews"]
    return document(bufferViews=[given[0] | more, given[1]])


def primitive_with(**more: Any) -> dict[str, Any]:
    return document(meshes=[{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, **more}]}])


HOLLOW = {"componentType": 5126, "type": "VEC3", "count": 4}
SPARSE = {"count": 1, "indices": {"bufferView": 1, "componentType": 5125}, "values": {"bufferView": 0}}
REFUSED: dict[str, tuple[bytes | dict[str, Any], str]] = {
    "101 nodes deep": (chain(101), "more than 100 deep"),
    "a chain of 3000 with matrices": (chain(3000), "more than 100 deep"),
    "doubling nodes": (doubling(30), "lies in two others"),
    "a ring": (ring(), "lies in another one"),
    "a graph": (graph(200), "lies in two others"),
    "a node in itself": (document(nodes=[{"mesh": 0, "children": [0]}]), "lies in another one"),
    "a root twice": (document(scenes=[{"nodes": [0, 0]}]), "is there twice"),
    "a child twice": (document(nodes=[{"children": [1, 1]}, {"mesh": 0}]), "lies in two others"),
    "sparse beyond": (accessor(sparse=SPARSE | {"count": 20}), "sparse accessor 0 has 20 elements"),
    "sparse without a view": (accessor(sparse={"count": 1, "indices": {}, "values": {}}), "not a readable glb"),
    "no data": (document(accessors=[HOLLOW] * 2), "accessor 0 has no data"),
    "Draco": (document(extensionsRequired=["KHR_draco_mesh_compression"]), "KHR_draco_mesh_compression, which"),
    "several": (document(extensionsRequired=["KHR_materials_unlit", "A", "B"]), "requires A, B, which can't be read"),
    "lines": (primitive_with(mode=1), "only points or lines"),
    "an unknown mode": (primitive_with(mode=7), "an unknown mode"),
    "indices beyond": (accessor(count=3), "vertices 0 to 3, but there are 3"),
    "two corners": (accessor(1, count=2), "2 corners make no triangles"),
    "more than the view has": (accessor(count=5), "not enough data"),
    "beyond the view": (accessor(byteOffset=4), "not enough data"),
    "beyond the buffer": (view(byteOffset=56), "not enough data"),
    "a stride too short": (view(byteStride=8), "8 bytes apart"),
    "a stride too long": (view(byteStride=256), "256 bytes apart"),
    "no elements": (accessor(count=0), "has 0 elements"),
    "a negative count": (accessor(count=-1), "stands where a whole number from 0 should"),
    "half a count": (accessor(count=1.5), "stands where a whole number from 0 should"),
    "no such mesh": (document(meshes=[]), "refers to entry 0 of a list that has 0"),
    "no such accessor": (primitive_with(indices=7), "refers to entry 7 of a list that has 2, counted from 0"),
    "no such node": (document(scene=1), "refers to entry 1 of a list that has 1"),
    "a negative index": (document(scenes=[{"nodes": [-1]}]), "something else stands where"),
    "wide positions": (accessor(componentType=5125), "a wrong type"),
    "flat positions": (accessor(type="VEC2"), "a wrong type"),
    "a projection": (document(nodes=[{"mesh": 0, "matrix": [1, 0, 0, 0.5, *MATRIX[4:]]}]), "the last row of a matrix"),
    "fifteen numbers": (document(nodes=[{"mesh": 0, "matrix": MATRIX[1:]}]), "16 numbers are needed"),
    "glTF 1": (document(asset={"version": "1.0"}), "another version of glTF, but only version 2"),
    "no mesh": (document(nodes=[{"name": "camera"}]), "holds no mesh"),
    "many places": (document(nodes=[{"mesh": 0}] * 1001, scenes=[{"nodes": [*range(1001)]}]), "more than 1000 parts"),
    "GLB 1": (b"glTF\1\0\0\0" + glb(document(), BINARY)[8:], "it has GLB version 1, but only version 2"),
    "cut short": (glb(document(), BINARY)[:-40], "but has"),
    "no JSON": (b"glTF" + bytes(100), "damaged"),
    "a list": (glb([1, 2]), "not an object"),
}  # fmt: skip


@pytest.mark.parametrize("fault", REFUSED)
def test_what_is_refused_and_why(fault: str) -> None:
    given, says = REFUSED[fault]
    data = given if isinstance(given, bytes) else glb(given, BINARY)
    with pytest.raises(MeshError) as refusal:
        read_arrays(data, "glb")
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert len(str(refusal.value)) < 300


def test_a_hundred_nodes_are_not_too_deep() -> None:
    vertices, _ = read_arrays(chain(100), "glb")
    np.testing.assert_array_equal(vertices, POINTS + np.array([99, 0, 0]))


def test_limits_end_reading() -> None:
    data = glb(document(nodes=[{"children": [1, 2]}, {"mesh": 0}, {"mesh": 0}]), BINARY)
    assert len(read_arrays(data, "glb", Limits(8, 8))[0]) == 8
    with pytest.raises(MeshError, match="more than 7 vertices"):
        read_arrays(data, "glb", Limits(7, 8))
    with pytest.raises(MeshError, match="more than 7 faces"):
        read_arrays(data, "glb", Limits(8, 7))


@pytest.mark.parametrize("format", ["glb", "gltf"])
def test_what_trimesh_writes(format: str) -> None:
    rng = np.random.default_rng(0)
    mesh = trimesh.creation.icosphere(2)
    mesh.vertices += 0.1 * rng.normal(size=mesh.vertices.shape)
    pose = trimesh.transformations.compose_matrix(scale=[1, 2, 3], angles=[0.3, 1, 2], translate=[4, 5, 6])
    scene = trimesh.Scene()
    scene.add_geometry(mesh, transform=pose)
    written = scene.export(file_type=format)
    if format == "gltf":
        tree = json.loads(written.pop("model.gltf"))
        for buffer in tree["buffers"]:
            buffer["uri"] = "data:;base64," + base64.b64encode(written[buffer["uri"]]).decode()
        written = json.dumps(tree).encode()
    vertices, faces = read_arrays(written, format)
    np.testing.assert_allclose(vertices, trimesh.transform_points(mesh.vertices, pose), rtol=1e-6, atol=1e-6)
    assert np.array_equal(faces, mesh.faces)


NUMBERS = st.floats(-2, 2, width=32).map(lambda x: round(x, 3))
TRANSFORMATIONS = st.fixed_dictionaries(
    {},
    optional={
        "translation": st.lists(NUMBERS, min_size=3, max_size=3),
        "rotation": st.sampled_from([[0, 0, 0, 1], [0.6, 0, 0, 0.8], [0.5, 0.5, 0.5, 0.5]]),
        "scale": st.lists(st.sampled_from([-1, 0.5, 1, 3]), min_size=3, max_size=3),
    },
)


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(st.lists(st.tuples(st.integers(0, 9), TRANSFORMATIONS, st.booleans()), min_size=1, max_size=10))
def test_trees_as_trimesh_reads_them(given_nodes: list[tuple[int, dict[str, Any], bool]]) -> None:
    """Each node is a child of one before it, and some have the mesh, which has two materials.

    Trimesh has another order of nodes.
    """
    nodes: list[dict[str, Any]] = []
    for k, (parent, transformation, has_mesh) in enumerate(given_nodes):
        nodes.append(transformation | ({"mesh": 0} if has_mesh or k == len(given_nodes) - 1 else {}))
        if k:
            nodes[parent % k].setdefault("children", []).append(k)
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * 2}]
    data = glb(document(nodes=nodes, meshes=meshes), BINARY)
    theirs = trimesh.load_scene(io.BytesIO(data), file_type="glb", process=False).to_mesh()
    vertices, faces = read_arrays(data, "glb")
    assert len(vertices) == len(theirs.vertices)
    triangles, expected = vertices[faces].reshape(-1, 9), theirs.vertices[theirs.faces].reshape(-1, 9)
    away = np.abs(triangles[:, None] - expected).max(axis=2)
    assert len(triangles) == len(expected)
    assert max(away.min(axis=0).max(), away.min(axis=1).max()) < 1e-5
