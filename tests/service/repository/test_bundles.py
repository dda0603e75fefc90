"""What the loader refuses; one bad bundle does not affect others."""

import io
import json
import logging
import os
import shutil
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import httpx
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from benchmarks import synthetic
from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.files.npz import npz_bytes
from shapespace.mesh.prolongation import Prolongation
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits import sandbox
from shapespace.service.repository import validation
from shapespace.service.repository.repository import Changes, ModelRepository
from shapespace.service.repository.validation import BundleValidator
from tests.faults.serving import peak_memory
from tests.service import hostile
from tests.service.bundles import SCALE, network, networks, reference, rescale, seal, write_bundle
from tests.service.bundles import geometry as geometry_of
from tests.service.conftest import Start
from tests.service.watching import samples, value

Spoil = Callable[[Path], None]


def rewrite(folder: Path, **changes: object) -> None:
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def flip_a_bit(folder: Path) -> None:
    path = folder / "factor-0.onnx"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def truncate(folder: Path) -> None:
    path = folder / "geometry.npz"
    path.write_bytes(path.read_bytes()[:-10])


def append(folder: Path) -> None:
    with (folder / "geometry.npz").open("ab") as file:
        file.write(b"more")


def promise_a_petabyte(folder: Path) -> None:
    files = json.loads((folder / "manifest.json").read_text())["files"]
    files["geometry.npz"]["bytes"] = 2**50
    rewrite(folder, files=files)


def add_a_file(folder: Path) -> None:
    (folder / "run.sh").write_text("echo")


def add_a_folder(folder: Path) -> None:
    (folder / "more").mkdir()


def remove_a_file(folder: Path) -> None:
    (folder / "combiner.onnx").unlink()


def link_a_file(folder: Path) -> None:
    shutil.move(folder / "combiner.onnx", folder.parents[1] / "elsewhere.onnx")
    (folder / "combiner.onnx").symlink_to(folder.parents[1] / "elsewhere.onnx")


def link_the_folder(folder: Path) -> None:
    moved = folder.parents[1] / "moved"
    shutil.move(folder, moved)
    folder.symlink_to(moved, target_is_directory=True)


def make_a_pipe(folder: Path) -> None:
    (folder / "combiner.onnx").unlink()
    os.mkfifo(folder / "combiner.onnx")


def point_outside(folder: Path) -> None:
    path = folder / "manifest.json"
    path.write_text(path.read_text().replace("combiner.onnx", "../combiner.onnx"))


def no_json(folder: Path) -> None:
    (folder / "manifest.json").write_text("{")


def no_manifest(folder: Path) -> None:
    (folder / "manifest.json").unlink()


def unknown_field(folder: Path) -> None:
    rewrite(folder, surprise=1)


def other_schema(folder: Path) -> None:
    rewrite(folder, schema_version=2)


def other_name(folder: Path) -> None:
    rewrite(folder, name="large")


def bounds_too_short(folder: Path) -> None:
    rewrite(folder, lower=[0.0])


def bounds_crossed(folder: Path) -> None:
    rewrite(folder, lower=[1.0, 1.0, 1.0], upper=[0.0, 2.0, 2.0])


def factors_overlap(folder: Path) -> None:
    factors = json.loads((folder / "manifest.json").read_text())["factors"]
    factors[1]["start"] = 0
    rewrite(folder, factors=factors)


def more_edges(folder: Path) -> None:
    rewrite(folder, edges=193)


def replace_network(folder: Path, file: str, model: onnx.ModelProto) -> None:
    (folder / file).write_bytes(model.SerializeToString())
    seal(folder)


def nan_weight(folder: Path) -> None:
    model = networks()["combiner.onnx"]
    weight = model.graph.initializer[0]
    values = numpy_helper.to_array(weight).copy()
    values[3] = np.nan
    weight.CopyFrom(numpy_helper.from_array(values, weight.name))
    replace_network(folder, "combiner.onnx", model)


