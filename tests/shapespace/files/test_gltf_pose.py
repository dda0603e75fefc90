"""glTF files that pose their mesh: morph weights, skins and nodes, as three.js shows them."""

from __future__ import annotations

import json
import struct
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.files.reading import read_arrays
from shapespace.mesh.triangle_mesh import MeshError

POSES = Path(__file__).parents[2] / "clients" / "poses.mjs"
RNG = np.random.default_rng(5)
COUNT = 24
REST = RNG.uniform(-1, 1, (COUNT, 3)).astype(np.float32)
FACES = np.arange(COUNT, dtype=np.uint16).reshape(-1, 3)
TARGETS = RNG.uniform(-0.5, 0.5, (2, COUNT, 3)).astype(np.float32)
TURN = [0.0, 0.0, np.sin(0.4), np.cos(0.4)]
TYPES = {np.dtype(np.float32): 5126, np.dtype(np.uint8): 5121, np.dtype(np.uint16): 5123}


class File:
    """A GLB file under construction: one triangle mesh, whose entries a test changes."""

    def __init__(self) -> None:
        self.data = b""
        self.tree: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": [], "scene": 0}
        self.primitive = {"attributes": {"POSITION": self.array(REST)}, "indices": self.array(FACES.reshape(-1, 1))}
        self.mesh: dict[str, Any] = {"primitives": [self.primitive]}
        self.tree |= {"meshes": [self.mesh], "nodes": [{"mesh": 0}], "scenes": [{"nodes": [0]}]}

    def view(self, values: np.ndarray) -> int:
        self.data += bytes(-len(self.data) % 4)
        self.tree["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes})
        self.data += np.ascontiguousarray(values).tobytes()
        return len(self.tree["bufferViews"]) - 1

    def array(self, values: np.ndarray, **members: object) -> int:
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[values.shape[1]]
        entry = {"bufferView": self.view(values), "componentType": TYPES[values.dtype], "count": len(values)}
        bounds = {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.tree["accessors"].append({**entry, "type": kind, **bounds, **members})
        return len(self.tree["accessors"]) - 1

    def morphs(self, weights: list[float]) -> None:
        self.primitive["targets"] = [{"POSITION": self.array(target)} for target in TARGETS]
        self.mesh["weights"] = weights

    def sparse_morph(self, weight: float) -> None:
        """A target that moves three vertices, which are all that the file holds of it."""
        indices, moves = np.array([[2], [5], [11]], np.uint16), TARGETS[0, :3]
        entry = {"componentType": 5126, "count": COUNT, "type": "VEC3", "min": [-1, -1, -1], "max": [1, 1, 1]}
        parts = {"indices": {"bufferView": self.view(indices), "componentType": 5123}}
        entry["sparse"] = {"count": 3, **parts, "values": {"bufferView": self.view(moves)}}
        self.tree["accessors"].append(entry)
        self.primitive["targets"] = [{"POSITION": len(self.tree["accessors"]) - 1}]
        self.mesh["weights"] = [weight]

    def skin(self, *, sets: int = 1, weights: np.ndarray | None = None, bind: bool = True, **mesh_node: object) -> None:
        """Two joints in a chain, of which the second is turned and shifted from where it was bound."""
        if weights is None:
            weights = RNG.dirichlet(np.ones(4 * sets), COUNT).astype(np.float32)
        for k in range(sets):
            joints = RNG.integers(0, 2, (COUNT, 4)).astype(np.uint8)
            some = weights[:, 4 * k : 4 * k + 4]
            members = {} if some.dtype == np.float32 else {"normalized": True}
            attributes = {f"JOINTS_{k}": self.array(joints), f"WEIGHTS_{k}": self.array(some, **members)}
            self.primitive["attributes"] |= attributes
        self.tree["nodes"] = [
            {"mesh": 0, "skin": 0, **mesh_node},
            {"children": [2], "translation": [0.1, 0.2, 0.3]},
            {"translation": [0, 0.5, 0], "rotation": TURN},
        ]
        self.tree["scenes"] = [{"nodes": [0, 1]}]
        self.tree["skins"] = [{"joints": [1, 2]}]
        if bind:
            inverse = np.tile(np.eye(4, dtype=np.float32), (2, 1, 1))
            inverse[:, 3, :3] = [[-0.1, -0.2, -0.3], [-0.1, -0.7, -0.3]]
            self.tree["skins"][0]["inverseBindMatrices"] = self.array(inverse.reshape(2, 16))

    def bytes(self) -> bytes:
        self.tree["buffers"] = [{"byteLength": len(self.data)}]
        text = json.dumps(self.tree).encode()
        text += b" " * (-len(text) % 4)
        data = self.data + bytes(-len(self.data) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _node_weights(file: File) -> None:
    file.morphs([1.0, 0.0])
    file.tree["nodes"][0]["weights"] = [0.0, 0.7]


def _unnormalised(file: File) -> None:
    file.skin(weights=RNG.uniform(0, 2, (COUNT, 4)).astype(np.float32))


def _bytes_as_weights(file: File) -> None:
    weights = np.zeros((COUNT, 4), np.uint8)
    weights[:, 0] = RNG.integers(1, 255, COUNT)
    weights[:, 1] = 255 - weights[:, 0]
    file.skin(weights=weights)


def _morph_under_skin(file: File) -> None:
    file.morphs([0.5, -0.25])
    file.skin()


def _nested(file: File) -> None:
    file.morphs([0.3, 0.0])
    file.tree["nodes"] = [
        {"children": [1], "scale": [2, 1, 0.5], "rotation": TURN},
        {"mesh": 0, "translation": [1, 2, 3]},
    ]


FILES: dict[str, Callable[[File], None]] = {
    "at rest": lambda _: None,
    "weights of the mesh": lambda file: file.morphs([1.0, 0.25]),
    "weights of the node": _node_weights,
    "weights of zero": lambda file: file.morphs([0.0, 0.0]),
    "a sparse target": lambda file: file.sparse_morph(0.8),
    "a target below nodes": _nested,
    "a skin": lambda file: file.skin(),
    "a skin whose node is scaled": lambda file: file.skin(scale=[0.01, 0.01, 0.01], translation=[5, 5, 5]),
    "a skin without bind matrices": lambda file: file.skin(bind=False),
    "weights that do not sum to one": _unnormalised,
    "weights as bytes": _bytes_as_weights,
    "a target under a skin": _morph_under_skin,
}


def made(change: Callable[[File], None]) -> bytes:
    file = File()
    change(file)
    return file.bytes()


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Vertices of each file as they are read here, and as three.js shows them."""
    folder = tmp_path_factory.mktemp("poses")
    paths = {name: folder / f"{k}.glb" for k, name in enumerate(FILES)}
    for name, path in paths.items():
        path.write_bytes(made(FILES[name]))
    done = subprocess.run(["node", POSES, *paths.values()], capture_output=True, text=True, check=True)
    shown = json.loads(done.stdout)
    return {name: (read_arrays(path)[0], np.array(shown[str(path)])) for name, path in paths.items()}


@pytest.mark.parametrize("name", FILES)
def test_vertices_are_where_three_js_shows_them(name: str, seen: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    ours, theirs = seen[name]
    np.testing.assert_allclose(ours, theirs, atol=2e-6)
    assert (name in ("at rest", "weights of zero")) == np.allclose(ours, REST)


def test_a_second_set_of_joints_counts() -> None:
    """Three.js ignores all but the first set. Here two sets that share the weights of one give the same shape."""
    one, two = File(), File()
    joints = RNG.integers(0, 2, (COUNT, 4)).astype(np.uint8)
    weights = RNG.dirichlet(np.ones(4), COUNT).astype(np.float32)
    for file, split in ((one, False), (two, True)):
        file.skin()
        first = weights * ([1, 1, 0, 0] if split else [1, 1, 1, 1])
        sets = [first, weights - first] if split else [first]
        for k, some in enumerate(sets):
            attributes = {f"JOINTS_{k}": file.array(joints), f"WEIGHTS_{k}": file.array(some.astype(np.float32))}
            file.primitive["attributes"] |= attributes
    shapes = [read_arrays(file.bytes(), "glb")[0] for file in (one, two)]
    np.testing.assert_allclose(*shapes, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda file: file.tree["skins"][0].update(joints=[1, 7]), "not a node of the scene"),
        (lambda file: file.tree["scenes"][0].update(nodes=[0]), "not a node of the scene"),
        (lambda file: file.tree["skins"][0].update(joints=[1]), "names joint 1"),
        (lambda file: file.tree["nodes"][0].update(skin=3), "not a readable glb file"),
    ],
)
def test_damaged_skins_are_refused(change: Callable[[File], None], says: str) -> None:
    file = File()
    file.skin()
    change(file)
    with pytest.raises(MeshError, match=says):
        read_arrays(file.bytes(), "glb")
