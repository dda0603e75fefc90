"""The training loop: it learns, and after a kill it continues to the same result."""

import ctypes
import itertools
import resource
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from shapespace.coordinates.nric import WeightedNorm, nric
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning import fitting
from shapespace.training.learning.allocator import memory_kept
from shapespace.training.learning.layers import Scaling
from shapespace.training.learning.networks import FactorNetwork
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.network_settings import FitSettings, LatentNetworkSettings


class Killed(Exception):  # noqa: N818 - not an error
    pass


@pytest.fixture(scope="module")
def data() -> tuple[TriangleMesh, torch.Tensor, torch.Tensor]:
    sphere = trimesh.creation.icosphere(1)
    ball = TriangleMesh.from_arrays(sphere.vertices, sphere.faces)
    rng = np.random.default_rng(0)
    a = rng.uniform(-1, 1, (80, 2))
    x = ball.vertices * (1 + 0.2 * a[:, :1, None]) + 0.2 * a[:, 1:, None] * ball.vertices[:, ::-1] ** 2
    return ball, torch.from_numpy(a).float(), torch.from_numpy(nric(x, ball.connectivity)).float()


def fit(data: tuple[TriangleMesh, torch.Tensor, torch.Tensor], path: Path, settings: FitSettings) -> FactorNetwork:
    ball, latent, z = data
    torch.manual_seed(7)
    scaling = Scaling.of(nric(ball.vertices, ball.connectivity), WeightedNorm.of(ball, 1.0).squared, z.numpy())
    box = Coordinates(np.full(2, -1.0), np.full(2, 1.0), np.full(2, np.nan))
    network = FactorNetwork(LatentNetworkSettings(hidden=[16, 16]), box, scaling, None)
    train, validation = torch.arange(64), torch.arange(64, 80)
    fitting.fit(network, latent, z, train, validation, settings, path, "test", seed=5)
    return network


@pytest.mark.parametrize(("schedule", "optimiser"), [("plateau", "adam"), ("cosine", "adam"), ("cosine", "muon")])
def test_a_killed_fit_continues_to_the_same_bits(
    data: tuple, schedule: str, optimiser: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = FitSettings(
        optimiser=optimiser, schedule=schedule, max_epochs=17, batch_size=16, patience=1, learning_rate=1e-2
    )
    whole = fit(data, tmp_path / "whole.safetensors", settings).state_dict()
    written = fitting._checkpoint

    def die(*arguments: object) -> None:
        written(*arguments)
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(fitting, "_checkpoint", die)
        for _ in range(3):  # at epochs 5, 10 and 15
            with pytest.raises(Killed):
                fit(data, tmp_path / "killed.safetensors", settings)
    continued = fit(data, tmp_path / "killed.safetensors", settings).state_dict()
    for key, value in whole.items():
        assert torch.equal(value, continued[key]), key


def test_a_finished_fit_is_read_not_repeated(data: tuple, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = FitSettings(max_epochs=3, batch_size=16)
    first = fit(data, tmp_path / "n.safetensors", settings).state_dict()
    monkeypatch.setattr(torch.optim.Adam, "step", None)
    again = fit(data, tmp_path / "n.safetensors", settings).state_dict()
    assert all(torch.equal(first[k], again[k]) for k in first)


@pytest.mark.parametrize("optimiser", ["adam", "muon"])
def test_a_fit_learns_and_keeps_its_best_epoch(data: tuple, optimiser: str, tmp_path: Path) -> None:
    settings = FitSettings(optimiser=optimiser, max_epochs=60, batch_size=16, learning_rate=1e-2)
    network = fit(data, tmp_path / "n.safetensors", settings)
    state = fitting.read_network(tmp_path / "n.safetensors").state
    errors = [validation for _, validation in state["history"]]
    assert state["best"] == min(errors)
    assert state["best"] < 0.05 * errors[0]
    network.eval()
    _, latent, z = data
    found = torch.nn.functional.mse_loss(
        fitting.predict(network.coefficients, latent[64:]), network.target(z[64:])
    ).item()
    assert found == pytest.approx(state["best"], rel=1e-4), "the parameters kept are those of the best epoch"


def test_the_rate_falls_on_a_plateau_and_ends_the_fit(data: tuple, tmp_path: Path) -> None:
    settings = FitSettings(max_epochs=500, batch_size=16, learning_rate=1e-2, final_rate=5e-3, patience=1)
    fit(data, tmp_path / "n.safetensors", settings)
    state = fitting.read_network(tmp_path / "n.safetensors").state
    assert state["epoch"] < 500


def test_on_a_plateau_the_rate_falls_to_a_tenth() -> None:
    optimiser = torch.optim.SGD([torch.zeros(1)], 1e-2)
    schedule = fitting._schedule(optimiser, FitSettings(schedule="plateau", patience=1))
    rates = []
    for _ in range(5):
        schedule.step(1.0)
        rates.append(optimiser.param_groups[0]["lr"])
    assert rates == pytest.approx([1e-2, 1e-2, 1e-3, 1e-3, 1e-4])


def test_a_fit_has_as_many_epochs_as_fit_into_its_time(
    data: tuple, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rate falls as if they were all that had been asked for."""
    monkeypatch.setattr(fitting, "time", SimpleNamespace(monotonic=itertools.count(step=6).__next__))
    settings = FitSettings(max_epochs=500, batch_size=16, schedule="cosine", minutes=1)
    short = fit(data, tmp_path / "short.safetensors", settings).state_dict()
    assert fitting.read_network(tmp_path / "short.safetensors").state["epoch"] == 10
    asked = FitSettings(max_epochs=10, batch_size=16, schedule="cosine")
    for key, value in fit(data, tmp_path / "asked.safetensors", asked).state_dict().items():
        assert torch.equal(value, short[key]), key


def test_freed_memory_is_kept_from_step_to_step() -> None:
    """The system maps no new pages for large arrays while networks are trained, and gets the memory back at the end."""
    size, page = 8 * 8_000_000, resource.getpagesize()

    def mapped_with_an_array() -> int:
        array = np.ones(size // 8)
        before = _mapped()
        del array
        return before - _mapped()

    def resident() -> int:
        return page * int(Path("/proc/self/statm").read_text().split()[1])

    assert mapped_with_an_array() >= size
    with memory_kept():
        assert mapped_with_an_array() < size / 2
        kept = resident()
    assert kept - resident() > size / 2
    assert mapped_with_an_array() >= size


class _Memory(ctypes.Structure):
    """``struct mallinfo2`` of malloc.h; its fifth number is ``hblkhd``."""

    _fields_ = (("before", 4 * ctypes.c_size_t), ("mapped", ctypes.c_size_t), ("after", 5 * ctypes.c_size_t))


def _mapped() -> int:
    """Return the bytes of arrays that the system mapped one by one."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = _Memory
    memory: _Memory = mallinfo2()
    return int(memory.mapped)
