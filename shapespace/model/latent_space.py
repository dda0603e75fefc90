"""Latent codes: their coordinates, bounds and periods."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from shapespace.arrays import FloatArray
from shapespace.bundle.schema import Manifest
from shapespace.counted import counted
from shapespace.model.choice import Choice

#: Fixed values farther outside the bounds are refused, in widths of the bounds: networks know nothing there.
FAR = 100.0
#: (n, m) codes as the networks take them; everything that identifies a shape is derived from this form.
Codes = NDArray[np.float32]
#: One of them (m,), and whether it is inside the bounds.
CheckedCode = tuple[Codes, bool]


class LatentError(ValueError):
    """A code that can't be used, with a sentence that says what to do."""


class WrongLengthError(LatentError):
    """A code with too few or too many coordinates."""


class NotFiniteError(LatentError):
    """A code with a coordinate that is not a finite number, or at which the networks' numbers overflow."""


class OutOfBoundsError(LatentError):
    """A code outside the bounds, which the caller asked to refuse."""


class InvalidFixedError(LatentError):
    """Fixed coordinates that do not exist, or whose values are not finite or far outside the bounds."""


@dataclass(frozen=True, eq=False)
class Fixed:
    """Coordinates of a code that keep their value."""

    mask: NDArray[np.bool_]  # (m,) whether a coordinate is fixed
    values: Codes  # (m,) values of fixed coordinates, as the networks take them; 0 for other coordinates

    def into(self, x: FloatArray) -> FloatArray:
        """Return a code (m,) with the fixed values inserted."""
        return np.where(self.mask, self.values, x)


class Bounds(Choice):
    """What to do with a code outside the bounds: extrapolate, move it to the nearest bound, or refuse it."""

    ALLOW = "allow"
    CLAMP = "clamp"
    REJECT = "reject"


class Distribution(Choice):
    """Distribution of random codes: two inside the bounds, and the Gaussian of the training codes."""

    UNIFORM = "uniform"
    GAUSSIAN = "gaussian"
    POPULATION = "population"


def _read_only(values: Sequence[float]) -> FloatArray:
    array = np.array(values)
    array.setflags(write=False)
    return array