def infinite_constant(folder: Path) -> None:
    model = networks()["combiner.onnx"]
    value = helper.make_tensor("c", TensorProto.FLOAT, [1], [np.inf])
    model.graph.node.insert(0, helper.make_node("Constant", [], ["unused"], value=value))
    replace_network(folder, "combiner.onnx", model)


def external_data(folder: Path) -> None:
    model = networks()["factor-0.onnx"]
    weight = model.graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="../../../../etc/passwd")
    replace_network(folder, "factor-0.onnx", model)


def wrong_width(folder: Path) -> None:
    nodes = [helper.make_node("MatMul", ["latent", "D"], ["nric"])]
    replace_network(folder, "factor-0.onnx", network(nodes, {"D": np.ones((1, 7))}, (1,), (7,)))


def wrong_output_name(folder: Path) -> None:
    wide = 2 * len(reference().edges)
    nodes = [helper.make_node("MatMul", ["latent", "D"], ["z"])]
    replace_network(folder, "factor-0.onnx", network(nodes, {"D": np.ones((1, wide))}, (1,), (wide,)))


def one_code_only(folder: Path) -> None:
    model = networks()["factor-0.onnx"]
    for end in (*model.graph.input, *model.graph.output):
        end.type.tensor_type.shape.dim[0].dim_value = 1
    replace_network(folder, "factor-0.onnx", model)


def weight_of_no_type(folder: Path) -> None:
    model = networks()["combiner.onnx"]
    model.graph.initializer[0].data_type = TensorProto.UNDEFINED
    replace_network(folder, "combiner.onnx", model)


def too_few_weights(folder: Path) -> None:
    model = networks()["combiner.onnx"]
    model.graph.initializer[0].dims[0] += 1
    replace_network(folder, "combiner.onnx", model)


def long_name_inside(folder: Path) -> None:
    """The first member's header has a name of 1500 bytes, all of which zipfile quotes in its error."""
    path = folder / "geometry.npz"
    data = bytearray(path.read_bytes())
    data[26:28] = (1500).to_bytes(2, "little")
    path.write_bytes(data)
    seal(folder)


def no_network(folder: Path) -> None:
    (folder / "factor-0.onnx").write_bytes(b"not a network")
    seal(folder)


def geometry(folder: Path, **changes: np.ndarray) -> None:
    (folder / "geometry.npz").write_bytes(npz_bytes(geometry_of().arrays() | changes))
    seal(folder)


def fine_arrays() -> dict[str, np.ndarray]:
    return geometry_of(fine=True).arrays()


def nan_vertex(folder: Path) -> None:
    vertices = reference().vertices.copy()
    vertices[5, 1] = np.nan
    geometry(folder, vertices=vertices)


def unsorted_edges(folder: Path) -> None:
    geometry(folder, edges=reference().edges[::-1])


def turned_face(folder: Path) -> None:
    faces = reference().faces.copy()
    faces[0] = faces[0, ::-1]
    geometry(folder, faces=faces)


def pickled_geometry(folder: Path) -> None:
    geometry(folder, vertices=np.array([{"a": 1}], dtype=object))


def no_edges(folder: Path) -> None:
    mesh = reference()
    (folder / "geometry.npz").write_bytes(npz_bytes({"vertices": mesh.vertices, "faces": mesh.faces}))
    seal(folder)


def no_fine_faces(folder: Path) -> None:
    arrays = fine_arrays()
    del arrays["fine_faces"]
    geometry(folder, **arrays)


def no_prolongation(folder: Path) -> None:
    arrays = fine_arrays()
    del arrays["prolongation_weights"]
    geometry(folder, **arrays)


def fine_face_out_of_range(folder: Path) -> None:
    arrays = fine_arrays()
    arrays["fine_faces"][7, 1] = 512
    geometry(folder, **arrays)


