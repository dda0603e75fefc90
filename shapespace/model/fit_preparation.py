"""What a model prepares once for all its fits: start shapes, parts of codes, and images of features."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.closest_points import VertexFaces
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.feature_search import FeatureSearch
from shapespace.model.fit_result import VertexDerivatives
from shapespace.model.fit_settings import SETTINGS
from shapespace.model.latent_space import Distribution
from shapespace.model.part_exchange import PartExchange
from shapespace.model.placement import THOROUGH, evenly
from shapespace.model.searched_shapes import SearchedShapes

#: Maximum number of training shapes that a fit compares with a scan.
REMEMBERED = 100


class StartShapes(NamedTuple):
    """Codes (k, m) with their shapes (k, V, 3), rough, coarse and aligned."""

    codes: FloatArray
    shapes: FloatArray

    @property
    def size(self) -> float:
        """Root mean square distance of a shape's vertices from their middle, at the median."""
        return float(np.median(np.sqrt(self.shapes.var(axis=1).sum(axis=1))))


class FitPreparation:
    """Shapes and codes with which fits of a model begin. Each is made at the first scan that needs it."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder
        self._features: FeatureSearch | None = None

    @cached_property
    def reach(self) -> dict[MeshChoice, tuple[VertexFaces, IntArray]]:
        """For each mesh, the faces around its vertices, and vertices that look for points."""
        return {
            choice: (VertexFaces(mesh.faces, len(mesh.vertices)), evenly(mesh.vertices, count))
            for choice, count in (
                (MeshChoice.COARSE, SETTINGS.coarse_vertices),
                (MeshChoice.FINE, SETTINGS.fine_vertices),
            )
            for mesh in (self.decoder.mesh(choice),)
        }

    @cached_property
    def shown(self) -> IntArray:
        """Coarse vertices that represent a shape in the search for placements; the first ones are spread evenly too."""
        return evenly(self.decoder.reference.vertices, THOROUGH.shape_points)

    @cached_property
    def starts(self) -> StartShapes:
        """Start shapes; made at the first scan."""
        return self.shapes_of(self.codes({}))

    @cached_property
    def remembered(self) -> StartShapes | None:
        """Shapes of training codes, at most REMEMBERED; made at the first scan that needs them."""
        codes = self.decoder.training_codes
        return (
            None if codes is None else self.shapes_of(codes[evenly(self.decoder.population.scores(codes), REMEMBERED)])
        )

    @cached_property
    def exchange(self) -> PartExchange:
        """Parts of random codes and of training codes; made at the first scan that needs them."""
        latents, count = self.decoder.latents, SETTINGS.random_shapes
        drawn = np.clip(self.decoder.population.sample(count, 1), *latents.box())
        uniform = latents.sample(count, 1, Distribution.UNIFORM).astype(np.float64)
        known = self.decoder.training_codes
        every = [drawn, uniform] if known is None else [drawn, uniform, known]
        return PartExchange(self.decoder, np.concatenate(every))

    @cached_property
    def start_derivatives(self) -> dict[int, VertexDerivatives]:
        """Derivatives at start codes, by their index, as earlier fits have computed them."""
        return {}

    def features(self, reconstruct: Reconstructor) -> FeatureSearch:
        """Return the search for features that move around a shape; made at the first scan."""
        if self._features is None:
            self._features = FeatureSearch.of(self.decoder, reconstruct)
        return self._features

    def codes(self, fixed: Mapping[int, float]) -> FloatArray:
        """Return the mean code and codes far apart from each other, (k, m), with some coordinates fixed."""
        population = self.decoder.population
        lower, upper = self.decoder.latents.box()
        drawn = np.concatenate(
            [population.mean[None], np.clip(population.sample(SETTINGS.random_shapes, 0), lower, upper)]
        )
        for k, value in fixed.items():
            drawn[:, k] = value
        return drawn[evenly(population.scores(drawn), SETTINGS.start_shapes)]

    def shapes_of(self, codes: FloatArray) -> StartShapes:
        """Return the shapes of codes (k, m)."""
        with self.decoder.solver() as reconstruct:
            rough = SearchedShapes(self.decoder, reconstruct, None, rough=True)
            raw = np.stack([rough(code) for code in codes])
        return StartShapes(codes, self.decoder.placed(raw, MeshChoice.COARSE))
