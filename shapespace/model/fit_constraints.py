"""Checked options of a fit, in the units of its search."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.latent_space import LatentSpace
from shapespace.model.options import FitOptions, Landmark, Prior, ScaleChoice
from shapespace.model.population import Population
from shapespace.model.scan import InvalidScanError

#: Maximum number of landmarks.
LANDMARKS = 1000
#: How far outside the bounds codes of the population may lie, as a fraction of the bounds' width.
MARGIN = 0.5
#: Weight of the code's plausibility where fits are compared. Four standard deviations cost as much as leaving 16 times
#: this share of the scan unexplained.
PLAUSIBLE = 0.001


@dataclass(frozen=True, eq=False)
class FitConstraints:
    """What a fit knows beside the scan.

    Lengths are in the units of the scan in the search. In these units, a scan of free scale is about as large as a
    shape. Others have the model's normalised units.
    """

    partial: bool  # whether the scan shows only a part of the shape
    free: bool  # whether the fit estimates the scan's size
    noise: float | None  # standard deviation of the scan's points; None if the fit estimates it
    landmarks: IntArray  # (l,) vertices of the fine mesh
    places: FloatArray  # (l, 3) positions of the landmarks
    sigmas: FloatArray  # (l,) standard deviations of the positions; infinite for the default share of the diagonal
    movable: NDArray[np.bool_]  # (m,) whether a coordinate may change
    prior: Population  # distribution of codes
    # lower, upper: (m,) limits of codes
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def of(cls, options: FitOptions, decoder: Decoder) -> FitConstraints:
        """Check options. Raises InvalidScanError, or InvalidFixedError if there is no such coordinate.

        Lengths of the result are in the model's normalised units.
        """
        latents, unit = decoder.latents, decoder.manifest.scale
        movable = ~latents.fixed(options.fixed).mask
        if not movable.any():
            raise InvalidScanError("fixed names all coordinates. Leave at least one to be found.")
        if options.noise is not None and not 0 < options.noise < float(np.finfo(np.float32).max):
            raise InvalidScanError("noise must be a positive number, the standard deviation in the scan's units.")
        if len(options.landmarks) > LANDMARKS:
            raise InvalidScanError(f"There are {len(options.landmarks)} landmarks. Give {LANDMARKS} at most.")
        for i, landmark in enumerate(options.landmarks):
            _require_landmark(i, landmark, len(decoder.mesh(MeshChoice.FINE).vertices))
        boxed = options.distribution is Prior.BOX
        lower, upper = latents.box(0.0 if boxed else MARGIN)
        return cls(
            partial=options.partial,
            free=options.scale is ScaleChoice.FREE,
            noise=None if options.noise is None else options.noise / unit,
            landmarks=np.array([landmark.vertex for landmark in options.landmarks], np.int64),
            places=np.array([landmark.position for landmark in options.landmarks]).reshape(-1, 3) / unit,
            sigmas=np.array([(landmark.sigma or np.inf) / unit for landmark in options.landmarks]),
            movable=movable,
            prior=Population.in_box(latents.lower, latents.upper) if boxed else decoder.population,
            lower=lower,
            upper=upper,
        )

    def in_units(self, unit: float) -> FitConstraints:
        """Return the same constraints with lengths in another unit."""
        noise = None if self.noise is None else self.noise / unit
        return replace(self, noise=noise, places=self.places / unit, sigmas=self.sigmas / unit)

    @cached_property
    def whiten(self) -> FloatArray:
        """Matrix (m, m) that takes changes of a code to scores in the prior."""
        return np.asarray(np.linalg.inv(self.prior.root), np.float64)

    def scores(self, code: FloatArray, latents: LatentSpace) -> FloatArray:
        """Return the scores (m,) of a code in the prior, angles the shorter way round."""
        return self.whiten @ latents.shorter(code - self.prior.mean)


def _require_landmark(i: int, landmark: Landmark, count: int) -> None:
    """Raise InvalidScanError if landmark i of a mesh with ``count`` vertices can't be used."""
    if not 0 <= landmark.vertex < count:
        raise InvalidScanError(
            f"landmarks[{i}].vertex is {landmark.vertex}, but the fine mesh has vertices 0 to {count - 1}."
        )
    if not (len(landmark.position) == 3 and np.abs(landmark.position).max() < np.finfo(np.float32).max):
        raise InvalidScanError(f"landmarks[{i}].position must be three finite numbers.")
    if landmark.sigma is not None and not 0 < landmark.sigma < np.inf:
        raise InvalidScanError(f"landmarks[{i}].sigma must be a positive number.")
