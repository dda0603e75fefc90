"""A device that exists in tests only: tensors there can't be mixed with tensors on the processor, as on a real GPU."""

from __future__ import annotations

import types
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch.utils import _pytree as tree
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing

#: PyTorch's device without memory; here it has some.
DEVICE = torch.device("meta")


class Elsewhere(torch.Tensor):
    """Tensor that says it is on `DEVICE`; its numbers are computed on the processor."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor) -> Elsewhere:
        facts = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, inner.shape, device=DEVICE, **facts)
        made.inner = inner
        return made

    @classmethod
    def __torch_dispatch__(cls, function: Any, kinds: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError("used outside of the fake device")


class FakeDevice(TorchDispatchMode):
    """While it is active, tensors move to `DEVICE` and back. Operations on tensors of both places are refused.

    Attributes:
        operations: number of operations there.
    """

    def __init__(self) -> None:
        super().__init__()
        self.operations = 0

    def __torch_dispatch__(self, function: Any, kinds: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [x for x in tree.tree_leaves((args, kwargs)) if isinstance(x, torch.Tensor)]
        there = any(isinstance(x, Elsewhere) for x in tensors)
        wanted = kwargs.get("device")
        moves = function in (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)
        if there and not moves:
            mixed = [x for x in tensors if not isinstance(x, Elsewhere) and x.dim()]
            assert not mixed, f"{function} mixes tensors of two devices: {mixed}"
        if wanted is not None and torch.device(wanted).type == DEVICE.type:
            kwargs["device"], there = torch.device("cpu"), True
        elif wanted is not None and there:
            there = False
        if function is torch.ops.aten.copy_.default:
            there = isinstance(args[0], Elsewhere)
        self.operations += there
        plain_args, plain_kwargs = tree.tree_map_only(Elsewhere, lambda x: x.inner, (args, kwargs))
        result = function(*plain_args, **plain_kwargs)
        if not there:
            return result
        result = tree.tree_map_only(torch.Tensor, Elsewhere, result)
        return return_and_correct_aliasing(function, args, kwargs, result) if tensors else result


@pytest.fixture
def fake_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeDevice]:
    """The device, with a random state of its own: the number of times that it was read."""
    state = [0]

    def read() -> torch.Tensor:
        state[0] += 1
        return torch.tensor(state)

    def write(saved: torch.Tensor) -> None:
        state[:] = saved.tolist()

    module = types.SimpleNamespace(get_rng_state=read, set_rng_state=write, state=state)
    monkeypatch.setattr(torch, DEVICE.type, module, raising=False)
    torch.get_device_module.cache_clear()
    with FakeDevice() as device:
        yield device
    torch.get_device_module.cache_clear()
