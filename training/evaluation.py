"""The figures of the paper's table for one run: R² of every model, vertex error, sizes and times."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from geometry.mesh import FloatArray, TriangleMesh, align
from geometry.nric import WeightedNorm
from geometry.reconstruction import Reconstructor
from training.coordinates import Coordinates
from training.sampling import Collection


def r_squared(predicted: NDArray, exact: NDArray, norm: WeightedNorm) -> dict[str, float]:
    """``1 − Σ‖z̃_i − z_i‖² / Σ‖z_i − mean‖²`` of both halves and of each (paper, section 4; mean over these samples)."""
    half = exact.shape[1] // 2
    exact = exact.astype(np.float64)
    error, spread = (predicted - exact) ** 2, (exact - exact.mean(axis=0)) ** 2

    def ratio(part: slice) -> float:
        weights = norm.squared[part]
        return float(1 - (error[:, part] @ weights).sum() / (spread[:, part] @ weights).sum())

    return {
        "total": ratio(slice(None)),
        "lengths": ratio(slice(0, half)),
        "angles": ratio(slice(half, None)),
    }


def exact_nric(collection: Collection, latents: FloatArray, batch: int = 100) -> NDArray[np.float32]:
    """Exact NRIC (n, 2E) of joint codes (n, m)."""
    parts = (latents[start : start + batch] for start in range(0, len(latents), batch))
    return np.concatenate([collection.shapes(part).nric.astype(np.float32) for part in parts])


def exact_factors(collection: Collection, latents: FloatArray) -> NDArray[np.float32]:
    """Exact factor shapes (n, J, 2E) of joint codes (n, m): each factor's part alone, the rest at the reference."""
    shapes = []
    for index in collection.factors.values():
        alone = np.zeros_like(latents)
        alone[:, index] = latents[:, index]
        shapes.append(exact_nric(collection, alone))
    return np.stack(shapes, axis=1)


@dataclass
class MultilinearGrid:
    """Multilinear interpolation of exact shapes on a regular grid of one factor (Sassen et al. 2020).

    Attributes:
        axes: nodes of each coordinate; periodic ones leave out the last, which is the first.
        values: (nodes…, 2E) NRIC.
        coordinates: of the factor.
    """

    axes: list[FloatArray]
    values: NDArray[np.float32]
    coordinates: Coordinates

    @classmethod
    def of(cls, collection: Collection, factor: list[int], nodes: int) -> MultilinearGrid:
        """Evaluate the nodes exactly."""
        coordinates = collection.coordinates[factor]
        axes = [
            np.linspace(low, high, nodes, endpoint=bool(np.isnan(period)))
            for low, high, period in zip(coordinates.lower, coordinates.upper, coordinates.period, strict=True)
        ]
        latents = np.zeros((nodes ** len(factor), len(collection.coordinates)))
        latents[:, factor] = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(factor))
        values = exact_nric(collection, latents)
        return cls(axes, values.reshape(*[nodes] * len(factor), -1), coordinates)

    def __call__(self, latents: FloatArray) -> NDArray:
        """NRIC (n, 2E) of the factor's latents (n, m_j)."""
        nodes = len(self.axes[0])
        step = np.array([axis[1] - axis[0] for axis in self.axes])
        position = (latents - self.coordinates.lower) / step
        periodic = np.isfinite(self.coordinates.period)
        cell = np.floor(position).astype(int)
        cell = np.where(periodic, cell, np.clip(cell, 0, nodes - 2))
        fraction = position - cell
        result = np.zeros((len(latents), self.values.shape[-1]))
        for corner in product((0, 1), repeat=len(self.axes)):
            weight = np.prod(np.where(corner, fraction, 1 - fraction), axis=1)
            result += weight[:, None] * self.values[tuple(((cell + corner) % nodes).T)]
        return result


def vertex_error(reference: TriangleMesh, eta: float, predicted: NDArray, exact: NDArray) -> dict[str, Any]:
    """Distances of reconstructed vertices to exact ones (n, V, 3) after rigid alignment.

    Returns:
        ``mean`` and ``max`` over all vertices, as fractions of the reference's bounding-box diagonal; mean
        ``iterations`` of Gauss–Newton from the reference; how often each ``status`` was met.
    """
    reconstruct = Reconstructor(reference, eta)
    distances: list[FloatArray] = []
    iterations: list[int] = []
    statuses: dict[str, int] = {}
    for z, vertices in zip(predicted, exact, strict=True):
        result = reconstruct(z, tolerance=1e-6)
        distances.append(np.linalg.norm(align(result.vertices, vertices) - vertices, axis=1))
        iterations.append(result.iterations)
        statuses[str(result.status)] = statuses.get(str(result.status), 0) + 1
    errors = np.array(distances) / reference.diagonal
    return {
        "mean": float(errors.mean()),
        "max": float(errors.max()),
        "iterations": float(np.mean(iterations)),
        "status": statuses,
    }


def size_bytes(*networks: nn.Module) -> int:
    """Bytes of the floating-point parameters and buffers."""
    return sum(t.numel() * t.element_size() for n in networks for t in n.state_dict().values() if t.is_floating_point())


def median_seconds(function: Callable[[], Any], repeat: int = 20) -> float:
    """Median wall time of a call, after one that warms up."""
    function()
    times = []
    for _ in range(repeat):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def model_times(collection: Collection, composite: Callable[[torch.Tensor], torch.Tensor]) -> dict[str, float]:
    """Median seconds for one code: exact shape, composite network, reconstruction from the reference (one thread)."""
    rng = np.random.default_rng(0)
    latents = collection.coordinates.uniform(1, rng)
    z = collection.shapes(latents).nric[0]
    reconstruct = Reconstructor(collection.reference)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            code = torch.as_tensor(latents, dtype=torch.float32)
            return {
                "exact": median_seconds(lambda: collection.shapes(latents)),
                "networks": median_seconds(lambda: composite(code)),
                "reconstruction": median_seconds(lambda: reconstruct(z, tolerance=1e-6), repeat=5),
            }
    finally:
        torch.set_num_threads(threads)
