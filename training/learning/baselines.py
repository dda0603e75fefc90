"""Baselines without networks: kernel ridge regression on codes, and multilinear interpolation of each factor."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from torch import Tensor, nn

from shapespace.arrays import FloatArray
from shapespace.training.learning.gaussian import Centres, every_axis
from shapespace.training.learning.latent_features import LatentFeatures
from shapespace.training.learning.layers import Scaling
from shapespace.training.learning.linear import Ridge, principal_axes
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.settings import EvaluationSettings


@dataclass(frozen=True)
class KernelSearch:
    """Candidates for kernel ridge regression, from which held-out codes choose."""

    # Lengths of the kernel, in multiples of the root of the number of inputs.
    lengths: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)
    penalties: tuple[float, ...] = tuple(10.0**k for k in range(-11, -1))  # ridge penalties
    components: int = 128  # number of principal coefficients of the shapes whose error decides


SEARCH = KernelSearch()
#: Fewest nodes of a grid along each coordinate: with two nodes it would be linear.
FEWEST_NODES = 3


class Exact(NamedTuple):
    """Exact lengths and angles (n, 2E) and vertices (n, V, 3), NaN for a code without a shape."""

    nric: NDArray[np.float32]
    vertices: NDArray[np.float32]


#: Function of a name, codes (n, m) and, if it isn't the run's, a collection. It computes exact shapes and saves them
#: under the name.
ExactShapes = Callable[..., Exact]


class LatentKernel(nn.Module):
    """Kernel ridge regression of NRIC on codes, with the functions of `Centres`, in double precision: γ = 1 / (2 ℓ²).

    The inputs x are bounded coordinates in [−1, 1], and the cosine and sine of periodic coordinates. Held-out codes
    choose the length ℓ and the penalty.

    Pairs ``own`` and ``held_out`` are codes (n, m) and their NRIC (n, 2E). ``slopes`` are codes (k, m) and derivatives
    (k, m, 2E) there, fitted as well; only for coordinates without a period.
    """

    anchors: Tensor
    nodes: Tensor
    weights: Tensor
    mean: Tensor

    def __init__(
        self,
        coordinates: Coordinates,
        scaling: Scaling,
        own: tuple[Tensor, Tensor],
        held_out: tuple[Tensor, Tensor],
        slopes: tuple[Tensor, Tensor] | None = None,
    ) -> None:
        super().__init__()
        self.features, self.scaling = LatentFeatures(coordinates, order=1), scaling
        x, others = (self.features(codes).double() for codes, _ in (own, held_out))
        y, wanted = (scaling.down(z).double() for _, z in (own, held_out))
        mean = y.mean(dim=0)
        axes = principal_axes(y - mean, by="rows")[1][: SEARCH.components]

        nodes, known = x[:0], None
        if slopes:
            nodes = self.features(slopes[0]).double()
            changes = (slopes[1] * (self.features.radius[:, None] * scaling.factor)).double().flatten(0, 1)
            known = *every_axis(nodes), changes

        def solved(length: float, penalties: Sequence[float], project: Callable[[Tensor], Tensor]) -> Ridge:
            rows = (*known[:2], project(known[2])) if known else None
            held_out = others, project(wanted - mean)
            return self._centres(x, nodes, length).fit((x, project(y - mean)), rows, held_out, penalties)

        lengths = [times * self.features.size**0.5 for times in SEARCH.lengths]
        best, self.length = min(
            ((solved(length, SEARCH.penalties, lambda values: values @ axes.T), length) for length in lengths),
            key=lambda fit: fit[0].error,
        )
        self.register_buffer("anchors", x)
        self.register_buffer("nodes", nodes)
        self.register_buffer("weights", solved(self.length, [best.penalty], lambda values: values).weights)
        self.register_buffer("mean", mean)

    @staticmethod
    def _centres(anchors: Tensor, nodes: Tensor, length: float) -> Centres:
        return Centres(anchors, nodes, torch.tensor(0.5 / length**2, dtype=anchors.dtype))

    def forward(self, codes: Tensor) -> Tensor:
        """Return NRIC (n, 2E) of codes (n, m)."""
        found = self._centres(self.anchors, self.nodes, self.length)(self.features(codes).double())
        return self.scaling.up((self.mean + found @ self.weights).float())


class MultilinearGrid:
    """Multilinear interpolation of exact shapes on a regular grid of one factor (Sassen et al. 2020).

    There are ``nodes`` along each latent of the factor. The end of a period equals its beginning and does not count.
    ``shapes`` computes exact shapes of codes (n, m).
    """

    def __init__(
        self, coordinates: Coordinates, factor: list[int], nodes: int, shapes: Callable[[FloatArray], Exact]
    ) -> None:
        own = coordinates[factor]
        ends = np.isfinite(own.period).astype(int)
        axes = [np.linspace(a, b, nodes + end) for a, b, end in zip(own.lower, own.upper, ends, strict=True)]
        latents = np.zeros((nodes ** len(factor), len(coordinates)))
        at_nodes = np.meshgrid(*(axis[:nodes] for axis in axes), indexing="ij")
        latents[:, factor] = np.stack(at_nodes, axis=-1).reshape(-1, len(factor))
        values = shapes(latents).nric.reshape(*[nodes] * len(factor), -1)
        closed = np.pad(values, [*((0, end) for end in ends), (0, 0)], mode="wrap")
        # Rounding may move a code slightly outside of the grid.
        self.interpolate = RegularGridInterpolator(axes, closed, bounds_error=False, fill_value=None)
        self.factor, self.nodes = factor, nodes
        self.size = values.nbytes  # bytes of the values at the nodes

    def __call__(self, latents: FloatArray) -> FloatArray:
        """Return NRIC (n, 2E) of the factor's part of codes (n, m)."""
        return self.interpolate(latents[:, self.factor])


def grid_nodes(dimension: int, settings: EvaluationSettings) -> int:
    """Return the number of nodes along each coordinate of a factor's grid; below `FEWEST_NODES` there is no grid."""
    return min(settings.grid_nodes, int(settings.grid_size ** (1 / dimension) + 1e-9))


def factor_grids(
    coordinates: Coordinates, factors: Iterable[list[int]], settings: EvaluationSettings, exact: ExactShapes
) -> list[MultilinearGrid]:
    """Return a grid for each factor, or an empty list if the grid of one factor would be too coarse."""
    each = [(index, grid_nodes(len(index), settings)) for index in factors]
    if min(nodes for _, nodes in each) < FEWEST_NODES:
        return []
    return [
        MultilinearGrid(coordinates, index, nodes, partial(exact, f"grid-{j}")) for j, (index, nodes) in enumerate(each)
    ]
