"""What the networks are made of: functions of the latents, a last layer of low rank, convolutions on edges."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from numpy.polynomial import legendre
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from torch import Tensor, nn

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.training.runs.coordinates import Coordinates

#: Entries from which a tensor that 8 or 16 bits hold as it is takes less room in a bundle.
NARROWED_SIZE = 1024


def half_precision(x: Tensor) -> Tensor:
    """The nearest values of 16 bits, in the same type."""
    return x.half().to(x.dtype)


def narrowest(x: Tensor) -> torch.dtype:
    """The type that a tensor goes into a bundle in: of 8 or 16 bits where they hold all of a large one."""
    if x.dtype == torch.float32 and x.numel() >= NARROWED_SIZE:
        for narrow in (torch.int8, torch.float16):
            if torch.equal(x, x.to(narrow).to(x.dtype)):
                return narrow
    return x.dtype


class LatentFeatures(nn.Module):
    """The functions of the latents that a network starts from, (n, m) → (n, size).

    A bounded coordinate is brought to [−1, 1]. A periodic one gives cos kx, sin kx for k = 1 … order.
    """

    centre: Tensor
    radius: Tensor
    wave: Tensor

    def __init__(self, coordinates: Coordinates, order: int) -> None:
        super().__init__()
        periodic = np.isfinite(coordinates.period) & (order > 0)
        self.periodic, self.bounded = np.flatnonzero(periodic).tolist(), np.flatnonzero(~periodic).tolist()
        centre = (coordinates.lower + coordinates.upper) / 2
        radius = np.maximum((coordinates.upper - coordinates.lower) / 2, 1e-12)
        self.register_buffer("centre", torch.as_tensor(centre[self.bounded], dtype=torch.float32))
        self.register_buffer("radius", torch.as_tensor(radius[self.bounded], dtype=torch.float32))
        wave = 2 * np.pi / coordinates.period[self.periodic, None] * np.arange(1, order + 1)
        self.register_buffer("wave", torch.as_tensor(wave, dtype=torch.float32))
        self.size = len(self.bounded) + 2 * wave.size

    def forward(self, latent: Tensor) -> Tensor:
        if not self.periodic:
            return (latent - self.centre) / self.radius
        angle = (latent[:, self.periodic, None] * self.wave).flatten(1)
        parts = [torch.cos(angle), torch.sin(angle)]
        if self.bounded:
            parts.insert(0, (latent[:, self.bounded] - self.centre) / self.radius)
        return torch.cat(parts, dim=1)


class FourierProducts(nn.Module):
    """Products of waves of several periodic coordinates whose frequencies lie in an ellipse, (n, m) → (n, size).

    ``{Π_i w_i(k_i x_i) : w_i ∈ {cos, sin}, Σ (k_i / K_i)² ≤ 1}``, the constant included.
    """

    columns: Tensor
    wave: Tensor

    def __init__(self, coordinates: Coordinates, orders: list[int]) -> None:
        super().__init__()
        if len(orders) != len(coordinates) or not np.isfinite(coordinates.period).all():
            raise ValueError("skip_orders needs one order for each coordinate, all of them periodic")
        # Column 0 is the constant, 2k − 1 and 2k are cos kx and sin kx.
        columns = [
            index
            for index in itertools.product(*(range(2 * k + 1) for k in orders))
            if sum(((i + 1) // 2 / k) ** 2 for i, k in zip(index, orders, strict=True)) <= 1
        ]
        self.register_buffer("columns", torch.tensor(columns).T.contiguous())
        self.register_buffer("wave", torch.as_tensor(2 * np.pi / coordinates.period, dtype=torch.float32))
        for i, k in enumerate(orders):
            self.register_buffer(f"frequency{i}", torch.arange(1, k + 1, dtype=torch.float32), persistent=False)
        self.size = len(columns)

    def forward(self, latent: Tensor) -> Tensor:
        result = torch.ones_like(latent[:, :1])
        for i, column in enumerate(self.columns):
            angle = latent[:, i, None] * self.wave[i] * self.get_buffer(f"frequency{i}")
            waves = torch.stack([torch.cos(angle), torch.sin(angle)], dim=2).flatten(1)
            waves = torch.cat([torch.ones_like(latent[:, :1]), waves], dim=1).index_select(1, column)
            result = result * waves
        return result


class Polynomials(nn.Module):
    """Products of Legendre polynomials of bounded coordinates up to a total degree, (n, m) → (n, size).

    Over the box they are orthogonal, with a root mean square of ``DECAY^degree``: a smooth map has less and less of the
    higher degrees, and a ridge penalty that knows it needs far fewer samples (a hand's factor of 6 coordinates from 72
    samples: R² 0.999, without it 0.85). The constant is the first.
    """

    DECAY = 0.3

    centre: Tensor
    radius: Tensor
    exponents: Tensor
    sizes: Tensor
    power: Tensor
    legendre: Tensor
    columns: Tensor

    def __init__(self, coordinates: Coordinates, degree: int) -> None:
        super().__init__()
        self.register_buffer("centre", torch.as_tensor((coordinates.lower + coordinates.upper) / 2).float())
        self.register_buffer("radius", torch.as_tensor((coordinates.upper - coordinates.lower) / 2).float())
        m = len(coordinates)
        chosen = (c for d in range(degree + 1) for c in itertools.combinations_with_replacement(range(m), d))
        exponents = [[c.count(i) for i in range(m)] for c in chosen]
        self.register_buffer("exponents", torch.tensor(exponents).T.contiguous())
        self.register_buffer("sizes", self.DECAY ** self.exponents.sum(dim=0))
        self.size = len(exponents)
        orders = range(degree + 1)
        rows = [np.pad(legendre.leg2poly([0] * k + [(2 * k + 1) ** 0.5]), (0, degree - k)) for k in orders]
        columns = self.exponents + (degree + 1) * torch.arange(m)[:, None]
        self.register_buffer("power", torch.arange(degree + 1).float(), persistent=False)
        self.register_buffer("legendre", torch.as_tensor(np.stack(rows, axis=1)).float(), persistent=False)
        self.register_buffer("columns", columns.flatten(), persistent=False)

    def forward(self, latent: Tensor) -> Tensor:
        x = (latent - self.centre) / self.radius
        values = (x[:, :, None] ** self.power @ self.legendre).flatten(1)
        # One gather and one product for all coordinates: in a small network every operation counts.
        return values.index_select(1, self.columns).unflatten(1, self.exponents.shape).prod(dim=1) * self.sizes


def patch_entries(midpoints: FloatArray, count: int, seed: int) -> list[IntArray]:
    """Entries of NRIC, lengths and then angles, of each patch of neighbouring edges; at most ``count`` patches."""
    edges = len(midpoints)
    labels = kmeans2(midpoints, count, seed=seed, minit="++")[1] if count > 1 else np.zeros(edges, dtype=int)
    members = (np.flatnonzero(labels == label) for label in np.unique(labels))
    return [np.concatenate([own, edges + own]) for own in members]


class PatchBasis(nn.Module):
    """A linear last layer of low rank: an orthonormal principal basis for each patch of neighbouring edges.

    A shape variation that moves about the surface has no small global basis, but within a patch it does.
    Being orthonormal up to one common unit, it turns a mean square of scaled differences into one of coefficients.
    """

    mean: Tensor
    order: Tensor
    place: Tensor

    def __init__(self, entries: list[NDArray], bases: list[NDArray], mean: NDArray) -> None:
        super().__init__()
        self.ranks = [basis.shape[1] for basis in bases]
        self.register_buffer("mean", torch.as_tensor(mean, dtype=torch.float32))
        for i, basis in enumerate(bases):
            self.register_buffer(f"basis{i}", half_precision(torch.as_tensor(basis.T.copy(), dtype=torch.float32)))
        order = np.concatenate(entries)
        self.register_buffer("order", torch.as_tensor(order))
        self.register_buffer("place", torch.as_tensor(np.argsort(order)))

    @classmethod
    def blank(cls, tensors: dict[str, Tensor]) -> PatchBasis:
        """One of the sizes of a saved one, to load it into; ``tensors`` are the saved one's, by their own names."""
        sizes = [tensors[f"basis{i}"].shape for i in range(sum(name.startswith("basis") for name in tensors))]
        stops = np.cumsum([size for _, size in sizes])
        entries = [np.arange(stop - size, stop) for stop, (_, size) in zip(stops, sizes, strict=True)]
        return cls(entries, [np.zeros((size, rank)) for rank, size in sizes], np.zeros(stops[-1]))

    @classmethod
    def fit(cls, y: NDArray, midpoints: FloatArray, patches: int, energy: float, seed: int) -> PatchBasis:
        """Principal bases of scaled differences y (n, 2E), sharing the kept variance over the patches as it pays."""
        mean = y.mean(axis=0)
        entries, values, vectors = patch_entries(midpoints, patches, seed), [], []
        for columns in entries:
            # Right singular vectors by whichever Gram matrix is smaller.
            d = (y[:, columns] - mean[columns]).astype(np.float64)
            if len(d) < len(columns):
                _, s, vt = np.linalg.svd(d, full_matrices=False)
                value, vector = s**2, vt.T
            else:
                value, vector = np.linalg.eigh(d.T @ d)
                value, vector = value[::-1], vector[:, ::-1]
            values.append(value)
            vectors.append(vector)
        every = np.sort(np.concatenate(values))[::-1]
        cut = every[min(np.searchsorted(np.cumsum(every), energy * every.sum()), len(every) - 1)]
        ranks = [max(1, int((value >= cut).sum())) for value in values]
        # The unit that gives the coefficients of y a mean square of one, so that a perceptron starts at their size.
        unit = np.sqrt(every.sum() / len(y) / sum(ranks))
        return cls(entries, [unit * v[:, :r] for v, r in zip(vectors, ranks, strict=True)], mean)

    @property
    def rank(self) -> int:
        """Number of coefficients, all patches together."""
        return sum(self.ranks)

    def _bases(self) -> list[Tensor]:
        return [self.get_buffer(f"basis{i}") for i in range(len(self.ranks))]

    def encode(self, y: Tensor) -> Tensor:
        """Coefficients (n, rank) of scaled differences (n, 2E)."""
        parts = (y - self.mean)[:, self.order].split([b.shape[1] for b in self._bases()], dim=1)
        return torch.cat(
            [part @ basis.T / basis[0].square().sum() for part, basis in zip(parts, self._bases(), strict=True)], dim=1
        )

    def forward(self, coefficients: Tensor) -> Tensor:
        """Scaled differences (n, 2E) of coefficients (n, rank)."""
        if len(self.ranks) == 1:
            return coefficients @ self._bases()[0] + self.mean
        parts = coefficients.split(self.ranks, dim=1)
        y = torch.cat([part @ basis for part, basis in zip(parts, self._bases(), strict=True)], dim=1)
        return y.index_select(1, self.place) + self.mean


