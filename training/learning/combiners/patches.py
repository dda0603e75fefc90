"""Fit one patch of edges: kernel regression on the factor shapes there, in a metric learned from its gradients."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from numpy.typing import NDArray
from torch import Tensor

from shapespace.training.learning.combiners.correction import Pairs, Slopes
from shapespace.training.learning.gaussian import Centres
from shapespace.training.learning.layers import half_precision, in_bytes, resized
from shapespace.training.learning.linear import Ridge, SpectralRidge, principal_axes, rounded


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


@dataclass(frozen=True)
class PatchFitting:
    """Settings of the regression in a patch."""

    axes_samples: int = 500  # largest number of samples that the principal axes of factors are computed from
    negligible: float = 1e-6  # share of the coordinates' mean square that is left out
    gammas: tuple[float, ...] = (0.5, 2.0, 8.0, 32.0)  # candidates for γ
    # Candidates for the ridge penalty, where the kernel's largest value is 1. Smaller penalties make the weights too
    # large for single precision.
    penalties: tuple[float, ...] = tuple(10.0**k for k in range(-6, 0))
    functions: int = 800  # largest number of functions with which γ is chosen
    rounding: float = 1.5  # factor by which rounding the weights may increase the squared error


FITTING = PatchFitting()


class Patch:
    """One patch of edges: first its axes, then its metric, then its functions and weights.

    How factors interact at an edge depends on the shape of each factor nearby. So every factor shape is projected to a
    few principal coefficients. All factors together have more coefficients than the samples can tell apart, but only
    few directions among them matter. A metric finds these first (`learned_metric`).
    """

    columns: NDArray  # (S,) its entries of NRIC, lengths and then angles
    axes: Tensor  # (J, d, S) principal axes of the factor shapes there, integers of 8 bits
    units: Tensor  # (J d,) factors of the axes; the first coefficient of the widest factor has a variance of one
    centre: Tensor  # (J d,) coefficients of the mean shapes
    metric: Tensor  # (J d, J d) rows A of the coordinates ``u = A c`` of coefficients c, in falling order of variance
    spread: Tensor  # (J d,) mean squares of the coordinates
    mean: Tensor  # (S,) the constant
    centres: Centres  # the n + k r functions, in r coordinates of 16 bits
    error: float  # squared error on held-out samples with these weights, summed over the entries
    basis: Tensor  # (S, S) principal axes of the output
    energy: Tensor  # (S,) mean squares along these axes
    weights: Tensor  # (n + k r, q) weights of the coefficients along the first axes, integers of 16 bits
    steps: Tensor  # (n + k r,) factors of the functions
    gains: Tensor  # (q,) factors of the coefficients

    def __init__(self, columns: NDArray, coefficients: int, y: Tensor) -> None:
        self.columns = columns
        axes, centre, widest = [], [], 0.0
        for shapes in y[: FITTING.axes_samples, :, columns].double().unbind(1):
            middle = shapes.mean(dim=0)
            s, vt = principal_axes(shapes - middle, by="svd")
            vt = resized(vt.T, coefficients).T
            axes.append(vt)
            centre.append(vt @ middle)
            widest = max(widest, float(s[0]) / len(shapes) ** 0.5)
        whole, unit = in_bytes(torch.stack(axes), dim=2)
        self.axes = whole.float()
        self.units = unit.flatten() / max(widest, 1e-12)
        self.centre = torch.cat(centre) / max(widest, 1e-12)

    def inputs(self, y: Tensor) -> Tensor:
        """Return coefficients (n, J d) of factor shapes (n, J, 2E)."""
        c = torch.einsum("njs,jds->njd", y[:, :, self.columns].double(), self.axes.double())
        return c.flatten(1) * self.units - self.centre

    def learn_metric(self, own: Pairs, held_out: Pairs) -> None:
        """Find the metric, and its principal coordinates."""
        x, other = self.inputs(own[0]), self.inputs(held_out[0])
        wanted, theirs = (pairs[1][:, self.columns].double() for pairs in (own, held_out))
        self.mean = wanted.mean(dim=0)
        metric = learned_metric(x, wanted - self.mean, (other, theirs - self.mean))
        # The kernel is invariant under rotations. In principal axes of the samples the fewest coordinates matter.
        z = x @ metric
        s, axes = principal_axes(z, by="columns")
        self.metric, self.spread = half_precision((metric @ axes.T).T.float()), s.square() / len(z)

    @property
    def rank(self) -> int:
        """Number of coordinates that matter."""
        left = self.spread.sum() - self.spread.cumsum(0)
        return 1 + int((left > FITTING.negligible * self.spread.sum()).sum())

    def coordinates(self, y: Tensor, rank: int) -> Tensor:
        """Return the first ``rank`` coordinates (n, rank) of factor shapes (n, J, 2E)."""
        return self.inputs(y) @ self.metric[:rank].double().T

    def slopes(self, slopes: Slopes, rank: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return coordinates (k m, rank) of samples with derivatives, their derivatives, and residual's (k m, S)."""
        axes, metric = self.axes.double().transpose(1, 2), self.metric[:rank].double().T
        along = (slopes.coefficients(axes, self.columns) * self.units) @ metric
        at = self.coordinates(slopes.inputs, rank).repeat_interleave(slopes.own.shape[1], dim=0)  # once a latent
        return at, along, slopes.missed[:, :, self.columns].flatten(0, 1).double()

    def fit(self, own: Pairs, held_out: Pairs, slopes: Slopes | None, rank: int, most: int, outputs: int) -> None:
        """Fit ``most`` functions of ``rank`` coordinates by ridge regression.

        Held-out samples choose γ and the penalty. The output has the rank ``outputs`` at most. Derivatives are fitted
        as well, if there are any.
        """
        x, other = (self.coordinates(inputs, rank) for inputs, _ in (own, held_out))
        wanted, theirs = (residual[:, self.columns].double() - self.mean for _, residual in (own, held_out))
        anchors, nodes = half_precision(x[:most]), x[:0]
        if slopes:
            nodes = half_precision(self.coordinates(slopes.inputs, rank)[: (most - len(anchors)) // rank])
        known = self.slopes(slopes, rank) if slopes else None
        share = min(1.0, FITTING.functions / (len(anchors) + nodes.numel()))
        tried = [Centres(anchors, nodes, torch.tensor(gamma, dtype=x.dtype)) for gamma in FITTING.gammas]

        def fitted(centres: Centres, penalties: Sequence[float] = FITTING.penalties) -> Ridge:
            return centres.fit((x, wanted), known, (other, theirs), penalties)

        self.centres = min(tried, key=lambda centres: fitted(centres.first(share)).error)
        features, others = self.centres(x), self.centres(other)
        rows = torch.cat([features, self.centres.along(*known[:2])]) if known else features
        penalties: Sequence[float] = FITTING.penalties
        while penalties:
            found = fitted(self.centres, penalties)
            s, axes = principal_axes(features @ found.weights, by="columns")
            self.energy, self.basis = s.square() / len(x), axes.T.float()
            basis = self.basis[:, :outputs].double()
            weights, steps, gains = rounded(found.weights @ basis, rows)
            self.weights, self.steps, self.gains = weights, steps.flatten(), gains.flatten()
            missed = (others * self.steps) @ weights @ (basis * gains).T - theirs
            self.error = float(missed.square().sum(dim=1).mean())
            # With few functions, weights may be so large that rounding spoils their sums; a larger penalty helps.
            if self.error <= FITTING.rounding * found.error * len(self.columns):
                break
            penalties = [penalty for penalty in penalties if penalty > found.penalty]
