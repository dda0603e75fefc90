"""Array types for signatures, and indices that are evenly spaced."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


def evenly_spaced(count: int, most: int) -> IntArray:
    """Return at most ``most`` (at least one) of the indices 0 to ``count − 1``, evenly spaced, with the first."""
    return np.unique(np.linspace(0, count - 1, min(count, max(1, most))).astype(np.int64))
