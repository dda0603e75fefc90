"""How near a space comes to shapes that it was not made from, beside principal components of the aligned vertices.

Principal components are what a user would otherwise take. Distances are means over vertices after rigid alignment, as
shares of the diagonal of the reference's bounding box.
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
from shapespace.shell.space import ShellSpace
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.codes import box_of, nearest_codes
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.mean import centred_mean
from shapespace.training.space.modes import ModeError, coefficients, mode_count, pga
from shapespace.training.space.sparse_modes import find_modes

#: Number of folds; of fewer than twice as many shapes each is held out by itself.
FOLDS = 5
#: Steps K of the logarithms and exponentials of a model, and of those by which spaces are compared.
STEPS, LIGHT_STEPS = 16, 8
#: Most shapes by which steps are chosen, and modes where the settings give no number.
SOME, FEW = 100, 10
#: One step is not chosen if a larger share of so many random shapes folds, with at most so many modes.
FOLDED, DRAWN, DRAWN_MODES = 0.1, 500, 10
#: Random shapes, whose distance from the collection is its specificity.
RANDOM = 200
#: Percentile of the vertices' distances that is reported beside their mean.
SHARE = 95


@dataclass(frozen=True)
class PrincipalComponents:
    """Of shapes aligned to their mean.

    Attributes:
        mean: (V, 3).
        axes: (n, 3V) orthonormal, strongest first.
        coefficients: (n, n) of the shapes.
    """

    mean: FloatArray
    axes: FloatArray
    coefficients: FloatArray

    def explained(self, count: int) -> float:
        """Share of the shapes' variance that the first components explain."""
        energy = (self.coefficients**2).sum(axis=0)
        return float(energy[:count].sum() / energy.sum())

    @classmethod
    def of(cls, shapes: FloatArray, reference: FloatArray) -> PrincipalComponents:
        """Of shapes (n, V, 3), aligned to the reference and then to their mean."""
        mean = align(shapes, reference).mean(axis=0)
        shapes = align(shapes, mean)
        mean = shapes.mean(axis=0)
        u, s, axes = np.linalg.svd((shapes - mean).reshape(len(shapes), -1), full_matrices=False)
        return cls(mean, axes, u * s)

    def nearest(self, shapes: FloatArray, count: int) -> FloatArray:
        """What the first components make of shapes (n, V, 3)."""
        some = self.axes[:count]
        rows = (align(shapes, self.mean) - self.mean).reshape(len(shapes), -1)
        return self.mean + (rows @ some.T @ some).reshape(shapes.shape)

    def random(self, count: int, codes: int, rng: np.random.Generator) -> FloatArray:
        """Shapes uniform in the box of the first components' coefficients."""
        some = self.coefficients[:, :count]
        drawn = rng.uniform(some.min(axis=0), some.max(axis=0), (codes, count))
        return self.mean + (drawn @ self.axes[:count]).reshape(codes, *self.mean.shape)


def vertex_distances(shapes: FloatArray, others: FloatArray, diagonal: float) -> FloatArray:
    """(n, V) between shapes (n, V, 3) and others (n, V, 3) or one (V, 3), as shares of a diagonal."""
    result: FloatArray = np.linalg.norm(align(shapes, others) - others, axis=-1) / diagonal
    return result


def to_nearest(shapes: FloatArray, collection: FloatArray, diagonal: float) -> float:
    """Mean distance of shapes (k, V, 3) from the nearest of a collection (n, V, 3)."""
    distances = [vertex_distances(shapes, other, diagonal).mean(axis=1) for other in collection]
    return float(np.min(distances, axis=0).mean())


def summary(distances: FloatArray) -> dict[str, float]:
    """Mean and 95th percentile of distances of vertices."""
    return {"mean": float(distances.mean()), f"p{SHARE}": float(np.percentile(distances, SHARE))}


def folds(count: int) -> list[IntArray]:
    """Indices of the shapes that are held out together."""
    parts = FOLDS if count >= 2 * FOLDS else count
    return [np.arange(fold, count, parts) for fold in range(parts)]