def perceptron(sizes: list[int]) -> nn.Sequential:
    """``MLP[N_1, …, N_T]`` with ELU and batch normalisation after each hidden layer."""
    layers: list[nn.Module] = []
    for n_in, n_out in itertools.pairwise(sizes[:-1]):
        layers += [nn.Linear(n_in, n_out), nn.BatchNorm1d(n_out), nn.ELU()]
    return nn.Sequential(*layers, nn.Linear(sizes[-2], sizes[-1]))


class EdgeConvolution(nn.Module):
    """A graph convolution on features (E, n, C) of edges.

    ``star`` is the paper's ``W₁ x_e + W₂ Σ_{N(e)} x + b``, where N(e) are the edges that share a vertex with e. It
    can't tell directions apart. ``flaps`` gives a matrix of its own to each of the four other edges of the two faces
    at e, in the order that e's direction and the faces' orientation fix: ``W₁ x_e + Σ_k W_{2,k} x_{e_k} + b``.
    """

    def __init__(self, around: Star | Flaps, n_in: int, n_out: int) -> None:
        super().__init__()
        self.own = nn.Linear(n_in, n_out)
        self.around = around
        self.other = nn.Linear(around.count * n_in, n_out, bias=False)
        if isinstance(around, Star):
            with torch.no_grad():
                # About ten neighbours: without this their sum outweighs the edge itself at the start.
                self.other.weight /= 10

    def forward(self, x: Tensor, neighbours: Tensor | None = None) -> Tensor:
        """On the whole mesh, or on a part of it with a table of its own, see `crops.Crop`."""
        around = self.around(x) if neighbours is None else _side_by_side(_gather(x, neighbours))
        return self.own(x) + self.other(around)


