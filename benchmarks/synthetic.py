"""Bundles of any size for benchmarks: capsules that bulge, with linear networks written by hand."""

from pathlib import Path

import numpy as np
import onnx
import trimesh
from onnx import TensorProto, helper, numpy_helper

from shapespace.arrays import FloatArray
from shapespace.bundle.geometry import Geometry
from shapespace.bundle.schema import Origin, Tolerance
from shapespace.bundle.writer import Facts, Networks, write_bundle
from shapespace.coordinates.nric import nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material

LATENTS_OF_A_FACTOR = 4


def capsule(vertices: int) -> TriangleMesh:
    """Return a capsule of meridians and circles of latitude, with about ``vertices`` vertices and unit area."""
    count = round(np.sqrt(vertices))
    made = trimesh.creation.capsule(height=2, radius=1, count=[count, count])
    mesh = TriangleMesh.from_arrays(made.vertices, made.faces)
    return mesh.with_vertices(mesh.vertices / np.sqrt(mesh.area))


def directions(mesh: TriangleMesh, count: int) -> FloatArray:
    """Return changes (count, 2E) of lengths and angles by each latent, from smooth random deformations."""
    rng, x = np.random.default_rng(0), mesh.vertices / mesh.diagonal
    rest = nric(mesh.vertices, mesh.connectivity)
    changes = []
    for _ in range(count):
        wave, phase, axis = 3 * rng.standard_normal(3), rng.uniform(0, 6), rng.standard_normal(3)
        offset = 0.1 * mesh.diagonal / np.sqrt(count) * np.outer(np.sin(x @ wave + phase), axis / np.linalg.norm(axis))
        changes.append(nric(mesh.vertices + offset, mesh.connectivity) - rest)
    return np.stack(changes)


def _network(nodes: list[onnx.NodeProto], weights: dict[str, FloatArray], row_in: list[int], size: int) -> bytes:
    source = nodes[0].input[0]
    graph = helper.make_graph(
        nodes,
        "network",
        [helper.make_tensor_value_info(source, TensorProto.FLOAT, ["n", *row_in])],
        [helper.make_tensor_value_info("nric", TensorProto.FLOAT, ["n", size])],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    return bytes(model.SerializeToString())


def write(models: Path, vertices: int, latents: int) -> Path:
    """Write a bundle into ``models/``; return its folder."""
    mesh = capsule(vertices)
    name = f"capsule-{vertices}-{latents}"
    rest, changes = nric(mesh.vertices, mesh.connectivity), directions(mesh, latents)
    groups = [range(latents)[k : k + LATENTS_OF_A_FACTOR] for k in range(0, latents, LATENTS_OF_A_FACTOR)]
    nodes = [helper.make_node("Gemm", ["latent", "D", "z"], ["nric"])]
    add_up = [
        helper.make_node("Einsum", ["factors"], ["sum"], equation="njz->nz"),
        helper.make_node("Sub", ["sum", "more"], ["nric"]),
    ]
    networks = Networks(
        factors=[_network(nodes, {"D": changes[list(k)], "z": rest}, [len(k)], len(rest)) for k in groups],
        combiner=_network(add_up, {"more": (len(groups) - 1) * rest}, [len(groups), len(rest)], len(rest)),
    )
    facts = Facts(
        name=name,
        version="1",
        licence="MIT",
        title=name,
        description="For benchmarks.",
        latent_names=[f"latent {k}" for k in range(latents)],
        factors={f"factor {j}": group for j, group in enumerate(groups)},
        lower=np.full(latents, -1.0),
        upper=np.full(latents, 1.0),
        period=np.full(latents, np.nan),
        material=Material(),
        eta_reconstruction=1e-2,
        scale=1.0,
        tolerance=Tolerance(required=1e-4, measured=1e-7),
        figures={},
        origin=Origin(config={}, data_digest="0" * 64, code_version="benchmark"),
    )
    return write_bundle(models, facts, networks, Geometry(reference=mesh))
