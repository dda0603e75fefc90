"""Differences of two shapes in lengths and angles at each vertex, and colours for them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import dihedral_angles, edge_lengths, wrap
from shapespace.mesh.attributes import linear
from shapespace.mesh.triangle_mesh import Connectivity

#: Moreland's "coolwarm", perceptually even away from its grey middle, at 33 equal steps in sRGB: "Diverging Color Maps
#: for Scientific Visualization" (2009).
_COOLWARM = (
    "3b4cc0 445acc 4e68d8 5875e1 6282ea 6c8ff1 779af7 82a6fb 8db0fe 98b9ff a3c2fe "
    "aec9fc b9d0f9 c3d5f4 ccd9ed d5dbe5 dddcdc e5d8d1 ecd3c5 f1ccb8 f5c4ac f7ba9f "
    "f7b093 f6a586 f4987a f08b6e eb7d62 e46e56 dd5f4b d44e41 ca3b37 be242e b40426"
)
#: The legend ends at this quantile of the absolute values. With the maximum, one outlier would make all others grey.
_QUANTILE = 0.98
#: Smallest end of the legend, so that rounding errors of unchanged vertices stay grey.
_SMALLEST = 0.01
#: Smallest end of the legend of a standard deviation, in any unit.
_SMALLEST_SPREAD = 1e-9


class Quantity(StrEnum):
    """Quantity that colours show.

    ``stretch`` is log(l / l₀), where l is the length of an edge and l₀ its length in the other shape. ``bending`` is
    the change of its dihedral angle in radians, positive if the edge became more convex. Both are means over the edges
    at a vertex, weighted by their lengths. ``spread`` is the standard deviation of the position of a vertex, in the
    units of the training meshes.
    """

    STRETCH = "stretch"
    BENDING = "bending"
    SPREAD = "spread"


@dataclass(frozen=True)
class Colouring:
    """A quantity at the vertices of a mesh.

    Attributes:
        quantity: the quantity.
        values: (V,) values, positive or negative; a spread is never negative.
        limit: end of the legend, 1, 2 or 5 times a power of ten, so that it rarely changes between frames. The legend
            starts at −limit, for a spread at 0. Values beyond an end have its colour.
    """

    quantity: Quantity
    values: FloatArray
    limit: float

    @classmethod
    def between(
        cls, quantity: Quantity, vertices: FloatArray, against: FloatArray, connectivity: Connectivity
    ) -> Colouring:
        """Compare a shape (V, 3) in stretch or bending with another shape (V, 3) of the same connectivity."""
        lengths = edge_lengths(against, connectivity)
        weights = lengths
        # Edges of collapsed faces can have no length. They cause neither warnings nor infinite colours.
        with np.errstate(divide="ignore", invalid="ignore"):
            if quantity is Quantity.STRETCH:
                change = np.log(edge_lengths(vertices, connectivity) / lengths)
            else:
                change = wrap(dihedral_angles(vertices, connectivity) - dihedral_angles(against, connectivity))
                weights = np.where(connectivity.interior, lengths, 0.0)
        change = np.nan_to_num(change, posinf=0.0, neginf=0.0)
        ends = connectivity.edge_ends.ravel()
        total, weight = (
            np.bincount(ends, np.tile(terms, 2), connectivity.vertex_count) for terms in (weights * change, weights)
        )
        values = total / np.where(weight > 0, weight, 1.0)
        return cls(quantity, values, _round_up(float(np.quantile(np.abs(values), _QUANTILE))))

    @classmethod
    def of_frames(
        cls, quantity: Quantity, frames: NDArray[np.floating], against: FloatArray, connectivity: Connectivity
    ) -> list[Colouring]:
        """Compare each of the shapes (n, V, 3) as `between` does; all have the largest of their legends."""
        found = [cls.between(quantity, frame.astype(np.float64), against, connectivity) for frame in frames]
        limit = max(each.limit for each in found)
        return [replace(each, limit=limit) for each in found]

    @classmethod
    def of_spread(cls, values: FloatArray) -> Colouring:
        """Colour standard deviations (V,) from blue to red."""
        limit = _round_up(float(np.quantile(values, _QUANTILE)), _SMALLEST_SPREAD)
        return cls(Quantity.SPREAD, values, limit)

    @property
    def ends(self) -> tuple[float, float]:
        """Values at the ends of the legend."""
        return (0.0 if self.quantity is Quantity.SPREAD else -self.limit), self.limit

    @property
    def srgb(self) -> FloatArray:
        """(V, 3) colours in sRGB, between 0 and 1."""
        table = np.array([list(bytes.fromhex(colour)) for colour in _COOLWARM.split()]) / 255
        low, high = self.ends
        place = (self.values - low) / (high - low)
        return np.stack([np.interp(place, np.linspace(0, 1, len(table)), channel) for channel in table.T], axis=1)

    @property
    def linear(self) -> FloatArray:
        """(V, 3) colours as linear light, as glTF requires."""
        return linear(self.srgb)

    @property
    def legend(self) -> dict[str, object]:
        """Quantity, range and colour map, for a legend."""
        return {"quantity": str(self.quantity), "range": [*self.ends], "map": "coolwarm"}


def _round_up(size: float, smallest: float = _SMALLEST) -> float:
    size = max(size, smallest)
    power = 10.0 ** math.floor(math.log10(size) + 1e-9)
    return next(step * power for step in (1, 2, 5, 10) if size <= step * power * (1 + 1e-9))
