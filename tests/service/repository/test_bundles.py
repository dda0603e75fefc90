"""What the loader refuses, and with which words."""

import io
import json
import operator
import os
import shutil
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.files.npz import npz_bytes
from shapespace.model.shape_model import ShapeModel
from tests.service import hostile
from tests.service.bundles import geometry as geometry_of
from tests.service.bundles import network, networks, reference, seal, write_bundle

Spoil = Callable[[Path], object]


def facts(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "manifest.json").read_text())
    return found


def rewrite(folder: Path, **changes: object) -> None:
    (folder / "manifest.json").write_text(json.dumps(facts(folder) | changes))


def manifest_with(**changes: object) -> Spoil:
    return lambda folder: rewrite(folder, **changes)


def bytes_of(file: str, change: Callable[[bytearray], object], *, sealed: bool = False) -> Spoil:
    """Change a file's bytes; if sealed, the manifest has the digest of the changed file."""

    def spoil(folder: Path) -> None:
        data = bytearray((folder / file).read_bytes())
        change(data)
        (folder / file).write_bytes(data)
        if sealed:
            seal(folder)

    return spoil


def put(start: int, *values: int) -> Callable[[bytearray], object]:
    """Overwrite bytes from an offset on."""
    return lambda data: operator.setitem(data, slice(start, start + len(values)), bytes(values))


def put_in_directory(start: int, *values: int) -> Callable[[bytearray], object]:
    """Overwrite bytes of the first entry of a ZIP's directory."""
    return lambda data: put(data.index(b"PK\x01\x02") + start, *values)(data)


