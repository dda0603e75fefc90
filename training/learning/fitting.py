"""Gradient descent: the training loop, and the files of networks, from which a killed run continues."""

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.optim import Adam, Muon, Optimizer
from torch.optim.lr_scheduler import CosineAnnealingLR, ReduceLROnPlateau

from shapespace.files.atomic import replaced_file
from shapespace.training.learning.allocator import memory_kept
from shapespace.training.learning.device import CPU, random_state, restore_random_state
from shapespace.training.learning.networks import ShapeNetwork, predict
from shapespace.training.runs.atomic_files import reading
from shapespace.training.runs.network_settings import FitSettings
from shapespace.training.runs.progress import bar

#: Epochs between two checkpoints.
CHECKPOINT_EPOCHS = 5


@dataclass(frozen=True)
class SavedNetwork:
    """Contents of a network's file."""

    # Training state: ``done``, ``epoch`` of at most ``epochs``, ``best`` validation loss, ``history`` of (train,
    # validation) losses.
    state: dict[str, Any]
    metadata: dict[str, str]  # see `ShapeNetwork.metadata`
    tensors: dict[str, Tensor]  # the network's ``state_dict()``
    extra: dict[str, Tensor]  # optimiser moments and random state of an unfinished training

    @property
    def done(self) -> bool:
        """Whether training has finished."""
        return bool(self.state["done"])


def save_network(
    path: Path, network: ShapeNetwork, state: dict[str, Any], extra: dict[str, Tensor] | None = None
) -> None:
    """Write a network and its training state as one safetensors file, atomically."""
    tensors = {f"network.{k}": v for k, v in network.state_dict().items()} | (extra or {})
    tensors = {k: v.cpu().contiguous().clone() for k, v in tensors.items()}
    with replaced_file(path) as file:
        file.write(save(tensors, metadata={"state": json.dumps(state), **network.metadata}))


def read_network(path: Path) -> SavedNetwork:
    """Read a file of `save_network`; raises OSError or DamagedFileError."""
    with reading(path), safe_open(path, framework="pt") as file:
        metadata = dict(file.metadata())
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a mapping
    prefix = "network."
    own = {k.removeprefix(prefix): tensors.pop(k) for k in list(tensors) if k.startswith(prefix)}
    return SavedNetwork(json.loads(metadata.pop("state")), metadata, own, tensors)


@memory_kept()
def fit(
    network: ShapeNetwork,
    inputs: Tensor,
    z: Tensor,
    train: Tensor,
    validation: Tensor,
    settings: FitSettings,
    path: Path,
    title: str,
    seed: int,
    device: torch.device = CPU,
) -> dict[str, Any]:
    """Fit a network to NRIC samples, and save its state after the epoch with the least validation loss.

    Epochs are compared by the network's `error`, usually the mean square difference of `coefficients` and `target`.
    With a last layer of low rank and orthonormal basis, this differs by a constant from the loss on z. An unfinished
    file at ``path`` is continued: it holds parameters, moments, schedule, random state and history.

    Inputs (n, …) and NRIC z (n, 2E) are of all samples. ``train`` and ``validation`` are indices of samples; the
    validation samples choose the learning rate and the epoch. The seed determines the order of batches and dropout.
    The network is trained on the device. Samples stay in main memory, and batches go to the device. In the end, the
    network is on the processor again. Returns the state, see `SavedNetwork`.
    """
    with torch.no_grad():
        target = network.target(z)
    saved = read_network(path) if path.exists() else None
    if saved:
        network.load_state_dict(saved.tensors)
        if saved.done:
            network.eval()
            return saved.state
    network.to(device)
    optimisers = _optimisers(network, settings)
    schedules = [_schedule(optimiser, settings) for optimiser in optimisers]
    torch.manual_seed(seed)
    if saved:
        state = saved.state
        best = _restore(optimisers, schedules, state, saved.extra)
        restore_random_state(device, saved.extra)
    else:
        # The closed-form fit may be better than any epoch.
        network.eval()
        error = _error(network, inputs[validation], target[validation], settings.batch_size, device)
        state = {"done": False, "epoch": 0, "epochs": settings.max_epochs, "best": error, "history": []}
        best = _copied(network)

    epochs = bar(title, "epoch", settings.max_epochs, initial=state["epoch"])
    while not state["done"]:
        start = time.monotonic()
        total = _epoch(network, optimisers, inputs, target, train, settings.batch_size, device)
        network.eval()
        error = _error(network, inputs[validation], target[validation], settings.batch_size, device)
        if settings.minutes and not state["epoch"]:
            _shorten(state, schedules, 60 * settings.minutes / (time.monotonic() - start))
        for schedule in schedules:
            if isinstance(schedule, ReduceLROnPlateau):
                schedule.step(error)
            else:
                schedule.step()
        state["epoch"] += 1
        state["history"].append([total, error])
        if error < state["best"]:
            state["best"] = error
            best = _copied(network)
        rate = optimisers[0].param_groups[0]["lr"]
        epochs.set_postfix(train=f"{total:.2e}", validation=f"{error:.2e}", rate=f"{rate:.0e}", refresh=False)
        epochs.update()
        state["done"] = state["epoch"] >= state["epochs"] or rate < settings.final_rate
        if not state["done"] and state["epoch"] % CHECKPOINT_EPOCHS == 0:
            _checkpoint(path, network, optimisers, schedules, state, best, random_state(device))
    epochs.close()
    network.to(CPU).load_state_dict(best)
    network.eval()
    save_network(path, network, state)
    return state


