"""Held-out shapes, approximated in the space that was found without them, and by simple models.

The simple models know the same shapes, have as many coordinates, and find codes by vertices, as our model does:

- ``components``: principal components of the aligned vertices.
- ``remembering_components``: principal components that remember the shapes they were found from, as our bundles do.
- ``linear_nric``: principal components of lengths and angles, with vertices by Gauss–Newton.
- ``differential_coordinates``: principal components of rotations and stretches of faces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.space import FirstStep
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.outcome import Status
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.codes import Codes, ShapeMap, exponential_map, nearest_codes
from shapespace.training.space.generalisation import PrincipalComponents, space_of, vertex_distances
from shapespace.training.space.geometry import COST, GeometryChoice, Kind, choose_geometry, straight_lines
from shapespace.training.space.local_fields import LocalVariation
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.memory import RememberingMap
from shapespace.training.space.modes import ModeError, coefficients, mode_count
from shapespace.training.space.related import Related
from shapespace.training.space.sparse_modes import find_modes
from shapespace.training.space.straight_lines import StraightKind, StraightLines


@dataclass(frozen=True)
class HeldOut:
    """Held-out shapes, approximated in the space that was found without them."""

    index: IntArray  # (k,) indices of the shapes in the collection
    counts: Sequence[float]  # numbers of modes
    # (k, V, 3) for each number: ``modes`` has the nearest shapes of the space. The simple models follow. Where there
    # are mirror images, ``components`` don't know them, but ``mirrored_components`` and the other models do
    near: dict[str, list[FloatArray]]
    maps: tuple[Kind, ...]  # (k,) the map from codes to shapes
    steps: IntArray  # (k,) K of the exponentials, 1 for straight lines
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
        near={
            kind: together(part.near[kind] for part in parts)
            for kind in parts[0].near
            if all(kind in part.near for part in parts)
        },
        maps=tuple(kind for part in parts for kind in part.maps),
        steps=np.concatenate([part.steps for part in parts]),
        stuck=together(part.stuck for part in parts),
    )


def held_out(
    reference: TriangleMesh,
    shapes: FloatArray,
    index: IntArray,
    counts: Sequence[int] | None,
    settings: ModeSettings,
    material: Material,
    steps: int | None = None,
    related: Related | None = None,
    first_step: FirstStep = "centred",
    *,
    remember: bool = True,
    among: Sequence[Kind] = COST,
    vary: bool = True,
) -> HeldOut:
    """Find mean and modes without some shapes, and approximate these shapes.

    Shapes (n, V, 3) at ``index`` (k,) are held out, and all shapes that are ``related`` to them. ``counts`` are numbers
    of modes, by default the configured number and half of it, and at most the number of the other shapes. The map from
    codes to shapes is as configured for the other shapes; "auto" chooses ``among`` some maps, and whether modes
    ``vary`` locally. ``steps`` is K, by default as configured for these, and at most `LIGHT_STEPS`; K stands for
    exponentials. The map may ``remember`` the shapes that it was found from, as bundles do. Raises ModeError if the
    other shapes have no mean, or no modes.
    """
    related = related or Related.none(len(shapes))
    known = related.without(index)
    kept, unseen, among_kept = shapes[known], shapes[index], related.some(known)
    if steps is None:
        choice = choose_geometry(settings, reference, kept, material, among_kept, first_step, among, vary=vary)
    else:
        choice = GeometryChoice("exponential", steps)
    space: _Exponentials | StraightLines
    if choice.kind == "exponential":
        steps = choice.light_steps
        space = _Exponentials(settings, reference, kept, unseen, among_kept, material, steps, first_step, choice.local)
        count = space.count if choice.count is None else choice.count
    else:
        space = straight_lines(choice, kept, reference)
        count = choice.count or len(space)
    workers = -1 if choice.kind == "exponential" else 1  # shapes of straight lines take less time than processes
    rivals = simple_models(reference, kept, related.original[known] == known)
    reached, stuck = [], []
    near: dict[str, list[FloatArray]] = {kind: [] for kind in ("modes", *rivals)}
    for each in [-(-count // 2), count] if counts is None else counts:
        some = space.first(min(each, len(space)))
        found = some.nearest(unseen)
        if remember:
            memory = RememberingMap(some.shape, some.codes_of(kept), kept, some.sizes, workers)
            found = memory.nearest(unseen, found)
        reached.append(found.codes.shape[1])
        stuck.append(np.array([status is not Status.CONVERGED for status in found.status]))
        for kind, nearest in rivals.items():
            near[kind].append(nearest(unseen, reached[-1]))
        near["modes"].append(found.vertices)
    maps = (choice.kind,) * len(index)
    return HeldOut(index, reached, near, maps, np.full(len(index), choice.light_steps), stuck)


#: Map from shapes (k, V, 3) and a number of coordinates to the nearest shapes (k, V, 3) of a simple model.
SimpleModel = Callable[[FloatArray, int], FloatArray]


def simple_models(reference: TriangleMesh, kept: FloatArray, own: NDArray[np.bool_]) -> dict[str, SimpleModel]:
    """Return functions that approximate shapes (k, V, 3) with a number of coordinates, by the names of simple models.

    Lines are left out where their mean has no shape. ``own`` (n,) marks shapes (n, V, 3) that are no mirror images.
    """
    rivals: dict[str, SimpleModel] = {"components": PrincipalComponents.of(kept[own], reference.vertices).nearest}
    if not own.all():
        rivals["mirrored_components"] = PrincipalComponents.of(kept, reference.vertices).nearest
    straight = StraightLines.of("vertices", kept, reference)

    def remembering(unseen: FloatArray, count: int) -> FloatArray:
        lines = straight.first(count)
        memory = RememberingMap(lines.shape, lines.codes_of(kept), kept, lines.sizes)
        return memory.nearest(unseen, lines.nearest(unseen)).vertices

    rivals["remembering_components"] = remembering
    names: tuple[tuple[str, StraightKind], ...] = (
        ("linear_nric", "nric"),
        ("differential_coordinates", "differential"),
    )
    for name, kind in names:
        with suppress(ModeError, NotPositiveDefiniteError):
            rivals[name] = partial(_nearest_on, StraightLines.of(kind, kept, reference))
    return rivals


def _nearest_on(lines: StraightLines, unseen: FloatArray, count: int) -> FloatArray:
    return lines.first(count).nearest(unseen).vertices


class _Exponentials:
    """Exponentials at the mean of shapes (n, V, 3), which approximate unseen shapes (k, V, 3)."""

    shape: ShapeMap
    _modes: FloatArray  # (m, V, 3)
    _codes: FloatArray  # (n, m)

    def __init__(
        self,
        settings: ModeSettings,
        reference: TriangleMesh,
        kept: FloatArray,
        unseen: FloatArray,
        related: Related,
        material: Material,
        steps: int,
        first_step: FirstStep,
        local: LocalVariation | None,
    ) -> None:
        self._settings, self._related, self._steps = settings, related, steps
        self._space, self._mean, self._fields = space_of(reference, kept, material, steps, first_step)
        # The search for codes starts from projected logarithms, because faces collapse on the straight line to a far
        # shape.
        self._towards = logarithms(self._space, self._mean, unseen, steps).fields
        own = mode_count(settings, self._space, self._mean, self._fields, related)
        self.count, self._local = own.count, own.local or local  # as configured

    def __len__(self) -> int:
        """Largest number of modes."""
        return max(self.count, len(self._fields) - 1)

    def first(self, count: int) -> _Exponentials:
        """Return the exponentials along this number of modes."""
        found = copy(self)
        share = self._local.share if self._local else 0.0
        modes = find_modes(self._settings, self._space, self._mean, self._fields, count, self._related, share)
        found._modes, found._codes = modes.vertices, modes.coefficients
        found.shape = exponential_map(self._space, self._mean, found._modes, self._steps)
        return found

    def codes_of(self, _: FloatArray) -> FloatArray:
        """Return codes (n, m) of the shapes that the modes were found from, to first order."""
        return self._codes

    @property
    def sizes(self) -> FloatArray:
        """Lengths (m,) of the modes."""
        return np.sqrt((self._modes**2).sum(axis=(1, 2)))

    def nearest(self, unseen: FloatArray) -> Codes:
        """Return the codes of the unseen shapes."""
        start, _ = coefficients(self._space, self._mean, self._towards, self._modes, self._settings.norm)
        return nearest_codes(self._space, self._mean, self._modes, unseen, start, self._steps)