def some_folds(count: int) -> list[IntArray]:
    """The first fold, or all where each shape is held out by itself."""
    return folds(count)[: 1 if count >= 2 * FOLDS else None]


@dataclass(frozen=True)
class HeldOut:
    """Shapes and what a space makes of them that was found without them.

    Attributes:
        index: (k,) which of the collection.
        counts: numbers of modes.
        by_modes: (k, V, 3) for each, the nearest exponentials.
        by_components: (k, V, 3) for each, what as many principal components make of them.
        by_mirrored: likewise, components of the shapes and their mirror images; empty where there are none.
        steps: (k,) K of the exponentials.
        stuck: (k,) for each, whether the search did not end, as exponentials run into collapsing faces on the way.
    """

    index: IntArray
    counts: Sequence[float]
    by_modes: list[FloatArray]
    by_components: list[FloatArray]
    by_mirrored: list[FloatArray]
    steps: IntArray
    stuck: list[NDArray[np.bool_]]

    def distances(self, shapes: FloatArray, diagonal: float) -> dict[str, list[FloatArray]]:
        """``modes`` and ``components``, for each number (k, V), from shapes (n, V, 3) of the collection; see above.

        And ``mirrored_components``, where there are mirror images.
        """
        given = shapes[self.index]
        near = {"modes": self.by_modes, "components": self.by_components}
        if self.by_mirrored:
            near["mirrored_components"] = self.by_mirrored
        return {name: [vertex_distances(each, given, diagonal) for each in found] for name, found in near.items()}


def joined(parts: Sequence[HeldOut]) -> HeldOut:
    """The shapes of several folds together; the numbers of modes are means."""

    def together(by_count: Iterable[list[NDArray]]) -> list[NDArray]:
        return [np.concatenate(each) for each in zip(*by_count, strict=True)]

    return HeldOut(
        index=np.concatenate([part.index for part in parts]),
        counts=np.mean([part.counts for part in parts], axis=0).tolist(),
        by_modes=together(part.by_modes for part in parts),
        by_components=together(part.by_components for part in parts),
        by_mirrored=together(part.by_mirrored for part in parts),
        steps=np.concatenate([part.steps for part in parts]),
        stuck=together(part.stuck for part in parts),
    )


