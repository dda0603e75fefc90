"""Training on a device: the same networks as on the processor, nothing mixed, and results on the processor."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from shapespace.coordinates.nric import nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning import DeviceError, device, fitting
from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.combiners.correction import JointSamples
from shapespace.training.learning.composite import Composite, TunedNetwork
from shapespace.training.learning.networks import FactorNetwork, ShapeNetwork
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.network_settings import (
    ConvolutionSettings,
    DenseSettings,
    FitSettings,
    KernelSettings,
    LatentNetworkSettings,
    PaperSettings,
)
from tests.training.conftest import TINY, Said
from tests.training.learning.conftest import scaling
from tests.training.learning.fake_device import DEVICE, Elsewhere, FakeDevice

SHORT = FitSettings(max_epochs=6, batch_size=6)
#: Settings of combiners whose training computes on every kind of tensor that a combiner has.
COMBINERS = {
    "dense": DenseSettings(hidden=[4], dropout=0.5, integrability=1.0, fit=SHORT),
    "star": PaperSettings(width=3, layers=2, integrability=1.0, fit=SHORT),
    "crops": ConvolutionSettings(width=3, layers=1, neighbourhood="flaps", crop=60, products=1, fit=SHORT),
    "kernel": KernelSettings(coefficients=2),
}


@pytest.fixture
def shapes(sheet: TriangleMesh) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Codes (24, 2) of two factors, factor shapes and joint shapes."""
    rng, rest = np.random.default_rng(0), nric(sheet.vertices, sheet.connectivity)
    codes, fields = rng.uniform(-1, 1, (24, 2)), 0.01 * rng.normal(size=(3, len(rest)))
    factors = rest + codes[:, :, None] * fields[:2]
    joint = factors.sum(axis=1) - rest + codes.prod(axis=1)[:, None] * fields[2]
    codes, factors, joint = (torch.as_tensor(each, dtype=torch.float32) for each in (codes, factors, joint))
    return codes, factors, joint


def combiner(sheet: TriangleMesh, shapes: tuple[torch.Tensor, ...], settings: Any) -> CombinerNetwork:
    _, factors, joint = shapes
    scale = scaling(sheet, joint.numpy())
    own, held_out = (JointSamples(factors[s], joint[s], scale, [[0], [1]]) for s in (slice(18), slice(18, None)))
    torch.manual_seed(0)
    with torch.no_grad():
        return CombinerNetwork.fit(settings, sheet, own, held_out, 0)


def trained(
    network: ShapeNetwork, inputs: torch.Tensor, joint: torch.Tensor, path: Path, on: torch.device = device.CPU
) -> dict[str, torch.Tensor]:
    train, validation = torch.arange(18), torch.arange(18, 24)
    fitting.fit(network, inputs, joint, train, validation, SHORT, path, "test", 5, on)
    return network.state_dict()


@pytest.mark.parametrize("kind", ["dense", "star", "crops"])
def test_a_combiner_learns_the_same_on_a_device(
    kind: str, sheet: TriangleMesh, shapes: tuple[torch.Tensor, ...], tmp_path: Path, fake_device: FakeDevice
) -> None:
    found = [
        trained(combiner(sheet, shapes, COMBINERS[kind]), *shapes[1:], tmp_path / name, on)
        for name, on in (("here", device.CPU), ("there", DEVICE))
    ]
    assert fake_device.operations > 100
    assert not any(isinstance(tensor, Elsewhere) for tensor in found[1].values())
    for name, tensor in found[0].items():
        torch.testing.assert_close(found[1][name], tensor)


@pytest.mark.parametrize("kind", ["star", "kernel"])
def test_factors_and_combiner_learn_together_on_a_device(
    kind: str, sheet: TriangleMesh, shapes: tuple[torch.Tensor, ...], tmp_path: Path, fake_device: FakeDevice
) -> None:
    """Fine-tuning changes the factor networks, also below a combiner without parameters, and makes nothing worse."""
    codes, _, joint = shapes
    scale, box = scaling(sheet, joint.numpy()), Coordinates(-np.ones(1), np.ones(1), np.full(1, np.nan))
    states, before = {}, {}
    for name, on in (("here", device.CPU), ("there", DEVICE)):
        joined = combiner(sheet, shapes, COMBINERS[kind])
        torch.manual_seed(1)
        factors = [FactorNetwork(LatentNetworkSettings(hidden=[4]), box, scale, None) for _ in range(2)]
        network = TunedNetwork(Composite([[0], [1]], factors, joined)).eval()
        before = {key: tensor.clone() for key, tensor in network.state_dict().items()}
        with torch.no_grad():
            error = network.error(network.coefficients(codes[18:]), network.target(joint[18:]))
        states[name] = trained(network, codes, joint, tmp_path / name, on)
        with torch.no_grad():
            assert network.error(network.coefficients(codes[18:]), network.target(joint[18:])) < error
    assert fake_device.operations > 100
    for key, tensor in states["here"].items():
        torch.testing.assert_close(states["there"][key], tensor)
    assert any(not torch.equal(tensor, before[key]) for key, tensor in states["here"].items() if "networks.1" in key)


def test_a_killed_training_continues_with_the_random_state_of_its_device(
    sheet: TriangleMesh,
    shapes: tuple[torch.Tensor, ...],
    tmp_path: Path,
    fake_device: FakeDevice,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path, state, written = tmp_path / "n.safetensors", torch.meta.state, fitting._checkpoint

    def die(*arguments: Any) -> None:
        written(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "_checkpoint", die)
        with pytest.raises(KeyboardInterrupt):
            trained(combiner(sheet, shapes, COMBINERS["dense"]), *shapes[1:], path, DEVICE)
    assert state == [1], "read once, for the checkpoint"
    state[0] = 70
    killed = trained(combiner(sheet, shapes, COMBINERS["dense"]), *shapes[1:], path, DEVICE)
    assert state == [1]
    whole = trained(combiner(sheet, shapes, COMBINERS["dense"]), *shapes[1:], tmp_path / "whole")
    for name, tensor in whole.items():
        torch.testing.assert_close(killed[name], tensor)


def test_a_missing_device_is_one_sentence_before_any_work(tmp_path: Path, said: Said) -> None:
    (tmp_path / "tiny.toml").write_text(
        TINY.replace("[networks.combiner", '[networks]\ndevice = "mps"\n\n[networks.combiner')
    )
    text = said("run", tmp_path / "tiny.toml", "--out", tmp_path / "run", code=1)
    assert 'networks.device is "mps"' in text
    assert "docs/how-to/gpu.md" in text
    assert not (tmp_path / "run" / "samples").exists()


def test_the_device_is_found_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert device.training_device("auto") == device.training_device("cpu") == device.CPU
    with pytest.raises(DeviceError, match="cuda"):
        device.training_device("cuda")
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert device.training_device("auto") == device.training_device("mps") == torch.device("mps")
