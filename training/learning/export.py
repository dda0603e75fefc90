"""Export trained networks as the ONNX files of a bundle, and check that ONNX and PyTorch agree."""

from dataclasses import replace
from importlib import metadata
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from torch import Tensor, nn

from shapespace.bundle.geometry import Geometry
from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import COMBINER, START, Network, Origin, Tolerance, factor_network
from shapespace.bundle.writer import Facts, Networks, write_bundle
from shapespace.coordinates.nric import WeightedNorm
from shapespace.model.accuracy import measure_accuracy
from shapespace.model.decoder import Decoder
from shapespace.model.latent_space import NotFiniteError
from shapespace.model.networks import ModelFailedError
from shapespace.shell.energy import Material
from shapespace.training.learning import ExportError
from shapespace.training.learning.composite import Composite
from shapespace.training.learning.decoder_graph import decoder_graph, exported
from shapespace.training.learning.layers import narrowest
from shapespace.training.learning.naming import NamingError, bundle_names
from shapespace.training.learning.networks import StartNetwork, predict
from shapespace.training.learning.straight import LinearNetwork
from shapespace.training.runs.config import Config
from shapespace.training.runs.sampling import Collection

#: Number of random codes, and of codes of training shapes, at which ONNX and PyTorch are compared.
CHECKED = 64


def to_onnx(network: nn.Module, example: Tensor, names: Network) -> bytes:
    """Return an ONNX file of a network, with the names that bundles use for its input and output."""
    model = exported(network, example, [names.input], [names.output])
    _narrow(model.graph)
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


def _narrow(graph: onnx.GraphProto) -> None:
    """Store each constant in the narrowest type that holds it exactly; the runtime widens it when it loads the file."""
    for tensor in graph.initializer:
        values = torch.tensor(onnx.numpy_helper.to_array(tensor))
        kind = narrowest(values)
        if kind != values.dtype:
            wide, narrow = tensor.name, f"{tensor.name}.narrow"
            tensor.CopyFrom(onnx.numpy_helper.from_array(values.to(kind).numpy(), narrow))
            graph.node.insert(0, onnx.helper.make_node("Cast", [narrow], [wide], to=onnx.TensorProto.FLOAT))


def _answer(file: bytes, names: Network, rows: NDArray) -> NDArray:
    session = onnxruntime.InferenceSession(file, providers=["CPUExecutionProvider"])
    return session.run([names.output], {names.input: rows})[0]


def difference(composite: Composite, networks: Networks, latents: Tensor, norm: WeightedNorm) -> float:
    """Return the largest ``‖z_onnx − z_torch‖ / ‖z_torch‖`` over codes (n, m)."""
    expected = predict(composite, latents, 8).numpy()
    shapes = [
        _answer(file, factor_network(j), latents[:, index].numpy())
        for j, (file, index) in enumerate(zip(networks.factors, composite.factors, strict=True))
    ]
    answer = _answer(networks.combiner, COMBINER, np.stack(shapes, axis=1))
    return float(np.sqrt(norm.square(answer - expected) / norm.square(expected)).max())


def _networks(composite: Composite, start: StartNetwork | LinearNetwork | None, latents: Tensor) -> Networks:
    some = latents[:2]
    return Networks(
        factors=[
            to_onnx(network, some[:, index], factor_network(j))
            for j, (network, index) in enumerate(zip(composite.networks, composite.factors, strict=True))
        ],
        combiner=to_onnx(composite.combiner, predict(composite.factor_shapes, some), COMBINER),
        start=to_onnx(start, some, START) if start else None,
    )


def export(
    composite: Composite,
    collection: Collection,
    config: Config,
    figures: dict[str, Any],
    data_digest: str,
    models: Path,
    geometry: Geometry,
    start: StartNetwork | LinearNetwork | None = None,
) -> Path:
    """Write ``models/NAME/VERSION/``, replacing a bundle that is there.

    The digest is the SHA-256 of the training samples. Raises ExportError if ONNX and PyTorch differ by more than the
    tolerance at a code, the bundle contradicts itself, or a code inside the bounds has no shape.
    """
    settings, reference = config.export, collection.reference
    try:
        factors, names = bundle_names(collection.factors, collection.latent_names, settings)
    except NamingError as error:
        raise ExportError(str(error)) from None
    rng = np.random.default_rng(0)
    codes = np.concatenate([collection.coordinates.uniform(CHECKED, rng), collection.codes[:CHECKED]])
    latents = torch.as_tensor(codes, dtype=torch.float32)
    networks = _networks(composite, start, latents)

    measured = difference(composite, networks, latents, WeightedNorm.of(reference, config.evaluation.eta))
    if not measured <= settings.tolerance:
        raise ExportError(
            f"the ONNX networks differ from PyTorch by {measured:.1e} in the weighted norm, but export.tolerance "
            f"allows {settings.tolerance:.0e}"
        )
    if start and networks.start:
        answer = _answer(networks.start, START, latents.numpy())
        distance = float(np.abs(answer - predict(start, latents, 8).numpy()).max())
        if not distance <= settings.tolerance * reference.diagonal:
            raise ExportError(
                f"start.onnx differs from PyTorch by {distance:.1e}, but export.tolerance allows "
                f"{settings.tolerance:.0e}"
            )

    coordinates, material = collection.coordinates, config.material
    facts = Facts(
        name=settings.name,
        version=str(settings.version),
        licence=settings.licence,
        title=settings.title,
        description=settings.description,
        latent_names=names,
        factors=factors,
        lower=coordinates.lower,
        upper=coordinates.upper,
        period=coordinates.period,
        material=Material(material.mu, material.lambda_, material.eta),
        eta_reconstruction=settings.eta_reconstruction,
        exponential_steps=collection.steps,
        exponential_first_step=collection.first_step,
        scale=collection.scale,
        tolerance=Tolerance(required=settings.tolerance, measured=measured),
        figures=figures,
        origin=Origin(config=_portable(config), data_digest=data_digest, code_version=metadata.version("shapespace")),
    )
    try:
        # Shapes are measured as they are served, which needs a bundle: a first one in a temporary folder.
        with TemporaryDirectory() as folder:
            first = read_bundle(write_bundle(Path(folder), facts, networks, geometry))
            decoder = Decoder(first)
            accuracy = measure_accuracy(decoder)
            facts = replace(facts, draft_error=accuracy.draft_error, auto_error=accuracy.auto_error)
            if settings.decoder:
                networks = replace(networks, decoder=decoder_graph(first, decoder))
        return write_bundle(models, facts, networks, geometry)
    except ValidationError as error:
        fault = error.errors(include_url=False, include_input=False)[0]
        raise ExportError(f"the manifest's {'.'.join(map(str, fault['loc']))}: {fault['msg']}") from None
    except NotFiniteError as error:
        raise ExportError(
            "a random code inside the bounds has no shape, so the model is too poor to be used. What may help: more "
            "samples.count, a larger collection.coarse_vertices, or leave out the shapes farthest from the others"
        ) from error
    except (BundleError, ModelFailedError) as error:
        raise ExportError(f"the bundle can't be served: {error}") from None


def _portable(config: Config) -> dict[str, Any]:
    """Return the configuration without folders of the training machine."""
    values = config.model_dump(mode="json", by_alias=True)
    if config.collection.data is not None:
        values["collection"]["data"] = config.collection.data.name
    return values
