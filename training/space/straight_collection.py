"""A collection parametrised by straight lines of vertices, or of lengths and angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import nric, unwrap
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.space import FirstStep
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.sampling import SampledShapes
from shapespace.training.space.shell_collection import names_of
from shapespace.training.space.straight_lines import StraightLines


@dataclass(frozen=True, eq=False)
class StraightCollection:
    """The shapes of codes in a hypercube on straight lines; see sampling.Collection.

    The bounds ``lower`` and ``upper`` are (m,). Networks that put out these lines exactly need no samples.
    """

    lines: StraightLines
    lower: FloatArray
    upper: FloatArray
    factors: dict[str, list[int]]
    scale: float
    #: Modes move no feature over the surface, and no symmetry is known. No sample needs a derivative.
    places = limit = differentiated = None
    symmetries = ()

    @property
    def reference(self) -> TriangleMesh:
        """The shape of the code 0."""
        return self.lines.reference

    @property
    def codes(self) -> FloatArray:
        """Codes (n, m) of the training shapes."""
        return self.lines.coefficients

    @property
    def steps(self) -> int | None:
        """1 for lines of vertices, which are exponentials of one step; None for lengths and angles."""
        return 1 if self.lines.kind == "vertices" else None

    @property
    def first_step(self) -> FirstStep:
        """The paper's: with it, an exponential of one step is a straight line."""
        return "paper"

    @property
    def latent_names(self) -> tuple[str, ...]:
        """(m,) names after the factors."""
        return names_of(self.factors)

    @property
    def coordinates(self) -> Coordinates:
        """The hypercube, of coordinates without a period."""
        return Coordinates(self.lower, self.upper, np.full(len(self.lower), np.nan))

    def shapes(self, latents: FloatArray) -> SampledShapes:
        """Shapes of codes (n, m), with one BLAS thread, and their lengths and angles."""
        reference = self.reference
        with threadpool_limits(1):
            found = [self.lines.shape(code) for code in latents]
        vertices = np.stack([reference.vertices if each is None else each[0] for each in found])
        reasons = ["Gauss–Newton found no shape" if each is None else "" for each in found]
        own = nric(reference.vertices, reference.connectivity)
        return SampledShapes(vertices, unwrap(nric(vertices, reference.connectivity), own), reasons)