def time_steps(
    settings: ModeSettings,
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    original_index: IntArray | None = None,
) -> int:
    """K of logarithms and exponentials, as the settings say or as ``auto`` finds.

    With K = 1 the exponential is ``X̄ + Σ_j w_j u_j``: shapes add up in vertices, which may come nearer to others of the
    kind, but folds them where limbs bend. It is chosen where it comes as near as `LIGHT_STEPS` to every shape, by
    principal modes of the other folds' logarithms at the mean of all, and hardly ever folds.

    Args:
        settings: of the modes; only ``log_steps`` and ``count`` matter.
        reference: gives connectivity.
        shapes: (n, V, 3), of which at most `SOME`, spread evenly, are held out.
        material: of the shell.
        original_index: (n,) shapes that they are of, from 0 on, mirror images last; by default none is an image.
    """
    if settings.log_steps != "auto":
        return settings.log_steps
    original_index = np.arange(len(shapes)) if original_index is None else original_index
    count = int(original_index.max()) + 1
    if count < FOLDS:  # too few to tell
        return STEPS
    used = original_index % -(-count // SOME) == 0
    try:
        if _folded(reference, shapes, material) > FOLDED:
            return STEPS
        original_index, shapes = np.unique(original_index[used], return_inverse=True)[1], shapes[used]
        few = max(1, min(FEW if settings.count == "auto" else settings.count, (int(original_index.max()) + 1) // 3))
        straight, bent = (
            _missed(reference, shapes, original_index, material, few, steps) for steps in (1, LIGHT_STEPS)
        )
    except (ModeError, NotPositiveDefiniteError):  # the stages that need mean and modes tell
        return STEPS
    return 1 if straight <= bent else STEPS


def _folded(reference: TriangleMesh, shapes: FloatArray, material: Material) -> float:
    """Share of random shapes of one step that fold where none of the shapes (n, V, 3) has as much as a crease."""
    space, mean, fields = _space(reference, shapes, material, 1)
    modes = pga(space, mean, fields, min(DRAWN_MODES, len(shapes) - 1), "vertices").vertices
    lower, upper = box_of(coefficients(space, mean, fields, modes, "vertices")[0])
    codes = np.random.default_rng(0).uniform(lower, upper, (DRAWN, len(modes)))
    drawn = mean + np.tensordot(codes, modes, axes=1)
    angles, others = (dihedral_angles(each, reference.connectivity) for each in (drawn, shapes))
    return float(folded_anew(angles, others).mean())


def _space(
    reference: TriangleMesh, shapes: FloatArray, material: Material, steps: int
) -> tuple[ShellSpace, FloatArray, FloatArray]:
    """At the mean of shapes (n, V, 3), the mean (V, 3), and their logarithms there (n, V, 3); raises ModeError."""
    found = centred_mean(reference, shapes, material, steps)
    if found.status is not Status.CONVERGED:
        raise ModeError(f"{len(shapes)} shapes that are not held out have no mean: {found.reason}")
    space = ShellSpace(reference.with_vertices(found.vertices), material)
    return space, found.vertices, logarithms(space, found.vertices, shapes, steps).fields


def _missed(
    reference: TriangleMesh, shapes: FloatArray, original_index: IntArray, material: Material, modes: int, steps: int
) -> float:
    """Mean distance of vertices of shapes (n, V, 3), the first of them originals, from what modes of others make."""
    space, mean, fields = _space(reference, shapes, material, steps)
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
) -> HeldOut:
    """Mean, logarithms and modes without some shapes, and what they make of these.

    Args:
        reference: gives connectivity.
        shapes: (n, V, 3), all of them.
        index: (k,) those that are held out, and their mirror images with them.
        counts: numbers of modes, as far as there are shapes; by default what the settings give, and half of it.
        settings: of the modes.
        material: of the shell.
        steps: K of logarithms and exponentials; by default what the settings give for the others, at most
            `LIGHT_STEPS`.
        original: (n,) which shape each is the mirror image of, itself where it is none; by default all are none.

    Raises:
        ModeError: the shapes that are left have no mean, or no modes.
    """
    original = np.arange(len(shapes)) if original is None else original
    known = np.flatnonzero(~np.isin(original, index))
    kept, unseen = shapes[known], shapes[index]
    original_index = np.unique(original[known], return_inverse=True)[1]
    if steps is None:
        steps = min(LIGHT_STEPS, time_steps(settings, reference, kept, material, original_index))
    space, mean, fields = _space(reference, kept, material, steps)
    own = original[known] == known
    components = PrincipalComponents.of(kept[own], reference.vertices)
    mirrored = None if own.all() else PrincipalComponents.of(kept, reference.vertices)
    if counts is None:
        count = mode_count(settings, space, mean, fields, original_index)
        counts = [-(-count // 2), count]
    counts = [min(count, len(kept) - 1) for count in counts]
    # The search for codes starts from projected logarithms: on the straight line to a far shape faces collapse.
    towards = logarithms(space, mean, unseen, steps).fields
    reached, by_modes, by_components, by_mirrored, stuck = [], [], [], [], []
    for count in counts:
        modes = find_modes(settings, space, mean, fields, count, original_index)
        start, _ = coefficients(space, mean, towards, modes.vertices, settings.norm)
        near = nearest_codes(space, mean, modes.vertices, unseen, start, steps)
        by_modes.append(near.vertices)
        stuck.append(np.array([status is not Status.CONVERGED for status in near.status]))
        by_components.append(components.nearest(unseen, len(modes)))
        if mirrored:
            by_mirrored.append(mirrored.nearest(unseen, len(modes)))
        reached.append(len(modes))
    return HeldOut(index, reached, by_modes, by_components, by_mirrored, np.full(len(index), steps), stuck)
