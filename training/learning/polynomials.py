"""Polynomials of the factors' shapes, one map for each patch of edges, that correct the affine sum."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.corrections import Correction, JointSamples, Slopes
from shapespace.training.learning.layers import half_precision, patch_entries
from shapespace.training.learning.linear import SpectralRidge, principal_axes, ridge
from shapespace.training.runs.config import PolynomialSettings
from shapespace.training.runs.progress import progress

#: Factor shapes (n, J, 2E), and the residual (n, 2E) of their affine sum to the joint shape, as scaled differences.
Pairs = tuple[Tensor, Tensor]


class PolynomialCorrection(Correction):
    """Cubic polynomials of the factors' shapes, patch by patch.

    How factors act on each other at an edge depends on what each of them does nearby. So in each patch of neighbouring
    edges the shape of every factor is projected to a few principal coefficients, and the correction is a polynomial of
    those of all factors. These are more coordinates than the samples can tell apart, but only few directions among them
    matter: they are found first, as a metric (`learned_metric`). In the coordinates of that metric the kernel
    ``1 + s + s²/2 + s³/6`` is a sum over monomials; those of the largest weight are kept, so that the size of the map
    does not depend on the number of samples.

    With P patches of at most S entries of NRIC, rank r of the metric, M monomials, and rank k of the output:

    Attributes:
        entries: (P, S) indices of the entries in each patch, 2E where there are fewer.
        place: (2E,) index in the flat ``entries`` of each entry of NRIC.
        axes: (P, J, d, S) principal axes of the factors' shapes, integers of 8 bits.
        units: (P, J d) factors of the axes.
        centre: (P, J d) coefficients of the mean shapes.
        metric: (P, r, J d) coordinates u of coefficients c, ``u = A c``.
        pairs: (2, ·) indices of the coordinates in the monomials of degree two.
        triples: (3, ·) the same of degree three.
        weights: (P, k, M), integers of 8 bits.
        gains: (P, k) factors of the weights and of the basis.
        basis: (P, S, k), integers of 8 bits.
        mean: (2E,) the constant.
    """

    entries: Tensor
    place: Tensor
    axes: Tensor
    units: Tensor
    centre: Tensor
    metric: Tensor
    pairs: Tensor
    triples: Tensor
    weights: Tensor
    gains: Tensor
    basis: Tensor
    mean: Tensor
    #: Mean number of edges of a patch.
    EDGES = 24
    #: Most samples that the principal axes of factors are computed from.
    AXES = 500
    #: The output's rank is the lowest that increases the squared error on held-out samples by at most this share.
    SLACK = 0.125

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        super().__init__()
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor)

    @classmethod
    def load(
        cls, settings: PolynomialSettings, reference: TriangleMesh, tensors: Mapping[str, Tensor]
    ) -> PolynomialCorrection:
        """See `Correction`."""
        return cls(tensors)

    @classmethod
    def fit(
        cls, settings: PolynomialSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> PolynomialCorrection:
        """See `Correction`; the held-out samples choose metrics too, and the seed is that of the patches."""
        pairs, others = (own.inputs, own.missed), (held_out.inputs, held_out.missed)
        midpoints = reference.edge_midpoints
        entries = patch_entries(midpoints, math.ceil(len(midpoints) / cls.EDGES), seed)
        patches = [_Patch(columns, settings.coefficients, pairs[0][: cls.AXES]) for columns in entries]
        for patch in progress(patches, "metrics", "patch"):
            patch.learn_metric(pairs, others)
        spread = torch.stack([patch.spread for patch in patches]).clamp_min(1e-30).log().mean(dim=0)
        monomials = _Monomials.strongest(spread.numpy(), settings.monomials)
        for patch in progress(patches, "polynomials", "patch"):
            patch.fit(pairs, others, monomials, own.slopes)
        return cls(_assembled(patches, monomials, pairs[1].shape[1], cls.SLACK))

    def difference(self, y: Tensor) -> Tensor:
        # The dimension of samples comes last: so gathers copy rows, and products of small matrices are few operations.
        rows = torch.cat([y, torch.zeros_like(y[:, :, :1])], dim=2).permute(2, 1, 0)
        local = rows.index_select(0, self.entries.flatten()).unflatten(0, self.entries.shape).transpose(1, 2)
        c = (self.axes @ local).flatten(1, 2) * self.units[:, :, None] - self.centre[:, :, None]
        u = (self.metric @ c).transpose(0, 1)
        parts = u, _products(u, self.pairs), _products(u, self.triples)
        found = torch.cat([part.transpose(0, 1) for part in parts], dim=1)
        out = (self.basis @ (self.weights @ found * self.gains[:, :, None])).flatten(0, 1)
        return out.index_select(0, self.place).T + self.mean


def _assembled(patches: list[_Patch], monomials: _Monomials, size: int, slack: float) -> dict[str, Tensor]:
    """The tensors of a `PolynomialCorrection` of 2E = ``size`` from its fitted patches."""
    rank = _output_rank(patches, slack)
    weights, gains, basis = _output_layers(patches, rank)
    # Shorter patches are padded with an entry of NRIC that does not exist, where shapes are zero.
    entries = _padded([torch.as_tensor(patch.columns) for patch in patches], size)
    mean = torch.zeros(size)
    for patch in patches:
        mean[patch.columns] = patch.mean.float()
    return {
        "entries": entries,
        "place": torch.argsort(entries.flatten())[:size],
        "axes": _padded([patch.axes.permute(2, 0, 1) for patch in patches]).permute(0, 2, 3, 1).contiguous(),
        "units": torch.stack([patch.units for patch in patches]).float(),
        "centre": torch.stack([patch.centre for patch in patches]).float(),
        "metric": torch.stack([patch.metric[: monomials.rank] for patch in patches]),
        "pairs": torch.as_tensor(monomials.pairs.T.copy()),
        "triples": torch.as_tensor(monomials.triples.T.copy()),
        "weights": weights,
        "gains": gains,
        "basis": basis,
        "mean": mean,
    }


def _padded(parts: list[Tensor], value: float = 0) -> Tensor:
    """(P, longest, …) of P tensors (·, …)."""
    return nn.utils.rnn.pad_sequence(parts, batch_first=True, padding_value=value)


def _output_rank(patches: list[_Patch], slack: float) -> int:
    """The smallest rank of the output that adds no more than this share to the squared error of all patches."""
    energy = _padded([patch.energy for patch in patches]).sum(dim=0)
    lost = energy.sum() - energy.cumsum(0)
    return min(int((lost > slack * sum(patch.error for patch in patches)).sum()) + 1, len(energy))


def _output_layers(patches: list[_Patch], rank: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (P, rank, M), gains (P, rank) and basis (P, S, rank) of the last two layers."""
    weights, gains, bases = [], [], []
    for patch in patches:
        basis = patch.basis[:, :rank]
        inner, first = in_bytes(basis.T @ patch.weights, dim=1)
        outer, second = in_bytes(basis, dim=0)
        missing = rank - basis.shape[1]
        weights.append(nn.functional.pad(inner, (0, 0, 0, missing)))
        gains.append(nn.functional.pad(first.flatten() * second.flatten(), (0, missing)))
        bases.append(nn.functional.pad(outer, (0, missing)))
    return torch.stack(weights), torch.stack(gains), _padded(bases)


