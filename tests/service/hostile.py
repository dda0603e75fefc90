"""Bundles that are well formed, with correct digests, but harmful when they are loaded or run."""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from tests.service.bundles import directions, networks, reference, seal, write_bundle

#: The first coordinate's bound is 0.2: harm beyond this value is not seen in the validation run.
BEYOND = 0.3
#: A code beyond it.
HARMFUL = [0.5, 0.7, 0.4]
_ALWAYS = -1e30

node = helper.make_node


def _value(name: str, kind: int, shape: list[Any] | None = None) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape)


def _graph(name: str, nodes: list[onnx.NodeProto], inputs: list[Any], outputs: list[Any]) -> onnx.GraphProto:
    return helper.make_graph(nodes, name, inputs, outputs)


def spoil_factor(
    folder: Path, nodes: list[onnx.NodeProto], weights: Mapping[str, np.ndarray] | None = None, beyond: float = _ALWAYS
) -> None:
    """Let factor 0 add ``harm``, computed by the nodes from ``trigger``, which is: latent > beyond."""
    mesh = reference()
    model = networks()["factor-0.onnx"]
    z = numpy_helper.to_array(next(w for w in model.graph.initializer if w.name == "z"))
    known = {"D": directions(mesh)[:1].astype(np.float32), "z": z, "beyond": np.float32(beyond), **(weights or {})}
    graph = helper.make_graph(
        [
            node("ReduceMax", ["latent"], ["largest"], keepdims=0),
            node("Greater", ["largest", "beyond"], ["trigger"]),
            *nodes,
            node("MatMul", ["latent", "D"], ["offset"]),
            node("Add", ["offset", "z"], ["sound"]),
            node("Add", ["sound", "harm"], ["nric"]),
        ],
        "network",
        [_value("latent", TensorProto.FLOAT, ["n", 1])],
        [_value("nric", TensorProto.FLOAT, ["n", len(z)])],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in known.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    (folder / "factor-0.onnx").write_bytes(model.SerializeToString())
    seal(folder)


def loops(folder: Path, beyond: float = _ALWAYS, nest: str = "") -> None:
    """A loop that never ends once it is triggered, alone or with an If or a Scan in it."""
    body = [node("Identity", ["on"], ["on_again"])]
    if nest == "if":
        branches = {
            name: _graph(name, [node("Neg", ["v"], [name])], [], [_value(name, TensorProto.FLOAT)])
            for name in ("then_branch", "else_branch")
        }
        body.append(node("If", ["on"], ["w"], **branches))
    elif nest == "scan":
        step = _graph(
            "step",
            [node("Add", ["s", "row"], ["s_next"]), node("Identity", ["s_next"], ["seen"])],
            [_value("s", TensorProto.FLOAT, []), _value("row", TensorProto.FLOAT, [])],
            [_value("s_next", TensorProto.FLOAT, []), _value("seen", TensorProto.FLOAT, [])],
        )
        body += [node("Scan", ["nothing", "rows"], ["sum", "sums"], body=step, num_scan_inputs=1)]
        body += [node("Add", ["v", "sum"], ["w"])]
    else:
        body.append(node("Neg", ["v"], ["w"]))
    around = _graph(
        "body",
        body,
        [_value("k", TensorProto.INT64, []), _value("on", TensorProto.BOOL, []), _value("v", TensorProto.FLOAT)],
        [_value("on_again", TensorProto.BOOL, []), _value("w", TensorProto.FLOAT)],
    )
    weights = {"most": np.int64(2**62), "nothing": np.float32(0), "rows": np.zeros(10**5, np.float32)}
    spoil_factor(folder, [node("Loop", ["most", "trigger", "nothing"], ["harm"], body=around)], weights, beyond)


def allocates(folder: Path, beyond: float = _ALWAYS, gigabytes: float = 8) -> None:
    """Allocates much memory without using it."""
    nodes = [
        node("Cast", ["trigger"], ["times"], to=TensorProto.INT64),
        node("Mul", ["times", "many"], ["count"]),
        node("ConstantOfShape", ["count"], ["zeros"]),
        node("ReduceSum", ["zeros"], ["harm"], keepdims=0),
    ]
    spoil_factor(folder, nodes, {"many": np.array([int(gigabytes * 2**28)])}, beyond)


def fails(folder: Path, beyond: float = _ALWAYS) -> None:
    """Fails with an index far out of range."""
    nodes = [
        node("Cast", ["trigger"], ["times"], to=TensorProto.INT64),
        node("Mul", ["times", "far"], ["index"]),
        node("Gather", ["nothing", "index"], ["harm"]),
    ]
    spoil_factor(folder, nodes, {"far": np.int64(2**40), "nothing": np.zeros(1, np.float32)}, beyond)


def changes_shape(folder: Path, beyond: float = _ALWAYS) -> None:
    """Answers two rows instead of one once it is triggered."""
    nodes = [
        node("Cast", ["trigger"], ["times"], to=TensorProto.INT64),
        node("Add", ["times", "one"], ["count"]),
        node("Concat", ["count", "one"], ["shape"], axis=0),
        node("ConstantOfShape", ["shape"], ["harm"]),
    ]
    spoil_factor(folder, nodes, {"one": np.array([1])}, beyond)


def not_finite(folder: Path, beyond: float = _ALWAYS) -> None:
    """Answers NaN, from 0/0."""
    nodes = [
        node("Cast", ["trigger"], ["times"], to=TensorProto.FLOAT),
        node("Sub", ["one", "times"], ["rest"]),
        node("Div", ["rest", "rest"], ["ratio"]),
        node("Sub", ["ratio", "one"], ["harm"]),
    ]
    spoil_factor(folder, nodes, {"one": np.float32(1)}, beyond)


def doubles(folder: Path) -> None:
    """Forty functions, each of which calls the next one twice: inlined they are a terabyte of nodes."""
    own = [helper.make_opsetid("", 18), helper.make_opsetid("own", 1)]
    functions = [
        helper.make_function(
            "own", f"f{k}", ["a"], ["c"],
            [node(f"f{k + 1}", ["a"], ["b"], domain="own"), node(f"f{k + 1}", ["b"], ["c"], domain="own")], own,
        )
        for k in range(40)
    ]  # fmt: skip
    functions.append(helper.make_function("own", "f40", ["a"], ["b"], [node("Neg", ["a"], ["b"])], own))
    spoil_factor(folder, [node("Neg", ["beyond"], ["harm"])])
    model = onnx.load(folder / "factor-0.onnx")
    harm = next(n for n in model.graph.node if n.output[0] == "harm")
    harm.op_type, harm.domain = "f0", "own"
    model.functions.extend(functions)
    model.opset_import.append(helper.make_opsetid("own", 1))
    (folder / "factor-0.onnx").write_bytes(model.SerializeToString())
    seal(folder)


def no_codes(folder: Path) -> None:
    """An empty array of training codes."""
    add_arrays(folder, training_codes=np.zeros((0, 3)))


def unpacks(folder: Path, size: int = 1_700_000_000) -> None:
    """An array of zeros that is compressed to a thousandth of its size."""
    path = folder / "geometry.npz"
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (size,)})
    with (
        zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
        archive.open("more.npy", "w", force_zip64=True) as file,
    ):
        file.write(header.getvalue())
        for _ in range(size // 2**20):
            file.write(bytes(2**20))
        file.write(bytes(size % 2**20))
    seal(folder)


def add_arrays(folder: Path, **arrays: np.ndarray) -> None:
    """Add arrays to the geometry, or replace some."""
    path = folder / "geometry.npz"
    with np.load(path) as known:
        every = {**known, **arrays}
    with path.open("wb") as file:
        np.savez(file, **every)
    seal(folder)


def hostile(models: Path, name: str, harm: Any, *args: Any, **options: Any) -> Path:
    """A small bundle of that name with this harm in it."""
    folder = write_bundle(models, name)
    harm(folder, *args, **options)
    return folder


def manifest(folder: Path, **changes: object) -> None:
    """Change members of a manifest; the files' digests stay the same."""
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
