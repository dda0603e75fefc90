"""Bundles: ONNX files, geometry and a manifest, written only where ONNX and PyTorch agree."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import warnings
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.coordinates.nric import WeightedNorm
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.layers import narrowest
from shapespace.training.learning.networks import Composite, StartNetwork, predict
from shapespace.training.runs.config import Config
from shapespace.training.runs.files import write_npz
from shapespace.training.runs.sampling import Collection

OPSET = 18


class ExportError(RuntimeError):
    """The bundle would not compute what the networks compute."""


def _to_onnx(network: nn.Module, example: Tensor, names: tuple[str, str], path: Path) -> None:
    network.eval()
    # Without gradients, so that the network takes its path of plain gathers and sums.
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program: Any = torch.onnx.export(
            network,
            (example,),
            input_names=[names[0]],
            output_names=[names[1]],
            dynamic_shapes=({0: torch.export.Dim("n", min=1)},),
            opset_version=OPSET,
            dynamo=True,
            verbose=False,
        )
    program.save(path, external_data=False)
    model = onnx.load(path)
    # Traces of the exporting machine: paths of source files in the metadata of every node.
    for node in model.graph.node:
        node.ClearField("metadata_props")
        node.ClearField("doc_string")
    model.ClearField("metadata_props")
    _narrow(model.graph)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)


def _narrow(graph: onnx.GraphProto) -> None:
    """Keep large constants in as few bits as hold them as they are; the runtime widens them when it loads the file."""
    for tensor in graph.initializer:
        values = torch.tensor(onnx.numpy_helper.to_array(tensor))
        kind = narrowest(values)
        if kind != values.dtype:
            wide, narrow = tensor.name, f"{tensor.name}.narrow"
            tensor.CopyFrom(onnx.numpy_helper.from_array(values.to(kind).numpy(), narrow))
            graph.node.insert(0, onnx.helper.make_node("Cast", [narrow], [wide], to=onnx.TensorProto.FLOAT))


def _session(path: Path) -> onnxruntime.InferenceSession:
    return onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])


def parity(composite: Composite, folder: Path, latents: Tensor, norm: WeightedNorm) -> float:
    """Largest ``‖z_onnx − z_torch‖ / ‖z_torch‖`` over codes (n, m), through the files as a server would run them."""
    expected = predict(composite, latents, 8).numpy()
    shapes = [
        _session(folder / f"factor-{j}.onnx").run(None, {"latent": latents[:, index].numpy()})[0]
        for j, index in enumerate(composite.factors)
    ]
    answer = _session(folder / "combiner.onnx").run(None, {"factors": np.stack(shapes, axis=1)})[0]
    return float(np.sqrt(norm.square(answer - expected) / norm.square(expected)).max())


def _digest(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    return {"sha256": hashlib.sha256(data).hexdigest(), "bytes": len(data)}


def export(
    composite: Composite,
    collection: Collection,
    config: Config,
    figures: dict[str, Any],
    data_digest: str,
    destination: Path,
    geometry: Mapping[str, NDArray],
    start: StartNetwork | None = None,
) -> Path:
    """Write ``destination/NAME/VERSION/``, replacing what is there.

    Args:
        composite: the networks.
        collection: what they parametrise.
        config: of the run.
        figures: what was measured of them.
        data_digest: SHA-256 of the samples they learned from.
        destination: the models directory.
        geometry: arrays of geometry.npz beside the reference's: a finer mesh with its prolongation, modes,
            training codes.
        start: for start.onnx, where there is one.

    Raises:
        ExportError: ONNX and PyTorch differ by more than the tolerance on 64 random codes.
    """
    settings, reference = config.export, collection.reference
    folder = destination / settings.name / str(settings.version)
    part = folder.with_name(f".{folder.name}.part")  # hidden from a server that watches
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    rng = np.random.default_rng(0)
    latents = torch.as_tensor(collection.coordinates.uniform(64, rng), dtype=torch.float32)
    for j, (network, index) in enumerate(zip(composite.networks, composite.factors, strict=True)):
        _to_onnx(network, latents[:2, index], ("latent", "nric"), part / f"factor-{j}.onnx")
    _to_onnx(
        composite.combiner, predict(composite.factor_shapes, latents[:2]), ("factors", "nric"), part / "combiner.onnx"
    )

    if start:
        _to_onnx(start, latents[:2], ("latent", "vertices"), part / "start.onnx")

    difference = parity(composite, part, latents, WeightedNorm.of(reference, config.evaluation.eta))
    if not difference <= settings.tolerance:
        raise ExportError(
            f"ONNX and PyTorch differ by {difference:.1e} in the weighted norm, over {settings.tolerance:.0e}"
        )
    if start:
        answer = _session(part / "start.onnx").run(None, {"latent": latents.numpy()})[0]
        distance = float(np.abs(answer - predict(start, latents, 8).numpy()).max())
        if not distance <= settings.tolerance * reference.diagonal:
            raise ExportError(f"start.onnx and PyTorch differ by {distance:.1e}, over {settings.tolerance:.0e}")

    write_npz(
        part / "geometry.npz",
        vertices=reference.vertices,
        faces=reference.faces.astype(np.int32),
        edges=reference.edges.astype(np.int32),
        **geometry,
    )
    manifest = _manifest(composite, collection, config, figures, data_digest, difference, "modes" in geometry)
    if start:
        manifest["start"] = {"file": "start.onnx", "input": "latent", "output": "vertices"}
    manifest["files"] = {path.name: _digest(path) for path in sorted(part.iterdir())}
    (part / "manifest.json").write_text(json.dumps(manifest, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    old = folder.with_name(f".{folder.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if folder.exists():
        os.replace(folder, old)
    os.replace(part, folder)
    shutil.rmtree(old, ignore_errors=True)
    return folder


def _portable(config: Config) -> dict[str, Any]:
    """The configuration without the folders of the machine that it was used on."""
    values = config.model_dump(mode="json", by_alias=True)
    if config.collection.data is not None:
        values["collection"]["data"] = config.collection.data.name
    return values


def _manifest(
    composite: Composite, collection: Collection, config: Config, figures: dict[str, Any], data_digest: str,
    difference: float, tangent: bool,
) -> dict[str, Any]:  # fmt: skip
    settings, coordinates, material = config.export, collection.coordinates, config.material
    reference: TriangleMesh = collection.reference
    return {
        "schema_version": 1,
        "name": settings.name,
        "version": str(settings.version),
        "licence": settings.licence,
        "title": settings.title,
        "description": settings.description,
        "latent_dimension": len(coordinates),
        "latent_names": list(collection.latent_names),
        "factors": [
            {
                "name": name,
                "start": index[0],
                "stop": index[-1] + 1,
                "file": f"factor-{j}.onnx",
                "input": "latent",
                "output": "nric",
            }
            for j, (name, index) in enumerate(collection.factors.items())
        ],
        "lower": coordinates.lower.tolist(),
        "upper": coordinates.upper.tolist(),
        "period": [None if np.isnan(p) else p for p in coordinates.period.tolist()],
        "edges": reference.connectivity.edge_count,
        "vertices": reference.connectivity.vertex_count,
        "faces": len(reference.faces),
        "mu": material.mu,
        "lambda": material.lambda_,
        "eta": material.eta,
        "eta_reconstruction": settings.eta_reconstruction,
        "exponential_steps": config.samples.steps if tangent else None,
        "scale": collection.scale,
        "combiner": {"file": "combiner.onnx", "input": "factors", "output": "nric"},
        "start": None,
        "geometry": {"file": "geometry.npz"},
        "onnx_tolerance": {"required": settings.tolerance, "measured": difference},
        "figures": figures,
        "origin": {
            "config": _portable(config),
            "data_digest": data_digest,
            "code_version": metadata.version("shapespace"),
        },
    }