class Star(nn.Module):
    """(E, n, C) → the same: sums over the edges that share a vertex with each, by way of sums at the vertices."""

    edges: Tensor
    at_vertex: Tensor
    count = 1

    def __init__(self, connectivity: Connectivity) -> None:
        super().__init__()
        self.register_buffer("edges", torch.tensor(connectivity.edges), persistent=False)
        self.register_buffer("at_vertex", torch.as_tensor(edges_at_vertices(connectivity)), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        if torch.compiler.is_exporting():
            at_vertex = _gather(x, self.at_vertex).sum(dim=1)
            return at_vertex[self.edges[:, 0]] + at_vertex[self.edges[:, 1]] - 2 * x
        return _StarSum.apply(x, self.edges, self.at_vertex)


class Flaps(nn.Module):
    """(E, n, C) → (E, n, 4 C): the features of the four other edges of the two faces at each edge, see `flaps`."""

    neighbours: Tensor
    targets: Tensor
    offsets: Tensor
    count = 4

    def __init__(self, connectivity: Connectivity) -> None:
        super().__init__()
        table = flaps(connectivity)
        # For the gradient: at which places of the table each edge stands.
        flat, count = table.ravel(), connectivity.edge_count
        order = np.argsort(flat, kind="stable")[: int((flat < count).sum())]
        for name, index in {
            "neighbours": table,
            "targets": order,
            "offsets": np.searchsorted(flat[order], np.arange(count)),
        }.items():
            self.register_buffer(name, torch.as_tensor(index), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        if torch.compiler.is_exporting():
            around = _gather(x, self.neighbours)
        else:
            around = _FlapGather.apply(x, self.neighbours, self.targets, self.offsets)
        return _side_by_side(around)


def edges_at_vertices(connectivity: Connectivity) -> IntArray:
    """(V, k) edges at each vertex, padded with E."""
    ends, count = connectivity.edges.ravel(), connectivity.edge_count
    order = np.argsort(ends, kind="stable")
    valence = np.bincount(ends, minlength=connectivity.vertex_count)
    table = np.full((len(valence), valence.max()), count)
    table[np.arange(valence.max()) < valence[:, None]] = order // 2
    return table


def flaps(connectivity: Connectivity) -> IntArray:
    """(E, 4) other edges of the faces left and right of i → j, in each the one at i first; E where there is none."""
    table = np.full((connectivity.edge_count, 4), connectivity.edge_count)
    for side in (0, 1):
        there = np.flatnonzero(connectivity.edge_faces[:, side] >= 0)
        face = connectivity.edge_faces[there, side]
        for column in (0, 1):
            # Edge k of a face lies opposite to its corner k: the edge at i is the one opposite to j.
            corner = connectivity.faces[face] == connectivity.edges[there, 1 - column, None]
            table[there, 2 * side + column] = connectivity.face_edges[face][corner]
    return table


def _gather(x: Tensor, neighbours: Tensor) -> Tensor:
    """(E, k, n, C) features of the neighbours of each edge, zero where there is none."""
    padded = torch.cat([x, torch.zeros_like(x[:1])])
    return padded.index_select(0, neighbours.flatten()).unflatten(0, neighbours.shape)


def _side_by_side(around: Tensor) -> Tensor:
    """(E, k, n, C) → (E, n, k C)."""
    return around.transpose(1, 2).flatten(2)


class _FlapGather(torch.autograd.Function):
    """The same for training: its gradient is a gather too, several times faster than autograd's scatter."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, neighbours: Tensor, targets: Tensor, offsets: Tensor) -> Tensor:
        ctx.save_for_backward(targets, offsets)
        return _gather(x, neighbours)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        targets, offsets = ctx.saved_tensors
        flat = gradient.reshape(gradient.shape[0] * gradient.shape[1], -1)
        total = nn.functional.embedding_bag(targets, flat, offsets, mode="sum")
        return total.view(len(offsets), *gradient.shape[2:]), None, None, None


class _StarSum(torch.autograd.Function):
    """``Bᵀ(Bx) − 2x`` with the incidence B of vertices and edges; symmetric, so it is its own gradient."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, edges: Tensor, at_vertex: Tensor) -> Tensor:
        ctx.save_for_backward(edges, at_vertex)
        padded = torch.cat([x, torch.zeros_like(x[:1])]).flatten(1)
        sums = nn.functional.embedding_bag(at_vertex, padded, mode="sum", padding_idx=len(x))
        return nn.functional.embedding_bag(edges, sums, mode="sum").view_as(x) - 2 * x

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _StarSum.apply(gradient.contiguous(), *ctx.saved_tensors), None, None
