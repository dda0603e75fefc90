"""Ridge regression and principal axes: the linear algebra of everything that is fitted in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor, nn

#: Eigenvalues below this share of the largest are rounding errors.
ROUNDING = 1e-12
#: Added to the diagonal of a Gram matrix, as a share of its trace, so that its Cholesky factor exists.
JITTER = 1e-12
#: Penalties of `regression`, as shares of the mean square of a feature.
PENALTIES = tuple(10.0**k for k in range(-6, 3))


@dataclass(frozen=True)
class WeightRounding:
    """Settings of `rounded`."""

    largest: int = 32767  # largest integer of a weight
    levels: int = 25000  # largest integer before compensation; the rest is room for compensating other errors
    block: int = 64  # rows that are rounded before all later rows are updated
    jitter: float = 1e-10  # added to the diagonal of the Gram matrix, as a share of its trace


WEIGHTS = WeightRounding()


@dataclass(frozen=True)
class Ridge:
    """A solution of ``(G + λ I) W = R``."""

    weights: Tensor  # W (p, q)
    penalty: float  # λ
    error: float  # mean square error on held-out pairs


def ridge(gram: Tensor, right: Tensor, held_out: tuple[Tensor, Tensor], penalties: Sequence[float]) -> Ridge:
    """Solve a ridge regression with the penalty that suits held-out pairs best; one Cholesky factorisation a penalty.

    With features X (n, p) of samples and values Y (n, q), these are the normal equations if G = XᵀX and R = XᵀY. They
    are the dual form, or kernel ridge regression, if G = XXᵀ and R = Y.

    G is (p, p), positive semi-definite, and R is (p, q). Held-out pairs are features (m, p), or kernels (m, n) with the
    samples, and values (m, q). All penalties are above 0.
    """
    features, wanted = held_out

    def solved(penalty: float) -> Ridge:
        half = torch.linalg.cholesky(gram + penalty * torch.eye(len(gram)))
        weights = torch.cholesky_solve(right, half)
        return Ridge(weights, penalty, float((features @ weights - wanted).square().mean()))

    return min(map(solved, penalties), key=lambda fit: fit.error)


def kernel_ridge(
    gram: Tensor, features: Tensor, values: Tensor, held_out: tuple[Tensor, Tensor], penalties: Sequence[float]
) -> Ridge:
    """Return weights (n, q) of functions that are not orthonormal; the penalty is on the norm of their sum.

    The functions have inner products ``gram`` (n, n). Their values at samples, or their derivatives, are features (m,
    n), which are fitted to values (m, q). Held-out pairs choose the penalty.
    """
    # Almost dependent functions are distinguished down to rounding errors.
    half = torch.linalg.cholesky(gram + JITTER * gram.trace() * torch.eye(len(gram)))
    x, theirs = (torch.linalg.solve_triangular(half, rows.T, upper=False).T for rows in (features, held_out[0]))
    found = ridge(x.T @ x, x.T @ values, (theirs, held_out[1]), penalties)
    return replace(found, weights=torch.linalg.solve_triangular(half.T, found.weights, upper=True))


def rounded(weights: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Round weights to integers of 16 bits with factors of rows and columns, so that their sums stay accurate.

    Kernels that almost depend on each other have large weights of both signs. Rounding each weight by itself would
    spoil their sums. So weights are rounded one after the other, and the remaining weights compensate each error at
    the samples as well as they can (Frantar et al., GPTQ, ICLR 2023).

    Weights (n, q) are of functions with values (m, n) at samples, the features. Returns integers (n, q), factors of
    rows (n, 1) and factors of columns (1, q).
    """
    gram = features.T @ features
    order = gram.diagonal().argsort(descending=True)
    gram = gram[order][:, order] + WEIGHTS.jitter * gram.trace() * torch.eye(len(gram))
    # Row i holds how later functions compensate an error of function i.
    rows = torch.linalg.cholesky(torch.cholesky_inverse(torch.linalg.cholesky(gram)), upper=True)
    columns = weights.square().mean(dim=0, keepdim=True).sqrt().clamp_min(1e-30)
    left = (weights / columns)[order]
    units = left.abs().amax(dim=1, keepdim=True).clamp_min(1e-30) / WEIGHTS.levels
    whole = torch.empty_like(left)
    for start in range(0, len(left), WEIGHTS.block):
        end = min(start + WEIGHTS.block, len(left))
        errors = torch.empty_like(left[start:end])
        for i, error in zip(range(start, end), errors, strict=True):
            whole[i] = (left[i] / units[i]).round().clamp(-WEIGHTS.largest, WEIGHTS.largest)
            error[:] = (left[i] - whole[i] * units[i]) / rows[i, i]
            left[i:end] -= rows[i, i:end, None] * error
        left[end:] -= rows[start:end, end:].T @ errors
    back = order.argsort()
    return whole[back], units[back], columns


