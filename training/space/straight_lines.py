"""Straight lines of shapes: ``x̄ + Σ_j w_j u_j`` in aligned vertices, in lengths and angles, or in rotations and
stretches.

These are the cheapest maps from codes to shapes. They need no exponential and no samples:

- "vertices": x̄ is the arithmetic mean of aligned shapes, and the u_j are their principal components. Modes add up as
  blend shapes do.
- "nric": x̄ is the mean of lengths and angles (NRIC). Gauss–Newton finds the vertices. Limbs can bend, but an angle
  changes in proportion to the code.
- "differential": the coordinates are rotations and stretches of faces, from the mean shape. One Poisson equation gives
  the vertices, see `face_coordinates`.

The u_j are principal components in a norm. The literature takes the norm of the coordinates, with the weights of
reconstruction or areas of faces. The norm of vertices measures the motions that the coordinates cause at the mean, as
users see them.

Mirror images may be among the shapes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import NRICJacobian, WeightedNorm, nric, unwrap
from shapespace.coordinates.reconstruction import DEFAULT_ETA, Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh, face_areas
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status
from shapespace.training.runs.workers import run
from shapespace.training.space.codes import Codes, NearestCode, gathered, nearest_code
from shapespace.training.space.face_coordinates import FaceCoordinates
from shapespace.training.space.local_fields import local_fields, scale_of
from shapespace.training.space.modes import NEGLIGIBLE, ModeError

StraightKind = Literal["vertices", "nric", "differential"]
#: The norm in which modes are principal components.
LineNorm = Literal["coordinates", "vertices"]
#: Tolerance of vertices from lengths and angles, as a share of the diagonal.
TOLERANCE = 1e-6
#: Most Gauss–Newton steps for a shape. Shapes near the training shapes take at most 30; a search that tries codes far
#: from them takes a shorter step instead.
ITERATIONS = 60
#: Shapes that differ by less than this share of the mean are the same.
ROUNDING = 1e-9
#: Smallest area of a face of the mean, as a share of its area in the reference: below it the mean has collapsed.
LEAST_AREA = 1e-3
#: Solvers at the reference, which are made when they are needed.
SOLVERS = ("_reconstruct", "differential")
#: Rounds of the mean of differential coordinates. The last moves no vertex by more than 1e-5 of the diagonal.
ROUNDS = 6


@dataclass(frozen=True, eq=False)
class StraightLines:
    """Straight lines through the mean of shapes, in coordinates of a kind. Modes are sorted by strength.

    It is pickled without its solvers. A process that unpickles it makes its own, at the first shape.
    """

    kind: StraightKind
    reference: TriangleMesh  # the shape of the code 0, at the position of the collection's reference
    mean: FloatArray  # (q,) x̄, flat vertices, NRIC or differential coordinates
    modes: FloatArray  # (m, q) u_j, scaled so that the largest coefficient of a shape is 1
    weights: FloatArray  # (q,) or (3V,) weights of squares in the norm
    coefficients: FloatArray  # (n, m) orthogonal projections of the shapes
    eta: float = DEFAULT_ETA  # weight of the angles
    norm: LineNorm = "coordinates"
    spread: FloatArray | None = None  # (m,) standard deviations of coefficients by local fields, if there are any

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in SOLVERS}

    @classmethod
    def of(
        cls,
        kind: StraightKind,
        shapes: FloatArray,
        reference: TriangleMesh,
        eta: float = DEFAULT_ETA,
        vertex_counts: FloatArray | None = None,
        norm: LineNorm = "coordinates",
        share: float = 0.0,
    ) -> StraightLines:
        """Find the mean of shapes (n, V, 3) in any position, and all their principal modes, see `along`.

        In the norm of vertices, a vertex counts as many times as ``vertex_counts`` (V,) says, by default once. So a
        simplified mesh has nearly the modes of the fine mesh. Local fields may add a ``share`` of the variance there.

        Raises ModeError if the shapes have no such mean, or are all the same.
        """
        if not np.isfinite(shapes).all():
            raise ModeError("a shape has a coordinate that is not finite")
        by_vertex = np.ones(shapes[0].size) if vertex_counts is None else np.repeat(vertex_counts, 3)
        if kind == "vertices":
            shapes = align(shapes, align(shapes, reference.vertices).mean(axis=0))
            rows = shapes.reshape(len(shapes), -1)
            mean = rows.mean(axis=0)
            centre = mean.reshape(-1, 3)
            weights = by_vertex
        elif kind == "differential":
            coordinates = _about_their_mean(shapes, reference)
            centre, weights, rows = coordinates.base.vertices, coordinates.weights, coordinates(shapes)
            mean = rows.mean(axis=0)
        else:
            rows = nric(shapes, reference.connectivity)
            angles = rows[:, rows.shape[1] // 2 :]
            middle = np.arctan2(np.sin(angles).mean(axis=0), np.cos(angles).mean(axis=0))
            rows = unwrap(rows, np.concatenate([rows[0, : len(middle)], middle]))
            mean = rows.mean(axis=0)
            # Weights at the reference first: the mean's own weights need its shape.
            centre = _shape_of_mean(reference, eta, mean)
            weights = WeightedNorm.of(reference.with_vertices(centre), eta).squared
        centre = align(centre, reference.vertices)
        if not np.isfinite(weights).all():
            raise ModeError("a face of the mean has no area")
        if kind == "vertices":
            # The mean in its final position, with the shapes around it.
            rows = align(shapes, centre).reshape(len(shapes), -1)
            mean = centre.ravel()
        size = 1.0 if kind == "differential" else np.sqrt((mean**2) @ weights)
        none = np.empty((0, len(mean)))
        bare = cls(kind, reference.with_vertices(centre), mean, none, weights, none, eta)
        offsets = rows - mean
        if ((offsets**2 @ weights) <= (ROUNDING * size) ** 2).all():
            raise ModeError("there are no modes: all shapes are the same as the mean")
        if norm == "vertices":
            bare = replace(bare, norm=norm, weights=by_vertex)
        if not share:
            return bare.along(offsets)
        local = local_fields(bare.reference, bare.moved(offsets))
        weighted = local.reshape(-1, len(by_vertex)) * np.sqrt(by_vertex)
        return bare.along(offsets, scale_of(weighted, bare.weighted(offsets), share) * local)

    def along(self, offsets: FloatArray, local: FloatArray | None = None) -> StraightLines:
        """Return the lines through the same mean along all principal modes of offsets (n, q) of shapes and, in the norm
        of vertices, of ``local`` fields (n, k, V, 3).
        """
        n, rows = len(offsets), self.weighted(offsets)
        if local is not None:
            fields = local.reshape(-1, self.reference.vertices.size)
            rows = np.concatenate([rows, fields * np.sqrt(self.weights)])
        u, s, _ = np.linalg.svd(rows, full_matrices=False)
        number = int((s**2 > NEGLIGIBLE * (s**2).sum()).sum())
        coefficients = (u * s)[:, :number]
        peaks = coefficients[np.abs(coefficients).argmax(axis=0), np.arange(number)]
        parts = (u[:, :number] / s[:number] * peaks).T
        modes = parts[:, :n] @ offsets
        if local is not None:
            modes += self.slopes((parts[:, n:] @ fields).reshape(number, -1, 3))
        return self._with(
            modes=modes,
            coefficients=coefficients[:n] / peaks,
            spread=np.sqrt((coefficients[n:] ** 2).sum(axis=0) / n) / np.abs(peaks) if local is not None else None,
        )

    def _with(self, **changes: Any) -> StraightLines:
        """Return the lines with some changes, and the same solvers."""
        found = replace(self, **changes)
        found.__dict__.update({name: self.__dict__[name] for name in SOLVERS if name in self.__dict__})
        return found

    def __len__(self) -> int:
        return len(self.modes)

    def require_mean(self, reference: TriangleMesh) -> None:
        """Raise ModeError if a face of the mean has collapsed, compared with a reference: no model can have it."""
        areas = face_areas(self.reference.vertices, reference.faces)
        if not (areas > LEAST_AREA * reference.face_areas).all():
            raise ModeError("a face of the mean has collapsed")

    def first(self, count: int) -> StraightLines:
        """Return the lines along the strongest modes alone."""
        spread = None if self.spread is None else self.spread[:count]
        return self._with(modes=self.modes[:count], coefficients=self.coefficients[:, :count], spread=spread)

    @cached_property
    def explained(self) -> FloatArray:
        """Shares (m,) of these modes in the variance that all of them explain."""
        energies = self.squares * (self.coefficients**2).sum(axis=0)
        return energies / energies.sum()

    def moved(self, offsets: FloatArray) -> FloatArray:
        """Return motions (n, V, 3) of vertices from the mean along offsets (n, q), to first order."""
        if self.kind == "vertices":
            return offsets.reshape(len(offsets), -1, 3)
        return self._change(self.reference.vertices, self.mean, offsets)

    def slopes(self, fields: FloatArray) -> FloatArray:
        """Return the derivatives (n, q) of the coordinates of the mean along vertex fields (n, V, 3)."""
        if self.kind == "vertices":
            return fields.reshape(len(fields), -1)
        return self.differential.along(fields) if self.kind == "differential" else self._nric_along(fields)

    def _nric_along(self, fields: FloatArray) -> FloatArray:
        jacobian = NRICJacobian(self.reference.connectivity)
        matrix = jacobian.matrix(jacobian.gradients(self.reference.vertices))
        return (matrix @ fields.reshape(len(fields), -1).T).T

    def weighted(self, offsets: FloatArray) -> FloatArray:
        """Return rows (n, r) whose sums of squares are the squares of offsets (n, q) in the norm."""
        some = self.moved(offsets).reshape(len(offsets), -1) if self.norm == "vertices" else offsets
        return some * np.sqrt(self.weights)

    @cached_property
    def _weighted_modes(self) -> FloatArray:
        return self.weighted(self.modes)

    @property
    def squares(self) -> FloatArray:
        """``‖u_j‖²`` (m,)."""
        return (self._weighted_modes**2).sum(axis=1)

    @property
    def sizes(self) -> FloatArray:
        """Lengths (m,) of the modes."""
        return np.sqrt(self.squares)

    @cached_property
    def fields(self) -> FloatArray:
        """Vertex fields (m, V, 3) of the modes at the reference."""
        return self.moved(self.modes)

    @cached_property
    def nric(self) -> FloatArray:
        """Changes (m, 2E) of lengths and angles along the modes at the reference."""
        return self.modes if self.kind == "nric" else self._nric_along(self.fields)

    @cached_property
    def _reconstruct(self) -> Reconstructor:
        return Reconstructor(self.reference, self.eta)

    @cached_property
    def differential(self) -> FaceCoordinates:
        """Differential coordinates from the reference."""
        return FaceCoordinates(self.reference)

    def offsets(self, shapes: FloatArray) -> FloatArray:
        """Return differences (n, q) between shapes (n, V, 3) in any position and the mean."""
        if self.kind == "vertices":
            return (align(shapes, self.reference.vertices) - self.reference.vertices).reshape(len(shapes), -1)
        if self.kind == "differential":
            return self.differential(shapes) - self.mean
        return unwrap(nric(shapes, self.reference.connectivity), self.mean) - self.mean

    def motions(self, shapes: FloatArray) -> FloatArray:
        """Return motions (n, 3V) of vertices from the mean to shapes (n, V, 3), to first order."""
        return self.moved(self.offsets(shapes)).reshape(len(shapes), -1)

    def _change(self, vertices: FloatArray, at: FloatArray, directions: FloatArray) -> FloatArray:
        """Return the derivatives (k, V, 3) of the shape (V, 3) of coordinates (q,) along directions (k, q)."""
        if self.kind == "differential":
            return self.differential.change(at, directions)
        return self._reconstruct.differential(vertices, directions)

    def project(self, shapes: FloatArray) -> FloatArray:
        """Project shapes (n, V, 3) orthogonally onto the modes; return codes (n, m)."""
        return self.weighted(self.offsets(shapes)) @ self._weighted_modes.T / self.squares

    def codes_of(self, shapes: FloatArray) -> FloatArray:
        """Return the codes (n, m) of shapes (n, V, 3): on lines of vertices, projections are the nearest."""
        return self.project(shapes) if self.kind == "vertices" else self.nearest(shapes).codes

    def shape(self, code: FloatArray) -> tuple[FloatArray, Callable[[], FloatArray]] | None:
        """Return the shape (V, 3) of a code (m,), and the function that computes its derivative (m, V, 3).

        None if Gauss–Newton finds no shape; the code 0 always has one.
        """
        values = self.mean + code @ self.modes
        if self.kind == "vertices":
            return values.reshape(-1, 3), lambda: self.fields
        if self.kind == "differential":
            vertices = self.differential.shape(values)
            return vertices, lambda: self._change(vertices, values, self.modes)
        found = self._reconstruct.from_guess(values, tolerance=TOLERANCE, max_iterations=ITERATIONS)
        if not found.converged and code.any():
            return None
        return found.vertices, lambda: self._change(found.vertices, values, self.modes)

    def nearest(self, shapes: FloatArray, workers: int = -1) -> Codes:
        """Find the codes whose shapes come closest to shapes (n, V, 3), in vertices after rigid alignment."""
        items = list(zip(shapes, self.project(shapes), strict=True))
        # Lines of vertices are so fast that other processes would only cost time.
        some = 1 if self.kind == "vertices" else workers
        return gathered(run(partial(_nearest, self), items, workers=some), len(items))


def _nearest(lines: StraightLines, item: tuple[FloatArray, FloatArray]) -> NearestCode:
    return nearest_code(lines.shape, *item)


def _about_their_mean(shapes: FloatArray, reference: TriangleMesh) -> FaceCoordinates:
    """Return differential coordinates from the base that is the shape of the mean of shapes (n, V, 3)."""
    base = reference
    for _ in range(ROUNDS):
        coordinates = FaceCoordinates(base)
        moved = coordinates.shape(coordinates(shapes).mean(axis=0))
        base = base.with_vertices(align(moved, reference.vertices))
    return FaceCoordinates(base)


def _shape_of_mean(reference: TriangleMesh, eta: float, mean: FloatArray) -> FloatArray:
    """Return the shape (V, 3) nearest to the mean (2E,) of lengths and angles. Raises ModeError if there is none."""
    try:
        found = Reconstructor(reference, eta).from_guess(mean, tolerance=TOLERANCE)
    except NotPositiveDefiniteError as error:
        raise ModeError(f"the mean of lengths and angles has no shape: {error}") from None
    if found.status is Status.NOT_FINITE:
        raise ModeError(f"the mean of lengths and angles has no shape: {found.reason}")
    return found.vertices
