"""Distances between held-out shapes and the space found without them, for modes and for principal components.

Principal components of the aligned vertices are the usual alternative. Distances are means over vertices after rigid
alignment, as shares of the diagonal of the reference's bounding box.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import dihedral_angles
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.mesh.triangle_quality import folded_anew
from shapespace.shell.energy import Material
from shapespace.shell.space import FirstStep, ShellSpace
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.codes import box_of, exponential_map, nearest_codes
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.mean import centred_mean
from shapespace.training.space.modes import ModeError, coefficients, pga
from shapespace.training.space.related import FOLDS, Related

#: Default steps K of logarithms and exponentials with the paper's first step.
STEPS = 16
#: Default steps K of logarithms with a centred first step, and most steps where spaces are compared.
LIGHT_STEPS = 8
#: Number of random shapes for the specificity.
RANDOM = 200
#: Percentile of the vertices' distances that is reported beside their mean.
PERCENTILE = 95
#: For the choice between one step and `STEPS`: most shapes that are held out, and their number of modes where the
#: settings give none.
CHOICE_SHAPES, CHOICE_MODES = 100, 10
#: One step is not chosen if a larger share of that many random shapes, of at most that many modes, folds.
FOLDED_SHARE, FOLDED_SHAPES, FOLDED_MODES = 0.1, 500, 10


@dataclass(frozen=True)
class PrincipalComponents:
    """Principal components of shapes aligned to their mean."""

    mean: FloatArray  # (V, 3)
    axes: FloatArray  # (n, 3V) orthonormal, strongest first
    coefficients: FloatArray  # (n, n) coefficients of the shapes

    def explained(self, count: int) -> float:
        """Return the share of the shapes' variance that the first components explain."""
        energy = (self.coefficients**2).sum(axis=0)
        return float(energy[:count].sum() / energy.sum())

    @classmethod
    def of(cls, shapes: FloatArray, reference: FloatArray) -> PrincipalComponents:
        """Analyse shapes (n, V, 3), aligned to the reference and then to their mean."""
        mean = align(shapes, reference).mean(axis=0)
        shapes = align(shapes, mean)
        mean = shapes.mean(axis=0)
        shapes -= mean
        u, s, axes = np.linalg.svd(shapes.reshape(len(shapes), -1), full_matrices=False)
        return cls(mean, axes, u * s)

    def nearest(self, shapes: FloatArray, count: int) -> FloatArray:
        """Project shapes (n, V, 3) onto the first components."""
        some = self.axes[:count]
        rows = (align(shapes, self.mean) - self.mean).reshape(len(shapes), -1)
        return self.mean + (rows @ some.T @ some).reshape(shapes.shape)

    def random(self, count: int, codes: int, rng: np.random.Generator) -> FloatArray:
        """Draw shapes uniformly in bounds around the first components' coefficients, wide as the bounds of a model."""
        some = self.coefficients[:, :count]  # there may be fewer
        drawn = rng.uniform(*box_of(some), (codes, some.shape[1]))
        return self.mean + (drawn @ self.axes[:count]).reshape(codes, *self.mean.shape)


def vertex_distances(shapes: FloatArray, others: FloatArray, diagonal: float) -> FloatArray:
    """Return distances (n, V) between shapes (n, V, 3) and others, (n, V, 3) or (V, 3), as shares of a diagonal."""
    return np.linalg.norm(align(shapes, others) - others, axis=-1) / diagonal


def to_nearest(shapes: FloatArray, collection: FloatArray, diagonal: float) -> float:
    """Return the mean distance between shapes (k, V, 3) and the nearest shapes of a collection (n, V, 3)."""
    distances = [vertex_distances(shapes, other, diagonal).mean(axis=1) for other in collection]
    return float(np.min(distances, axis=0).mean())


def summary(distances: FloatArray) -> dict[str, float]:
    """Return the mean and the 95th percentile of distances of vertices."""
    return {"mean": float(distances.mean()), f"p{PERCENTILE}": float(np.percentile(distances, PERCENTILE))}


def many_steps(first_step: FirstStep) -> int:
    """Return K of exponentials that bend, where the settings leave it open."""
    return LIGHT_STEPS if first_step == "centred" else STEPS


