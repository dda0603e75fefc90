"""The layer and the graph against drafts of the server."""

import pickle
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch

import shapespace
from shapespace.torch import ShapeLayer
from tests.shapespace.torch.conftest import BUNDLED


def away(model: shapespace.ShapeModel, found: np.ndarray, codes: np.ndarray) -> float:
    """Return the largest distance from drafts, as a share of the diagonal."""
    drafts = [model.shape(code, quality="draft") for code in codes]
    assert all(draft.diagnostics.quality == "draft" for draft in drafts)
    distance = np.linalg.norm(found - np.stack([draft.vertices for draft in drafts]), axis=2)
    return float(distance.max()) / (model.manifest.scale * model.mesh().diagonal)


def test_layer_returns_drafts(model: shapespace.ShapeModel) -> None:
    layer, codes = ShapeLayer(model.folder), model.sample(2, seed=3)
    with torch.no_grad():
        assert away(model, layer(torch.tensor(codes)).numpy(), codes) < 2e-5
        assert away(model, layer.double()(torch.tensor(codes).double()).numpy(), codes) < 5e-6
    assert layer.names == model.names
    assert np.array_equal(layer.faces, model.faces)
    assert np.allclose(layer.lower, model.lower)
    assert np.allclose(layer.upper, model.upper)


@pytest.mark.parametrize("model", BUNDLED, indirect=True)
def test_graph_returns_drafts_and_misfits(model: shapespace.ShapeModel) -> None:
    entry, files = model.manifest.decoder, model.manifest.files
    session = onnxruntime.InferenceSession(model.folder / entry.file, providers=["CPUExecutionProvider"])
    codes = model.sample(4, seed=4)
    vertices, misfit = session.run(["vertices", "misfit"], {"latent": codes})
    assert away(model, vertices, codes) < 2e-5
    residuals = [model.shape(code, quality="draft").diagnostics.residual for code in codes]
    assert misfit == pytest.approx(residuals, rel=2e-2, abs=1e-5)
    assert 2 * files[entry.file].bytes <= sum(file.bytes for file in files.values())
    assert entry.error <= 1.4e-5


def test_layer_has_derivatives(tiny: Path) -> None:
    layer = ShapeLayer(tiny, torch.float64)
    code = ((layer.lower + 2 * layer.upper) / 3)[None].requires_grad_()
    some = torch.tensor(np.random.default_rng(0).normal(size=layer(code).shape))
    assert torch.autograd.gradcheck(lambda x: (layer(x) * some).sum(), code, eps=1e-4, atol=1e-4, rtol=1e-4)


def test_layer_moves_between_processes_and_types(tiny: Path) -> None:
    layer = ShapeLayer(tiny)
    codes = (layer.lower + layer.upper)[None] / 2
    twin = pickle.loads(pickle.dumps(layer))  # noqa: S301
    twin.load_state_dict(layer.state_dict())
    with torch.no_grad():
        assert torch.equal(twin(codes), layer(codes))
        again = twin.double().float()
        assert torch.equal(again(codes), layer(codes))
    with pytest.raises(TypeError, match=r"not in torch\.float16"):
        twin.half()


def test_layer_refuses_codes_of_another_length(tiny: Path) -> None:
    with pytest.raises(ValueError, match=r"codes must be \(n, 3\), not \(2, 5\)"):
        ShapeLayer(tiny)(torch.zeros(2, 5))


def test_layer_refuses_codes_of_another_type_and_says_how_to_convert_them(tiny: Path) -> None:
    with pytest.raises(TypeError, match=r"float64, but the layer computes in torch\.float32.*layer\.double"):
        ShapeLayer(tiny)(torch.zeros(2, 3, dtype=torch.float64))
    with pytest.raises(TypeError, match="ndarray, not a tensor"):
        ShapeLayer(tiny)(np.zeros((2, 3), np.float32))