class LatentSpace:
    """Coordinates of a model's codes, with their bounds and periods.

    A coordinate with a period is an angle: only its remainder counts, and it can be out of bounds only where the bounds
    are narrower than the period.
    """

    def __init__(self, manifest: Manifest) -> None:
        self.model = manifest.name
        self.names = manifest.latent_names
        self.lower, self.upper = _read_only(manifest.lower), _read_only(manifest.upper)
        self.periodic = np.array([period is not None for period in manifest.period])
        self._period = np.array([period or 1.0 for period in manifest.period])
        # Rounded like codes, so that a bound itself always counts as inside.
        self._low, self._high = self.lower.astype(np.float32), self.upper.astype(np.float32)
        #: (m,) unit of distance in each coordinate.
        self.width = self.upper - self.lower

    @property
    def dimension(self) -> int:
        """Number m of coordinates."""
        return len(self.names)

    def codes(
        self, values: Sequence[Sequence[float]] | NDArray[np.floating], bounds: Bounds = Bounds.ALLOW
    ) -> tuple[Codes, NDArray[np.bool_]]:
        """Check codes and bring them into the one form that identifies a shape.

        Args:
            values: n lists of m numbers, or an array (n, m).
            bounds: what to do with codes outside the bounds.

        Returns:
            (n, m) codes, angles within one period from ``lower``; and (n,) whether each is inside the bounds.

        Raises:
            WrongLengthError, NotFiniteError, OutOfBoundsError: the message names the first fault.
        """
        for i, value in enumerate(values):
            if len(value) != self.dimension:
                names = f" ({'; '.join(self.names)})" if self.dimension <= 12 else ""
                raise WrongLengthError(
                    f"Code {i} has {counted(len(value), 'number')}, but {self.model} takes {self.dimension}{names}. "
                    f"Give exactly {self.dimension}."
                )
        with np.errstate(over="ignore"):
            x = np.array(values, dtype=np.float64).reshape(-1, self.dimension).astype(np.float32)
        bad = np.argwhere(~np.isfinite(x))
        if len(bad):
            raise NotFiniteError(
                f"Coordinate {bad[0, 1]} of code {bad[0, 0]} is not a finite number. Give finite numbers."
            )
        if self.periodic.any():
            x = self._remainder(x.astype(np.float64)).astype(np.float32)
        if bounds is Bounds.CLAMP:
            x = np.clip(x, self._low, self._high)
        outside = (x < self._low) | (x > self._high)
        if bounds is Bounds.REJECT and outside.any():
            i, k = np.argwhere(outside)[0]
            raise OutOfBoundsError(
                f"Coordinate {k} ({self.names[k]}) of code {i} is {x[i, k]:g}, outside "
                f"[{self._low[k]:g}, {self._high[k]:g}]. Move it inside, or choose clamp or allow for bounds."
            )
        # Adding zero turns −0 into 0, so that a shape has only one code.
        inside = np.logical_not(outside.any(axis=1))
        return x + np.float32(0), inside

    def code(self, value: Sequence[float], bounds: Bounds = Bounds.ALLOW) -> CheckedCode:
        """Check one code; return it as (m,) with whether it is inside the bounds. See ``codes``."""
        codes, inside = self.codes([value], bounds)
        return codes[0], bool(inside[0])

    def fixed(self, values: Mapping[int, float] | None = None) -> Fixed:
        """Check values by index that coordinates keep, which may be outside the bounds. Raises InvalidFixedError."""
        values = values or {}
        unknown = [index for index in values if index not in range(self.dimension)]
        if unknown:
            name = str(unknown[0])
            known = f" {name} is {self.names.index(name)}." if name in self.names else ""
            raise InvalidFixedError(
                f"fixed names coordinate {unknown[0]!r}, but {self.model} has coordinates 0 to {self.dimension - 1}, "
                f"whole numbers.{known}"
            )
        mask = np.isin(np.arange(self.dimension), list(values))
        code = np.array([values.get(k, 0.0) for k in range(self.dimension)])
        with np.errstate(over="ignore"):
            bad = np.flatnonzero(~np.isfinite(code.astype(np.float32)))
        if len(bad):
            raise InvalidFixedError(f"fixed[{bad[0]}] is not a finite number. Give finite numbers.")
        outside = np.maximum(self.lower - code, code - self.upper)
        far = np.flatnonzero(mask & ~self.periodic & (outside > FAR * self.width))
        if len(far):
            k = far[0]
            raise InvalidFixedError(
                f"fixed[{k}] ({self.names[k]}) is {code[k]:g}, far outside [{self.lower[k]:g}, {self.upper[k]:g}]. "
                "Give a value nearer to these bounds."
            )
        return Fixed(mask, np.where(mask, self.code(code.tolist())[0], np.float32(0)))

    def found(self, x: FloatArray, bounds: Bounds, fixed: Fixed) -> CheckedCode:
        """Check the code (m,) at which a search ended, like ``code``, with fixed values inserted.

        Clamping leaves fixed coordinates alone.
        """
        if bounds is Bounds.CLAMP:
            code, _ = self.code(x.tolist(), Bounds.CLAMP)
            return self.code(fixed.into(code.astype(np.float64)).tolist())
        return self.code(fixed.into(x).tolist(), bounds)

    def box_around(self, fixed: Fixed, margin: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper bounds (m,) like ``box``, equal where a coordinate is fixed."""
        lower, upper = self.box(margin)
        return fixed.into(lower), fixed.into(upper)

    def unroll(self, keyframes: FloatArray) -> FloatArray:
        """Shift angles of successive keyframes (K, m) by whole periods: each step becomes the shorter arc."""
        steps = self.shorter(np.diff(keyframes, axis=0))
        return np.concatenate([keyframes[:1], keyframes[:1] + np.cumsum(steps, axis=0)])

    def shorter(self, steps: FloatArray) -> FloatArray:
        """Return differences (…, m) of codes with angles the shorter way round."""
        half = self._period / 2
        return np.where(self.periodic, half - np.mod(half - steps, self._period), steps)

    def box(self, margin: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return lower and upper bounds (m,), wider by a fraction of the width on each side.

        Angles have infinite bounds, unless their bounds span less than a period.
        """
        free = self.periodic & (self.width >= self._period * (1 - 1e-9))
        extra = margin * self.width
        return np.where(free, -np.inf, self.lower - extra), np.where(free, np.inf, self.upper + extra)

    def sample(self, count: int, seed: int, distribution: Distribution) -> Codes:
        """Return random codes (count, m) inside the bounds, the same on every machine.

        Gaussian codes have their mean in the middle of the bounds and a standard deviation of a quarter of the width,
        before they are cut off at the bounds. Raises ValueError for the population, which belongs to the model.
        """
        if distribution is Distribution.POPULATION:
            raise ValueError("the bounds know no population")
        shares = np.random.Generator(np.random.PCG64(seed)).random((count, self.dimension))
        if distribution is Distribution.GAUSSIAN:
            low, high = ndtr(-2.0), ndtr(2.0)
            shares = 0.5 + ndtri(low + (high - low) * shares) / 4
        values = self.lower + shares * self.width
        return self.codes(values.tolist(), Bounds.CLAMP)[0]

    def _remainder(self, x: FloatArray) -> FloatArray:
        # Codes already in range keep their exact value.
        moved = self.lower + np.mod(x - self.lower, self._period)
        inside = (x >= self.lower) & (x < self.lower + self._period)
        return np.where(self.periodic & ~inside, moved, x)


class TrainingCodes:
    """Training codes (n, m) of a model, n ≥ 1, which measure how plausible other codes are."""

    def __init__(self, latents: LatentSpace, codes: FloatArray) -> None:
        self._latents, self._codes = latents, codes
        others = np.array([np.sort(self._distances(code))[1:2] for code in codes])
        #: Median distance of a training code from its nearest neighbour; without neighbours the bounds' width.
        self.spacing = float(np.median(others)) if others.any() else 1.0

    def plausibility(self, code: Codes) -> float:
        """Return the distance of a code (m,) from the nearest training code, in multiples of their spacing."""
        return float(self._distances(code).min() / self.spacing)

    def _distances(self, code: NDArray) -> FloatArray:
        """Return distances (n,) from the training codes: root mean square in fractions of the bounds' width."""
        steps = self._latents.shorter(self._codes - code) / self._latents.width
        return np.sqrt((steps**2).mean(axis=1))
