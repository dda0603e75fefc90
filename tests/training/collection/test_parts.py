"""Collections of several parts: which is the shell, which parts are attached, and what is refused."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.attributes import Labels
from shapespace.mesh.rigid_motion import align
from shapespace.training.collection.appearance import reference_surface
from shapespace.training.collection.faults import IngestError
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.init import configuration, write
from shapespace.training.collection.mesh_collection import MeshCollection, normalised
from shapespace.training.runs.config import load, parse
from tests.surfaces import ball, with_parts, write_files

REST, SURFACE = with_parts(ball(2))
FACES = SURFACE.triangles
OBJECT = SURFACE.objects.of[SURFACE.triangle_polygons]
NAMES = ("Eye", "Bar", "Nail")


def stretched(k: int) -> np.ndarray:
    """A shape of the collection; its eye moves rigidly."""
    shape = REST * [1, 1, 1 + 0.3 * k]
    eye = np.unique(FACES[OBJECT == 0])
    shape[eye] = align(REST[eye], shape[eye])
    return shape


def collection(folder: Path, wanted: Sequence[str] = (), surface=SURFACE) -> MeshCollection:  # type: ignore[no-untyped-def]
    folder.mkdir(exist_ok=True)
    for k in range(4):
        write_files(folder / f"shape{k}.obj", stretched(k), surface)
    return read_collection(folder, wanted)


def test_the_largest_is_the_shell_and_the_others_are_attached(tmp_path: Path) -> None:
    meshes = collection(tmp_path)
    assert [part.name for part in meshes.parts] == ["Bar", "Eye", "Nail"]
    for part in meshes.parts:
        assert part.faces.tolist() == np.flatnonzero(np.array(NAMES)[OBJECT] == part.name).tolist()
    np.testing.assert_array_equal(meshes.faces, FACES)
    assert any("3 separate parts" in note and "attached to it: 'Eye', 'Nail'" in note for note in meshes.notes)
    # Normalisation gives the shell area 1.
    vertices, scale = normalised(meshes, 0)
    shell = trimesh.Trimesh(vertices[0], meshes.shell_faces, process=False)
    assert shell.area == pytest.approx(1)
    np.testing.assert_allclose(scale * vertices[2], stretched(2), atol=1e-9)


@pytest.mark.parametrize(("wanted", "kept"), [(["Bar"], [1]), (["Bar", "Nail"], [1, 2]), (["Nail", "Eye"], [2, 0])])
def test_parts_that_are_not_named_are_left_out(wanted: list[str], kept: list[int], tmp_path: Path) -> None:
    meshes = collection(tmp_path, wanted)
    there = np.isin(OBJECT, kept)
    used = np.unique(FACES[there])
    np.testing.assert_array_equal(used[meshes.faces], FACES[there])
    np.testing.assert_allclose(meshes.vertices[1], stretched(1)[used], atol=1e-12)
    assert [part.name for part in meshes.parts] == (wanted if len(wanted) > 1 else [])
    assert meshes.file_vertices is not None
    np.testing.assert_array_equal(np.flatnonzero(meshes.file_vertices >= 0), used)
    surface, faults = reference_surface(tmp_path, meshes, 0)
    assert surface
    assert not faults
    assert surface.objects
    assert surface.objects.names == tuple(NAMES[k] for k in sorted(kept))
    np.testing.assert_array_equal(surface.sizes, SURFACE.sizes[np.isin(SURFACE.objects.of, kept)])
    corners = np.repeat(np.isin(SURFACE.objects.of, kept), SURFACE.sizes)
    np.testing.assert_allclose(surface.uv[surface.uv_corners], SURFACE.uv[SURFACE.uv_corners[corners]], atol=1e-12)


def test_names_are_those_that_tell_parts_apart(tmp_path: Path) -> None:
    one = Labels(("Person",), np.zeros(len(SURFACE.sizes), int))
    by_material = replace(SURFACE, objects=one, groups=Labels(("all",), one.of))
    assert {part.name for part in collection(tmp_path / "a", surface=by_material).parts} == {"skin", "cap"}
    folder = tmp_path / "b"
    folder.mkdir()
    np.savez(folder / "all.npz", vertices=np.stack([stretched(k) for k in range(4)]), faces=FACES)
    meshes = read_collection(folder / "all.npz")
    assert [part.name for part in meshes.parts] == ["part 2", "part 1", "part 3"]
    with pytest.raises(IngestError, match=r"no part 'Teeth'.* its parts are 'part 1', 'part 2', 'part 3'"):
        read_collection(folder / "all.npz", ["Teeth"])


def test_a_collection_of_one_part_knows_no_other(tmp_path: Path) -> None:
    body, surface = ball(1)
    for k in range(3):
        write_files(tmp_path / f"ball{k}.obj", body * [1, 1, 1 + 0.3 * k], surface)
    assert read_collection(tmp_path, ["part 1"]).parts == ()
    with pytest.raises(IngestError, match="no part 'head'"):
        read_collection(tmp_path, ["head"])


def test_scenes_of_several_meshes_are_parts_by_their_names(tmp_path: Path) -> None:
    for k in range(3):
        scene = trimesh.Scene()
        for name, number in zip(NAMES, range(3), strict=True):
            used, local = np.unique(FACES[number == OBJECT], return_inverse=True)
            mesh = trimesh.Trimesh(stretched(k)[used], local.reshape(-1, 3), process=False)
            scene.add_geometry(mesh, geom_name=name, node_name=name)
        scene.export(tmp_path / f"shape{k}.glb")
    meshes = read_collection(tmp_path)
    assert meshes.parts[0].name == "Bar"
    assert {part.name for part in meshes.parts} == set(NAMES)


def without(name: str):  # type: ignore[no-untyped-def]
    return SURFACE.only(SURFACE.objects.of != NAMES.index(name))


#: The same faces with the names of two parts exchanged.
REORDERED = replace(SURFACE, objects=Labels(("Nail", "Bar", "Eye"), SURFACE.objects.of))


@pytest.mark.parametrize(
    ("first", "third", "says"),
    [
        (SURFACE, without("Eye"), "has other faces than shape0.obj: it has no part 'Eye'"),
        (SURFACE, REORDERED, "its parts come in another order: 'Nail', 'Bar', 'Eye', unlike those of shape0.obj"),
        (without("Nail"), SURFACE, "has other faces than shape0.obj: its part 'Nail' is not in shape0.obj"),
    ],
)
def test_parts_that_differ_between_files_are_named(first, third, says: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    collection(tmp_path, surface=first)
    write_files(tmp_path / "shape2.obj", stretched(2), third)
    with pytest.raises(IngestError, match=re.escape(f"shape2.obj: {says}")) as refusal:
        read_collection(tmp_path)
    assert "\n" not in str(refusal.value)


def test_two_shells_of_size_are_refused_unless_one_keeps_its_form(tmp_path: Path) -> None:
    sphere = trimesh.creation.icosphere(2)
    shapes = np.stack([sphere.vertices * [1, 1, 1 + 0.3 * k] for k in range(4)])
    faces = np.concatenate([sphere.faces, sphere.faces + len(sphere.vertices)])
    soft = np.concatenate([shapes, shapes + np.array([3, 0, 0])], axis=1)
    hard = np.concatenate([shapes, np.repeat(0.9 * shapes[:1] + [3, 0, 0], 4, axis=0)], axis=1)
    np.savez(tmp_path / "soft.npz", vertices=soft, faces=faces)
    np.savez(tmp_path / "hard.npz", vertices=hard, faces=faces)
    with pytest.raises(IngestError, match=r"2 separate parts, .*'part 2'.* too large .* train one model for each"):
        read_collection(tmp_path / "soft.npz")
    assert [part.name for part in read_collection(tmp_path / "hard.npz").parts] == ["part 1", "part 2"]


def with_specks(path: Path) -> int:
    """Write an NPZ of a ball and 120 triangles as parts of their own; return the number of the ball's faces."""
    sphere = trimesh.creation.icosphere(2)
    specks = np.repeat(np.arange(120.0), 3)[:, None] * [0.01, 0, 0] + np.tile(0.005 * np.eye(3), (120, 1)) + [0, 2, 0]
    shapes = np.stack([np.concatenate([sphere.vertices * [1, 1, 1 + 0.3 * k], specks]) for k in range(3)])
    faces = np.concatenate([sphere.faces, len(sphere.vertices) + np.arange(360).reshape(-1, 3)])
    np.savez(path, vertices=shapes, faces=faces)
    return len(sphere.faces)


