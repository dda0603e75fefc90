"""Bundles of any size for benchmarks: capsules that bulge, with linear networks written down by hand."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import onnx
import trimesh
from onnx import TensorProto, helper, numpy_helper

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import nric
from shapespace.files.formats import npz
from shapespace.mesh.triangle_mesh import TriangleMesh

LATENTS_OF_A_FACTOR = 4


def capsule(vertices: int) -> TriangleMesh:
    """About so many vertices, of unit area."""
    count = round(np.sqrt(vertices))
    made = trimesh.creation.capsule(height=2, radius=1, count=[count, count])
    mesh = TriangleMesh.from_arrays(made.vertices, made.faces)
    return mesh.with_vertices(mesh.vertices / np.sqrt(mesh.area))


def directions(mesh: TriangleMesh, count: int) -> FloatArray:
    """(count, 2E): what each latent adds to lengths and angles, of smooth random deformations."""
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
    """A bundle in ``models/``; returns its folder."""
    mesh = capsule(vertices)
    name = f"capsule-{vertices}-{latents}"
    folder = models / name / "1"
    folder.mkdir(parents=True)
    rest, changes = nric(mesh.vertices, mesh.connectivity), directions(mesh, latents)
    starts = range(0, latents, LATENTS_OF_A_FACTOR)
    factors = []
    for j, start in enumerate(starts):
        part = changes[start : start + LATENTS_OF_A_FACTOR]
        nodes = [helper.make_node("Gemm", ["latent", "D", "z"], ["nric"])]
        file = f"factor-{j}.onnx"
        (folder / file).write_bytes(_network(nodes, {"D": part, "z": rest}, [len(part)], len(rest)))
        facts = {"name": f"factor {j}", "start": start, "stop": start + len(part)}
        factors.append(facts | {"file": file, "input": "latent", "output": "nric"})
    add_up = [
        helper.make_node("Einsum", ["factors"], ["sum"], equation="njz->nz"),
        helper.make_node("Sub", ["sum", "more"], ["nric"]),
    ]
    more = {"more": (len(factors) - 1) * rest}
    (folder / "combiner.onnx").write_bytes(_network(add_up, more, [len(factors), len(rest)], len(rest)))
    (folder / "geometry.npz").write_bytes(npz(vertices=mesh.vertices, faces=mesh.faces, edges=mesh.edges))
    files = {
        path.name: {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "bytes": path.stat().st_size}
        for path in sorted(folder.iterdir())
    }
    manifest = {
        "schema_version": 1,
        "name": name,
        "version": "1",
        "licence": "MIT",
        "title": name,
        "description": "For benchmarks.",
        "latent_dimension": latents,
        "latent_names": [f"latent {k}" for k in range(latents)],
        "factors": factors,
        "lower": [-1.0] * latents,
        "upper": [1.0] * latents,
        "period": [None] * latents,
        "edges": len(mesh.edges),
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "mu": 1.0,
        "lambda": 1.0,
        "eta": 1e-4,
        "eta_reconstruction": 1e-2,
        "scale": 1.0,
        "combiner": {"file": "combiner.onnx", "input": "factors", "output": "nric"},
        "start": None,
        "geometry": {"file": "geometry.npz"},
        "onnx_tolerance": {"required": 1e-4, "measured": 1e-7},
        "figures": {},
        "origin": {"config": {}, "data_digest": "0" * 64, "code_version": "benchmark"},
        "files": files,
    }
    (folder / "manifest.json").write_text(json.dumps(manifest))
    return folder
