"""Attributes of the reference's file survive reading, welding and choosing the reference."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.attributes import MeshAttributes
from shapespace.training.collection.appearance import kept, reference_surface
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.mesh_collection import MeshCollection
from shapespace.training.runs.config import load
from shapespace.training.stages.run import execute
from shapespace.training.stages.stage import Run
from tests.surfaces import ball, corner_uv, same_corners, write_files

REST, SURFACE = ball(1)
SHAPES = [REST * [1, 1, 1 + 0.3 * k] for k in range(3)]

CONFIG = """
[collection]
data = "balls"
coarse_vertices = 0

[export]
name = "balls"
title = "Balls"
description = "A run for the tests."
licence = "MIT"
"""


def surface_of(folder: Path, name: str | None = None) -> tuple[MeshCollection, MeshAttributes | None, list[str]]:
    meshes = read_collection(folder)
    return meshes, *reference_surface(folder, meshes, meshes.index(name))


def with_numbers(shape: np.ndarray) -> bytes:
    return MESH_FORMATS["glb"].encode(shape, SURFACE.triangles, None, SURFACE)


def of_others(shape: np.ndarray) -> bytes:
    """A GLB as other programs write it: vertices split along seams, without `_VERTEX` numbers."""
    split = SURFACE.split
    look = trimesh.visual.TextureVisuals(uv=split.uv)
    mesh = trimesh.Trimesh(shape[split.vertex], split.faces, process=False, visual=look)
    return bytes(mesh.export(file_type="glb"))


@pytest.mark.parametrize("encode", [with_numbers, of_others])
def test_seams_that_are_welded_stay_seams_of_the_texture(encode: Callable[[np.ndarray], bytes], tmp_path: Path) -> None:
    for k, shape in enumerate(SHAPES):
        (tmp_path / f"ball{k}.glb").write_bytes(encode(shape))
    meshes, found, faults = surface_of(tmp_path)
    assert not faults
    assert found
    assert meshes.vertices.shape[1] == len(REST)
    found.check(len(REST), meshes.faces)
    # All these files have vertices in the order of the ball's.
    named = encode is with_numbers
    wanted = SURFACE if named else replace(SURFACE, material_of=None, materials=())
    found = found if named else replace(found, material_of=None, materials=())
    same_corners(corner_uv(found), corner_uv(wanted))
    assert found.shading is None, "smooth normals in the file stay smooth across the seam"


def test_vertices_that_are_dropped_leave_polygons_where_they_are(tmp_path: Path) -> None:
    (tmp_path / "balls").mkdir()
    for k, shape in enumerate(SHAPES):
        path = tmp_path / "balls" / f"ball{k}.obj"
        moved = replace(SURFACE, corners=SURFACE.corners + 2)
        write_files(path, np.vstack([[[9, 9, 9], [8, 8, 8]], shape]), moved)
    meshes, found, faults = surface_of(tmp_path / "balls")
    assert not faults
    assert found
    assert np.array_equal(found.corners, SURFACE.corners)
    assert np.array_equal(found.triangles, meshes.faces)
    sentence = kept(found)
    assert "40 triangles, 20 quads" in sentence
    assert "skin.png" in sentence
    assert "licence" in sentence


def test_the_reference_s_file_counts_and_of_stl_the_first_other_one(tmp_path: Path) -> None:
    named = replace(SURFACE, objects=None)
    for k, shape in enumerate(SHAPES):
        path = tmp_path / f"ball{k}.obj"
        path.write_bytes(MESH_FORMATS["obj"].encode(shape, SURFACE.triangles, None, named))
        path.write_text(f"o Ball {k}\n{path.read_text()}")
    (tmp_path / "ball3.stl").write_bytes(MESH_FORMATS["stl"].encode(REST * [2, 1, 1], SURFACE.triangles))
    for name, wanted in (("ball1", "Ball 1"), ("ball2", "Ball 2"), ("ball3", "Ball 0")):
        _, found, _ = surface_of(tmp_path, name)
        assert found
        assert found.objects
        assert found.objects.names == (wanted,)


def test_a_run_says_what_it_keeps_and_what_it_leaves_out(tmp_path: Path) -> None:
    (tmp_path / "balls").mkdir()
    for k, shape in enumerate(SHAPES):
        write_files(tmp_path / "balls" / f"ball{k}.obj", shape, SURFACE)
    config = tmp_path / "balls.toml"
    config.write_text(CONFIG)
    said: list[str] = []

    def ingest() -> dict:
        said.clear()
        execute(Run(tmp_path / "run", *load(config), tmp_path / "models"), "ingest", show=said.append)
        return json.loads((tmp_path / "run" / "ingest.json").read_text())

    assert any("kept for answers: 40 triangles, 20 quads" in note for note in ingest()["notes"])
    picture = tmp_path / "balls" / "maps" / "skin.png"
    picture.unlink()
    (tmp_path / "balls" / "balls.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    (warning,) = ingest()["warnings"]
    assert "ball" in warning.partition(": ")[0]
    assert "the texture skin.png of material skin is left out: No such file" in warning
    assert any("skin.png" in line for line in said)
    assert any(line.startswith("data: 1 changed (balls.mtl)") for line in said), "materials are data"
    names = json.loads((tmp_path / "run" / "surface.json").read_text())
    assert [material["texture"] for material in names["materials"]] == [None, None]
    # Results of the collection's former files are deleted.
    for k, shape in enumerate(SHAPES):
        plain = MESH_FORMATS["obj"].encode(shape, SURFACE.triangles)
        (tmp_path / "balls" / f"ball{k}.obj").write_bytes(plain)
    ingest()
    assert not (tmp_path / "run" / "surface.json").exists()
