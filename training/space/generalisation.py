"""How near a space comes to shapes that it was not made from, beside principal components of the aligned vertices.

Principal components are what a user would otherwise take. Distances are means over vertices after rigid alignment, as
shares of the diagonal of the reference's bounding box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.space import ShellSpace
from shapespace.solve.outcome import Status
from shapespace.training.runs.config import ModeSettings
from shapespace.training.space.codes import nearest_codes
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.mean import centred_mean
from shapespace.training.space.modes import ModeError, coefficients, find_modes, mode_count

#: Number of folds; of fewer than twice as many shapes each is held out by itself.
FOLDS = 5
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


def summary(distances: FloatArray) -> dict[str, float]:
    """Mean and 95th percentile of distances of vertices."""
    return {"mean": float(distances.mean()), f"p{SHARE}": float(np.percentile(distances, SHARE))}


def folds(count: int) -> list[IntArray]:
    """Indices of the shapes that are held out together."""
    parts = FOLDS if count >= 2 * FOLDS else count
    return [np.arange(fold, count, parts) for fold in range(parts)]


@dataclass(frozen=True)
class HeldOut:
    """Shapes and what a space makes of them that was found without them.

    Attributes:
        index: (k,) which of the collection.
        counts: numbers of modes.
        by_modes: (k, V, 3) for each, the nearest exponentials.
        by_components: (k, V, 3) for each, what as many principal components make of them.
        by_mirrored: likewise, components of the shapes and their mirror images; empty where there are none.
    """

    index: IntArray
    counts: Sequence[float]
    by_modes: list[FloatArray]
    by_components: list[FloatArray]
    by_mirrored: list[FloatArray]

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
    return HeldOut(
        np.concatenate([part.index for part in parts]),
        np.mean([part.counts for part in parts], axis=0).tolist(),
        *(
            [np.concatenate(shapes) for shapes in zip(*by_count, strict=True)]
            for by_count in zip(*((part.by_modes, part.by_components, part.by_mirrored) for part in parts), strict=True)
        ),
    )


def held_out(
    reference: TriangleMesh,
    shapes: FloatArray,
    index: IntArray,
    counts: Sequence[int] | None,
    settings: ModeSettings,
    material: Material,
    steps: int,
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
        steps: K of logarithms and exponentials.
        original: (n,) which shape each is the mirror image of, itself where it is none; by default all are none.

    Raises:
        ModeError: the shapes that are left have no mean, or no modes.
    """
    original = np.arange(len(shapes)) if original is None else original
    known = np.flatnonzero(~np.isin(original, index))
    kept, unseen = shapes[known], shapes[index]
    whose = np.unique(original[known], return_inverse=True)[1]
    found = centred_mean(reference, kept, material, steps)
    if found.status is not Status.CONVERGED:
        raise ModeError(f"without some shapes the others have no mean: {found.reason}")
    mean = found.vertices
    space = ShellSpace(reference.with_vertices(mean), material)
    fields = logarithms(space, mean, kept, steps).fields
    own = original[known] == known
    components = PrincipalComponents.of(kept[own], reference.vertices)
    mirrored = None if own.all() else PrincipalComponents.of(kept, reference.vertices)
    if counts is None:
        count = mode_count(settings, space, mean, fields, whose)
        counts = [-(-count // 2), count]
    counts = [min(count, len(kept) - 1) for count in counts]
    # The search for codes starts from projected logarithms: on the straight line to a far shape faces collapse.
    towards = logarithms(space, mean, unseen, steps).fields
    reached, by_modes, by_components, by_mirrored = [], [], [], []
    for count in counts:
        modes = find_modes(settings, space, mean, fields, count, whose)
        start, _ = coefficients(space, mean, towards, modes.vertices, settings.norm)
        by_modes.append(nearest_codes(space, mean, modes.vertices, unseen, start, steps).vertices)
        by_components.append(components.nearest(unseen, len(modes)))
        if mirrored:
            by_mirrored.append(mirrored.nearest(unseen, len(modes)))
        reached.append(len(modes))
    return HeldOut(index, reached, by_modes, by_components, by_mirrored)
