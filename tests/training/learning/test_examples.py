"""Laws of corrections by examples: exact at the examples, nothing elsewhere. Each run checks its exported ones."""

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from shapespace.training.learning.combiners.combiner import CombinerNetwork
from shapespace.training.learning.composite import Composite
from shapespace.training.learning.examples import ExampleCorrectedCombiner
from shapespace.training.learning.layers import Scaling
from shapespace.training.runs.network_settings import KernelSettings

SIZE = 60


class Sum(nn.Module):
    """The affine sum alone."""

    def forward(self, y: Tensor) -> Tensor:
        return y.sum(dim=1)


@pytest.fixture
def combiner() -> CombinerNetwork:
    rng = np.random.default_rng(0)
    scaling = Scaling(rng.normal(size=SIZE), rng.uniform(1, 3, SIZE))
    return CombinerNetwork(scaling, KernelSettings(), Sum(), {})


def shapes(count: int, seed: int) -> Tensor:
    """(count, 2, SIZE) of two factors of three coordinates each."""
    generator = torch.Generator().manual_seed(seed)
    codes, modes = (torch.randn(*size, generator=generator) for size in ((count, 2, 3), (2, 3, SIZE)))
    return torch.einsum("njk,jks->njs", codes, modes)


def at(combiner: nn.Module, factors: Tensor) -> Tensor:
    with torch.no_grad():
        return combiner(factors)


def test_examples_come_back_and_shapes_between_them_stay(combiner: CombinerNetwork) -> None:
    factors, missed = shapes(12, 1), 0.1 * torch.randn(12, SIZE, generator=torch.Generator().manual_seed(2))
    remembering = ExampleCorrectedCombiner(combiner, factors, missed)
    added = at(remembering, factors) - at(combiner, factors)
    assert (added - missed).abs().max() < 0.01 * missed.abs().max()  # weights have 8 bits
    # Halfway to the nearest other example a quarter of each is left.
    apart = torch.cdist(factors.sum(dim=1), factors.sum(dim=1)).fill_diagonal_(torch.inf)
    halfway = (factors + factors[apart.argmin(dim=1)]) / 2
    left = (at(remembering, halfway) - at(combiner, halfway)).norm(dim=1)
    assert left.max() < 0.45 * missed.norm(dim=1).max()
    away = 20 * factors
    torch.testing.assert_close(at(remembering, away), at(combiner, away))


def test_a_shape_that_is_there_twice_is_remembered_once(combiner: CombinerNetwork) -> None:
    factors, missed = shapes(6, 1).repeat(2, 1, 1), 0.1 * torch.ones(12, SIZE)
    remembering = ExampleCorrectedCombiner(combiner, factors, missed)
    added = at(remembering, factors) - at(combiner, factors)
    assert (added - missed).abs().max() < 0.01 * missed.abs().max()


def test_many_examples_of_few_coordinates_add_no_more_than_was_missed(combiner: CombinerNetwork) -> None:
    """Two hundred examples lie along a line with different errors, many of them almost equal."""
    generator = torch.Generator().manual_seed(4)
    codes, mode = torch.rand(1200, 1, 1, generator=generator), torch.randn(1, 2, SIZE, generator=generator)
    missed = 0.1 * torch.randn(200, SIZE, generator=generator)
    remembering = ExampleCorrectedCombiner(combiner, codes[:200] * mode, missed)
    added = at(remembering, codes[200:] * mode) - at(combiner, codes[200:] * mode)
    assert added.norm(dim=1).max() < 3 * missed.norm(dim=1).max()


def test_angles_are_missed_by_the_shorter_way(combiner: CombinerNetwork) -> None:
    """An angle of π − ε may be predicted as −π + ε: the difference is 2 ε."""
    networks = [nn.Linear(2, SIZE) for _ in range(2)]
    composite = Composite([[0, 1], [2, 3]], networks, combiner)  # type: ignore[arg-type]
    codes = np.random.default_rng(3).normal(size=(5, 4)).astype(np.float32)
    found = at(composite, torch.from_numpy(codes)).double().numpy()
    wanted = found + 0.05
    turned = wanted.copy()
    turned[:, SIZE // 2 :] += 2 * np.pi * np.arange(-2, 3)[:, None]
    with torch.no_grad():
        remembering = ExampleCorrectedCombiner.of(composite, codes, turned)
        again = remembering(composite.factor_shapes(torch.from_numpy(codes))).numpy()
    np.testing.assert_allclose(again, wanted, atol=1e-3)
