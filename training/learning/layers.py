"""Scaling, last layers of low rank, and number formats that all networks share.

Networks put out NRIC ``z`` (n, 2E) and compute in *scaled differences*: ``(z − z̄)`` times the square roots of the
weights of ``‖·‖_{2,z̄}``. Lengths and angles are each divided by their own standard deviation, so that the mean square
over entries is the loss with both halves normalised. With a given weight η of angles, one number divides both.
"""

from __future__ import annotations

import itertools

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn

from shapespace.arrays import FloatArray, IntArray
from shapespace.training.learning.linear import principal_axes
from shapespace.training.runs.network_settings import Normalisation

#: Smallest number of entries of a tensor that is stored in 8 or 16 bits, if these hold its values exactly.
NARROWED_SIZE = 1024


def half_precision(x: Tensor) -> Tensor:
    """Round to the nearest 16-bit floating-point values, in the type of x."""
    return x.half().to(x.dtype)


def in_bytes(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """Return integers from −127 to 127 (floating-point numbers) and factors along ``dim``; x is about their product."""
    unit = x.abs().amax(dim=dim, keepdim=True).clamp_min(1e-30) / 127
    return (x / unit).round(), unit


def resized(values: Tensor, size: int) -> Tensor:
    """Return the first ``size`` entries of the last dimension, with zeros beyond its end."""
    return nn.functional.pad(values[..., :size], (0, max(0, size - values.shape[-1])))


def narrowest(x: Tensor) -> torch.dtype:
    """Return the type of a tensor in a bundle: 8 or 16 bits where they hold all values of a large tensor exactly."""
    if x.dtype == torch.float32 and x.numel() >= NARROWED_SIZE:
        for narrow in (torch.int8, torch.int16, torch.float16):
            if torch.equal(x, x.to(narrow).to(x.dtype)):
                return narrow
    return x.dtype


class Scaling(nn.Module):
    """Affine map between NRIC and scaled differences.

    Args:
        mean: z̄ of the reference, (2E,).
        factor: (2E,) scaled differences per unit of z; 0 for entries without a weight (boundary angles).
    """

    mean: Tensor
    factor: Tensor
    inverse: Tensor

    def __init__(self, mean: FloatArray, factor: FloatArray) -> None:
        super().__init__()
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        self.register_buffer("factor", torch.as_tensor(factor, dtype=torch.float32))
        inverse = np.divide(1.0, factor, out=np.zeros_like(factor), where=factor > 0)
        self.register_buffer("inverse", torch.as_tensor(inverse, dtype=torch.float32))

    @classmethod
    def blank(cls, size: int) -> Scaling:
        """Return a scaling of zeros, to load saved tensors into."""
        return cls(np.zeros(size), np.zeros(size))

    @classmethod
    def of(cls, reference: FloatArray, weights: FloatArray, samples: NDArray, eta: float | None = None) -> Scaling:
        """Scale samples (n, 2E) to unit mean square about their mean, as a whole in the norm with a given η.

        Without η, each half has unit mean square. ``weights`` (2E,) are of the norm with η = 1.
        """
        half = len(weights) // 2
        root = np.sqrt(weights * np.repeat([1.0, eta or 1.0], half))
        spread = (samples - samples.mean(axis=0)) * root
        factor = root.copy()
        for part in (slice(0, half), slice(half, None)) if eta is None else (slice(None),):
            factor[part] /= max(float(np.sqrt(np.mean(spread[:, part] ** 2))), 1e-12)
        return cls(reference, factor)

    def down(self, z: Tensor) -> Tensor:
        """Map NRIC to scaled differences."""
        return (z - self.mean) * self.factor

    def up(self, y: Tensor) -> Tensor:
        """Map scaled differences to NRIC."""
        return self.mean + y * self.inverse


def patch_entries(midpoints: FloatArray, count: int, seed: int) -> list[IntArray]:
    """Return the entries of NRIC, lengths and then angles, for at most ``count`` patches of neighbouring edges."""
    edges = len(midpoints)
    labels = kmeans2(midpoints, count, seed=seed, minit="++")[1] if count > 1 else np.zeros(edges, dtype=int)
    members = (np.flatnonzero(labels == label) for label in np.unique(labels))
    return [np.concatenate([own, edges + own]) for own in members]


def supporting(y: NDArray, share: float) -> NDArray[np.bool_]:
    """Mark the entries (2E,) of the fewest edges that hold a share of the variance of scaled differences y (n, 2E)."""
    variance = y.var(axis=0, dtype=np.float64).reshape(2, -1).sum(axis=0)
    strongest = np.argsort(-variance, kind="stable")
    held = np.cumsum(variance[strongest])
    few = np.zeros(len(variance), dtype=bool)
    few[strongest[: 1 + np.searchsorted(held[:-1], share * held[-1])]] = True
    return np.tile(few | (share == 1), 2)


class PatchBasis(nn.Module):
    """Linear last layer of low rank: an orthonormal principal basis for each patch of neighbouring edges.

    A variation that moves over the surface has no small basis on the whole surface, but has one within a patch. The
    basis is orthonormal up to one common factor. So the mean square error is the same, up to that factor, in
    coefficients and in scaled differences. Entries in no patch keep their mean.
    """

    mean: Tensor
    order: Tensor

    def __init__(self, entries: list[NDArray], bases: list[NDArray], mean: NDArray) -> None:
        super().__init__()
        self.ranks = [basis.shape[1] for basis in bases]
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        for i, basis in enumerate(bases):
            self.register_buffer(f"basis{i}", half_precision(torch.as_tensor(basis.T.copy(), dtype=torch.float32)))
        order = np.concatenate(entries)
        place = np.full(len(mean), len(order), dtype=np.int32)
        place[order] = np.arange(len(order))
        self.register_buffer("order", torch.as_tensor(order))
        #: Index of each entry among the entries of all patches, followed by a zero.
        self.place: Tensor | None
        self.register_buffer("place", torch.as_tensor(place) if bases[1:] or len(order) < len(mean) else None)

    @classmethod
    def blank(cls, tensors: dict[str, Tensor]) -> PatchBasis:
        """Return a basis of zeros with the sizes of saved tensors, to load these tensors into."""
        sizes = [tensors[f"basis{i}"].shape for i in range(sum(name.startswith("basis") for name in tensors))]
        stops = np.cumsum([size for _, size in sizes])
        entries = [np.arange(stop - size, stop) for stop, (_, size) in zip(stops, sizes, strict=True)]
        return cls(entries, [np.zeros((size, rank)) for rank, size in sizes], np.zeros(len(tensors["mean"])))

    @classmethod
    def fit(
        cls, y: NDArray, midpoints: FloatArray, patches: int, energy: float, seed: int, support: float = 1
    ) -> PatchBasis:
        """Fit principal bases to scaled differences y (n, 2E).

        The axes of largest variance over all patches are kept, until they hold the share ``energy`` of the variance.
        Before that, edges with the least variance are left out; the others hold the share ``support`` of the variance.
        """
        mean, vary = y.mean(axis=0), supporting(y, support)
        entries = [own[vary[own]] for own in patch_entries(midpoints, patches, seed)]
        entries, values, vectors = [own for own in entries if len(own)], [], []
        for columns in entries:
            d = torch.as_tensor((y[:, columns] - mean[columns]).astype(np.float64))
            s, axes = principal_axes(d, by="svd" if len(d) < len(columns) else "columns")
            values.append(s.numpy() ** 2)
            vectors.append(axes.numpy().T)
        every = np.sort(np.concatenate(values))[::-1]
        cut = every[min(np.searchsorted(np.cumsum(every), energy * every.sum()), len(every) - 1)]
        ranks = [max(1, int((value >= cut).sum())) for value in values]
        # In this unit the coefficients of y have a mean square of one, like the outputs of a new perceptron.
        unit = np.sqrt(every.sum() / len(y) / sum(ranks))
        return cls(entries, [unit * v[:, :r] for v, r in zip(vectors, ranks, strict=True)], mean)

    @property
    def rank(self) -> int:
        """Number of coefficients of all patches together."""
        return sum(self.ranks)

    def _bases(self) -> list[Tensor]:
        return [self.get_buffer(f"basis{i}") for i in range(len(self.ranks))]

    def encode(self, y: Tensor) -> Tensor:
        """Return coefficients (n, rank) of scaled differences (n, 2E)."""
        parts = (y - self.mean)[:, self.order].split([b.shape[1] for b in self._bases()], dim=1)
        return torch.cat(
            [part @ basis.T / basis[0].square().sum() for part, basis in zip(parts, self._bases(), strict=True)], dim=1
        )

    def forward(self, coefficients: Tensor) -> Tensor:
        """Return scaled differences (n, 2E) of coefficients (n, rank)."""
        if self.place is None:
            return coefficients @ self._bases()[0] + self.mean
        parts = coefficients.split(self.ranks, dim=1)
        y = torch.cat([part @ basis for part, basis in zip(parts, self._bases(), strict=True)], dim=1)
        if len(self.order) < len(self.mean):
            y = nn.functional.pad(y, (0, 1))
        return y.index_select(1, self.place) + self.mean


def perceptron(sizes: list[int], normalisation: Normalisation = "before", dropout: float = 0) -> nn.Sequential:
    """Return ``MLP[N_1, …, N_T]`` with ELU and batch normalisation, and perhaps dropout, in each hidden layer."""
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes[:-1]):
        norms = [] if normalisation == "none" else [nn.BatchNorm1d(n_out)]
        ends = [*norms, nn.ELU()] if normalisation == "before" else [nn.ELU(), *norms]
        layers += [nn.Linear(n_in, n_out), *ends, *([nn.Dropout(dropout)] if dropout else [])]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))