def fewer_fine_vertices(folder: Path) -> None:
    mesh = reference()
    geometry(folder, **fine_arrays() | {"fine_vertices": mesh.vertices, "fine_faces": mesh.faces})


def moved_fine_vertex(folder: Path) -> None:
    arrays = fine_arrays()
    arrays["fine_vertices"] = arrays["fine_vertices"] + np.eye(512, 3)
    geometry(folder, **arrays)


def prolongation_of_other_faces(folder: Path) -> None:
    arrays = fine_arrays()
    arrays["prolongation_faces"] = np.roll(arrays["prolongation_faces"], 1, axis=0)
    geometry(folder, **arrays)


def index_out_of_range(folder: Path) -> None:
    arrays = fine_arrays()
    arrays["prolongation_indices"][3] = 128
    geometry(folder, **arrays)


def infinite_prolongation(folder: Path) -> None:
    arrays = fine_arrays()
    arrays["prolongation_weights"][3] = np.inf
    geometry(folder, **arrays)


def flat_modes(folder: Path) -> None:
    geometry(folder, modes=np.zeros((3, 192)))


def codes_too_long(folder: Path) -> None:
    geometry(folder, training_codes=np.zeros((5, 4)))


def too_few_vertices_of_files(folder: Path) -> None:
    geometry(folder, file_vertices=np.arange(63))


def no_training_codes(folder: Path) -> None:
    geometry(folder, training_codes=np.zeros((0, 3)))


def too_large_for_its_file(folder: Path) -> None:
    hostile.unpacks(folder, 2**22)


def repack(folder: Path, change: Callable[[bytearray, int], None]) -> None:
    """Change the ZIP directory of the geometry, from the offset of its first entry."""
    path = folder / "geometry.npz"
    data = bytearray(path.read_bytes())
    change(data, data.index(b"PK\x01\x02"))
    path.write_bytes(data)
    seal(folder)


def less_than_it_unpacks_to(folder: Path) -> None:
    def change(data: bytearray, entry: int) -> None:
        data[entry + 24 : entry + 28] = (200).to_bytes(4, "little")

    repack(folder, change)


def more_than_it_holds(folder: Path) -> None:
    """An array whose header declares a thousand million rows."""
    header = io.BytesIO()
    promise = {"descr": "<f8", "fortran_order": False, "shape": (999_999_999, 3)}
    np.lib.format.write_array_header_1_0(header, promise)
    with zipfile.ZipFile(folder / "geometry.npz", "w") as archive:
        archive.writestr("vertices.npy", header.getvalue() + bytes(24))
    seal(folder)


def packed_in_another_way(folder: Path) -> None:
    def change(data: bytearray, entry: int) -> None:
        data[entry + 10 : entry + 12] = (14).to_bytes(2, "little")  # LZMA

    repack(folder, change)


def vertices_of_files_that_are_none(folder: Path) -> None:
    geometry(folder, file_vertices=np.array([-1, *range(63), 64]))


