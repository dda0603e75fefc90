"""The layer and the graph against shapes of the server."""

import pickle
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

import shapespace
from shapespace.torch import ShapeLayer

MODELS = {
    name: max((Path("models") / name).iterdir(), key=lambda path: int(path.name)) for name in ("figure", "freaky-torus")
}


@pytest.fixture(scope="module", params=MODELS)
def model(request: pytest.FixtureRequest) -> shapespace.ShapeModel:
    return shapespace.load(MODELS[request.param])


@pytest.fixture(scope="module")
def layer(model: shapespace.ShapeModel) -> ShapeLayer:
    return ShapeLayer(MODELS[model.manifest.name])


def away(model: shapespace.ShapeModel, found: np.ndarray, codes: np.ndarray) -> float:
    """Return the largest distance from drafts, as a share of the diagonal."""
    drafts = [model.shape(code, quality="draft") for code in codes]
    assert all(draft.diagnostics.quality == "draft" for draft in drafts)
    distance = np.linalg.norm(found - np.stack([draft.vertices for draft in drafts]), axis=2)
    return float(distance.max()) / (model.manifest.scale * model.mesh().diagonal)


def test_layer_returns_drafts(model: shapespace.ShapeModel, layer: ShapeLayer) -> None:
    codes = model.sample(4, seed=3)
    with torch.no_grad():
        assert away(model, layer(torch.tensor(codes)).numpy(), codes) < 2e-5
        wide = ShapeLayer(MODELS[model.manifest.name]).double()
        assert away(model, wide(torch.tensor(codes).double()).numpy(), codes) < 5e-6
    assert layer.names == model.names
    assert np.array_equal(layer.faces, model.faces)
    assert np.allclose(layer.lower, model.lower)
    assert np.allclose(layer.upper, model.upper)


def test_graph_returns_drafts_and_misfits(model: shapespace.ShapeModel) -> None:
    folder = MODELS[model.manifest.name]
    session = onnxruntime.InferenceSession(folder / "decoder.onnx", providers=["CPUExecutionProvider"])
    codes = model.sample(8, seed=4)
    vertices, misfit = session.run(["vertices", "misfit"], {"latent": codes})
    assert away(model, vertices, codes) < 2e-5
    residuals = [model.shape(code, quality="draft").diagnostics.residual for code in codes]
    assert misfit == pytest.approx(residuals, rel=2e-2, abs=1e-5)
    files = model.manifest.files
    assert 2 * files["decoder.onnx"].bytes <= sum(entry.bytes for entry in files.values())


def test_layer_has_derivatives(model: shapespace.ShapeModel) -> None:
    layer = ShapeLayer(MODELS[model.manifest.name], torch.float64)
    code = torch.tensor(model.sample(1, seed=5), dtype=torch.float64, requires_grad=True)
    some = torch.tensor(np.random.default_rng(0).normal(size=layer(code).shape))
    assert torch.autograd.gradcheck(lambda x: (layer(x) * some).sum(), code, eps=1e-4, atol=1e-4, rtol=1e-4)


def test_layer_moves_between_processes_and_types(layer: ShapeLayer) -> None:
    codes = (layer.lower + layer.upper)[None] / 2
    twin = pickle.loads(pickle.dumps(layer))  # noqa: S301
    twin.load_state_dict(layer.state_dict())
    with torch.no_grad():
        assert torch.equal(twin(codes), layer(codes))
        again = twin.double().float()
        assert torch.equal(again(codes), layer(codes))
    with pytest.raises(TypeError, match=r"not in torch\.float16"):
        twin.half()


def test_layer_refuses_codes_of_another_length(layer: ShapeLayer) -> None:
    with pytest.raises(ValueError, match=rf"codes must be \(n, {len(layer.names)}\), not \(2, 3\)"):
        layer(torch.zeros(2, 3))