def time_steps(
    settings: ModeSettings,
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    related: Related | None = None,
    first_step: FirstStep = "centred",
) -> int:
    """Return K of logarithms, from the settings or by cross-validation.

    With K = 1 the exponential is ``X̄ + Σ_j w_j u_j``: modes add up in vertices. This may come closer to unseen shapes,
    but shapes fold where limbs bend. K = 1 is chosen if it has at most the error of `LIGHT_STEPS` on held-out shapes,
    and if random shapes rarely fold. Modes are principal modes of the other folds' logarithms, see
    `nearest_exponentials`.

    The settings ``log_steps`` and ``count`` matter. At most `CHOICE_SHAPES` shapes (n, V, 3), spread evenly, are held
    out, those that are ``related`` together.
    """
    if settings.log_steps != "auto":
        return settings.log_steps
    many = many_steps(first_step)
    related = related or Related.none(len(shapes))
    if related.groups < FOLDS:  # too few to choose
        return many
    used = related.spread(CHOICE_SHAPES)
    try:
        if _folded(reference, shapes, material, first_step) > FOLDED_SHARE:
            return many
        related, shapes = related.some(used), shapes[used]
        asked = CHOICE_MODES if settings.count == "auto" else settings.count
        few = max(1, min(asked, related.originals // 3))
        straight, bent = (
            _missed(reference, shapes, related, material, few, steps, first_step) for steps in (1, LIGHT_STEPS)
        )
    except (ModeError, NotPositiveDefiniteError):  # the stages that need mean and modes report it
        return many
    return 1 if straight <= bent else many


def _folded(reference: TriangleMesh, shapes: FloatArray, material: Material, first_step: FirstStep) -> float:
    """Return the share of random shapes of one step that fold where none of the shapes (n, V, 3) has a crease."""
    space, mean, fields = space_of(reference, shapes, material, 1, first_step)
    modes = pga(space, mean, fields, min(FOLDED_MODES, len(shapes) - 1), "vertices").vertices
    lower, upper = box_of(coefficients(space, mean, fields, modes, "vertices")[0])
    codes = np.random.default_rng(0).uniform(lower, upper, (FOLDED_SHAPES, len(modes)))
    drawn = mean + np.tensordot(codes, modes, axes=1)
    angles, others = (dihedral_angles(each, reference.connectivity) for each in (drawn, shapes))
    return float(folded_anew(angles, others).mean())


def space_of(
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    steps: int,
    first_step: FirstStep,
    reached: float = 0,
) -> tuple[ShellSpace, FloatArray, FloatArray]:
    """Return the space at the mean of shapes (n, V, 3), the mean (V, 3) and the logarithms (n, V, 3).

    Raises ModeError if the shapes have no mean, or less than the share ``reached`` of them has a geodesic from it.
    """
    found = centred_mean(reference, shapes, material, steps, first_step=first_step, reached=reached)
    if found.status is not Status.CONVERGED:
        raise ModeError(f"{len(shapes)} shapes that are not held out have no mean: {found.reason}")
    space = ShellSpace(reference.with_vertices(found.vertices), material, first_step=first_step)
    return space, found.vertices, logarithms(space, found.vertices, shapes, steps).fields


def nearest_exponentials(
    space: ShellSpace,
    mean: FloatArray,
    fields: FloatArray,
    towards: FloatArray,
    shapes: FloatArray,
    count: int,
    steps: int,
) -> FloatArray:
    """Return the exponentials (k, V, 3) nearest to shapes (k, V, 3), along modes of the logarithms (n, V, 3) of others.

    ``towards`` (k, V, 3) are the logarithms of the shapes. The mean (V, 3) may be the mean of all of them. Exponentials
    lead from the mean of the other logarithms, see `ModesOfOthers`. Raises ModeError if that mean has no exponential.
    """
    others = ModesOfOthers.of(space, mean, fields, count)
    modes, centre = others.vertices, others.centre
    start = others.codes(towards)
    if exponential_map(space, mean, modes, steps, centre)(np.zeros(len(modes))) is None:
        raise ModeError("the mean of the logarithms of the shapes that are not held out has no exponential")
    return nearest_codes(space, mean, modes, shapes, start, steps, centre=centre).vertices


@dataclass(frozen=True, eq=False)
class ModesOfOthers:
    """Principal modes of the logarithms of some shapes, about their mean. So they know nothing of other shapes."""

    space: ShellSpace
    mean: FloatArray  # (V, 3) where the logarithms are, which may be the mean of more shapes
    centre: FloatArray  # (V, 3) mean of the logarithms
    vertices: FloatArray  # (m, V, 3) modes

    @classmethod
    def of(
        cls, space: ShellSpace, mean: FloatArray, fields: FloatArray, count: int, local: FloatArray | None = None
    ) -> ModesOfOthers:
        """Find the modes of logarithms (n, V, 3). ``local`` fields (…, V, 3) may join these."""
        centre = fields.mean(axis=0)
        some = fields - centre
        if local is not None:
            some = np.concatenate([some, local.reshape(-1, *mean.shape)])
        return cls(space, mean, centre, pga(space, mean, some, count, "vertices").vertices)

    def codes(self, fields: FloatArray) -> FloatArray:
        """Return the codes (k, m) nearest to logarithms (k, V, 3) in the tangent space."""
        return coefficients(self.space, self.mean, fields - self.centre, self.vertices, "vertices")[0]

    def left(self, fields: FloatArray) -> FloatArray:
        """Return what the modes leave (k, V, 3) of logarithms (k, V, 3)."""
        return fields - self.centre - np.tensordot(self.codes(fields), self.vertices, axes=1)


def _missed(
    reference: TriangleMesh,
    shapes: FloatArray,
    related: Related,
    material: Material,
    modes: int,
    steps: int,
    first_step: FirstStep,
) -> float:
    """Return the mean distance between the originals among shapes (n, V, 3) and the modes of the other folds."""
    space, mean, fields = space_of(reference, shapes, material, steps, first_step)
    away = []
    for index in related.folds():
        known = fields[related.without(index)]
        near = nearest_exponentials(space, mean, known, fields[index], shapes[index], modes, steps)
        away.append(vertex_distances(near, shapes[index], 1.0))
    return float(np.concatenate(away).mean())
