"""Polynomials of the factors' shapes, one map for each patch of edges, that correct the affine sum."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.learning.corrections import JointSamples, Pairs, Slopes
from shapespace.training.learning.linear import ridge
from shapespace.training.learning.patches import (
    PENALTIES,
    Patch,
    PatchCorrection,
    common_tensors,
    in_bytes,
    output_rank,
    padded_bases,
    patches_of,
)
from shapespace.training.runs.config import PolynomialSettings
from shapespace.training.runs.progress import progress


class PolynomialCorrection(PatchCorrection):
    """Cubic polynomials of the factors' shapes, patch by patch.

    In the coordinates of the metric the kernel ``1 + s + s²/2 + s³/6`` is a sum over monomials; those of the largest
    weight are kept, so that the size of the map does not depend on the number of samples.

    With M monomials, and rank k of the output:

    Attributes:
        pairs: (2, ·) indices of the coordinates in the monomials of degree two.
        triples: (3, ·) the same of degree three.
        weights: (P, k, M), integers of 8 bits.
        gains: (P, k) factors of the weights and of the basis.
        basis: (P, S, k), integers of 8 bits.
    """

    pairs: Tensor
    triples: Tensor
    weights: Tensor
    gains: Tensor
    basis: Tensor
    #: Mean number of edges of a patch.
    EDGES = 24

    @classmethod
    def fit(
        cls, settings: PolynomialSettings, reference: TriangleMesh, own: JointSamples, held_out: JointSamples, seed: int
    ) -> PolynomialCorrection:
        """See `Correction`; the held-out samples choose metrics too, and the seed is that of the patches."""
        count = math.ceil(len(reference.edges) / cls.EDGES)
        pairs, others = own.pairs, held_out.pairs
        patches = patches_of(_Patch, reference, count, settings.coefficients, pairs, others, seed)
        spread = torch.stack([patch.spread for patch in patches]).clamp_min(1e-30).log().mean(dim=0)
        monomials = _Monomials.strongest(spread.numpy(), settings.monomials)
        for patch in progress(patches, "polynomials", "patch"):
            patch.fit(pairs, others, monomials, own.slopes)
        weights, gains, basis = _output_layers(patches, output_rank(patches))
        return cls(
            common_tensors(patches, monomials.rank, pairs[1].shape[1])
            | {
                "pairs": torch.as_tensor(monomials.pairs.T.copy()),
                "triples": torch.as_tensor(monomials.triples.T.copy()),
                "weights": weights,
                "gains": gains,
                "basis": basis,
            }
        )

    def difference(self, y: Tensor) -> Tensor:
        u = self.coordinates(y).transpose(0, 1)
        parts = u, _products(u, self.pairs), _products(u, self.triples)
        found = torch.cat([part.transpose(0, 1) for part in parts], dim=1)
        return self.whole(self.basis @ (self.weights @ found * self.gains[:, :, None]))


def _output_layers(patches: list[_Patch], rank: int) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (P, rank, M), gains (P, rank) and basis (P, S, rank) of the last two layers."""
    bases = padded_bases(patches, rank)
    weights = [basis[: len(patch.columns)].T @ patch.weights for patch, basis in zip(patches, bases, strict=True)]
    inner, first = in_bytes(torch.stack(weights), dim=2)
    outer, second = in_bytes(bases, dim=1)
    return inner, first.flatten(1) * second.flatten(1), outer


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


class _Patch(Patch):
    """One patch while it is fitted.

    Attributes:
        weights: (S, M) of the monomials.
    """

    def _features(self, y: Tensor, monomials: _Monomials) -> Tensor:
        """(n, 1 + M) monomials, each times the square root of its weight in the kernel."""
        u = self.coordinates(y, monomials.rank).T
        products = (_products(u, torch.as_tensor(index.T)) for index in (monomials.pairs, monomials.triples))
        return torch.cat([torch.ones_like(u[:1]), torch.cat([u, *products]) * monomials.roots[:, None]]).T

    def _slopes(self, slopes: Slopes, monomials: _Monomials) -> Pairs:
        """(k m, 1 + M) derivatives of the monomials, and (k m, S) of what they are to be."""
        at, along, missed = self.slopes(slopes, monomials.rank)
        products = (
            _product_slopes(at.T, along.T, torch.as_tensor(index.T)) for index in (monomials.pairs, monomials.triples)
        )
        rows = torch.cat([along.T, *products]) * monomials.roots[:, None]
        return torch.cat([torch.zeros_like(rows[:1]), rows]).T, missed

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
        self.keep_axes(x[: len(own[0]), 1:] @ weights[1:])
        self.weights = (weights[1:] * monomials.roots[:, None]).T.float()


def _roots(index: NDArray) -> Tensor:
    """(k,) ``1 / √β!`` of monomials ``x^β`` given as rows of coordinates."""
    return torch.tensor([_factorial(row) for row in index], dtype=torch.float64).rsqrt()