def test_there_may_not_be_more_parts_than_an_answer_can_take(tmp_path: Path) -> None:
    count = with_specks(tmp_path / "specks.npz")
    with pytest.raises(IngestError, match="121 separate parts, but at most 100 are allowed"):
        read_collection(tmp_path / "specks.npz")
    assert len(read_collection(tmp_path / "specks.npz", ["part 1"]).faces) == count


def listed_parts(text: str) -> dict[str, int]:
    """Names of parts and their numbers of vertices that a configuration lists."""
    found = re.findall(r'^#   (".*") +(\d+) vertices +[\d.]+%$', text, flags=re.MULTILINE)
    return {json.loads(name): int(count) for name, count in found}


def test_init_names_the_parts(tmp_path: Path) -> None:
    text = configuration(collection(tmp_path), "shapes", "Shapes")
    assert '# parts = ["Bar", "Eye", "Nail"]' in text
    assert parse(text.replace("# parts", "parts"), "text").collection.parts == ["Bar", "Eye", "Nail"]
    sizes = {name: len(np.unique(FACES[k == OBJECT])) for k, name in enumerate(NAMES)}
    assert listed_parts(text) == sizes


def test_init_selects_parts_by_name(tmp_path: Path) -> None:
    collection(tmp_path / "shapes")
    out, meshes = write(tmp_path / "shapes", tmp_path / "c.toml", parts=["Bar", "Nail"])
    assert load(out)[0].collection.parts == ["Bar", "Nail"]
    assert [part.name for part in meshes.parts] == ["Bar", "Nail"]
    assert list(listed_parts(out.read_text())) == ["Bar", "Eye", "Nail"]
    with pytest.raises(IngestError, match=r"no part 'Teeth'"):
        write(tmp_path / "shapes", tmp_path / "d.toml", parts=["Teeth"])


