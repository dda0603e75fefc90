"""Small bundles with networks built by hand, whose lengths and angles are known in closed form."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from shapespace.bundle import writer
from shapespace.bundle.geometry import FineMesh, Geometry
from shapespace.bundle.schema import MANIFEST, Origin, Tolerance
from shapespace.bundle.writer import Facts, Networks
from shapespace.coordinates.nric import nric
from shapespace.mesh.prolongation import Prolongation
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.training.collection.generators import freaky_torus

SCALE = 3.0
LATENTS = ("size", "turn", "twist")


def reference() -> TriangleMesh:
    """A coarse torus of unit area."""
    mesh = torus(8, 8)
    return mesh.with_vertices(mesh.vertices / np.sqrt(mesh.area))


def fine_reference() -> TriangleMesh:
    """A finer torus in the same position; every other vertex of every fourth ring is a coarse vertex."""
    mesh = torus(32, 16)
    return mesh.with_vertices(mesh.vertices / np.sqrt(torus(8, 8).area))


def torus(n: int, m: int) -> TriangleMesh:
    """A torus of n rings with m vertices each."""
    v = freaky_torus.reference().vertices.reshape(64, 32, 3)[:: 64 // n, :: 32 // m].reshape(-1, 3)
    i, j = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")

    def at(di: int, dj: int) -> np.ndarray:
        return ((i + di) % n * m + (j + dj) % m).ravel()

    faces = np.concatenate([np.stack([at(0, 0), at(1, 0), at(1, 1)], 1), np.stack([at(0, 0), at(1, 1), at(0, 1)], 1)])
    return TriangleMesh.from_arrays(v, faces)


def directions(mesh: TriangleMesh) -> np.ndarray:
    """(3, 2E): what each latent adds to lengths and angles; the first, a uniform scaling, is integrable."""
    z = nric(mesh.vertices, mesh.connectivity)
    size = z.copy()
    size[mesh.connectivity.edge_count :] = 0
    stretched = nric(mesh.vertices * [1.15, 1, 1], mesh.connectivity) - z
    twisted = nric(mesh.vertices * [1, 1, 1.3], mesh.connectivity) - z
    return np.stack([size, stretched, twisted])


def expected_nric(code: np.ndarray) -> np.ndarray:
    """(2E,) the bundle's lengths and angles for a code (3,), normalised."""
    mesh = reference()
    a = np.array([code[0], np.sin(code[1]), code[2]])
    return nric(mesh.vertices, mesh.connectivity) + a @ directions(mesh)


def network(nodes: list[Any], weights: dict[str, np.ndarray], row_in: tuple, row_out: tuple) -> onnx.ModelProto:
    """A model from ``latent`` or ``factors`` to ``nric`` or ``vertices``, as the nodes name them."""
    source, target = nodes[0].input[0], nodes[-1].output[0]
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info(source, TensorProto.FLOAT, ["n", *row_in])],
        [helper.make_tensor_value_info(target, TensorProto.FLOAT, ["n", *row_out])],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.checker.check_model(model)
    return model


def networks(idle: int = 0) -> dict[str, onnx.ModelProto]:
    """Factor 0 is ``size``; factor 1 the angle ``turn``, ``twist`` and idle ones; the combiner is the sum."""
    mesh = reference()
    z = nric(mesh.vertices, mesh.connectivity)
    d = directions(mesh)
    wide = len(z)
    # The sine of the first coordinate and the second itself, selected by masks.
    periodic = [
        helper.make_node("Sin", ["latent"], ["sine"]),
        helper.make_node("Mul", ["sine", "first"], ["angle"]),
        helper.make_node("Mul", ["latent", "second"], ["rest"]),
        helper.make_node("Add", ["angle", "rest"], ["features"]),
        helper.make_node("MatMul", ["features", "D"], ["offset"]),
        helper.make_node("Add", ["offset", "z"], ["nric"]),
    ]
    return {
        "factor-0.onnx": network(
            [
                helper.make_node("MatMul", ["latent", "D"], ["offset"]),
                helper.make_node("Add", ["offset", "z"], ["nric"]),
            ],
            {"D": d[:1], "z": z},
            (1,),
            (wide,),
        ),
        "factor-1.onnx": network(
            periodic,
            {
                "first": np.eye(2 + idle)[0],
                "second": np.eye(2 + idle)[1],
                "D": np.pad(d[1:], [(0, idle), (0, 0)]),
                "z": z,
            },
            (2 + idle,),
            (wide,),
        ),
        "combiner.onnx": network(
            [
                helper.make_node("Einsum", ["factors"], ["sum"], equation="njz->nz"),
                helper.make_node("Sub", ["sum", "z"], ["nric"]),
            ],
            {"z": z},
            (2, wide),
            (wide,),
        ),
    }


