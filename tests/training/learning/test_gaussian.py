"""Gaussian kernels and their gradients: derivatives, inner products, and what derivatives of samples are worth."""

import pytest
import torch
from torch import Tensor

from shapespace.training.learning.gaussian import Centres

GAMMA = torch.tensor(0.7, dtype=torch.float64)
PENALTIES = (1e-9, 1e-6, 1e-3)


def points(count: int, seed: int) -> Tensor:
    return 2 * torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 1


@pytest.fixture(params=[0, 4], ids=["kernels", "and gradients"])
def centres(request: pytest.FixtureRequest) -> Centres:
    return Centres(points(5, 0), points(request.param, 1), GAMMA)


def test_derivatives_along_directions(centres: Centres) -> None:
    u, directions, step = points(6, 2), points(6, 3), 1e-5
    quotients = (centres(u + step * directions) - centres(u - step * directions)) / (2 * step)
    torch.testing.assert_close(centres.along(u, directions), quotients, rtol=0, atol=1e-9)


def test_inner_products(centres: Centres) -> None:
    gram = centres.gram
    torch.testing.assert_close(gram, gram.T)
    torch.testing.assert_close(gram.diagonal(), torch.ones_like(gram.diagonal()))
    assert torch.linalg.eigvalsh(gram)[0] > 0
    # The kernel reproduces: the product with the kernel at a point is the value there.
    torch.testing.assert_close(gram[: len(centres.anchors)], centres(centres.anchors))


def test_batches_are_their_parts_one_by_one(centres: Centres) -> None:
    gammas = torch.tensor([0.5, 2.0], dtype=torch.float64)
    both = Centres(*(torch.stack([x, 0.5 * x]) for x in (centres.anchors, centres.nodes)), gammas[:, None, None])
    u = torch.stack([points(6, 4), points(6, 5)])
    for k in range(2):
        one = Centres(both.anchors[k], both.nodes[k], gammas[k])
        torch.testing.assert_close(both(u)[k], one(u[k]))


def test_gradients_beside_derivatives_are_worth_many_samples() -> None:
    def wave(u: Tensor) -> Tensor:
        return torch.sin(2 * u.sum(dim=1, keepdim=True)) * u[:, :1]

    at, held_out, unseen = points(20, 0), points(40, 1), points(200, 2)
    axes = torch.eye(3, dtype=at.dtype)
    changes = torch.cat([torch.autograd.functional.jvp(wave, at, axis.expand_as(at))[1] for axis in axes])
    slopes = at.repeat(3, 1), axes.repeat_interleave(len(at), dim=0), changes

    def error(nodes: Tensor, known: tuple[Tensor, Tensor, Tensor] | None) -> float:
        centres = Centres(at, nodes, GAMMA)
        found = centres.fit((at, wave(at)), known, (held_out, wave(held_out)), PENALTIES)
        return float((centres(unseen) @ found.weights - wave(unseen)).square().mean())

    values, rows, both = error(at[:0], None), error(at[:0], slopes), error(at, slopes)
    assert both < 0.1 * rows < 0.1 * values