def test_init_selects_the_largest_part_where_not_all_can_be_kept(tmp_path: Path) -> None:
    count = with_specks(tmp_path / "specks.npz")
    out, meshes = write(tmp_path / "specks.npz", tmp_path / "c.toml")
    assert any("at most 100 are allowed" in note for note in meshes.notes)
    assert "only the largest" in out.read_text()
    sizes = listed_parts(out.read_text())
    assert len(sizes) == 121
    assert (sizes["part 1"], sizes["part 121"]) == (162, 3)
    config, _ = load(out)
    assert config.collection.parts == ["part 1"]
    assert config.collection.data
    assert len(read_collection(config.collection.data, config.collection.parts).faces) == count == len(meshes.faces)


@pytest.mark.parametrize("name", ["", "skin"])
def test_init_selects_the_first_of_equal_halves(name: str, tmp_path: Path) -> None:
    """Both halves may have one name, beside which an eye has its own."""
    sphere = trimesh.creation.icosphere(2)
    eye = trimesh.creation.icosphere(1, radius=0.1)
    faces = np.concatenate([eye.faces, *(sphere.faces + k * len(sphere.vertices) + len(eye.vertices) for k in (0, 1))])
    folder = tmp_path / "halves"
    folder.mkdir()
    for k in range(3):
        shape = sphere.vertices * [1, 1, 1 + 0.3 * k]
        away = np.array([3.0, 0, 0])
        corners = np.concatenate([eye.vertices, shape + away, shape * [-1 - 1e-9, 1, 1] - away])
        lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
        for part, begins in (("eye", 0), (name, len(eye.faces))):
            lines += [f"g {part}"] * bool(name)
            some = faces[: len(eye.faces)] if part == "eye" else faces[begins:]
            lines += ["f {} {} {}".format(*face) for face in (some + 1).tolist()]
        (folder / f"shape{k}.obj").write_text("\n".join([*lines, ""]))
    out, meshes = write(folder, tmp_path / "c.toml")
    first = "skin 1" if name else "part 2"
    config, _ = load(out)
    assert config.collection.parts == [first]
    assert set(listed_parts(out.read_text())) == {"eye", "skin 1", "skin 2"} if name else {"part 1", "part 2", "part 3"}
    for found in (meshes, read_collection(folder, [first])):
        np.testing.assert_allclose(found.vertices[1].mean(axis=0), [3, 0, 0], atol=1e-6)
        assert len(found.faces) == len(sphere.faces)


@pytest.mark.parametrize("format", ["obj", "glb", "stl"])
def test_attached_parts_may_be_split_and_numbered_otherwise_in_each_file(format: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for k in range(4):
        shape = stretched(k)
        corners = FACES.ravel().copy()
        alone = (rng.random(len(corners)) < 0.5) & (k > 0)
        corners[alone] = len(shape) + np.arange(alone.sum())
        vertices = np.concatenate([shape, shape[FACES.ravel()[alone]]])
        order = rng.permutation(len(vertices)) if k else np.arange(len(vertices))
        faces = np.argsort(order)[corners].reshape(-1, 3)
        (tmp_path / f"shape{k}.{format}").write_bytes(MESH_FORMATS[format].encode(vertices[order], faces))
    meshes = read_collection(tmp_path)
    assert [len(part.faces) for part in meshes.parts] == [(k == OBJECT).sum() for k in (1, 0, 2)]
    for k in range(4):
        np.testing.assert_allclose(meshes.vertices[k][meshes.faces], stretched(k)[FACES], atol=1e-6)
        for part, number in zip(meshes.parts, (1, 0, 2), strict=True):
            own = meshes.vertices[k][meshes.faces[part.faces]]
            np.testing.assert_allclose(own, stretched(k)[FACES[number == OBJECT]], atol=1e-6)
    assert meshes.vertices.shape[1] == len(np.unique(FACES))