FAULTS: dict[Spoil, str] = {
    flip_a_bit: "factor-0.onnx does not have the digest",
    promise_a_petabyte: "not 1125899906842624 as the manifest says",
    truncate: "geometry.npz has",
    append: "geometry.npz is longer than",
    add_a_file: "run.sh is not in the manifest",
    add_a_folder: "more is a link or not a plain file",
    remove_a_file: "combiner.onnx is missing",
    link_a_file: "combiner.onnx is a link",
    link_the_folder: "1 is a link",
    make_a_pipe: "combiner.onnx is a link or not a plain file",
    point_outside: "String should match pattern",
    no_json: "Invalid JSON",
    no_manifest: "manifest.json is missing",
    unknown_field: "surprise",
    other_schema: "schema_version",
    other_name: "of large/1, not of small/1",
    bounds_too_short: "lower has 1 entries",
    bounds_crossed: "lower must lie below upper",
    factors_overlap: "consecutive",
    more_edges: "the manifest says",
    nan_weight: "combiner.onnx: z has a weight that is not finite",
    infinite_constant: "combiner.onnx: c has a weight that is not finite",
    external_data: "keeps its data in another file",
    wrong_width: "factor-0.onnx must have one output",
    wrong_output_name: "factor-0.onnx must have one output",
    one_code_only: "factor-0.onnx must have one input",
    no_network: "factor-0.onnx is not a readable ONNX file",
    weight_of_no_type: "can't be read: The element type in the input tensor is UNDEFINED",
    too_few_weights: "can't be read: cannot reshape array",
    long_name_inside: "geometry.npz is not a readable NPZ file",
    nan_vertex: "vertex 5 has a coordinate that is not finite",
    unsorted_edges: "edges are not those of the faces",
    turned_face: "oriented oppositely",
    pickled_geometry: "geometry.npz is not a readable NPZ file",
    no_edges: "geometry.npz has no array 'edges'",
    no_fine_faces: "geometry.npz has no array 'fine_faces', which goes with",
    no_prolongation: "geometry.npz: there is no array prolongation_weights",
    fine_face_out_of_range: "geometry.npz: fine mesh: faces name vertices 0 to 512",
    fewer_fine_vertices: "the prolongation is to 512 vertices, but there are 64 fine_vertices",
    moved_fine_vertex: "fine_vertices are up to 1.0e+00 away",
    prolongation_of_other_faces: "prolongation_faces are not the faces of the mesh",
    index_out_of_range: "prolongation_indices must lie in [0, 128)",
    infinite_prolongation: "prolongation_weights has an entry that is not finite",
    flat_modes: "modes must be real numbers (3, 64, 3), not float64 (3, 192)",
    too_few_vertices_of_files: "file_vertices must be at least 64 whole numbers, not int64 (63,)",
    vertices_of_files_that_are_none: "file_vertices must name each of the vertices 0 to 63, or -1",
    no_training_codes: "geometry.npz: training_codes is empty",
    too_large_for_its_file: "geometry.npz: its arrays would come to",
    less_than_it_unpacks_to: "geometry.npz is not a readable NPZ file",
    more_than_it_holds: "geometry.npz is not a readable NPZ file: vertices.npy can't be float64 (999999999, 3)",
    packed_in_another_way: "geometry.npz is not a readable NPZ file: vertices.npy is packed in a way",
    codes_too_long: "training_codes must be real numbers (n, 3), not float64 (5, 4)",
}


def load(folder: Path) -> ShapeModel:
    return ShapeModel(read_bundle(folder))


@pytest.mark.parametrize("spoil", [pytest.param(spoil, id=spoil.__name__) for spoil in FAULTS])
def test_bundles_that_are_not_what_they_say_are_refused(tmp_path: Path, spoil: Spoil) -> None:
    folder = write_bundle(tmp_path)
    assert load(folder).manifest.name == "small"
    spoil(folder)
    with pytest.raises(BundleError) as refusal:
        load(folder)
    assert FAULTS[spoil] in str(refusal.value)
    assert len(str(refusal.value)) < 400


