"""Graph convolutions on the edges of the mesh: the paper's combiner, and better ones, trained on crops of the mesh."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from shapespace.arrays import IntArray
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.training.learning.combiners.correction import Correction, JointSamples
from shapespace.training.learning.combiners.crops import Crops
from shapespace.training.learning.combiners.products import ProductCorrection
from shapespace.training.runs.network_settings import ConvolutionSettings, FitSettings, ProductSettings


class ConvolutionCorrection(Correction):
    """Graph convolutions on edges, each followed by batch normalisation and ELU in some order, and dropout.

    With ``residual`` they correct the affine sum, or its correction by products, and start at zero. Without
    ``residual`` they put out the joint shape itself, as in the paper. Features of an edge are the lengths and angles of
    the J factors, length and angle in the reference, and learned constants. ``factor_count`` is J, and ``rest`` (E, 2)
    is `JointSamples.rest`.
    """

    rest: Tensor

    def __init__(
        self,
        settings: ConvolutionSettings,
        reference: TriangleMesh,
        rest: Tensor,
        factor_count: int,
        products: ProductCorrection | None,
    ) -> None:
        super().__init__({})
        self.settings, self.reference = settings, reference
        connectivity = reference.connectivity
        self.register_buffer("rest", rest)
        self.edge_constants = nn.Parameter(0.1 * torch.randn(connectivity.edge_count, settings.edge_channels))
        widths = [2 * factor_count + 2 + settings.edge_channels] + [settings.width] * settings.layers
        around = Star(connectivity) if settings.neighbourhood == "star" else Flaps(connectivity)
        self.convolutions = nn.ModuleList(EdgeConvolution(around, a, b) for a, b in itertools.pairwise(widths))
        norms = (nn.Identity() if settings.normalisation == "none" else nn.BatchNorm1d(width) for width in widths[1:])
        self.norms = nn.ModuleList(norms)
        self.dropout = nn.Dropout(settings.dropout)
        self.readout = nn.Linear(widths[-1], 2)
        if settings.residual:
            nn.init.zeros_(self.readout.weight)
            nn.init.zeros_(self.readout.bias)
        self.products = products

    @classmethod
    def fit(
        cls,
        settings: ConvolutionSettings,
        reference: TriangleMesh,
        own: JointSamples,
        held_out: JointSamples,
        seed: int,
    ) -> ConvolutionCorrection:
        products = None
        if settings.products:
            how = ProductSettings(coefficients=settings.products)
            products = ProductCorrection.fit(how, reference, own, held_out, seed)
        result = cls(settings, reference, own.rest, own.factors.shape[1], products)
        result.penalise_gaps(settings.integrability, reference, own.scaling)
        return result

    @classmethod
    def load(
        cls, settings: ConvolutionSettings, reference: TriangleMesh, tensors: Mapping[str, Tensor]
    ) -> ConvolutionCorrection:
        prefix, products = "products.", None
        if settings.products:
            own = {name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)}
            products = ProductCorrection(own)
        inputs = tensors["convolutions.0.own.weight"].shape[1]
        factor_count = (inputs - 2 - settings.edge_channels) // 2
        result = cls(settings, reference, tensors["rest"], factor_count, products)
        result.load_state_dict(tensors)
        return result

    @property
    def descent(self) -> FitSettings:
        return self.settings.fit

    @cached_property
    def crops(self) -> Crops | None:
        """Crops that the loss is computed on; None for whole shapes. Raises ValueError if crops are too small."""
        size, table = self.settings.crop, flaps(self.reference.connectivity)
        return Crops(self.reference.edge_midpoints, table, size, self.settings.layers) if size else None

    def _start(self, y: Tensor) -> Tensor:
        """Return the shapes (n, 2E) that the convolutions correct."""
        if not self.settings.residual:
            return torch.zeros_like(y[:, 0])
        total = y.sum(dim=1)
        return total if self.products is None else total + self.products.difference(y)

    def _constants(self) -> Tensor:
        """Return features (E, 2 + edge_channels) of edges that are the same for all shapes."""
        return torch.cat([self.rest, self.edge_constants], dim=1)

    def forward(self, y: Tensor) -> Tensor:
        start, (n, j, double) = self._start(y), y.shape
        # Edges come first, so that a sum over neighbours adds contiguous rows.
        channels = y.view(n, 2 * j, double // 2).permute(2, 0, 1)
        features = torch.cat([channels, self._constants()[:, None, :].expand(-1, n, -1)], dim=2)
        return start + self._layers(features).permute(1, 2, 0).reshape(n, double)

    def _layers(self, x: Tensor, neighbours: Tensor | None = None) -> Tensor:
        """Map features (E, n, C) of edges to outputs (E, n, 2)."""
        for convolution, norm in zip(self.convolutions, self.norms, strict=True):
            new = convolution(x, neighbours).flatten(0, 1)
            late = self.settings.normalisation == "after"
            new = norm(nn.functional.elu(new)) if late else nn.functional.elu(norm(new))
            new = self.dropout(new).view(*x.shape[:2], -1)
            x = x + new if self.settings.residual and x.shape == new.shape else new
        return self.readout(x)

    def loss(self, y: Tensor, target: Tensor) -> Tensor:
        """Return the mean square error on the inner edges of crops, or on whole shapes."""
        if self.crops is None:
            return super().loss(y, target)
        n, j, double = y.shape
        missed = (target - self._start(y)).view(n, 2, double // 2)
        crop = self.crops.draw(missed.square().sum(dim=1))

        def at(channels: Tensor) -> Tensor:
            """(n, c, E) → (nK, c)."""
            return channels.take_along_dim(crop.edges[:, None], dim=2).transpose(1, 2).flatten(0, 1)

        x = torch.cat([at(y.view(n, 2 * j, double // 2)), self._constants()[crop.edges.flatten()]], dim=1)[:, None]
        inner = crop.inner.flatten()
        return nn.functional.mse_loss(self._layers(x, crop.neighbours)[inner, 0], at(missed)[inner])


class EdgeConvolution(nn.Module):
    """Graph convolution on features (E, n, C) of edges.

    `Star`, from the paper: ``W₁ x_e + W₂ Σ_{N(e)} x + b``, where N(e) are the edges that share a vertex with e. It
    does not distinguish directions. `Flaps` has a matrix for each of the four other edges of the two faces at e, in an
    order fixed by e's direction and the faces' orientation: ``W₁ x_e + Σ_k W_{2,k} x_{e_k} + b``.
    """

    def __init__(self, around: Star | Flaps, n_in: int, n_out: int) -> None:
        super().__init__()
        self.own = nn.Linear(n_in, n_out)
        self.around = around
        self.other = nn.Linear(around.count * n_in, n_out, bias=False)
        if isinstance(around, Star):
            with torch.no_grad():
                # An edge has about ten neighbours, so their sum starts at the size of the edge's own features.
                self.other.weight /= 10

    def forward(self, x: Tensor, neighbours: Tensor | None = None) -> Tensor:
        """Map features (E, n, n_in) to features (E, n, n_out). On the edges of n crops, x is (n K, 1, n_in), with the
        neighbours of a `Crop`.
        """
        around = self.around(x) if neighbours is None else _side_by_side(_gather(x, neighbours))
        return self.own(x) + self.other(around)


class Star(nn.Module):
    """Sums over the edges that share a vertex with each edge, (E, n, C) → (E, n, C)."""

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
    """Features of the four other edges of the two faces at each edge, (E, n, C) → (E, n, 4 C); see `flaps`."""

    neighbours: Tensor
    targets: Tensor
    offsets: Tensor
    count = 4

    def __init__(self, connectivity: Connectivity) -> None:
        super().__init__()
        table = flaps(connectivity)
        # The gradient needs the places of each edge in the flat table.
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
    """Return the edges (V, k) at each vertex, padded with E."""
    ends, count = connectivity.edges.ravel(), connectivity.edge_count
    order = np.argsort(ends, kind="stable")
    valence = np.bincount(ends, minlength=connectivity.vertex_count)
    table = np.full((len(valence), valence.max()), count)
    table[np.arange(valence.max()) < valence[:, None]] = order // 2
    return table


def flaps(connectivity: Connectivity) -> IntArray:
    """Return the other edges (E, 4) of the faces left and right of i → j, the edge at i first; E for a missing face."""
    table = np.full((connectivity.edge_count, 4), connectivity.edge_count)
    for side in (0, 1):
        there = np.flatnonzero(connectivity.edge_faces[:, side] >= 0)
        face = connectivity.edge_faces[there, side]
        for column in (0, 1):
            # Edge k of a face lies opposite to its corner k, so the edge at i lies opposite to j.
            corner = connectivity.faces[face] == connectivity.edges[there, 1 - column, None]
            table[there, 2 * side + column] = connectivity.face_edges[face][corner]
    return table


def _gather(x: Tensor, neighbours: Tensor) -> Tensor:
    """Return features (E, k, n, C) of the neighbours of each edge, zero for a missing neighbour."""
    padded = torch.cat([x, torch.zeros_like(x[:1])])
    return padded.index_select(0, neighbours.flatten()).unflatten(0, neighbours.shape)


def _side_by_side(around: Tensor) -> Tensor:
    return around.transpose(1, 2).flatten(2)


class _FlapGather(torch.autograd.Function):
    """`_gather` whose gradient is also a gather, several times faster than autograd's scatter."""

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
