"""All faults of a collection are told at once, in a table; files that are left out are listed with the reason."""

from __future__ import annotations

import json
import os
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
import trimesh

from shapespace.files.formats import MESH_FORMATS
from shapespace.training.collection.faults import IngestError
from shapespace.training.collection.ingest import read_collection
from shapespace.training.collection.listing import data_files

BALL = trimesh.creation.icosphere(subdivisions=2)
FACES = np.array(BALL.faces)


def ball(k: int) -> np.ndarray:
    return BALL.vertices * [1 + 0.1 * k, 2, 1] + 0.03 * np.random.default_rng(0).standard_normal(BALL.vertices.shape)


def write(path: Path, shape: np.ndarray, faces: np.ndarray = FACES) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(MESH_FORMATS[path.suffix[1:]].encode(shape, faces))
    return path


def balls(folder: Path, names: str = "pose{}.obj", count: int = 6) -> Path:
    for k in range(count):
        write(folder / names.format(k), ball(k))
    return folder


def faults(folder: Path) -> dict[str, list[str]]:
    """The rows of the table, by the names of files, without those names."""
    with pytest.raises(IngestError) as refusal:
        read_collection(folder)
    head, columns, *rows = str(refusal.value).splitlines()
    assert head == f"the meshes have {len(rows)} faults:"
    assert columns.split("  ")[1] == "file"
    found: dict[str, list[str]] = {}
    for row in rows:
        place, what, remedy = re.split(r"\s{2,}", row.strip())
        assert what
        assert remedy
        found.setdefault(Path(place).name, []).append(what)
    assert list(found) == sorted(found)
    return found


def test_all_faults_of_all_files_are_in_one_table(tmp_path: Path) -> None:
    folder = balls(tmp_path / "meshes", count=12)
    (folder / "pose0.obj").write_bytes(b"")
    nan, flat, mixed = ball(1), ball(3), ball(6)
    nan[7] = np.nan
    write(folder / "pose1.obj", nan)
    write(folder / "pose2.obj", ball(2), FACES[:-1][::-1])
    flat[FACES[5, 0]] = flat[FACES[5, 1]]
    write(folder / "pose3.obj", flat)
    write(folder / "pose4.obj", 1000 * ball(4))
    write(folder / "pose5.obj", ball(5) * [-1, 1, 1])
    write(folder / "pose6.obj", mixed[np.random.default_rng(1).permutation(len(mixed))])
    write(folder / "pose7.ply", ball(7))
    nan[8] = np.inf
    write(folder / "pose8.obj", nan, FACES[1:])  # two faults in one file
    found = faults(folder)
    assert list(found) == [f"pose{k}.{'ply' if k == 7 else 'obj'}" for k in range(9)]
    for name, says in {
        "pose0.obj": "has no faces",
        "pose1.obj": "vertex 8 has a coordinate that is not finite (counted from 1)",
        "pose2.obj": "has 162 vertices and 319 faces, but pose",
        "pose3.obj": "has no area",
        "pose7.ply": "pose7.obj has the same name",
    }.items():
        assert len(found[name]) == 1
        assert says in found[name][0]
    assert any("not finite" in what for what in found["pose8.obj"])
    assert any("319 faces" in what for what in found["pose8.obj"])
    for name, says in {"pose4": "another size", "pose5": "inside out", "pose6": "vertices in another order"}.items():
        assert any(says in what for what in found[f"{name}.obj"]), name


def test_the_odd_file_is_named_where_it_comes_first(tmp_path: Path) -> None:
    folder = balls(tmp_path / "meshes")
    write(folder / "pose0.obj", ball(0), FACES[1:])
    with pytest.raises(IngestError, match=r"pose0\.obj: has 162 vertices and 319 faces, but pose1\.obj has") as refusal:
        read_collection(folder)
    assert "\n" not in str(refusal.value)


def test_all_faulty_shapes_of_an_npz_are_named(tmp_path: Path) -> None:
    shapes = np.stack([ball(k) for k in range(6)])
    shapes[1, 5], shapes[4, 6] = np.nan, np.inf
    np.savez(tmp_path / "all.npz", vertices=shapes, faces=FACES)
    with pytest.raises(IngestError, match=r"(?s)shape 1 +vertex 5 .*shape 4 +vertex 6 "):
        read_collection(tmp_path / "all.npz")