def _optimisers(network: nn.Module, settings: FitSettings) -> list[Optimizer]:
    parameters = list(network.parameters())
    if settings.optimiser == "adam":
        return [_adam(parameters, settings)]
    matrices = [p for p in parameters if p.ndim == 2]
    others = [p for p in parameters if p.ndim != 2]
    # One rate suits both, since Muon's steps are made as large as Adam's.
    muon = Muon(matrices, settings.learning_rate, weight_decay=settings.weight_decay, adjust_lr_fn="match_rms_adamw")
    return [muon, _adam(others, settings)]


def _adam(parameters: list[nn.Parameter], settings: FitSettings) -> Adam:
    decay = settings.weight_decay
    return Adam(parameters, settings.learning_rate, weight_decay=decay, decoupled_weight_decay=decay > 0)


#: Schedule of a learning rate.
Schedule = ReduceLROnPlateau | CosineAnnealingLR


def _schedule(optimiser: Optimizer, settings: FitSettings) -> Schedule:
    if settings.schedule == "plateau":
        return ReduceLROnPlateau(optimiser, factor=0.1, patience=settings.patience, threshold=1e-3)
    return CosineAnnealingLR(optimiser, T_max=settings.max_epochs)


def _epoch(
    network: ShapeNetwork,
    optimisers: Sequence[Optimizer],
    inputs: Tensor,
    target: Tensor,
    train: Tensor,
    batch_size: int,
    device: torch.device,
) -> float:
    """Pass once over the training samples in random order, and return the mean loss of the batches."""
    network.train()
    order = train[torch.randperm(len(train))]
    total = 0.0
    # A last batch of fewer samples is left out: batch normalisation of one sample has no variance.
    batches = [b for b in order.split(batch_size) if len(b) == batch_size] or [order]
    for batch in batches:
        loss = network.loss(inputs[batch].to(device), target[batch].to(device))
        network.zero_grad()
        loss.backward()
        for optimiser in optimisers:
            optimiser.step()
        total += loss.item() / len(batches)
    return total


def _copied(network: ShapeNetwork) -> dict[str, Tensor]:
    return {k: v.clone() for k, v in network.state_dict().items()}


def _shorten(state: dict[str, Any], schedules: Sequence[Schedule], affordable: float) -> None:
    """Limit the number of epochs, and let the learning rate fall sooner."""
    state["epochs"] = max(1, min(state["epochs"], int(affordable)))
    for schedule in schedules:
        if isinstance(schedule, CosineAnnealingLR):
            schedule.T_max = state["epochs"]


def _error(network: ShapeNetwork, inputs: Tensor, target: Tensor, batch_size: int, device: torch.device) -> float:
    found = predict(lambda part: network.coefficients(part.to(device)), inputs, batch_size)
    return network.error(found, target.to(device)).item()


def _checkpoint(
    path: Path,
    network: ShapeNetwork,
    optimisers: Sequence[Optimizer],
    schedules: Sequence[Schedule],
    state: dict[str, Any],
    best: dict[str, Tensor],
    random: dict[str, Tensor],
) -> None:
    moments = {
        f"optimiser.{k}.{index}.{key}": value
        for k, optimiser in enumerate(optimisers)
        for index, values in optimiser.state_dict()["state"].items()
        for key, value in values.items()
    }
    extra = {f"best.{k}": v for k, v in best.items()} | moments | {"rng": torch.get_rng_state()} | random
    rates = [optimiser.param_groups[0]["lr"] for optimiser in optimisers]
    save_network(path, network, state | {"rates": rates, "schedules": [s.state_dict() for s in schedules]}, extra)


def _restore(
    optimisers: Sequence[Optimizer], schedules: Sequence[Schedule], state: dict[str, Any], extra: dict[str, Tensor]
) -> dict[str, Tensor]:
    """Restore all state except the network from a checkpoint, and return the best parameters."""
    torch.set_rng_state(extra["rng"])
    rates, schedules_before = state.pop("rates"), state.pop("schedules")
    for k, (optimiser, schedule) in enumerate(zip(optimisers, schedules, strict=True)):
        schedule.load_state_dict(schedules_before[k])
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in extra.items():
            if key.startswith(f"optimiser.{k}."):
                *_, index, name = key.split(".")
                moments.setdefault(int(index), {})[name] = value
        groups = optimiser.state_dict()["param_groups"]
        groups[0]["lr"] = rates[k]
        optimiser.load_state_dict({"state": moments, "param_groups": groups})
    return {k.removeprefix("best."): v for k, v in extra.items() if k.startswith("best.")}
