"""Learn a metric of inputs from the gradients of a kernel regression, so that few directions remain."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from shapespace.training.learning.combiners.correction import Pairs
from shapespace.training.learning.linear import SpectralRidge, principal_axes


@dataclass(frozen=True)
class MetricLearning:
    """Settings of the metric's iteration."""

    # Candidates for the ridge penalty; the kernel is 1 at the centre.
    penalties: tuple[float, ...] = tuple(10.0 ** (k / 2) for k in range(-14, 1))
    samples: int = 800  # largest number of samples to learn from
    gradients: int = 150  # number of samples at which gradients are computed
    outputs: int = 16  # number of principal components of the values whose gradients are used
    steps: int = 4  # number of updates
    power: float = 0.25  # power of the mean outer product of gradients. The consistent power 1/2 fits noise.
    scale: float = 1 / 8  # root mean square of the strongest coefficient in the first metric


LEARNING = MetricLearning()


def _kernel(s: Tensor) -> Tensor:
    """Return ``κ(s)``, the exponential series to degree three."""
    return 1 + s * (1 + s * (1 / 2 + s / 6))


def learned_metric(x: Tensor, y: Tensor, held_out: Pairs) -> Tensor:
    """Return a linear map A (k, k), z = x A, that makes kernel ridge regression of y (n, q) on x (n, k) accurate.

    The kernel is ``κ(z·z') = 1 + s + s²/2 + s³/6``, s = z·z'. A starts as a multiple of the identity. Each step sets
    it to a power of the mean outer product of the regression's gradients, which shrinks the directions in which y does
    not change (recursive feature machines: Radhakrishnan et al., Science 383, 2024). Held-out pairs choose the penalty
    and the step.
    """
    x, y = x[: LEARNING.samples], y[: LEARNING.samples]
    components = principal_axes(y, by="svd")[1][: LEARNING.outputs].T
    metric = LEARNING.scale * torch.eye(x.shape[1], dtype=x.dtype)
    size = (x @ metric).square().sum()
    best, chosen = math.inf, metric
    for step in range(LEARNING.steps + 1):
        z = x @ metric
        s = z @ z.T
        found = SpectralRidge.fit(_kernel(s), y, (_kernel(held_out[0] @ metric @ z.T), held_out[1]), LEARNING.penalties)
        if found.error < best:
            best, chosen = found.error, metric
        if step < LEARNING.steps:
            metric = _updated(metric, z, s[: LEARNING.gradients], found.weights @ components)
            metric = metric * (size / (x @ metric).square().sum().clamp_min(1e-30)).sqrt()
    return chosen


def _updated(metric: Tensor, z: Tensor, s: Tensor, weights: Tensor) -> Tensor:
    """Return a power of the mean outer product of gradients, up to a factor.

    ``s`` (m, n) has inner products of the samples where gradients are taken with all samples z = x A (n, k), and
    ``weights`` (n, q) are of the kernel regression.
    """
    slope = 1 + s * (1 + s / 2)  # κ'(s)
    gradients = torch.einsum("pn,nq,nk->pqk", slope, weights, z).flatten(0, 1) @ metric.T
    value, vector = torch.linalg.eigh(gradients.T @ gradients)
    return vector * (value / value[-1].clamp_min(1e-30)).clamp_min(1e-12) ** LEARNING.power