def test_every_file_that_is_left_out_is_listed_with_the_reason(tmp_path: Path) -> None:
    folder = balls(tmp_path / "meshes", "pose{}.ply")
    balls(folder / "raw")
    for name in ("README.md", "scan.vtx", "pose1.mtl", "no extension", "two\nlines.fbx", ".pose9.ply", "skin.png"):
        (folder / name).touch()
    notes = read_collection(folder).notes
    assert notes == (
        "left out, as their formats are not read: no extension, pose1.mtl, README.md, scan.vtx, two\\nlines.fbx",
        "left out, as their names begin with a dot: .pose9.ply",
        "left out, as they are folders; --file reads one file from each: raw/",
    )


# ---------------------------------------------------------------- one folder for each subject


def test_one_file_of_each_subject_s_folder_is_a_shape_with_the_subject_s_name(tmp_path: Path) -> None:
    study = balls(tmp_path / "study", "sub-{}/mesh.obj", 11)
    write(study / "sub-2" / "other.obj", ball(0))
    (study / "sub-3" / "mesh.mtl").touch()
    (study / "participants.tsv").touch()
    (study / "sub-12").mkdir()
    collection = read_collection(study, file="mesh.obj")
    assert collection.names == tuple(f"sub-{k}" for k in range(11))
    np.testing.assert_allclose(collection.vertices[10], ball(10), atol=1e-6)
    assert collection.places[3] == ("sub-3/mesh.obj", 1)
    assert collection.notes == (
        "left out, as they have no file mesh.obj: sub-12/",
        "left out, as only mesh.obj is read from each folder: other.obj",
        "left out, as they are not in a subject's folder: participants.tsv",
    )
    names = [path.relative_to(study).as_posix() for path in data_files(study, "mesh.obj")]
    assert sorted(names) == sorted([f"sub-{k}/mesh.obj" for k in range(11)] + ["sub-3/mesh.mtl"])


@pytest.mark.parametrize(
    ("names", "file"),
    [
        ("sub-{}/mesh.ply", "mesh.ply"),
        ("sub-{0}/sub-{0}_mesh.ply", "*_mesh.ply"),
        ("sub-{}/surf/pial.obj", "surf/pial.obj"),
        ("P{}/scan [final].stl", "scan [final].stl"),
    ],
)
def test_a_folder_of_subjects_alone_is_refused_with_the_argument_that_reads_it(
    names: str, file: str, tmp_path: Path
) -> None:
    study = balls(tmp_path / "study", names, 4)
    with pytest.raises(IngestError, match=re.escape(f"--file {shlex.quote(file)} (4 files)")):
        read_collection(study)
    assert len(read_collection(study, file=file).names) == 4


def test_subjects_may_have_a_folder_for_each_session(tmp_path: Path) -> None:
    study = tmp_path / "study"
    for k in range(2):
        balls(study / f"sub-0{k}", "ses-{}/surf/pial.ply", 2 + k)
    with pytest.raises(IngestError, match=re.escape("--file '*/surf/pial.ply' (5 files)")):
        read_collection(study)
    names = ["sub-00_ses-0", "sub-00_ses-1", "sub-01_ses-0", "sub-01_ses-1", "sub-01_ses-2"]
    for file in ("ses-*/surf/pial.ply", "*/*/pial.ply", "**/pial.ply"):
        ending = "" if file.startswith("ses") else "_surf"
        assert list(read_collection(study, file=file).names) == [name + ending for name in names]
    for k in range(3):
        write(tmp_path / "plain" / f"P{k}" / "scan [final]" / "mesh.ply", ball(k))
    plain = read_collection(tmp_path / "plain", file="scan [final]/mesh.ply")
    assert list(plain.names) == ["P0", "P1", "P2"], "a folder's own name, although it looks like a pattern"
    write(study / "sub-01" / "ses-1" / "surf" / "white.ply", ball(1))
    with pytest.raises(IngestError, match=re.escape(f"{Path('sub-01/ses-1/surf')}: has 2 files ses-*/surf/*.ply")):
        read_collection(study, file="ses-*/surf/*.ply")


@pytest.mark.parametrize(
    ("file", "says"),
    [
        ("none.ply", r"none of its folders has a file none\.ply; .*--file mesh\.obj"),
        ("mesh.fbx", r"the format of 'mesh\.fbx' is not read; these are: glb, "),
        ("../mesh.obj", r"is not a path within a folder"),
        ("/mesh.obj", r"is not a path within a folder"),
        ("*.obj", r"(?s)sub-1 +has 2 files \*\.obj .*sub-2 +has 2 files \*\.obj"),
    ],
)
def test_a_file_that_subjects_do_not_have_once_is_refused(file: str, says: str, tmp_path: Path) -> None:
    study = balls(tmp_path / "study", "sub-{}/mesh.obj", 6)
    for k in (1, 2):
        write(study / f"sub-{k}" / "extra.obj", ball(k))
    with pytest.raises(IngestError, match=says):
        read_collection(study, file=file)


