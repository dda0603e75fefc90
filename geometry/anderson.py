"""Anderson acceleration of a preconditioned fixed-point iteration."""

from __future__ import annotations

from collections import deque

import numpy as np

from geometry.mesh import FloatArray


class Anderson:
    """Mixes the last iterates of ``x ← x + M⁻¹F(x)`` so that ``‖F‖`` in the norm of M⁻¹ is smallest.

    For an affine F this is GMRES with preconditioner M in that norm; it costs a few dot products and needs no
    derivative. The chord iteration it serves contracts by 0.03 to 0.3, and faster with every mixed iterate.

    Args:
        depth: how many earlier iterates are mixed.
    """

    def __init__(self, depth: int = 5) -> None:
        self._history: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque(maxlen=depth)
        self._last: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def __call__(self, x: FloatArray, forces: FloatArray, step: FloatArray) -> FloatArray:
        """The next iterate from x, F(x) and M⁻¹F(x), all of one shape."""
        now = (x, forces, step)
        if self._last is not None:
            dx, df, ds = (a - b for a, b in zip(now, self._last, strict=True))
            self._history.append((dx + ds, df, ds))
        self._last = now
        if not self._history:
            return x + step
        df, ds = (np.stack([h[i].ravel() for h in self._history]) for i in (1, 2))
        mix = np.linalg.lstsq(ds @ df.T, ds @ forces.ravel(), rcond=None)[0]
        return x + step - np.einsum("n,n...->...", mix, np.stack([h[0] for h in self._history]))
