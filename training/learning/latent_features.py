"""Functions of latent codes: the inputs of perceptrons and of linear layers."""

import itertools
import math

import numpy as np
import torch
from numpy.polynomial import legendre
from torch import Tensor, nn

from shapespace.training.runs.latent_coordinates import Coordinates

#: Most polynomials of a layer: cubics of 47 coordinates. Cubics of 80 coordinates would be 91,881.
MOST_MONOMIALS = 20_000


class LatentFeatures(nn.Module):
    """Inputs of a perceptron, (n, m) → (n, size).

    A bounded coordinate is mapped to [−1, 1], a periodic coordinate to cos kx, sin kx for k = 1 … order.
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

    ``{Π_i w_i(k_i x_i) : w_i ∈ {cos, sin}, Σ (k_i / K_i)² ≤ 1}``, including the constant.
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

    They are orthogonal over the box, with a root mean square of ``DECAY^degree``. The coefficients of a smooth map
    fall with the degree, so a ridge penalty that grows with the degree needs far fewer samples. Example: a hand's
    factor of 6 coordinates from 72 samples has R² 0.999, and 0.85 with equal sizes. The constant comes first.
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
        # One gather and one product for all coordinates, since few operations make a small network fast.
        return values.index_select(1, self.columns).unflatten(1, self.exponents.shape).prod(dim=1) * self.sizes


def affordable_degree(degree: int, coordinates: int) -> int:
    """Return the largest total degree with at most `MOST_MONOMIALS` products, between 1 and ``degree``."""
    return next((d for d in range(degree, 1, -1) if math.comb(coordinates + d, d) <= MOST_MONOMIALS), 1)
