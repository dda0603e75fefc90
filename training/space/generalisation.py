"""Distances between held-out shapes and the space found without them, for modes and for principal components.

Principal components of the aligned vertices are the usual alternative. Distances are means over vertices after rigid
alignment, as shares of the diagonal of the reference's bounding box.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import dihedral_angles
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.mesh.triangle_quality import folded_anew
from shapespace.shell.energy import Material
from shapespace.shell.space import FirstStep, ShellSpace
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.codes import box_of, nearest_codes
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.mean import centred_mean
from shapespace.training.space.modes import ModeError, coefficients, mode_count, pga
from shapespace.training.space.sparse_modes import find_modes

#: Number of folds. Below twice this number of shapes, each shape is held out by itself.
FOLDS = 5
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
        u, s, axes = np.linalg.svd((shapes - mean).reshape(len(shapes), -1), full_matrices=False)
        return cls(mean, axes, u * s)

    def nearest(self, shapes: FloatArray, count: int) -> FloatArray:
        """Project shapes (n, V, 3) onto the first components."""
        some = self.axes[:count]
        rows = (align(shapes, self.mean) - self.mean).reshape(len(shapes), -1)
        return self.mean + (rows @ some.T @ some).reshape(shapes.shape)

    def random(self, count: int, codes: int, rng: np.random.Generator) -> FloatArray:
        """Draw shapes uniformly in the box of the first components' coefficients."""
        some = self.coefficients[:, :count]
        drawn = rng.uniform(some.min(axis=0), some.max(axis=0), (codes, count))
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


def folds(count: int) -> list[IntArray]:
    """Return the indices of the shapes that are held out together, for each fold."""
    parts = FOLDS if count >= 2 * FOLDS else count
    return [np.arange(fold, count, parts) for fold in range(parts)]


@dataclass(frozen=True)
class HeldOut:
    """Held-out shapes, approximated in the space that was found without them."""

    index: IntArray  # (k,) indices of the shapes in the collection
    counts: Sequence[float]  # numbers of modes
    # (k, V, 3) for each number: ``modes`` has the nearest exponentials, ``components`` the projections onto as many
    # principal components, and ``mirrored_components`` those of the shapes and their mirror images, where there are any
    near: dict[str, list[FloatArray]]
    steps: IntArray  # (k,) K of the exponentials
    # (k,) for each number: whether the search did not converge, because faces of exponentials collapse
    stuck: list[NDArray[np.bool_]]

    def distances(self, shapes: FloatArray, diagonal: float) -> dict[str, list[FloatArray]]:
        """Return distances to the shapes (n, V, 3) of the collection: (k, V) for each kind and number of modes."""
        given = shapes[self.index]
        return {kind: [vertex_distances(each, given, diagonal) for each in found] for kind, found in self.near.items()}


def joined(parts: Sequence[HeldOut]) -> HeldOut:
    """Join the shapes of several folds. The numbers of modes are means."""

    def together(by_count: Iterable[list[NDArray]]) -> list[NDArray]:
        return [np.concatenate(each) for each in zip(*by_count, strict=True)]

    return HeldOut(
        index=np.concatenate([part.index for part in parts]),
        counts=np.mean([part.counts for part in parts], axis=0).tolist(),
        near={kind: together(part.near[kind] for part in parts) for kind in parts[0].near},
        steps=np.concatenate([part.steps for part in parts]),
        stuck=together(part.stuck for part in parts),
    )


