"""Writer and reader of bundles agree, and equal bundles are written byte for byte the same."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from shapespace.bundle import writer
from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import ARRAYS, MANIFEST, SURFACE, Manifest
from shapespace.bundle.writer import Networks
from shapespace.mesh.fine_detail import FineDetail
from shapespace.mesh.prolongation import Prolongation, RigidPart
from tests.service.bundles import facts, fine_reference, geometry, reference, seal, write_bundle


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    written = replace(geometry(fine=True), file_vertices=np.array([-1, *range(512)]))
    part = np.array([3, 5, 8, 300])
    rest = written.reference.vertices
    fields = np.full((1, len(written.fine.reference.vertices), 3), 0.5, np.float32)
    detail = FineDetail(rest, np.ones((1, *rest.shape), np.float32), fields)
    parts = (RigidPart(part, written.fine.reference.vertices[part]),)
    prolong = replace(written.fine.prolong, rigid=parts, detail=detail)
    written = replace(written, fine=replace(written.fine, prolong=prolong))
    networks = Networks(factors=[b"0", b"1"], combiner=b"2", start=b"3")
    folder = writer.write_bundle(tmp_path, facts(), networks, written)
    assert folder == tmp_path / "small" / "1"
    again = write_bundle(tmp_path / "again", start=True, fine=True)
    found = read_bundle(again)
    np.testing.assert_array_equal(found.reference.vertices, reference().vertices)
    np.testing.assert_array_equal(found.fine.reference.vertices, fine_reference().vertices)
    np.testing.assert_array_equal(found.modes, written.modes)
    np.testing.assert_array_equal(found.training_codes, written.training_codes)
    assert found.file_vertices is None
    assert not found.fine.prolong.rigid
    assert found.networks.keys() == {"factor-0.onnx", "factor-1.onnx", "combiner.onnx", "start.onnx"}
    assert (folder / "start.onnx").read_bytes() == b"3"
    with np.load(folder / "geometry.npz") as arrays:
        kinds = {name: kind for name, kind in ARRAYS.items() if not name.startswith(SURFACE)}
        assert list(arrays) == list(kinds)
        (rigid,) = Prolongation.from_arrays(arrays).rigid
        np.testing.assert_array_equal(rigid.vertices, part)
        np.testing.assert_array_equal(rigid.rest, written.fine.reference.vertices[part])
        assert {name: arrays[name].dtype for name in arrays} == {name: kind.dtype for name, kind in kinds.items()}
    assert [path.name for path in folder.parent.iterdir()] == ["1"]


def test_equal_contents_give_equal_bytes_and_replace_what_is_there(tmp_path: Path) -> None:
    write_bundle(tmp_path, fine=True)
    first = contents(write_bundle(tmp_path / "other", start=True))
    assert contents(write_bundle(tmp_path, start=True)) == first


def _with_a_note(folder: Path) -> None:
    write_bundle(folder.parents[1])
    (folder / "notes.txt").write_text("mine")


def _meshes(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "pose.obj").write_text("v 0 0 0")


def _other_manifest(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / MANIFEST).write_text('["of another program"]')


def _one_file(folder: Path) -> None:
    folder.parent.mkdir(parents=True)
    folder.write_text("mine")


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (_with_a_note, "holds notes.txt, which no export has written"),
        (_meshes, "holds pose.obj, which no export has written"),
        (_other_manifest, "holds manifest.json, which no export has written"),
        (_one_file, "is not a folder"),
    ],
)
def test_a_folder_that_holds_anything_else_is_not_replaced(
    build: Callable[[Path], None], says: str, tmp_path: Path
) -> None:
    folder = tmp_path / "small" / "1"
    build(folder)
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    with pytest.raises(BundleError, match=says):
        write_bundle(tmp_path, start=True)
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before


def test_the_manifest_keeps_the_order_and_the_names_of_the_schema(tmp_path: Path) -> None:
    text = (write_bundle(tmp_path) / MANIFEST).read_text()
    wanted = [field.alias or name for name, field in Manifest.model_fields.items()]
    assert list(json.loads(text)) == wanted
    assert list(json.loads(text)["factors"][0]) == ["name", "start", "stop", "file", "input", "output"]


def test_facts_that_contradict_each_other_write_nothing(tmp_path: Path) -> None:
    networks = Networks(factors=[b"0", b"1"], combiner=b"2")
    for wrong in (
        {"lower": np.zeros(2)},
        {"factors": {"size": [0], "form": [2]}},
        {"name": "Small"},
        {"factors": {"size": [0, 1, 2]}},
    ):
        with pytest.raises(ValidationError):
            writer.write_bundle(tmp_path, replace(facts(), **wrong), networks, geometry())
    assert not list(tmp_path.iterdir())


def test_a_shell_without_the_second_constant_can_be_served(tmp_path: Path) -> None:
    folder = write_bundle(tmp_path)
    path = folder / MANIFEST
    path.write_text(json.dumps(json.loads(path.read_text()) | {"lambda": 0.0}))
    assert read_bundle(folder).manifest.lambda_ == 0


@pytest.mark.parametrize(
    ("name", "array", "says"),
    [
        ("edges", reference().edges.astype(float), "edges must be whole numbers (192, 2), not float64 (192, 2)"),
        ("vertices", np.ones((64, 3), int), "geometry.npz"),
        ("training_codes", np.zeros((4, 3), int), "training_codes must be real numbers (n, 3), not int64 (4, 3)"),
    ],
)
def test_arrays_of_another_type_are_refused(tmp_path: Path, name: str, array: np.ndarray, says: str) -> None:
    folder = write_bundle(tmp_path)
    np.savez(folder / "geometry.npz", **geometry().arrays() | {name: array})
    seal(folder)
    with pytest.raises(BundleError) as refusal:
        read_bundle(folder)
    assert says in str(refusal.value)
