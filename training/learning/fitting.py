"""The training loop: Adam, a falling rate, and a checkpoint that a killed run continues from."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR, ReduceLROnPlateau

from shapespace.training.learning.networks import ShapeNetwork, predict
from shapespace.training.runs.atomic_files import whole
from shapespace.training.runs.config import FitSettings
from shapespace.training.runs.progress import bar

CHECKPOINT_EPOCHS = 5


def save_network(path: Path, network: nn.Module, state: dict[str, Any], extra: dict[str, Tensor] | None = None) -> None:
    """Write parameters, buffers and a JSON state as one safetensors file, whole or not at all."""
    tensors = {f"network.{k}": v for k, v in network.state_dict().items()} | (extra or {})
    tensors = {k: v.contiguous().clone() for k, v in tensors.items()}
    with whole(path) as file:
        file.write(save(tensors, metadata={"state": json.dumps(state)}))


def load_network(path: Path, network: nn.Module) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read what `save_network` wrote into the network; returns state and the extra tensors."""
    state, tensors, extra = read_network(path)
    network.load_state_dict(tensors)
    return state, extra


def read_network(path: Path) -> tuple[dict[str, Any], dict[str, Tensor], dict[str, Tensor]]:
    """What `save_network` wrote: state, the network's tensors by its own names, the extra ones."""
    with safe_open(path, framework="pt") as file:
        state = json.loads(file.metadata()["state"])
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a mapping
    prefix = "network."
    own = {k.removeprefix(prefix): tensors.pop(k) for k in list(tensors) if k.startswith(prefix)}
    return state, own, tensors


def finished(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]] | None:
    """State and tensors, by the network's own names, of a fit that is done; None where it isn't."""
    if not path.exists():
        return None
    state, tensors, _ = read_network(path)
    return (state, tensors) if state["done"] else None


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
) -> dict[str, Any]:
    """Fit a network to NRIC samples and leave the best epoch's parameters in ``path``.

    The loss is the mean square of scaled differences (networks.py) between `coefficients` and `target`. Where a last
    layer of low rank is orthonormal this differs from the loss on z by a constant. An unfinished file at ``path`` is
    continued: parameters, Adam, schedule, random state and history are all in it.

    Args:
        network: what is fitted, from its present parameters.
        inputs: (n, …) all inputs.
        z: (n, 2E) all targets.
        train: (n_train,) indices.
        validation: (n_validation,) indices, which choose the learning rate and the epoch that is kept.
        settings: rates, patience, batch size.
        path: safetensors file of the result.
        title: what the progress bar says.
        seed: of the order of batches and of dropout.

    Returns:
        The state: epochs, best validation loss, history of (train, validation) losses.
    """
    with torch.no_grad():
        target = network.target(z)
    optimiser = torch.optim.Adam(network.parameters(), settings.learning_rate)
    schedule = (
        ReduceLROnPlateau(optimiser, factor=0.1, patience=settings.patience, threshold=1e-3)
        if settings.schedule == "plateau"
        else CosineAnnealingLR(optimiser, T_max=settings.max_epochs)
    )
    torch.manual_seed(seed)
    state: dict[str, Any] = {"done": False, "epoch": 0, "best": float("inf"), "history": []}
    best = {k: v.clone() for k, v in network.state_dict().items()}
    if path.exists():
        state, extra = load_network(path, network)
        if state["done"]:
            network.eval()
            return state
        best = _restore(network, optimiser, schedule, state, extra)
    else:
        # What was fitted in closed form may be the best there is.
        network.eval()
        state["best"] = _error(network, inputs[validation], target[validation], settings.batch_size)

    epochs = bar(title, "epoch", settings.max_epochs, initial=state["epoch"])
    while not state["done"]:
        network.train()
        order = train[torch.randperm(len(train))]
        total = 0.0
        # The last batch is left out where it is short: batch normalisation of one sample has no variance.
        batches = [b for b in order.split(settings.batch_size) if len(b) == settings.batch_size] or [order]
        for batch in batches:
            loss = network.loss(inputs[batch], target[batch])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            total += loss.item() / len(batches)
        network.eval()
        error = _error(network, inputs[validation], target[validation], settings.batch_size)
        if isinstance(schedule, ReduceLROnPlateau):
            schedule.step(error)
        else:
            schedule.step()
        state["epoch"] += 1
        state["history"].append([total, error])
        if error < state["best"]:
            state["best"] = error
            best = {k: v.clone() for k, v in network.state_dict().items()}
        rate = optimiser.param_groups[0]["lr"]
        epochs.set_postfix(train=f"{total:.2e}", validation=f"{error:.2e}", rate=f"{rate:.0e}")
        epochs.update()
        state["done"] = state["epoch"] >= settings.max_epochs or rate < settings.final_rate
        if not state["done"] and state["epoch"] % CHECKPOINT_EPOCHS == 0:
            _checkpoint(path, network, optimiser, schedule, state, best)
    epochs.close()
    network.load_state_dict(best)
    network.eval()
    save_network(path, network, state)
    return state


def _error(network: ShapeNetwork, inputs: Tensor, target: Tensor, batch_size: int) -> float:
    return nn.functional.mse_loss(predict(network.coefficients, inputs, batch_size), target).item()


def _checkpoint(
    path: Path,
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    schedule: ReduceLROnPlateau | CosineAnnealingLR,
    state: dict[str, Any],
    best: dict[str, Tensor],
) -> None:
    moments = {
        f"adam.{index}.{key}": value
        for index, values in optimiser.state_dict()["state"].items()
        for key, value in values.items()
    }
    extra = {f"best.{k}": v for k, v in best.items()} | moments | {"rng": torch.get_rng_state()}
    rate = optimiser.param_groups[0]["lr"]
    save_network(path, network, state | {"rate": rate, "schedule": schedule.state_dict()}, extra)


def _restore(
    network: nn.Module,
    optimiser: torch.optim.Optimizer,
    schedule: ReduceLROnPlateau | CosineAnnealingLR,
    state: dict[str, Any],
    extra: dict[str, Tensor],
) -> dict[str, Tensor]:
    """Put a checkpoint back; returns the best parameters so far."""
    torch.set_rng_state(extra["rng"])
    schedule.load_state_dict(state.pop("schedule"))
    moments: dict[int, dict[str, Tensor]] = {}
    for key, value in extra.items():
        if key.startswith("adam."):
            _, index, name = key.split(".")
            moments.setdefault(int(index), {})[name] = value
    groups = optimiser.state_dict()["param_groups"]
    groups[0]["lr"] = state.pop("rate")
    optimiser.load_state_dict({"state": moments, "param_groups": groups})
    return {k.removeprefix("best."): v for k, v in extra.items() if k.startswith("best.")}