def time_steps(
    settings: ModeSettings,
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    original_index: IntArray | None = None,
    first_step: FirstStep = "centred",
) -> int:
    """Return K of logarithms, from the settings or by cross-validation.

    With K = 1 the exponential is ``X̄ + Σ_j w_j u_j``: modes add up in vertices. This may come closer to unseen shapes,
    but shapes fold where limbs bend. K = 1 is chosen if it has at most the error of `LIGHT_STEPS` on held-out shapes,
    and if random shapes rarely fold. Modes are principal modes of the other folds' logarithms, at the mean of all
    shapes.

    The settings ``log_steps`` and ``count`` matter. At most `CHOICE_SHAPES` shapes (n, V, 3), spread evenly, are held
    out. ``original_index`` (n,) is the index of each shape's original, from 0, mirror images last.
    """
    if settings.log_steps != "auto":
        return settings.log_steps
    many = LIGHT_STEPS if first_step == "centred" else STEPS
    original_index = np.arange(len(shapes)) if original_index is None else original_index
    count = int(original_index.max()) + 1
    if count < FOLDS:  # too few to choose
        return many
    used = original_index % -(-count // CHOICE_SHAPES) == 0
    try:
        if _folded(reference, shapes, material, first_step) > FOLDED_SHARE:
            return many
        original_index, shapes = np.unique(original_index[used], return_inverse=True)[1], shapes[used]
        asked = CHOICE_MODES if settings.count == "auto" else settings.count
        few = max(1, min(asked, (int(original_index.max()) + 1) // 3))
        straight, bent = (
            _missed(reference, shapes, original_index, material, few, steps, first_step) for steps in (1, LIGHT_STEPS)
        )
    except (ModeError, NotPositiveDefiniteError):  # the stages that need mean and modes report it
        return many
    return 1 if straight <= bent else many


def _folded(reference: TriangleMesh, shapes: FloatArray, material: Material, first_step: FirstStep) -> float:
    """Return the share of random shapes of one step that fold where none of the shapes (n, V, 3) has a crease."""
    space, mean, fields = _space(reference, shapes, material, 1, first_step)
    modes = pga(space, mean, fields, min(FOLDED_MODES, len(shapes) - 1), "vertices").vertices
    lower, upper = box_of(coefficients(space, mean, fields, modes, "vertices")[0])
    codes = np.random.default_rng(0).uniform(lower, upper, (FOLDED_SHAPES, len(modes)))
    drawn = mean + np.tensordot(codes, modes, axes=1)
    angles, others = (dihedral_angles(each, reference.connectivity) for each in (drawn, shapes))
    return float(folded_anew(angles, others).mean())


def _space(
    reference: TriangleMesh, shapes: FloatArray, material: Material, steps: int, first_step: FirstStep
) -> tuple[ShellSpace, FloatArray, FloatArray]:
    """Return the space at the mean of shapes (n, V, 3), the mean (V, 3) and the logarithms (n, V, 3). Raises ModeError
    if the shapes have no mean.
    """
    found = centred_mean(reference, shapes, material, steps, first_step=first_step)
    if found.status is not Status.CONVERGED:
        raise ModeError(f"{len(shapes)} shapes that are not held out have no mean: {found.reason}")
    space = ShellSpace(reference.with_vertices(found.vertices), material, first_step=first_step)
    return space, found.vertices, logarithms(space, found.vertices, shapes, steps).fields


def _missed(
    reference: TriangleMesh,
    shapes: FloatArray,
    original_index: IntArray,
    material: Material,
    modes: int,
    steps: int,
    first_step: FirstStep,
) -> float:
    """Return the mean distance between the originals among shapes (n, V, 3) and the modes of the other folds."""
    space, mean, fields = _space(reference, shapes, material, steps, first_step)
    count = int(original_index.max()) + 1
    away = []
    for index in folds(count):
        directions = pga(space, mean, fields[~np.isin(original_index, index)], modes, "vertices").vertices
        start, _ = coefficients(space, mean, fields[index], directions, "vertices")
        near = nearest_codes(space, mean, directions, shapes[index], start, steps).vertices
        away.append(vertex_distances(near, shapes[index], 1.0))
    return float(np.concatenate(away).mean())


def held_out(
    reference: TriangleMesh,
    shapes: FloatArray,
    index: IntArray,
    counts: Sequence[int] | None,
    settings: ModeSettings,
    material: Material,
    steps: int | None = None,
    original: IntArray | None = None,
    first_step: FirstStep = "centred",
) -> HeldOut:
    """Find mean, logarithms and modes without some shapes, and approximate these shapes.

    Shapes (n, V, 3) at ``index`` (k,) are held out, with their mirror images: ``original`` (n,) is the index of each
    shape's original. ``counts`` are numbers of modes, by default the configured number and half of it, and at most the
    number of the other shapes. ``steps`` is K, by default as configured for these, and at most `LIGHT_STEPS`. Raises
    ModeError if the other shapes have no mean, or no modes.
    """
    original = np.arange(len(shapes)) if original is None else original
    known = np.flatnonzero(~np.isin(original, index))
    kept, unseen = shapes[known], shapes[index]
    original_index = np.unique(original[known], return_inverse=True)[1]
    if steps is None:
        steps = min(LIGHT_STEPS, time_steps(settings, reference, kept, material, original_index, first_step))
    space, mean, fields = _space(reference, kept, material, steps, first_step)
    own = original[known] == known
    components = PrincipalComponents.of(kept[own], reference.vertices)
    mirrored = None if own.all() else PrincipalComponents.of(kept, reference.vertices)
    if counts is None:
        count = mode_count(settings, space, mean, fields, original_index)
        counts = [-(-count // 2), count]
    counts = [min(count, len(kept) - 1) for count in counts]
    # The search for codes starts from projected logarithms, because faces collapse on the straight line to a far shape.
    towards = logarithms(space, mean, unseen, steps).fields
    reached, stuck = [], []
    near: dict[str, list[FloatArray]] = {"modes": [], "components": []}
    if mirrored:
        near["mirrored_components"] = []
    for count in counts:
        modes = find_modes(settings, space, mean, fields, count, original_index)
        start, _ = coefficients(space, mean, towards, modes.vertices, settings.norm)
        found = nearest_codes(space, mean, modes.vertices, unseen, start, steps)
        near["modes"].append(found.vertices)
        stuck.append(np.array([status is not Status.CONVERGED for status in found.status]))
        near["components"].append(components.nearest(unseen, len(modes)))
        if mirrored:
            near["mirrored_components"].append(mirrored.nearest(unseen, len(modes)))
        reached.append(len(modes))
    return HeldOut(index, reached, near, np.full(len(index), steps), stuck)
