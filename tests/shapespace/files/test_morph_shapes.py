"""One glTF file whose morph targets are shapes: each is what the file shows with the weight of that target alone."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from shapespace.files.reading import read_arrays, read_morph_file
from shapespace.mesh.triangle_mesh import MeshError
from tests.shapespace.files.test_gltf_pose import COUNT, FACES, REST, TARGETS, TURN, TYPES, File

TYPES |= {np.dtype(np.int16): 5122}


def names(file: File, *given: object) -> None:
    file.mesh["extras"] = {"targetNames": [*given]}


def two(file: File) -> None:
    file.morphs([0.25, 0.5])
    names(file, "smile", "frown")


def no_names(file: File) -> None:
    file.morphs([])


def some_names(file: File) -> None:
    file.morphs([])
    names(file, None, "base")


def sparse(file: File) -> None:
    file.sparse_morph(1)
    names(file, "smile", "more names than targets")


def several_primitives(file: File) -> None:
    two(file)
    again = {"attributes": {"POSITION": file.array(REST + 3)}, "indices": file.primitive["indices"]}
    again["targets"] = [{"NORMAL": file.array(TARGETS[0])}, {"POSITION": file.array(TARGETS[1])}]
    file.mesh["primitives"].append(again)


def numbered_materials(file: File) -> None:
    """Two primitives that share numbered vertices, of which the second has no targets of its own to move them."""
    two(file)
    file.primitive["attributes"]["_VERTEX"] = file.array(np.arange(COUNT, dtype=np.float32)[:, None])
    file.mesh["primitives"].append({**file.primitive, "indices": file.array(FACES[:2].reshape(-1, 1))})


def several_meshes(file: File) -> None:
    """Teeth that follow the smile only, under another number, and glasses that never move."""
    two(file)
    teeth = {"attributes": {"POSITION": file.array(REST + 3)}, "targets": [{"POSITION": file.array(TARGETS[1])}]}
    glasses = {"attributes": {"POSITION": file.array(REST - 3)}}
    file.tree["meshes"] += [{"primitives": [teeth], "extras": {"targetNames": ["smile"]}}, {"primitives": [glasses]}]
    file.tree["nodes"] += [{"mesh": 1, "translation": [1, 2, 3]}, {"mesh": 2}]
    file.tree["scenes"][0]["nodes"] = [0, 1, 2]


def quantised(file: File) -> None:
    file.tree |= {"extensionsRequired": ["KHR_mesh_quantization"], "extensionsUsed": ["KHR_mesh_quantization"]}
    file.primitive["attributes"]["POSITION"] = file.array(np.round(REST * 32767).astype(np.int16), normalized=True)
    file.primitive["targets"] = [
        {"POSITION": file.array(np.round(target * 32767).astype(np.int16), normalized=True)} for target in TARGETS
    ]
    file.tree["nodes"][0]["scale"] = [2, 2, 2]


def skinned(file: File) -> None:
    file.skin()
    two(file)


def turned(file: File) -> None:
    two(file)
    file.tree["nodes"][0] |= {"rotation": TURN, "weights": [1, 0]}


FILES: dict[Callable[[File], None], list[str]] = {
    two: ["base", "smile", "frown"],
    no_names: ["base", "target 1", "target 2"],
    some_names: ["base 2", "target 1", "base"],
    sparse: ["base", "smile"],
    several_primitives: ["base", "smile", "frown"],
    numbered_materials: ["base", "smile", "frown"],
    several_meshes: ["base", "smile", "frown"],
    quantised: ["base", "target 1", "target 2"],
    skinned: ["base", "smile", "frown"],
    turned: ["base", "smile", "frown"],
}


def with_weights(file: File, name: str, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the file, read as one mesh with the weight of one target."""
    for mesh in file.tree["meshes"]:
        count = max(len(primitive.get("targets", ())) for primitive in mesh["primitives"])
        given = mesh.get("extras", {}).get("targetNames", [])
        labels = [(given[k] if k < len(given) else None) or f"target {k + 1}" for k in range(count)]
        mesh["weights"] = [float(label == name) for label in labels]
    for node in file.tree["nodes"]:
        node.pop("weights", None)
    path = folder / "posed.glb"
    path.write_bytes(file.bytes())
    return read_arrays(path)


@pytest.mark.parametrize("change", FILES)
def test_each_shape_is_what_the_file_shows_with_that_weight(change: Callable[[File], None], tmp_path: Path) -> None:
    file, path = File(), tmp_path / "face.glb"
    change(file)
    path.write_bytes(file.bytes())
    found = read_morph_file(path)
    assert list(found.names) == FILES[change]
    for k, name in enumerate(found.names):
        vertices, faces = with_weights(file, name if k else "", tmp_path)
        np.testing.assert_array_equal(found.vertices[k], vertices)
        assert np.array_equal(found.faces, faces)
        assert (k == 0) == np.array_equal(found.vertices[k], found.vertices[0])


def test_a_target_name_must_be_its_own(tmp_path: Path) -> None:
    file, path = File(), tmp_path / "face.glb"
    file.morphs([])
    names(file, "smile", "smile")
    path.write_bytes(file.bytes())
    with pytest.raises(MeshError, match="two morph targets are called 'smile'"):
        read_morph_file(path)
    assert len(read_arrays(path)[0]) == COUNT, "as one mesh it is read"
