"""The map from codes to shapes, chosen for a collection: straight lines, or exponentials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import dihedral_angles
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.mesh.triangle_quality import folded_anew
from shapespace.shell.energy import Material
from shapespace.shell.space import FirstStep, ShellSpace
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.codes import box_of, nearest_codes
from shapespace.training.space.generalisation import (
    CHOICE_SHAPES,
    FOLDED_MODES,
    FOLDED_SHAPES,
    FOLDED_SHARE,
    FOLDS,
    LIGHT_STEPS,
    folds,
    many_steps,
    space_of,
    time_steps,
    vertex_distances,
)
from shapespace.training.space.modes import ModeCount, ModeError, coefficients, mode_count, pga, worthwhile_with_soft
from shapespace.training.space.soft_fields import SoftFields, soft_fields
from shapespace.training.space.straight_lines import StraightKind, StraightLines

Kind = Literal["vertices", "nric", "differential", "exponential"]
#: All maps, the cheapest first.
COST: tuple[Kind, ...] = ("vertices", "differential", "nric", "exponential")
#: A cheaper map is chosen if its error is at most the first multiple of the least error, or the second multiple of the
#: error of exponentials. These are compared without networks and with dense modes, so served models are less exact.
AS_GOOD, AS_GOOD_AS_NETWORKS = 1.02, 1.05
#: Straight lines of vertices whose random shapes fold are chosen only if all other maps have at least this multiple of
#: their error.
FOLDED_BETTER = 1.03
#: Where the map is chosen again without some of the shapes, maps with more than this multiple of the chosen map's error
#: on all shapes are left out: the other shapes would not choose them either, and exponentials take long.
HOPEFUL = 1.2
#: Exponentials are compared only if at least this share of the shapes has a geodesic from the mean. Of heads whose
#: eyelids and lips close, half have none, after long searches.
REACHED = 2 / 3
#: Below this number of shapes, maps are also compared with half as many modes: single shapes decide less then.
FEW = 20
#: Folds end once the differences between the errors of the chosen map and of the others are this number of standard
#: errors from changing the choice, with at least this number of shapes.
CERTAIN, ENOUGH = 3, 8


@dataclass(frozen=True)
class GeometryChoice:
    """The chosen map, and what it was chosen by."""

    kind: Kind
    steps: int  # K of exponentials, 1 for straight lines
    count: int | None = None  # number of modes of straight lines
    compared: int | None = None  # number of modes of all maps in the comparison
    held_out: int = 0  # number of shapes in the comparison
    # mean distance of each map from these shapes, as a share of the diagonal
    errors: dict[Kind, float] = field(default_factory=dict)
    folded: float = 0.0  # share of random shapes that fold on straight lines of vertices
    soft_share: float = 0.0  # variance that soft fields add to straight lines, as a share of the shapes' variance

    @property
    def light_steps(self) -> int:
        """K where spaces are compared."""
        return min(LIGHT_STEPS, self.steps)


def choose_geometry(
    settings: ModeSettings,
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    original_index: IntArray | None = None,
    first_step: FirstStep = "centred",
    among: Sequence[Kind] = COST,
) -> GeometryChoice:
    """Choose the map from codes to shapes (n, V, 3), the number of modes and K.

    ``modes.geometry = "auto"`` compares four maps on shapes that are held out of the modes in inner folds: straight
    lines of vertices, of rotations and stretches, and of lengths and angles, and exponentials. All have the same
    number of modes, the smallest that one of them would have without soft fields, and with few shapes also half as
    many. The cheapest map is chosen whose error is at most 2 % above every other straight line, and at most 5 % above
    exponentials. No map remembers training shapes here. Means come from all shapes, and modes of exponentials are
    dense, because sparse modes may cost at most 2 % more. Exponentials are left out if many shapes have no geodesic
    from the mean.

    ``original_index`` (n,) is the index of each shape's original, from 0, mirror images last. ``among`` are the maps
    that "auto" compares, in the order of their cost. A single one is not compared.
    """
    original_index = np.arange(len(shapes)) if original_index is None else original_index
    if settings.geometry == "exponential":
        steps = time_steps(settings, reference, shapes, material, original_index, first_step)
        return GeometryChoice("exponential", steps)
    if settings.geometry != "auto":
        among = (settings.geometry,)
    kind, *others = among
    few = original_index.max() + 1 < FOLDS  # too few to compare exponentials
    if kind == "exponential" or (few and "exponential" in others):
        return GeometryChoice("exponential", _many(settings, first_step))
    if not others:
        lines = StraightLines.of(kind, shapes, reference)
        lines.require_mean(reference)
        own = straight_count(settings, lines, shapes, original_index, material)
        return GeometryChoice(kind, 1, own.count, soft_share=own.soft.share if own.soft else 0.0)
    return _Comparison(settings, reference, shapes, material, original_index, first_step, among).choice()


def hopeful(kind: Kind, errors: Mapping[Kind, float]) -> tuple[Kind, ...]:
    """Return the maps that may be chosen without some of the shapes, from the map and the errors of all shapes."""
    if not errors:
        return COST
    return tuple(each for each in COST if each in errors and errors[each] <= HOPEFUL * errors[kind])


def _many(settings: ModeSettings, first_step: FirstStep) -> int:
    """Return K of exponentials, which bend."""
    if settings.log_steps != "auto":
        return settings.log_steps
    return many_steps(first_step)


def straight_count(
    settings: ModeSettings, lines: StraightLines, shapes: FloatArray, original_index: IntArray, material: Material
) -> ModeCount:
    """Return the number of modes of straight lines, as configured or by cross-validation.

    Errors are measured on vertices at the mean, see `worthwhile_with_soft`.
    """
    if settings.count != "auto":
        count = max(1, min(settings.count, len(lines)))
        return ModeCount(count, count)
    found = worthwhile_with_soft(lines.motions(shapes), lambda: soft_fields_of(lines, material), original_index)
    count = min(found.supported, len(lines))
    return found if found.soft else ModeCount(count, count)


def straight_lines(
    choice: GeometryChoice,
    shapes: FloatArray,
    reference: TriangleMesh,
    material: Material,
    vertex_counts: FloatArray | None = None,
) -> StraightLines:
    """Return the chosen straight lines of shapes (n, V, 3), along all their modes. ``vertex_counts`` as for lines."""
    if choice.kind == "exponential":
        raise ValueError("exponentials are no straight lines")
    lines = StraightLines.of(choice.kind, shapes, reference, vertex_counts=vertex_counts)
    if not choice.soft_share:
        return lines
    soft = SoftFields(soft_fields_of(lines, material), choice.soft_share)
    return StraightLines.of(choice.kind, shapes, reference, vertex_counts=vertex_counts, soft=soft)


def soft_fields_of(lines: StraightLines, material: Material) -> FloatArray:
    """Return the soft fields (p, V, 3) at the mean of straight lines."""
    return soft_fields(ShellSpace(lines.reference, material), lines.reference.vertices)


#: Map from indices of the shapes that modes are found from, indices of unseen shapes, and a number of modes, to the
#: nearest shapes (k, V, 3).
_Nearest = Callable[[IntArray, IntArray, int], FloatArray]


class _Comparison:
    """Errors of all maps on the same held-out shapes."""

    def __init__(
        self,
        settings: ModeSettings,
        reference: TriangleMesh,
        shapes: FloatArray,
        material: Material,
        original_index: IntArray,
        first_step: FirstStep,
        among: Sequence[Kind],
    ) -> None:
        self._settings, self._reference, self._shapes, self._material = settings, reference, shapes, material
        self._original_index, self._among = original_index, among
        used = original_index % -(-(original_index.max() + 1) // CHOICE_SHAPES) == 0
        self._some, self._own = shapes[used], np.unique(original_index[used], return_inverse=True)[1]
        self._steps, self._first_step = _many(settings, first_step), first_step
        self._light = min(LIGHT_STEPS, self._steps)

    def choice(self) -> GeometryChoice:
        """Compare the maps fold by fold, until the choice is certain."""
        settings, lines = self._settings, self._lines()
        own = {
            kind: straight_count(settings, each, self._shapes, self._original_index, self._material)
            for kind, each in lines.items()
        }
        maps: dict[Kind, _Nearest] = {kind: partial(self._on_lines, kind) for kind in lines}
        asked = list(own.values())
        if "exponential" in self._among:
            with suppress(ModeError, NotPositiveDefiniteError):  # they have no mean, or reach too few shapes
                at = space_of(self._reference, self._some, self._material, self._light, self._first_step, REACHED)
                asked.append(mode_count(settings, *at, self._own))
                maps["exponential"] = partial(self._on_exponentials, *at)
        if not maps:  # the stages that need a mean report it
            return GeometryChoice("exponential", self._steps)
        every = folds(int(self._own.max()) + 1)
        supported = (int((~np.isin(self._own, index)).sum()) - 1 for index in every)
        count = max(1, min(*(each.supported for each in asked), *supported))
        counts = sorted({count, -(-count // 2)}) if self._own.max() + 1 < FEW else [count]
        folded = self._folded(lines["vertices"].first(min(count, FOLDED_MODES))) if "vertices" in lines else 0.0
        away: dict[Kind, FloatArray] = {kind: np.empty(0) for kind in maps}
        kind, errors, held_out = cheapest({}, folded), dict[Kind, float](), 0
        for index in every:
            kept, held_out = np.flatnonzero(~np.isin(self._own, index)), held_out + len(index)
            for each in list(away):
                with suppress(ModeError, NotPositiveDefiniteError):
                    given = self._some[index]
                    near = [maps[each](kept, index, some) for some in counts]
                    distances = [vertex_distances(x, given, self._reference.diagonal).mean(axis=1) for x in near]
                    away[each] = np.concatenate([away[each], np.mean(distances, axis=0)])
                    continue
                del away[each]
            errors = {each: float(distances.mean()) for each, distances in away.items()}
            kind = cheapest(errors, folded)
            if held_out >= ENOUGH and certain(away, kind):
                break
        if kind == "exponential":
            return GeometryChoice(kind, self._steps, None, count, held_out, errors, folded)
        share = soft.share if (soft := own[kind].soft) else 0.0
        return GeometryChoice(kind, 1, own[kind].count, count, held_out, errors, folded, share)

    def _on_lines(self, kind: StraightKind, kept: IntArray, index: IntArray, count: int) -> FloatArray:
        """Return the shapes (k, V, 3) nearest to shapes ``index`` on straight lines of the shapes ``kept``."""
        lines = StraightLines.of(kind, self._some, self._reference, kept)
        return lines.first(count).nearest(self._some[index]).vertices

    def _on_exponentials(
        self, space: ShellSpace, mean: FloatArray, fields: FloatArray, kept: IntArray, index: IntArray, count: int
    ) -> FloatArray:
        """Return the nearest exponentials (k, V, 3) of principal modes of the logarithms (n, V, 3) ``kept``."""
        modes = pga(space, mean, fields[kept], count, "vertices").vertices
        start, _ = coefficients(space, mean, fields[index], modes, "vertices")
        return nearest_codes(space, mean, modes, self._some[index], start, self._light).vertices

    def _lines(self) -> dict[StraightKind, StraightLines]:
        found: dict[StraightKind, StraightLines] = {}
        for kind in self._among:
            if kind == "exponential":
                continue
            try:
                lines = StraightLines.of(kind, self._shapes, self._reference)
                lines.require_mean(self._reference)
            except (ModeError, NotPositiveDefiniteError):
                continue
            found[kind] = lines
        return found

    def _folded(self, lines: StraightLines) -> float:
        """Return the share of random shapes that fold where no training shape has a crease."""
        lower, upper = box_of(lines.coefficients)
        codes = np.random.default_rng(0).uniform(lower, upper, (FOLDED_SHAPES, len(lines)))
        drawn = (lines.mean + codes @ lines.modes).reshape(FOLDED_SHAPES, -1, 3)
        angles, others = (dihedral_angles(each, self._reference.connectivity) for each in (drawn, self._shapes))
        return float(folded_anew(angles, others).mean())


def cheapest(errors: dict[Kind, float], folded: float) -> Kind:
    """Return the cheapest map that is as good as the others, from errors by map.

    Straight lines of vertices whose random shapes often fold must be better than the others.
    """
    if not errors:
        return "exponential"
    others = dict(errors)
    others.pop("vertices", None)
    if "vertices" in errors and others and folded > FOLDED_SHARE:
        for kind in (_as_good(others), min(others, key=lambda each: others[each])):
            if others[kind] <= FOLDED_BETTER * errors["vertices"]:
                return kind
    return _as_good(errors)


def _as_good(errors: dict[Kind, float]) -> Kind:
    def good(kind: Kind) -> bool:
        return all(errors[kind] <= _margin(kind, other) * errors[other] for other in errors if other != kind)

    return next(kind for kind in COST if kind in errors and good(kind))


def _margin(one: Kind, other: Kind) -> float:
    """Return the multiple of an error up to which the cheaper of two maps is as good."""
    return AS_GOOD_AS_NETWORKS if "exponential" in (one, other) else AS_GOOD


def certain(errors: dict[Kind, FloatArray], kind: Kind) -> bool:
    """Return whether further shapes would not change the choice, from errors (n,) of the same shapes by each map."""
    for other, theirs in errors.items():
        if other != kind:
            cheaper = COST.index(kind) < COST.index(other)
            margin = _margin(kind, other)
            gaps = margin * theirs - errors[kind] if cheaper else theirs - margin * errors[kind]
            if gaps.mean() < CERTAIN * gaps.std() / np.sqrt(len(gaps)):
                return False
    return True
