"""Where networks are trained: the device, and the state of its random numbers."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from shapespace.training.learning import DeviceError

CPU = torch.device("cpu")
#: Name of the device's random state among the tensors of a checkpoint.
_STATE = "rng.device"


def training_device(name: Literal["auto", "cpu", "cuda", "mps"]) -> torch.device:
    """Return the device of the setting ``networks.device``. Raises DeviceError if PyTorch does not find it."""
    found = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if name == "auto":
        return torch.device(next((kind for kind, there in found.items() if there), "cpu"))
    if not found.get(name, True):
        raise DeviceError(
            f'networks.device is "{name}", but this PyTorch ({torch.__version__}) finds no such GPU; install a PyTorch '
            'for your GPU (docs/how-to/gpu.md), or set device = "auto"'
        )
    return torch.device(name)


def random_state(device: torch.device) -> dict[str, Tensor]:
    """Return the random state of a GPU under its name in a checkpoint; empty for the processor."""
    if device.type == "cpu":
        return {}
    return {_STATE: torch.get_device_module(device).get_rng_state().cpu()}


def restore_random_state(device: torch.device, saved: dict[str, Tensor]) -> None:
    """Restore what `random_state` returned. A checkpoint of another device leaves the state as the seed made it."""
    if device.type != "cpu" and _STATE in saved:
        torch.get_device_module(device).set_rng_state(saved[_STATE])