def in_bytes(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Integers from −127 to 127, as floating-point numbers, and the factors along ``dim`` that make x of them."""
    unit = x.abs().amax(dim=dim, keepdim=True).clamp_min(1e-30) / 127
    return (x / unit).round(), unit


def _products(u: Tensor, factors: Tensor) -> Tensor:
    """(k, …) products of coordinates u (r, …), each of those that a column of ``factors`` names."""
    result = u.index_select(0, factors[0])
    for index in factors[1:]:
        result = result * u.index_select(0, index)
    return result


def _product_slopes(u: Tensor, along: Tensor, factors: Tensor) -> Tensor:
    """(k, …) derivatives of `_products` as the coordinates change by ``along`` (r, …)."""
    result = torch.zeros(())
    for i, index in enumerate(factors):
        others = [other for j, other in enumerate(factors) if j != i]
        result = result + along.index_select(0, index) * _products(u, torch.stack(others))
    return result


def _factorial(index: Sequence[int] | NDArray) -> int:
    """``β!`` of the monomial ``x^β`` that is the product of these coordinates."""
    return math.prod(map(math.factorial, np.bincount(index)))


@dataclass(frozen=True)
class _Monomials:
    """Monomials of degree two and three that all patches have.

    Attributes:
        pairs: (k, 2) indices of coordinates.
        triples: (l, 3) the same.
    """

    pairs: NDArray
    triples: NDArray

    @classmethod
    def strongest(cls, spread: NDArray, count: int) -> _Monomials:
        """Those that the kernel gives most weight.

        In ``s^k / k!``, s = u·u', the monomial ``u^β`` has the weight ``1 / β!``.

        Args:
            spread: logarithms of the mean squares of the coordinates, falling.
            count: of monomials.
        """
        found = [
            (sum(spread[list(index)]) - math.log(_factorial(index)), index)
            for degree in (2, 3)
            for index in itertools.combinations_with_replacement(range(len(spread)), degree)
        ]
        kept = [index for _, index in sorted(found, reverse=True)[:count]]
        pairs, triples = ([index for index in kept if len(index) == degree] for degree in (2, 3))
        return cls(np.array(pairs, dtype=int).reshape(-1, 2), np.array(triples, dtype=int).reshape(-1, 3))

    @property
    def rank(self) -> int:
        """Coordinates that occur, the first ones; at least one."""
        return 1 + int(np.concatenate([self.pairs.ravel(), self.triples.ravel()]).max(initial=0))

    @cached_property
    def roots(self) -> Tensor:
        """(r + k + l,) square roots of their weights in the kernel, those of degree one first."""
        return torch.cat([torch.ones(self.rank), _roots(self.pairs), _roots(self.triples)])


class _Patch:
    """One patch while it is fitted.

    Attributes:
        columns: (S,) its entries of NRIC, lengths and then angles.
        axes: (J, d, S) principal axes of the factors' shapes there, integers of 8 bits.
        units: (J d,) factors of the axes, with which the first coefficient of the widest factor has a variance of one.
        centre: (J d,) coefficients of the mean shapes.
        metric: (J d, J d) rows A of the coordinates ``u = A c`` of coefficients c, those of the largest variance first.
        spread: (J d,) mean squares of the coordinates.
        weights: (S, M) of the monomials.
        basis: (S, k) principal axes of the polynomial's values.
        energy: (k,) mean squares of the values along these.
        error: squared error on held-out samples, their mean summed over the entries.
        mean: (S,) the constant.
    """

    def __init__(self, columns: NDArray, coefficients: int, y: Tensor) -> None:
        self.columns, axes, centre, widest = columns, [], [], 0.0
        for shapes in y[:, :, columns].double().unbind(1):
            middle = shapes.mean(dim=0)
            s, vt = principal_axes(shapes - middle, by="svd")
            vt = nn.functional.pad(vt[:coefficients], (0, 0, 0, max(0, coefficients - len(vt))))
            axes.append(vt)
            centre.append(vt @ middle)
            widest = max(widest, float(s[0]) / len(y) ** 0.5)
        whole, unit = in_bytes(torch.stack(axes), dim=2)
        self.axes = whole.float()
        self.units = unit.flatten() / max(widest, 1e-12)
        self.centre = torch.cat(centre) / max(widest, 1e-12)

    def _inputs(self, y: Tensor) -> Tensor:
        """(n, J d) coefficients of factor shapes (n, J, 2E)."""
        c = torch.einsum("njs,jds->njd", y[:, :, self.columns].double(), self.axes.double())
        return c.flatten(1) * self.units - self.centre

    def learn_metric(self, own: Pairs, held_out: Pairs) -> None:
        """Find the metric, and its principal coordinates."""
        x, other = self._inputs(own[0]), self._inputs(held_out[0])
        wanted, theirs = (pairs[1][:, self.columns].double() for pairs in (own, held_out))
        self.mean = wanted.mean(dim=0)
        metric, self.penalty = learned_metric(x, wanted - self.mean, (other, theirs - self.mean))
        # The kernel is invariant under rotations: in the principal axes of the samples the fewest monomials matter.
        z = x @ metric
        s, axes = principal_axes(z, by="columns")
        self.metric, self.spread = half_precision((metric @ axes.T).T.float()), s.square() / len(z)

    def _features(self, y: Tensor, monomials: _Monomials) -> Tensor:
        """(n, 1 + M) monomials, each times the square root of its weight in the kernel."""
        u = self.metric[: monomials.rank].double() @ self._inputs(y).T
        products = (_products(u, torch.as_tensor(index.T)) for index in (monomials.pairs, monomials.triples))
        return torch.cat([torch.ones_like(u[:1]), torch.cat([u, *products]) * monomials.roots[:, None]]).T

    def _slopes(self, slopes: Slopes, monomials: _Monomials) -> Pairs:
        """(k m, 1 + M) derivatives of the monomials, and (k m, S) of what they are to be."""
        metric, axes = self.metric[: monomials.rank].double(), self.axes.double().transpose(1, 2)
        u = metric @ slopes.repeated(self._inputs(slopes.inputs)).T
        along = metric @ (slopes.coefficients(axes, self.columns) * self.units).T
        products = (
            _product_slopes(u, along, torch.as_tensor(index.T)) for index in (monomials.pairs, monomials.triples)
        )
        rows = torch.cat([torch.zeros_like(u[:1]), torch.cat([along, *products]) * monomials.roots[:, None]]).T
        return rows, slopes.missed[:, :, self.columns].flatten(0, 1).double()

    def fit(self, own: Pairs, held_out: Pairs, monomials: _Monomials, slopes: Slopes | None) -> None:
        """Ridge regression on the monomials, with the kernel's penalty or one ten times smaller or larger."""
        x, other = (self._features(y, monomials) for y in (own[0], held_out[0]))
        wanted, theirs = (residual[:, self.columns].double() - self.mean for _, residual in (own, held_out))
        if slopes:
            rows, derivatives = self._slopes(slopes, monomials)
            x, wanted = torch.cat([x, rows]), torch.cat([wanted, derivatives])
        penalties = max(self.penalty / 10, PENALTIES[0]), self.penalty, 10 * self.penalty
        if len(x) < x.shape[1]:
            found = ridge(x @ x.T, wanted, (other @ x.T, theirs), penalties)
            weights = x.T @ found.weights
        else:
            found = ridge(x.T @ x, x.T @ wanted, (other, theirs), penalties)
            weights = found.weights
        self.mean = self.mean + weights[0]
        self.error = found.error * theirs.shape[1]
        values = x[: len(own[0]), 1:] @ weights[1:]
        s, axes = principal_axes(values, by="columns")
        self.energy, self.basis = s.square() / len(values), axes.T.float()
        self.weights = (weights[1:] * monomials.roots[:, None]).T.float()


def _roots(index: NDArray) -> Tensor:
    """(k,) ``1 / √β!`` of monomials ``x^β`` given as rows of coordinates."""
    return torch.tensor([_factorial(row) for row in index], dtype=torch.float64).rsqrt()


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
    return 1 + s + s**2 / 2 + s**3 / 6


def learned_metric(x: Tensor, y: Tensor, held_out: Pairs) -> tuple[Tensor, float]:
    """A linear map A (k, k) of inputs x (n, k), z = x A, for which kernel ridge regression of y (n, q) is accurate.

    The kernel is ``κ(z·z') = 1 + s + s²/2 + s³/6``, s = z·z'. A starts as a multiple of the identity and is then set,
    several times, to a power of the mean outer product of the gradients of the regression, which shrinks the directions
    in which y does not change (recursive feature machines: Radhakrishnan et al., Science 383, 2024). Held-out pairs
    choose the penalty and the step.

    Returns:
        The map and its penalty.
    """
    x, y = x[:SAMPLES], y[:SAMPLES]
    components = principal_axes(y, by="svd")[1][:OUTPUTS].T
    metric = SCALE * torch.eye(x.shape[1], dtype=x.dtype)
    size = (x @ metric).square().sum()
    best, chosen = math.inf, (metric, PENALTIES[-1])
    for step in range(STEPS + 1):
        z = x @ metric
        s = z @ z.T
        found = SpectralRidge.fit(_kernel(s), y, (_kernel(held_out[0] @ metric @ z.T), held_out[1]), PENALTIES)
        if found.error < best:
            best, chosen = found.error, (metric, found.penalty)
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
    gradients = torch.einsum("pn,nq,nk->pqk", 1 + s + s**2 / 2, weights, z).flatten(0, 1) @ metric.T
    value, vector = torch.linalg.eigh(gradients.T @ gradients)
    return vector * (value / value[-1].clamp_min(1e-30)).clamp_min(1e-12) ** POWER
