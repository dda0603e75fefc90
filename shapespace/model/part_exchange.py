"""A search for a limb in the wrong place: parts of a code are exchanged for the parts of other codes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.model.decoder import Decoder
from shapespace.model.fit_constraints import PLAUSIBLE, FitConstraints
from shapespace.model.fit_result import FitState
from shapespace.model.placement import evenly
from shapespace.model.scan import Scan, nearest_points

#: Number of parts that are tried for each factor, and number of points of either side that judge a shape.
PARTS, POINTS = 12, 300
#: A point at these distances counts as half explained, as fractions of the diagonal. A limb that moved towards its
#: place, but did not reach it, only counts if the distance is long.
LONG, SHORT = 0.1, 0.03
#: Vertices of a shape with larger coordinates are no shape; the model is normalised.
HUGE = 1e6


@dataclass(frozen=True, eq=False)
class ShapeJudge:
    """Quick comparison of coarse shapes at a placement in a scan, by a few points and the nearest vertices."""

    decoder: Decoder
    scan: Scan
    constraints: FitConstraints

    def __call__(self, state: FitState, code: FloatArray, shape: FloatArray, half: float) -> float:
        """Return the cost of a code (m,) and its shape (V, 3), placed like a state's; ``half`` is LONG or SHORT."""
        if not (np.abs(shape) < HUGE).all():  # also where the networks overflow
            return np.inf
        shape = align(shape, state.shape)
        square = (half * self.decoder.reference.diagonal) ** 2
        found = nearest_points(cKDTree(shape), state.placement.back(self.scan.points[:POINTS]))[0] ** 2
        cost = float((found / (found + square)).mean())
        if not self.constraints.partial:
            some = shape[:: max(1, len(shape) // POINTS)]
            back = (self.scan.distances(state.placement(some)) / state.placement.scale) ** 2
            cost += float((back / (back + square)).mean())
        scores = self.constraints.scores(code, self.decoder.latents)
        return cost + PLAUSIBLE * float(scores @ scores)


class PartExchange:
    """For each factor, parts (n, m_j) of codes (k, m), far apart from each other."""

    def __init__(self, decoder: Decoder, codes: FloatArray) -> None:
        self.decoder = decoder
        shares = codes / decoder.latents.width
        self.parts: list[FloatArray] = []
        for factor in decoder.manifest.factors:
            own = slice(factor.start, factor.stop)
            self.parts.append(codes[evenly(shares[:, own], PARTS), own])

    def __call__(self, reconstruct: Reconstructor, judge: ShapeJudge, state: FitState) -> FloatArray:
        """Return a code (m,) in which factors have the parts that explain the scan best; the same code if it is best.

        The factor that gains most comes first. Otherwise a shoulder would turn to make up for an elbow.
        """
        cost = judge(state, state.code, reconstruct.integrate(self.decoder.nric(state.code)), LONG)
        every = [self._best(reconstruct, judge, state, state.code, j) for j in range(len(self.parts))]
        code = state.code
        for j in np.argsort([each[0] for each in every]):
            if every[j][0] >= cost:
                break
            own, found = every[j] if code is state.code else self._best(reconstruct, judge, state, code, j)
            if own < cost:
                cost, code = own, found
        return code

    def _best(
        self, reconstruct: Reconstructor, judge: ShapeJudge, state: FitState, code: FloatArray, j: int
    ) -> tuple[float, FloatArray]:
        """Return the best code (m,) that differs from a code by another part of factor j, and its cost."""
        factor = self.decoder.manifest.factors[j]
        own = slice(factor.start, factor.stop)
        if not judge.constraints.movable[own].all():
            return np.inf, code
        others = np.repeat(code[None], len(self.parts[j]), axis=0)
        others[:, own] = self.parts[j]
        shapes = map(reconstruct.integrate, self.decoder.exchanged(code, j, self.parts[j]))
        costs = [judge(state, *each, LONG) for each in zip(others, shapes, strict=True)]
        k = int(np.argmin(costs))
        return costs[k], others[k]
