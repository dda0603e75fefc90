"""Latent codes: their coordinates, bounds and periods."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from geometry.mesh import FloatArray
from service.manifest import Manifest

#: (n, m) codes as the networks take them; everything that identifies a shape is derived from this form.
Codes = NDArray[np.float32]


class LatentError(ValueError):
    """A code that can't be used, with a sentence that says what to do."""


class WrongLengthError(LatentError):
    """A code with too few or too many coordinates."""


class NotFiniteError(LatentError):
    """A code with a coordinate that isn't a finite number, or from which none come out."""


class OutOfBoundsError(LatentError):
    """A code outside the bounds where the caller asked to refuse those."""


class Bounds(StrEnum):
    """What to do with a code outside the bounds: extrapolate, move it to the nearest bound, or refuse it."""

    ALLOW = "allow"
    CLAMP = "clamp"
    REJECT = "reject"


class LatentSpace:
    """The coordinates of a model's codes.

    A coordinate with a period is an angle: only its remainder counts, and it is out of bounds nowhere but
    in the gap that bounds narrower than the period leave.
    """

    def __init__(self, manifest: Manifest) -> None:
        self.model = manifest.name
        self.names = manifest.latent_names
        self.lower, self.upper = np.array(manifest.lower), np.array(manifest.upper)
        self.periodic = np.array([period is not None for period in manifest.period])
        self._period = np.array([period or 1.0 for period in manifest.period])

    @property
    def dimension(self) -> int:
        """M."""
        return len(self.names)

    def codes(
        self, values: Sequence[Sequence[float]], bounds: Bounds = Bounds.ALLOW
    ) -> tuple[Codes, NDArray[np.bool_]]:
        """Check codes and bring them into the one form that identifies a shape.

        Args:
            values: n lists of m numbers.
            bounds: what to do outside the bounds.

        Returns:
            (n, m) codes, angles within one period from ``lower``; and (n,) whether each is inside the bounds.

        Raises:
            WrongLengthError, NotFiniteError, OutOfBoundsError: with the place of the first fault.
        """
        for i, value in enumerate(values):
            if len(value) != self.dimension:
                names = f" ({', '.join(self.names)})" if self.dimension <= 12 else ""
                raise WrongLengthError(
                    f"Code {i} has {len(value)} numbers, but {self.model} takes {self.dimension}{names}. "
                    f"Send exactly {self.dimension}."
                )
        with np.errstate(over="ignore"):
            x = np.array(values, dtype=np.float64).reshape(-1, self.dimension).astype(np.float32)
        self._require_finite(x)
        x = self._remainder(x.astype(np.float64)).astype(np.float32)
        # Compared as float32, so that a bound itself is inside on every way through.
        lower, upper = self.lower.astype(np.float32), self.upper.astype(np.float32)
        if bounds is Bounds.CLAMP:
            x = np.clip(x, lower, upper)
        outside = (x < lower) | (x > upper)
        if bounds is Bounds.REJECT and outside.any():
            i, k = np.argwhere(outside)[0]
            raise OutOfBoundsError(
                f"Coordinate {k} ({self.names[k]}) of code {i} is {x[i, k]:g}, outside "
                f'[{lower[k]:g}, {upper[k]:g}]. Move it inside, or send "bounds": "clamp" or "allow".'
            )
        # Adding zero turns −0 into 0: the same shape must not have two names.
        inside = np.logical_not(outside.any(axis=1))
        return x + np.float32(0), inside

    def unroll(self, keyframes: FloatArray) -> FloatArray:
        """Shift angles of successive keyframes (K, m) by whole periods: each step becomes the shorter arc."""
        steps = np.diff(keyframes, axis=0)
        half = self._period / 2
        shorter = half - np.mod(half - steps, self._period)
        steps = np.where(self.periodic, shorter, steps)
        return np.concatenate([keyframes[:1], keyframes[:1] + np.cumsum(steps, axis=0)])

    def _require_finite(self, x: Codes) -> None:
        bad = np.argwhere(~np.isfinite(x))
        if len(bad):
            raise NotFiniteError(
                f"Coordinate {bad[0, 1]} of code {bad[0, 0]} is not a finite number. Send finite numbers."
            )

    def _remainder(self, x: FloatArray) -> FloatArray:
        # Codes already in range keep their exact value.
        moved = self.lower + np.mod(x - self.lower, self._period)
        inside = (x >= self.lower) & (x < self.lower + self._period)
        return np.where(self.periodic & ~inside, moved, x)
