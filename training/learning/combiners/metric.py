"""A metric of inputs, learned from the gradients of a kernel regression, in which few directions are left."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from shapespace.training.learning.combiners.correction import Pairs
from shapespace.training.learning.linear import SpectralRidge, principal_axes

#: Candidates for the penalty, where the kernel is 1 at the centre.
PENALTIES = tuple(10.0 ** (k / 2) for k in range(-14, 1))
#: Most samples that a metric is learned from, and at how many of them gradients are computed.
SAMPLES, GRADIENTS = 800, 150
#: How often the metric is updated, and the power of the mean outer product of gradients that it is set to. With the
#: consistent power 1/2 it fits noise.
STEPS, POWER = 4, 0.25
#: The gradients are those of this many principal components of the values.
OUTPUTS = 16
#: The first metric is scaled so that the strongest coefficient has this root mean square.
SCALE = 1 / 8


def _kernel(s: Tensor) -> Tensor:
    """``κ(s)``, the exponential series to degree three."""
    return 1 + s * (1 + s * (1 / 2 + s / 6))


def _kernel_slope(s: Tensor) -> Tensor:
    """``κ'(s)``."""
    return 1 + s * (1 + s / 2)


def learned_metric(x: Tensor, y: Tensor, held_out: Pairs) -> Tensor:
    """A linear map A (k, k) of inputs x (n, k), z = x A, for which kernel ridge regression of y (n, q) is accurate.

    The kernel is ``κ(z·z') = 1 + s + s²/2 + s³/6``, s = z·z'. A starts as a multiple of the identity and is then set,
    several times, to a power of the mean outer product of the gradients of the regression, which shrinks the directions
    in which y does not change (recursive feature machines: Radhakrishnan et al., Science 383, 2024). Held-out pairs
    choose the penalty and the step.
    """
    x, y = x[:SAMPLES], y[:SAMPLES]
    components = principal_axes(y, by="svd")[1][:OUTPUTS].T
    metric = SCALE * torch.eye(x.shape[1], dtype=x.dtype)
    size = (x @ metric).square().sum()
    best, chosen = math.inf, metric
    for step in range(STEPS + 1):
        z = x @ metric
        s = z @ z.T
        found = SpectralRidge.fit(_kernel(s), y, (_kernel(held_out[0] @ metric @ z.T), held_out[1]), PENALTIES)
        if found.error < best:
            best, chosen = found.error, metric
        if step < STEPS:
            metric = _updated(metric, z, s[:GRADIENTS], found.weights @ components)
            metric = metric * (size / (x @ metric).square().sum().clamp_min(1e-30)).sqrt()
    return chosen


def _updated(metric: Tensor, z: Tensor, s: Tensor, weights: Tensor) -> Tensor:
    """A power of the mean outer product of gradients, up to a factor.

    Args:
        metric: A (k, k).
        z: (n, k) = x A.
        s: (m, n) inner products of the samples at which gradients are taken, with all.
        weights: (n, q) of the kernel regression.
    """
    gradients = torch.einsum("pn,nq,nk->pqk", _kernel_slope(s), weights, z).flatten(0, 1) @ metric.T
    value, vector = torch.linalg.eigh(gradients.T @ gradients)
    return vector * (value / value[-1].clamp_min(1e-30)).clamp_min(1e-12) ** POWER
