"""One glTF file whose morph targets are the shapes is a collection, for ``init`` and for runs."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from shapespace.files.reading import read_arrays
from shapespace.training.collection.appearance import reference_surface
from shapespace.training.collection.checks import IngestError
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.init import write
from shapespace.training.collection.listing import data_files
from shapespace.training.runs.config import load
from tests.shapespace.files.test_gltf_pose import File
from tests.training.collection.test_ingest import FACES, SHAPES
from tests.training.conftest import Said


def face_file(path: Path, targets: int = 2) -> Path:
    """A ball whose targets are the two other shapes of the collection, with a small ball on its side."""
    file, corners = File(), FACES.astype(np.uint16).reshape(-1, 1)
    head, eye = SHAPES.astype(np.float32), (0.1 * SHAPES + [9, 0, 0]).astype(np.float32)
    file.tree["meshes"] = [
        {
            "name": name,
            "weights": [0, 0.5][:targets],
            "extras": {"targetNames": ["wide", "wider"][:targets]},
            "primitives": [
                {
                    "attributes": {"POSITION": file.array(shapes[0])},
                    "indices": file.array(corners),
                    "targets": [{"POSITION": file.array(shape - shapes[0])} for shape in shapes[1 : 1 + targets]],
                }
            ],
        }
        for name, shapes in (("Head", head), ("Eye", eye))
    ]
    file.tree["nodes"] = [{"mesh": 0, "name": "Head"}, {"mesh": 1, "name": "Eye"}]
    file.tree["scenes"] = [{"nodes": [0, 1]}]
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(file.bytes())
    return path


@pytest.mark.parametrize("named", ["file", "folder"])
def test_morph_targets_are_a_collection(named: str, tmp_path: Path) -> None:
    path = face_file(tmp_path / "face" / "face.glb")
    found = read_collection(path if named == "file" else path.parent)
    assert found.names == ("base", "wide", "wider")
    assert [part.name for part in found.parts] == ["Head", "Eye"]
    head = found.faces[found.parts[0].faces]
    np.testing.assert_allclose(found.vertices[:, head], SHAPES[:, FACES], atol=1e-6)
    surface, faults = reference_surface(path if named == "file" else path.parent, found, 0)
    assert not faults
    assert surface is not None
    assert surface.objects is not None
    assert surface.objects.names == ("Head", "Eye")


def test_init_writes_a_configuration_for_such_a_file(tmp_path: Path) -> None:
    path = face_file(tmp_path / "face.glb")
    out, collection = write(path, tmp_path / "face.toml")
    config, _ = load(out)
    assert config.collection.data == path.resolve()
    assert config.export.title == "face"
    assert 'parts = ["Head", "Eye"]' in out.read_text()
    assert collection.names[collection.central] in out.read_text()
    assert read_collection(config.collection.data, config.collection.parts).names == collection.names


def test_as_one_mesh_such_a_file_is_the_shape_that_it_shows(tmp_path: Path) -> None:
    vertices, _ = read_arrays(face_file(tmp_path / "face.glb"))
    np.testing.assert_allclose(vertices[:42], (SHAPES[0] + SHAPES[2]) / 2, atol=1e-6)


def test_buffers_beside_a_file_belong_to_the_collection(tmp_path: Path) -> None:
    for name in ("face.gltf", "face.bin", "face.txt", "skin.png"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in data_files(tmp_path / "face.gltf")] == ["face.gltf", "face.bin", "skin.png"]
    assert [p.name for p in data_files(tmp_path / "face.txt")] == ["face.txt"]


def test_a_run_reads_a_file_with_buffers_beside_it(tmp_path: Path, said: Said) -> None:
    data = face_file(tmp_path / "face.glb").read_bytes()
    size = int.from_bytes(data[12:16], "little")
    tree = json.loads(data[20 : 20 + size])
    tree["buffers"][0]["uri"] = "face.bin"
    (tmp_path / "face.gltf").write_text(json.dumps(tree))
    (tmp_path / "face.bin").write_bytes(data[28 + size :])
    said("init", tmp_path / "face.gltf", "--out", tmp_path / "face.toml")
    run = "run", tmp_path / "face.toml", "--out", tmp_path / "run", "--until", "ingest"
    said(*run)
    assert "ingest: done before" in said(*run)


@pytest.mark.parametrize("targets", [0, 1])
def test_too_few_targets_are_told(targets: int, tmp_path: Path) -> None:
    path = face_file(tmp_path / "face" / "face.glb", targets)
    for data in (path, path.parent):
        with pytest.raises(IngestError, match=rf"face\.glb: has {1 + targets} shapes?; .* each morph target"):
            read_collection(data)


def test_other_shapes_of_a_file_are_named_in_faults(tmp_path: Path) -> None:
    path = face_file(tmp_path / "face.glb")
    data = bytearray(path.read_bytes())
    at = data.rindex((SHAPES[2].astype(np.float32) - SHAPES[0].astype(np.float32)).tobytes())
    data[at : at + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(bytes(data))
    with pytest.raises(IngestError, match=r"face\.glb: shape wider: .*not finite"):
        read_collection(path)