def other_middle(data: bytearray) -> None:
    data[len(data) // 2] ^= 1


flip_a_bit = bytes_of("factor-0.onnx", other_middle)


def promise_a_petabyte(folder: Path) -> None:
    files = facts(folder)["files"]
    files["geometry.npz"]["bytes"] = 2**50
    rewrite(folder, files=files)


def factors_overlap(folder: Path) -> None:
    factors = facts(folder)["factors"]
    factors[1]["start"] = 0
    rewrite(folder, factors=factors)


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


def network_with(change: Callable[[onnx.ModelProto], object], file: str = "combiner.onnx") -> Spoil:
    """Change a network and seal the bundle."""

    def spoil(folder: Path) -> None:
        model = networks()[file]
        change(model)
        (folder / file).write_bytes(model.SerializeToString())
        seal(folder)

    return spoil


def nan_weight(model: onnx.ModelProto) -> None:
    weight = model.graph.initializer[0]
    values = numpy_helper.to_array(weight).copy()
    values[3] = np.nan
    weight.CopyFrom(numpy_helper.from_array(values, weight.name))


def infinite_constant(model: onnx.ModelProto) -> None:
    value = helper.make_tensor("c", TensorProto.FLOAT, [1], [np.inf])
    model.graph.node.insert(0, helper.make_node("Constant", [], ["unused"], value=value))


def external_data(model: onnx.ModelProto) -> None:
    weight = model.graph.initializer[0]
    weight.ClearField("raw_data")
    weight.data_location = TensorProto.EXTERNAL
    weight.external_data.add(key="location", value="../../../../etc/passwd")


def factor_of(width: int, output: str = "nric") -> Callable[[onnx.ModelProto], object]:
    """Replace the network by one that has this width and this name of its output."""
    nodes = [helper.make_node("MatMul", ["latent", "D"], [output])]
    return lambda model: model.CopyFrom(network(nodes, {"D": np.ones((1, width))}, (1,), (width,)))


def one_code_only(model: onnx.ModelProto) -> None:
    for end in (*model.graph.input, *model.graph.output):
        end.type.tensor_type.shape.dim[0].dim_value = 1


def weight_of_no_type(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].data_type = TensorProto.UNDEFINED


def too_few_weights(model: onnx.ModelProto) -> None:
    model.graph.initializer[0].dims[0] += 1


Change = Callable[[np.ndarray], np.ndarray] | np.ndarray | None


def arrays_with(*, fine: bool = False, **changes: Change) -> Spoil:
    """Replace arrays of the geometry and seal the bundle: by another one, by a changed one, or by none."""

    def spoil(folder: Path) -> None:
        arrays = geometry_of(fine=fine).arrays()
        for name, change in changes.items():
            new = change(arrays[name].copy()) if callable(change) else change
            arrays = {key: array for key, array in arrays.items() if key != name}
            arrays |= {} if new is None else {name: new}
        (folder / "geometry.npz").write_bytes(npz_bytes(arrays))
        seal(folder)

    return spoil


def entry(index: Any, value: float) -> Callable[[np.ndarray], np.ndarray]:
    """Change one entry of an array."""

    def change(array: np.ndarray) -> np.ndarray:
        array[index] = value
        return array

    return change


def more_than_it_holds(folder: Path) -> None:
    """An array whose header declares a thousand million rows."""
    header = io.BytesIO()
    promise = {"descr": "<f8", "fortran_order": False, "shape": (999_999_999, 3)}
    np.lib.format.write_array_header_1_0(header, promise)
    with zipfile.ZipFile(folder / "geometry.npz", "w") as archive:
        archive.writestr("vertices.npy", header.getvalue() + bytes(24))
    seal(folder)


COARSE = reference()
WIDTH = 2 * len(COARSE.edges)
FACTOR, GEOMETRY = "factor-0.onnx", "geometry.npz"
#: Ways to spoil a bundle, and what the refusal says.
FAULTS: dict[str, tuple[Spoil, str]] = {
    "flip a bit": (flip_a_bit, "factor-0.onnx does not have the digest"),
    "promise a petabyte": (promise_a_petabyte, "not 1125899906842624 as the manifest says"),
    "truncate": (bytes_of(GEOMETRY, lambda data: data.__delitem__(slice(-10, None))), "geometry.npz has"),
    "append": (bytes_of(GEOMETRY, lambda data: data.extend(b"more")), "geometry.npz has more than"),
    "add a file": (lambda folder: (folder / "run.sh").write_text("echo"), "run.sh is not in the manifest"),
    "add a folder": (lambda folder: (folder / "more").mkdir(), "more is a link or not a plain file"),
    "remove a file": (lambda folder: (folder / "combiner.onnx").unlink(), "combiner.onnx is missing"),
    "link a file": (link_a_file, "combiner.onnx is a link"),
    "link the folder": (link_the_folder, "1 is a link"),
    "make a pipe": (make_a_pipe, "combiner.onnx is a link or not a plain file"),
    "point outside": (point_outside, "String should match pattern"),
    "no JSON": (lambda folder: (folder / "manifest.json").write_text("{"), "Invalid JSON"),
    "no manifest": (lambda folder: (folder / "manifest.json").unlink(), "manifest.json is missing"),
    "unknown field": (manifest_with(surprise=1), "surprise"),
    "other schema": (manifest_with(schema_version=2), "schema_version"),
    "other name": (manifest_with(name="large"), "of large/1, not of small/1"),
    "bounds too short": (manifest_with(lower=[0.0]), "lower has 1 entries"),
    "bounds crossed": (manifest_with(lower=[1.0] * 3, upper=[0.0, 2.0, 2.0]), "lower must lie below upper"),
    "factors overlap": (factors_overlap, "consecutive"),
    "more edges": (manifest_with(edges=193), "the manifest says"),
    "NaN weight": (network_with(nan_weight), "combiner.onnx: z has a weight that is not finite"),
    "infinite constant": (network_with(infinite_constant), "combiner.onnx: c has a weight that is not finite"),
    "external data": (network_with(external_data, FACTOR), "has its data in another file"),
    "wrong width": (network_with(factor_of(7), FACTOR), "factor-0.onnx must have one output"),
    "wrong output name": (network_with(factor_of(WIDTH, "z"), FACTOR), "factor-0.onnx must have one output"),
    "one code only": (network_with(one_code_only, FACTOR), "factor-0.onnx must have one input"),
    "no network": (
        bytes_of(FACTOR, lambda data: operator.setitem(data, slice(None), b"not a network"), sealed=True),
        "factor-0.onnx is not a readable ONNX file",
    ),
    "weight of no type": (
        network_with(weight_of_no_type),
        "can't be read: The element type in the input tensor is UNDEFINED",
    ),
    "too few weights": (network_with(too_few_weights), "can't be read: cannot reshape array"),
    # The first member's header has a name of 1500 bytes, all of which zipfile quotes in its error.
    "long name inside": (
        bytes_of(GEOMETRY, put(26, *(1500).to_bytes(2, "little")), sealed=True),
        "geometry.npz is not a readable NPZ file",
    ),
    "NaN vertex": (arrays_with(vertices=entry((5, 1), np.nan)), "vertex 5 has a coordinate that is not finite"),
    "unsorted edges": (arrays_with(edges=lambda edges: edges[::-1]), "edges are not those of the faces"),
    "turned face": (arrays_with(faces=entry(0, COARSE.faces[0, ::-1])), "oriented oppositely"),
    "pickled geometry": (
        arrays_with(vertices=np.array([{"a": 1}], dtype=object)),
        "geometry.npz is not a readable NPZ file",
    ),
    "no edges": (arrays_with(edges=None), "geometry.npz has no array 'edges'"),
    "no fine faces": (
        arrays_with(fine=True, fine_faces=None),
        "geometry.npz has no array 'fine_faces', which goes with",
    ),
    "no prolongation": (
        arrays_with(fine=True, prolongation_weights=None),
        "geometry.npz: there is no array prolongation_weights",
    ),
    "fine face out of range": (
        arrays_with(fine=True, fine_faces=entry((7, 1), 512)),
        "geometry.npz: fine mesh: faces name vertices 0 to 512",
    ),
    "fewer fine vertices": (
        arrays_with(fine=True, fine_vertices=COARSE.vertices, fine_faces=COARSE.faces),
        "the prolongation is to 512 vertices, but there are 64 fine_vertices",
    ),
    "moved fine vertex": (
        arrays_with(fine=True, fine_vertices=lambda vertices: vertices + np.eye(512, 3)),
        "fine_vertices are up to 1.0e+00 away",
    ),
    "prolongation of other faces": (
        arrays_with(fine=True, prolongation_faces=lambda faces: np.roll(faces, 1, axis=0)),
        "prolongation_faces are not the faces of the mesh",
    ),
    "index out of range": (
        arrays_with(fine=True, prolongation_indices=entry(3, 128)),
        "prolongation_indices must lie in [0, 128)",
    ),
    "infinite prolongation": (
        arrays_with(fine=True, prolongation_weights=entry(3, np.inf)),
        "prolongation_weights has an entry that is not finite",
    ),
    "flat modes": (
        arrays_with(modes=np.zeros((3, 192))),
        "modes must be real numbers (3, 64, 3), not float64 (3, 192)",
    ),
    "too few vertices of files": (
        arrays_with(file_vertices=np.arange(63)),
        "file_vertices must be at least 64 whole numbers, not int64 (63,)",
    ),
    "vertices of files that are none": (
        arrays_with(file_vertices=np.array([-1, *range(63), 64])),
        "file_vertices must name each of the vertices 0 to 63, or -1",
    ),
    "no training codes": (arrays_with(training_codes=np.zeros((0, 3))), "geometry.npz: training_codes is empty"),
    "codes too long": (
        arrays_with(training_codes=np.zeros((5, 4))),
        "training_codes must be real numbers (n, 3), not float64 (5, 4)",
    ),
    "too large for its file": (
        lambda folder: hostile.unpacks(folder, 2**22),
        "geometry.npz: its arrays would have",
    ),
    "less than it unpacks to": (
        bytes_of(GEOMETRY, put_in_directory(24, *(200).to_bytes(4, "little")), sealed=True),
        "geometry.npz is not a readable NPZ file",
    ),
    "more than it holds": (
        more_than_it_holds,
        "geometry.npz is not a readable NPZ file: vertices.npy can't be float64 (999999999, 3)",
    ),
    "packed in another way": (
        bytes_of(GEOMETRY, put_in_directory(10, *(14).to_bytes(2, "little")), sealed=True),  # LZMA
        "geometry.npz is not a readable NPZ file: vertices.npy is compressed in a way",
    ),
}


def load(folder: Path) -> ShapeModel:
    return ShapeModel(read_bundle(folder))


@pytest.mark.parametrize("fault", FAULTS)
def test_bundles_that_are_not_what_they_say_are_refused(tmp_path: Path, fault: str) -> None:
    spoil, says = FAULTS[fault]
    folder = write_bundle(tmp_path)
    assert load(folder).manifest.name == "small"
    spoil(folder)
    with pytest.raises(BundleError) as refusal:
        load(folder)
    assert says in str(refusal.value)
    assert len(str(refusal.value)) < 400