def test_accepting_takes_the_path_of_a_subject_s_file(tmp_path: Path) -> None:
    study = balls(tmp_path / "study", "sub-{}/mesh.obj", 5)
    write(study / "sub-3" / "mesh.obj", 1000 * ball(3))
    collection = read_collection(study, file="mesh.obj")
    for name in ("sub-3", "sub-3/mesh.obj"):
        collection.require_accepted([name])
    with pytest.raises(IngestError, match=r"sub-3/mesh\.obj: has another size"):
        collection.require_accepted([])


# ---------------------------------------------------------------- sliders and joints


def with_slider(path: Path, shape: np.ndarray, weight: float) -> None:
    """A GLB with a morph target that doubles the shape."""
    arrays = [shape.astype("<f4"), shape.astype("<f4"), FACES.astype("<u4")]
    starts = np.cumsum([0, *(array.nbytes for array in arrays)]).tolist()
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": starts[-1]}],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
            for start, array in zip(starts, arrays, strict=False)
        ],
        "accessors": [
            {"bufferView": k, "componentType": 5126, "count": len(shape), "type": "VEC3"} for k in range(2)
        ] + [{"bufferView": 2, "componentType": 5125, "count": FACES.size, "type": "SCALAR"}],
        "meshes": [
            {
                "primitives": [{"attributes": {"POSITION": 0}, "indices": 2, "targets": [{"POSITION": 1}]}],
                "weights": [weight],
            }
        ],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    data = b"".join(array.tobytes() for array in arrays)
    chunks = [(len(text), b"JSON", text), (len(data), b"BIN\0", data)]
    body = b"".join(size.to_bytes(4, "little") + kind + content for size, kind, content in chunks)
    path.write_bytes(b"glTF" + (2).to_bytes(4, "little") + (12 + len(body)).to_bytes(4, "little") + body)


def test_sliders_and_joints_that_are_left_as_they_stand_are_told_in_one_line(tmp_path: Path) -> None:
    folder = balls(tmp_path / "meshes", "pose{}.glb", 5)
    assert not read_collection(folder).notes
    for k in (3, 4):
        with_slider(folder / f"pose{k}.glb", ball(k), 0.5)
    collection = read_collection(folder)
    np.testing.assert_allclose(collection.vertices[4], 1.5 * ball(4), atol=1e-6)
    (note,) = collection.notes
    assert note.startswith("pose3.glb, pose4.glb: with sliders (morph targets) or joints")


def test_names_of_files_that_break_lines_do_not_break_the_table(tmp_path: Path) -> None:
    folder = balls(tmp_path / "meshes")
    for name in ("a\nb.obj", "c\x1b.obj"):
        (folder / name).touch()
    with pytest.raises(IngestError) as refusal:
        read_collection(folder)
    _, _, *rows = str(refusal.value).splitlines()
    assert [row.split("  ")[1].rpartition("/")[2] for row in rows] == ["a\\nb.obj", "c\\x1b.obj"]


def test_a_file_whose_name_is_no_text_is_a_fault(tmp_path: Path) -> None:
    folder = balls(tmp_path / "meshes")
    (folder / os.fsdecode(b"pose\xff.obj")).touch()
    with pytest.raises(IngestError, match=r"pose\\udcff\.obj: its name is not valid UTF-8; rename it"):
        read_collection(folder)


def test_files_that_can_not_be_read_are_listed_with_all_other_faults(tmp_path: Path) -> None:
    folder = balls(tmp_path / "balls")
    (folder / "pose1.obj").unlink()
    (folder / "pose1.obj").symlink_to("/proc/self/mem")  # may be opened, but not read
    (folder / "pose2.obj").write_bytes(b"")
    assert {"pose1.obj", "pose2.obj"} <= {Path(name).name for name in faults(folder)}


def test_a_pattern_with_several_files_in_every_folder_is_called_that(tmp_path: Path) -> None:
    for subject in ("a", "b", "c"):
        balls(tmp_path / "subjects" / subject, count=2)
    with pytest.raises(IngestError, match=r"has 2 files \*\.obj"):
        read_collection(tmp_path / "subjects", file="*.obj")