def start_network() -> onnx.ModelProto:
    """A start network for Gauss–Newton that uses ``size`` only."""
    mesh = reference()
    flat = mesh.vertices.reshape(1, -1)
    weights = {"D": np.concatenate([flat, 0 * flat, 0 * flat]), "x": flat}
    nodes = [
        helper.make_node("MatMul", ["latent", "D"], ["offset"]),
        helper.make_node("Add", ["offset", "x"], ["flat"]),
        helper.make_node("Reshape", ["flat", "shape"], ["vertices"]),
    ]
    model = network_with_shape(nodes, weights, mesh)
    onnx.checker.check_model(model)
    return model


def network_with_shape(nodes: list[Any], weights: dict[str, np.ndarray], mesh: TriangleMesh) -> onnx.ModelProto:
    graph = helper.make_graph(
        nodes,
        "start",
        [helper.make_tensor_value_info("latent", TensorProto.FLOAT, ["n", 3])],
        [helper.make_tensor_value_info("vertices", TensorProto.FLOAT, ["n", len(mesh.vertices), 3])],
        [
            *(numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in weights.items()),
            numpy_helper.from_array(np.array([-1, len(mesh.vertices), 3], np.int64), "shape"),
        ],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)


def facts(name: str = "small", version: str = "1", *, idle: int = 0) -> Facts:
    """Facts for the manifest, except those that follow from the files."""
    return Facts(
        name=name,
        version=version,
        licence="CC0-1.0",
        title="Small torus",
        description="A torus for tests.",
        latent_names=[*LATENTS, *(f"idle-{k}" for k in range(idle))],
        factors={"size": [0], "form": list(range(1, 3 + idle))},
        lower=np.array([-0.2, -np.pi, 0.0, *[-1.0] * idle]),
        upper=np.array([0.2, np.pi, 1.0, *[1.0] * idle]),
        period=np.array([np.nan, 2 * np.pi, np.nan, *[np.nan] * idle]),
        material=Material(),
        eta_reconstruction=1e-2,
        scale=SCALE,
        tolerance=Tolerance(required=1e-4, measured=1e-7),
        figures={
            "r2": {"composite": {"total": 1.0}},
            "generalisation": {
                "held_out": 3,
                "steps": 8,
                "counts": [1, 2],
                "modes": [{"mean": 0.04, "p95": 0.06}, {"mean": 0.03, "p95": 0.05}],
                "components": [{"mean": 0.08, "p95": 0.12}, {"mean": 0.05, "p95": 0.07}],
                "worst": "a",
            },
            "compactness": {"modes": 0.9, "components": 0.8},
            "specificity": {"modes": 0.02, "components": 0.03},
        },
        origin=Origin(config={}, data_digest="0" * 64, code_version="test"),
    )


def geometry(*, fine: bool | TriangleMesh = False) -> Geometry:
    """The reference; if ``fine``, also a fine mesh, that one or another, modes and training codes."""
    mesh = reference()
    if fine is False:
        return Geometry(reference=mesh)
    finer = fine_reference() if fine is True else fine
    return Geometry(
        reference=mesh,
        fine=FineMesh(finer, Prolongation.of(mesh, finer)),
        modes=np.zeros((3, len(mesh.vertices), 3)),
        training_codes=np.array([[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2], [0.1, 3, 0.5], [0.1, -3, 0.5]]),
    )


def write_bundle(
    models: Path,
    name: str = "small",
    version: str = "1",
    *,
    start: bool = False,
    fine: bool | TriangleMesh = False,
    idle: int = 0,
) -> Path:
    """Write a complete bundle and return its folder; idle coordinates come last and have no effect."""
    *factors, combiner = (model.SerializeToString() for model in networks(idle).values())
    files = Networks(factors=factors, combiner=combiner, start=start_network().SerializeToString() if start else None)
    return writer.write_bundle(models, facts(name, version, idle=idle), files, geometry(fine=fine))


def seal(folder: Path) -> None:
    """Update the manifest's digests after files have been changed."""
    path = folder / MANIFEST
    files = sorted(file for file in folder.iterdir() if file.is_file() and file != path)
    entries = {file.name: writer.entry(file.read_bytes()).model_dump() for file in files}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"files": entries}))


def rescale(folder: Path, scale: float) -> None:
    """Replace a bundle by one whose lengths are in other units, in one step as `export` does."""
    facts = json.loads((folder / MANIFEST).read_text()) | {"scale": scale}
    part = folder.parent / ".manifest.json"
    part.write_text(json.dumps(facts))
    part.replace(folder / MANIFEST)