def test_a_bad_bundle_is_left_out_with_one_line(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_bundle(tmp_path, "good")
    flip_a_bit(write_bundle(tmp_path, "bad"))
    write_bundle(tmp_path, "half", "1")
    no_json(write_bundle(tmp_path, "half", "2"))
    with caplog.at_level(logging.ERROR):
        repository = ModelRepository(tmp_path)
    assert [model.manifest.name for model in repository] == ["good", "half"]
    assert repository.versions("half") == ["1"]
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2
    assert all("\n" not in message and "is not served" in message for message in messages)


def test_a_server_starts_without_models_and_says_so(tmp_path: Path, start: Start) -> None:
    flip_a_bit(write_bundle(tmp_path / "models"))
    server = start(tmp_path / "models")
    with httpx.Client(base_url=server.url) as client:
        assert client.get("/v1/models").json() == {"models": []}
        assert client.get("/v2/health/live").status_code == 200
        ready = client.get("/v2/health/ready")
        assert ready.status_code == 503
        assert "models folder" in ready.json()["detail"]
    assert "bundle small/1 is not served: factor-0.onnx" in server.stop()


@pytest.mark.long
def test_a_fine_mesh_of_a_hundred_and_sixty_thousand_vertices_is_no_bomb(tmp_path: Path) -> None:
    folder = synthetic.write(tmp_path, 500, 4)
    coarse, fine = synthetic.capsule(500), synthetic.capsule(160_000)
    prolong = Prolongation.of(coarse, fine)
    arrays = {"fine_vertices": prolong(coarse.vertices), "fine_faces": fine.faces.astype(np.int32), **prolong.arrays()}
    with np.load(folder / "geometry.npz") as known:
        arrays |= known
    for write in (np.savez, np.savez_compressed):
        with (folder / "geometry.npz").open("wb") as file:
            write(file, **arrays)
        seal(folder)
        repository = ModelRepository(tmp_path)
        assert repository.refused == []
        model = next(iter(repository))
        assert model.decoder.fine
        assert len(model.decoder.fine.reference.vertices) > 150_000


def name_with_a_line_break(models: Path) -> None:
    write_bundle(models, "bad").parent.rename(models / "bad\nINFO shapespace: bundle forged is served")


def of(harm: Callable[..., None], **options: object) -> Callable[[Path], object]:
    return lambda models: hostile.hostile(models, "bad", harm, **options)


#: Harmful bundles with correct manifests, and the log line expected for each.
ATTACKS: dict[str, tuple[Callable[[Path], object], str]] = {
    "loops": (of(hostile.loops), "bad/1 is not served: factor-0.onnx does not answer in time, for zeros"),
    "loops, with an if": (of(hostile.loops, nest="if"), "does not answer in time"),
    "loops, with a scan": (of(hostile.loops, nest="scan"), "does not answer in time"),
    "loops at its upper bounds": (of(hostile.loops, beyond=0.15), "does not answer in time, at a code inside"),
    "fails": (of(hostile.fails), "factor-0.onnx fails: "),
    "fails at its upper bounds": (of(hostile.fails, beyond=0.15), "indices element out of data bounds"),
    "allocates": (of(hostile.allocates), "std::bad_alloc"),
    "gives another shape": (of(hostile.changes_shape), "factor-0.onnx gives (2, 384), not (1, 384)"),
    "is not finite": (of(hostile.not_finite), "does not give finite numbers for zeros"),
    "has no training codes": (of(hostile.no_codes), "training_codes is empty"),
    "unpacks": (of(hostile.unpacks), "its arrays would come to 170000"),
    "forges a line": (name_with_a_line_break, r"bad\nINFO shapespace: bundle forged is served/1 is not served"),
}


@pytest.mark.parametrize(
    "attack",
    [
        pytest.param(name, marks=[] if name in {"loops", "allocates", "forges a line"} else pytest.mark.long)
        for name in ATTACKS
    ],
)
def test_a_server_starts_beside_any_bundle(tmp_path: Path, start: Start, attack: str) -> None:
    make, line = ATTACKS[attack]
    models = tmp_path / "models"
    write_bundle(models, "good")
    make(models)
    server = start(models, workers=2)
    with httpx.Client(base_url=server.url, timeout=60) as client:
        assert [model["name"] for model in client.get("/v1/models").json()["models"]] == ["good"]
        assert client.get("/v1/models/good/mesh", params={"latent": "0.1,0.7,0.4"}).status_code == 200
        assert value(samples(client), "shapespace_bundles_refused") == 1
    assert peak_memory(server) < 300 * 2**20
    log = server.stop().splitlines()
    assert sum(line in entry for entry in log) == 1, log
    assert not [entry for entry in log if entry.startswith("INFO shapespace: bundle forged")]
    assert len([entry for entry in log if entry.startswith("ERROR ")]) == 1, log


def messages(caplog: pytest.LogCaptureFixture) -> list[str]:
    found = [record.getMessage() for record in caplog.records if record.levelno >= logging.ERROR]
    caplog.clear()
    return found


def test_a_validation_that_never_ends_or_dies_keeps_no_other_bundle_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    hostile.hostile(tmp_path, "a", hostile.doubles)
    write_bundle(tmp_path, "b")
    monkeypatch.setattr(validation, "SECONDS", 8)
    repository = ModelRepository(tmp_path)
    assert [model.manifest.name for model in repository] == ["b"]
    assert messages(caplog) == ["bundle a/1 is not served: tried in a process of its own, it took longer than 8 s"]

    write_bundle(tmp_path, "c")
    monkeypatch.setitem(sandbox.TASKS, "validate", "tests.service.tasks:crash_at_c")
    assert repository.reload() == Changes(refused=["a/1", "c/1"])
    assert messages(caplog)[-1] == "bundle c/1 is not served: tried in a process of its own, it died of SIGSEGV"

    monkeypatch.undo()
    shutil.rmtree(tmp_path / "a")
    assert repository.reload() == Changes(loaded=["c/1"])


class Swapping(BundleValidator):
    """Changes each bundle between its validation and its use."""

    def digest(self, folder: Path) -> str:
        digest = super().digest(folder)
        rescale(folder, 2 * SCALE)
        return digest


def test_only_the_bundle_that_was_tried_is_served(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_bundle(tmp_path, "small")
    repository = ModelRepository(tmp_path, validator=Swapping())
    assert list(repository) == []
    assert messages(caplog) == ["bundle small/1 is not served: it changed while it was tried"]
    assert repository.reload() == Changes(loaded=["small/1"])
    assert repository.get("small").manifest.scale == 2 * SCALE


def test_what_nobody_expected_is_a_line_as_well(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("a", "b", "c"):
        write_bundle(tmp_path, name)
    real = ModelRepository._take_up

    def broken(self: ModelRepository, folder: Path, *more: object) -> ShapeModel:
        if folder.parent.name == "b":
            raise RuntimeError("surprise\nINFO forged")
        return real(self, folder, *more)  # type: ignore[arg-type]

    with monkeypatch.context() as patch:
        patch.setattr(ModelRepository, "_take_up", broken)
        repository = ModelRepository(tmp_path)
    assert [model.manifest.name for model in repository] == ["a", "c"]
    (line,) = messages(caplog)
    assert line.startswith("bundle b/1 is not served: RuntimeError: surprise INFO forged (test_bundles.py, line ")
    assert repository.reload() == Changes(loaded=["b/1"])

    listed = Path.iterdir

    def unreadable(path: Path) -> object:
        if path == tmp_path / "b":
            raise PermissionError(13, "Permission denied", str(path))
        return listed(path)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "iterdir", unreadable)
        assert repository.reload() == Changes(refused=["b"])
        assert [model.manifest.name for model in repository] == ["a", "b", "c"]
        assert repository.signature()
    assert "Permission denied" in messages(caplog)[0]
    assert repository.reload() == Changes()


def test_a_bundle_that_is_served_already_is_not_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_bundle(tmp_path, "small")
    repository = ModelRepository(tmp_path)
    model = repository.get("small")
    monkeypatch.setattr(sys, "executable", "/nowhere/python")
    assert repository.reload() == Changes()
    assert repository.get("small") is model
    flip_a_bit(tmp_path / "small" / "1")
    assert repository.reload() == Changes(refused=["small/1"])
    no_manifest(tmp_path / "small" / "1")
    assert repository.reload() == Changes(refused=["small/1"])
    assert repository.get("small") is model