@dataclass(frozen=True)
class SpectralRidge:
    """Ridge regression by the eigenvectors of G, which serve all penalties and maps of low rank."""

    values: Tensor  # eigenvalues of G (k,), none negative
    vectors: Tensor  # V (p, k), eigenvectors of G; where k < p, the eigenvectors of eigenvalues above rounding errors
    projected: Tensor  # VᵀR (k, q)
    penalty: float  # λ with the smallest error on held-out pairs
    error: float  # mean square error on held-out pairs

    @classmethod
    def fit(
        cls, gram: Tensor, right: Tensor, held_out: tuple[Tensor, Tensor], penalties: Sequence[float]
    ) -> SpectralRidge:
        """Solve for G and R; see `ridge` for the arguments."""
        values, vectors = torch.linalg.eigh(gram)
        return cls._chosen(values.clamp_min(0), vectors, vectors.T @ right, held_out, penalties)

    @classmethod
    def of_samples(
        cls, x: Tensor, y: Tensor, held_out: tuple[Tensor, Tensor], penalties: Sequence[float]
    ) -> SpectralRidge:
        """Solve for G = XᵀX and R = XᵀY, by the smaller of XᵀX and XXᵀ: features x (n, p), values y (n, q)."""
        if len(x) >= x.shape[1]:
            return cls.fit(x.T @ x, x.T @ y, held_out, penalties)
        values, left = torch.linalg.eigh(x @ x.T)
        kept = values > ROUNDING * values[-1]
        values, left = values[kept], left[:, kept]
        return cls._chosen(
            values, x.T @ left * values.rsqrt(), left.T @ y * values.sqrt()[:, None], held_out, penalties
        )

    @classmethod
    def _chosen(
        cls,
        values: Tensor,
        vectors: Tensor,
        projected: Tensor,
        held_out: tuple[Tensor, Tensor],
        penalties: Sequence[float],
    ) -> SpectralRidge:
        features, wanted = held_out[0] @ vectors, held_out[1]
        errors = {
            penalty: float((features @ (projected / (values + penalty)[:, None]) - wanted).square().mean())
            for penalty in penalties
        }
        penalty = min(errors, key=errors.__getitem__)
        return cls(values, vectors, projected, penalty, errors[penalty])

    @property
    def weights(self) -> Tensor:
        """W (p, q)."""
        return self.vectors @ (self.projected / (self.values + self.penalty)[:, None])

    def low_rank(self, rank: int) -> tuple[Tensor, Tensor]:
        """Return factors (p, rank) and (rank, q) of the map of this rank nearest to the solution in values X W."""
        # Except for the penalty, the columns of X H are orthonormal, so X H B and B have the same error.
        scale = (self.values + self.penalty).rsqrt()
        h, b = self.vectors * scale, self.projected * scale[:, None]
        strongest = torch.linalg.eigh(b @ b.T)[1][:, -rank:]
        strongest = nn.functional.pad(strongest, (0, rank - strongest.shape[1]))
        return h @ strongest, strongest.T @ b


def regression(x: Tensor, y: Tensor, held_out: tuple[Tensor, Tensor]) -> SpectralRidge:
    """Fit y (n, q) to features x (n, p), with a mean square of about one, by ridge regression in double precision."""
    x, y = (values.double() / len(x) ** 0.5 for values in (x, y))
    return SpectralRidge.of_samples(x, y, (held_out[0].double(), held_out[1]), PENALTIES)


def principal_axes(x: Tensor, by: Literal["svd", "rows", "columns"]) -> tuple[Tensor, Tensor]:
    """Return singular values (k,) of x (n, p), in falling order, and right singular vectors as rows (k, p).

    The caller subtracts the mean. The results have the type of x.

    Args:
        x: n samples.
        by: ``svd`` is accurate to rounding, k = min(n, p). ``rows`` uses the eigenvectors of x xᵀ, k = n, the fastest
            for n much less than p. Axes that are rounding errors (`ROUNDING`), and their singular values, are 0.
            ``columns`` uses the eigenvectors of xᵀ x, k = p, the fastest for n much greater than p. The last two
            compute in double precision and resolve no singular value below 1e-8 of the largest.
    """
    if by == "svd":
        _, s, vt = torch.linalg.svd(x, full_matrices=False)
        return s, vt
    wide = x.double()
    if by == "columns":
        value, vector = torch.linalg.eigh(wide.T @ wide)
        return value.flip(0).clamp_min(0).sqrt().to(x.dtype), vector.flip(1).T.to(x.dtype)
    value, vector = torch.linalg.eigh(wide @ wide.T)
    s = torch.where(value > ROUNDING * value[-1], value, 0).flip(0).sqrt()
    axes = vector.flip(1).T @ wide * torch.where(s > 0, 1 / s, 0)[:, None]
    return s.to(x.dtype), axes.to(x.dtype)
