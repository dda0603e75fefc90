"""What a shape does to another's lengths and angles, vertex by vertex, and as colours."""

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
#: The legend ends at this quantile of the sizes, so that one stray vertex doesn't take the colour from all others.
_QUANTILE = 0.98
#: Smallest end of the legend, in percent or degrees: rounding errors of unchanged vertices stay grey.
_SMALLEST = 0.01
#: The same for a standard deviation, in any unit.
_SMALLEST_SPREAD = 1e-9


class Quantity(StrEnum):
    """What is coloured; of the first two a mean over the edges at a vertex, weighted by their lengths.

    ``stretch`` is the logarithm of an edge's length by its length in the other shape, ``bending`` the change of its
    dihedral angle in radians, positive where it got more convex. ``spread`` is the standard deviation of where the
    vertex is, in the units of the training meshes.
    """

    STRETCH = "stretch"
    BENDING = "bending"
    SPREAD = "spread"


@dataclass(frozen=True)
class Colouring:
    """A quantity at the vertices of a mesh.

    Attributes:
        quantity: which.
        values: (V,), positive or negative; a spread is never negative.
        limit: the legend goes from −limit, of a spread from 0, to limit, which is 1, 2 or 5 times a power of ten, so
            that it stays the same from one frame to the next; values beyond have the colours of its ends.
    """

    quantity: Quantity
    values: FloatArray
    limit: float

    @classmethod
    def between(
        cls, quantity: Quantity, vertices: FloatArray, against: FloatArray, connectivity: Connectivity
    ) -> Colouring:
        """How a shape (V, 3) differs in stretch or bending from another one (V, 3) of the same connectivity."""
        lengths = edge_lengths(against, connectivity)
        weights = lengths
        # Faces that collapse have edges without length: no warning, and no infinite colour.
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
        cls,
        quantity: Quantity,
        frames: NDArray[np.floating],
        against: FloatArray,
        connectivity: Connectivity,
    ) -> list[Colouring]:
        """Each of shapes (n, V, 3) as `between` has it, with the largest of their legends for all."""
        found = [cls.between(quantity, frame.astype(np.float64), against, connectivity) for frame in frames]
        limit = max(each.limit for each in found)
        return [replace(each, limit=limit) for each in found]

    @classmethod
    def of_spread(cls, values: FloatArray) -> Colouring:
        """Standard deviations (V,), from blue to red."""
        limit = _round_up(float(np.quantile(values, _QUANTILE)), _SMALLEST_SPREAD)
        return cls(Quantity.SPREAD, values, limit)

    @property
    def ends(self) -> tuple[float, float]:
        """Values at the ends of the legend."""
        return (0.0 if self.quantity is Quantity.SPREAD else -self.limit), self.limit

    @property
    def srgb(self) -> FloatArray:
        """(V, 3) colours between 0 and 1 as screens take them."""
        table = np.array([list(bytes.fromhex(colour)) for colour in _COOLWARM.split()]) / 255
        low, high = self.ends
        place = (self.values - low) / (high - low)
        return np.stack([np.interp(place, np.linspace(0, 1, len(table)), channel) for channel in table.T], axis=1)

    @property
    def linear(self) -> FloatArray:
        """(V, 3) the same colours as linear light, which glTF wants."""
        return linear(self.srgb)

    @property
    def srgb_bytes(self) -> NDArray[np.uint8]:
        """(V, 3) the colours as bytes."""
        return np.rint(255 * self.srgb).astype(np.uint8)

    @property
    def legend(self) -> dict[str, object]:
        """What one needs to read the colours."""
        return {"quantity": str(self.quantity), "range": [*self.ends], "map": "coolwarm"}


def _round_up(size: float, smallest: float = _SMALLEST) -> float:
    size = max(size, smallest)
    power = 10.0 ** math.floor(math.log10(size) + 1e-9)
    return next(step * power for step in (1, 2, 5, 10) if size <= step * power * (1 + 1e-9))
