"""The map from codes to shapes, chosen for a collection: straight lines, or exponentials."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
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
from shapespace.training.space.codes import box_of
from shapespace.training.space.generalisation import (
    CHOICE_SHAPES,
    FOLDED_MODES,
    FOLDED_SHAPES,
    FOLDED_SHARE,
    LIGHT_STEPS,
    ModesOfOthers,
    many_steps,
    nearest_exponentials,
    space_of,
    time_steps,
    vertex_distances,
)
from shapespace.training.space.local_fields import LOCAL_SHARE, LocalVariation, local_fields, scale_of
from shapespace.training.space.modes import (
    FEWEST,
    ModeCount,
    ModeError,
    count_with_local,
    left_of_held_out,
    mode_count,
    unseen_share,
    worthwhile_with_local,
)
from shapespace.training.space.related import FOLDS, Related
from shapespace.training.space.straight_lines import StraightLines

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
#: Shares of the variance that local fields may add to the modes of the chosen map. The next one is tried until held-out
#: shapes are certainly farther away. Unless more than the first is best, smaller ones follow: of many modes, the last
#: have little variance themselves.
LOCAL_SHARES, SMALLER_SHARES = (0.01, 0.03, 0.1, 0.3), (0.003, 0.001)
#: Folds end once the differences between the errors of the chosen map and of the others are this number of standard
#: errors from changing the choice, with at least this number of shapes.
CERTAIN, ENOUGH = 3, 8


@dataclass(frozen=True)
class GeometryChoice:
    """The chosen map, and what it was chosen by."""

    kind: Kind
    steps: int  # K of exponentials, 1 for straight lines
    count: int | None = None  # number of modes, of exponentials only where local fields change it
    compared: int | None = None  # number of modes of all maps in the comparison
    held_out: int = 0  # number of shapes in the comparison
    # mean distance of each map from these shapes, as a share of the diagonal
    errors: dict[Kind, float] = field(default_factory=dict)
    folded: float = 0.0  # share of random shapes that fold on straight lines of vertices
    local_share: float = 0.0  # variance that local fields add to the modes, as a share of the shapes' variance
    unseen_share: float = 0.0  # variance of held-out shapes outside the span of the others, as a share of theirs
    local_gain: float = 0.0  # share by which local fields lower the error of shapes in the comparison

    @property
    def light_steps(self) -> int:
        """K where spaces are compared."""
        return min(LIGHT_STEPS, self.steps)

    @property
    def local(self) -> LocalVariation | None:
        """The local variation of the modes, if there is any."""
        return LocalVariation(self.local_share, self.unseen_share) if self.local_share else None


def choose_geometry(
    settings: ModeSettings,
    reference: TriangleMesh,
    shapes: FloatArray,
    material: Material,
    related: Related | None = None,
    first_step: FirstStep = "centred",
    among: Sequence[Kind] = COST,
    *,
    vary: bool = True,
) -> GeometryChoice:
    """Choose the map from codes to shapes (n, V, 3), the number of modes and K.

    ``modes.geometry = "auto"`` compares four maps on shapes that are held out of the modes in inner folds: straight
    lines of vertices, of rotations and stretches, and of lengths and angles, and exponentials. All have the same
    number of modes, the smallest that one of them would have without local fields, and with few shapes also half as
    many. The cheapest map is chosen whose error is at most 2 % above every other straight line, and at most 5 % above
    exponentials. No map remembers training shapes here. Straight lines are found anew without each fold. Exponentials
    keep the mean of all shapes, but lead from the mean of the other logarithms. Their modes are dense, because sparse
    modes may cost at most 2 % more. They are left out if many shapes have no geodesic from the mean.

    If modes may ``vary``, the same folds then choose how much of the variance of its modes comes from local fields,
    unless the number of modes needs them anyway. Shares for exponentials are compared by what the modes leave of
    held-out logarithms, without a search. If ``modes.count`` is "auto", the modes are then counted again.

    Shapes that are ``related`` are held out together; by default none are. ``among`` are the maps that "auto" compares,
    in the order of their cost. A single one is not compared.
    """
    related = related or Related.none(len(shapes))
    if settings.geometry == "exponential":
        steps = time_steps(settings, reference, shapes, material, related, first_step)
        return GeometryChoice("exponential", steps)
    if settings.geometry != "auto":
        among = (settings.geometry,)
    few = related.groups < FEWEST  # too few to compare exponentials
    if "exponential" in among and (few or (len(among) == 1 and not vary)):
        return GeometryChoice("exponential", _many(settings, first_step))
    comparison = _Comparison(settings, reference, shapes, material, related, first_step, among, vary)
    return comparison.choice() if len(among) > 1 else comparison.of_one(among[0])


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


def straight_count(settings: ModeSettings, lines: StraightLines, shapes: FloatArray, related: Related) -> ModeCount:
    """Return the number of modes of straight lines, as configured or by cross-validation.

    Errors are measured on vertices at the mean, see `worthwhile_with_local`.
    """
    if settings.count != "auto":
        count = max(1, min(settings.count, len(lines)))
        return ModeCount(count, count)
    motions = lines.motions(shapes)

    def local() -> FloatArray:
        return local_fields(lines.reference, motions.reshape(len(shapes), -1, 3))

    found = worthwhile_with_local(motions, local, related)
    count = min(found.supported, len(lines))
    return found if found.local else ModeCount(count, count)


def straight_lines(
    choice: GeometryChoice, shapes: FloatArray, reference: TriangleMesh, vertex_counts: FloatArray | None = None
) -> StraightLines:
    """Return the chosen straight lines of shapes (n, V, 3), along all their modes. ``vertex_counts`` as for lines."""
    if choice.kind == "exponential":
        raise ValueError("exponentials are no straight lines")
    share = choice.local_share
    return StraightLines.of(choice.kind, shapes, reference, vertex_counts=vertex_counts, norm="vertices", share=share)


@dataclass(frozen=True, eq=False)
class _Part(ABC):
    """A map that knows nothing of the shapes of a fold."""

    mean: TriangleMesh
    shapes: FloatArray  # (k, V, 3) of the fold
    size: float  # distances are shares of it
    _measured: dict[tuple[int, float], FloatArray] = field(default_factory=dict, init=False)

    @cached_property
    @abstractmethod
    def _motions(self) -> FloatArray:
        """Motions (n, V, 3) of vertices from the mean to the other shapes."""

    @cached_property
    def _fields(self) -> FloatArray:
        return local_fields(self.mean, self._motions)

    def _local(self, share: float) -> FloatArray:
        """Return local fields (n, k, V, 3) that have a share of the variance."""
        return scale_of(self._fields, self._motions, share) * self._fields

    def searched(self, count: int) -> FloatArray:
        """Return the distances (k,) of the shapes from the nearest shapes of the map, to compare maps."""
        return self.left(count, 0.0)

    def left(self, count: int, share: float) -> FloatArray:
        """Return the distances (k,) of the shapes from modes with a share of local fields, to compare shares."""
        if (count, share) not in self._measured:
            self._measured[count, share] = self._distances(count, share)
        return self._measured[count, share]

    @abstractmethod
    def _distances(self, count: int, share: float) -> FloatArray:
        """Measure what ``left`` returns."""


@dataclass(frozen=True, eq=False)
class _LinesPart(_Part):
    lines: StraightLines  # of the other shapes
    others: FloatArray  # (n, V, 3)

    @cached_property
    def _offsets(self) -> FloatArray:
        return self.lines.offsets(self.others)

    @cached_property
    def _motions(self) -> FloatArray:
        return self.lines.moved(self._offsets)

    def _distances(self, count: int, share: float) -> FloatArray:
        lines = self.lines.along(self._offsets, self._local(share)) if share else self.lines
        near = lines.first(count).nearest(self.shapes).vertices
        return vertex_distances(near, self.shapes, self.size).mean(axis=1)


@dataclass(frozen=True, eq=False)
class _ExponentialsPart(_Part):
    space: ShellSpace
    fields: FloatArray  # (n, V, 3) logarithms of the other shapes
    towards: FloatArray  # (k, V, 3) logarithms of the shapes of the fold
    steps: int

    @cached_property
    def _motions(self) -> FloatArray:
        return self.fields - self.fields.mean(axis=0)

    def searched(self, count: int) -> FloatArray:
        mean, towards = self.mean.vertices, self.towards
        near = nearest_exponentials(self.space, mean, self.fields, towards, self.shapes, count, self.steps)
        return vertex_distances(near, self.shapes, self.size).mean(axis=1)

    def _distances(self, count: int, share: float) -> FloatArray:
        # In the tangent space: searches take minutes and choose the same shares (benchmarks/NOTES.md).
        local = self._local(share) if share else None
        modes = ModesOfOthers.of(self.space, self.mean.vertices, self.fields, count, local)
        return np.linalg.norm(modes.left(self.towards), axis=-1).mean(axis=1) / self.size


@dataclass(frozen=True, eq=False)
class _Map:
    """A map of all shapes, and the map without some of those that are compared."""

    kind: Kind
    own: ModeCount
    mean: TriangleMesh
    rows: FloatArray  # (n, 3V) motions of vertices from the mean to the shapes that are compared
    without: Callable[[IntArray, IntArray], _Part]  # from indices of the shapes that are kept, and of the others
    lines: StraightLines | None = None

    @cached_property
    def local(self) -> FloatArray:
        """Local fields (n, k, V, 3) of the shapes that are compared."""
        return local_fields(self.mean, self.rows.reshape(len(self.rows), -1, 3))


class _Comparison:
    """Errors of all maps on the same held-out shapes."""

    def __init__(
        self,
        settings: ModeSettings,
        reference: TriangleMesh,
        shapes: FloatArray,
        material: Material,
        related: Related,
        first_step: FirstStep,
        among: Sequence[Kind],
        vary: bool,
    ) -> None:
        self._settings, self._reference, self._shapes, self._material = settings, reference, shapes, material
        self._related, self._among, self._vary = related, among, vary
        used = related.spread(CHOICE_SHAPES)
        self._some, self._some_related = shapes[used], related.some(used)
        self._steps, self._first_step = _many(settings, first_step), first_step
        self._light = min(LIGHT_STEPS, self._steps)
        self._folds = self._some_related.folds()
        self._parts: dict[tuple[Kind, int], _Part] = {}

    def choice(self) -> GeometryChoice:
        """Compare the maps fold by fold, until the choice is certain."""
        maps: dict[Kind, _Map] = {}
        for kind in self._among:
            with suppress(ModeError, NotPositiveDefiniteError):
                maps[kind] = self._map(kind)
        if not maps:  # the stages that need a mean report it
            return GeometryChoice("exponential", self._steps)
        supported = (len(self._some_related.without(index)) - 1 for index in self._folds)
        count = max(1, min(*(each.own.supported for each in maps.values()), *supported))
        counts = sorted({count, -(-count // 2)}) if self._some_related.originals < FEW else [count]
        straight = maps["vertices"].lines if "vertices" in maps else None
        folded = self._folded(straight.first(min(count, FOLDED_MODES))) if straight else 0.0
        away: dict[Kind, FloatArray] = {kind: np.empty(0) for kind in maps}
        kind, errors, held_out = cheapest({}, folded), dict[Kind, float](), 0
        for fold, index in enumerate(self._folds):
            held_out += len(index)
            for each in list(away):
                with suppress(ModeError, NotPositiveDefiniteError):
                    found = [self._part(maps[each], fold).searched(some) for some in counts]
                    away[each] = np.concatenate([away[each], np.mean(found, axis=0)])
                    continue
                del away[each]
            errors = {each: float(distances.mean()) for each, distances in away.items()}
            kind = cheapest(errors, folded)
            if held_out >= ENOUGH and certain(away, kind):
                break
        if kind not in maps:
            return GeometryChoice(kind, self._steps)
        return replace(self._chosen(maps[kind]), compared=count, held_out=held_out, errors=errors, folded=folded)

    def of_one(self, kind: Kind) -> GeometryChoice:
        """Return the choice of a map that is not compared with others.

        Raises ModeError or NotPositiveDefiniteError if straight lines have no mean.
        """
        try:
            return self._chosen(self._map(kind))
        except (ModeError, NotPositiveDefiniteError):
            if kind == "exponential":  # the stages that need a mean report it
                return GeometryChoice(kind, self._steps)
            raise

    def _map(self, kind: Kind) -> _Map:
        """Return a map of all shapes. Raises ModeError or NotPositiveDefiniteError if it has no mean."""
        size = self._reference.diagonal
        if kind == "exponential":
            # They must reach enough shapes.
            at = space_of(self._reference, self._some, self._material, self._light, self._first_step, REACHED)
            own, (space, mean, fields) = mode_count(self._settings, *at, self._some_related), at
            centre = self._reference.with_vertices(mean)

            def exponentials(kept: IntArray, index: IntArray) -> _Part:
                held_out, towards = self._some[index], fields[index]
                return _ExponentialsPart(centre, held_out, size, space, fields[kept], towards, self._light)

            return _Map(kind, own, centre, fields.reshape(len(fields), -1), exponentials)

        def straight(kept: IntArray, index: IntArray) -> _Part:
            others = self._some[kept]
            found = StraightLines.of(kind, others, self._reference, norm="vertices")
            return _LinesPart(found.reference, self._some[index], size, found, others)

        lines = StraightLines.of(kind, self._shapes, self._reference, norm="vertices")
        lines.require_mean(self._reference)
        own = straight_count(self._settings, lines, self._shapes, self._related)
        return _Map(kind, own, lines.reference, lines.motions(self._some), straight, lines)

    def _chosen(self, chosen: _Map) -> GeometryChoice:
        """Return the choice of a map, with the share of local fields in its modes."""
        own = chosen.own
        steps, count = (self._steps, None) if chosen.kind == "exponential" else (1, own.count)
        if own.local:
            return GeometryChoice(chosen.kind, steps, count, local_share=own.local.share, unseen_share=own.local.unseen)
        if not self._vary or self._some_related.groups < FOLDS:
            return GeometryChoice(chosen.kind, steps, count)
        left = left_of_held_out(chosen.rows @ chosen.rows.T, self._some_related)
        unseen = unseen_share(left, self._some_related)
        # Compared with as many modes as local fields ask for: of few modes, they would replace better ones.
        share, gain = self._local_share(chosen, self._count(chosen, LOCAL_SHARE * unseen))
        if not share:
            return GeometryChoice(chosen.kind, steps, count)
        if self._settings.count == "auto":
            count = self._count(chosen, share)
        return GeometryChoice(chosen.kind, steps, count, local_share=share, unseen_share=unseen, local_gain=gain)

    def _count(self, chosen: _Map, share: float) -> int:
        """Return the number of modes of a map with a share of local fields."""
        if self._settings.count != "auto":
            return chosen.own.count
        more = count_with_local(chosen.rows, chosen.local, share, self._some_related)
        return max(chosen.own.count, min(more, self._some_related.originals - 1))

    def _local_share(self, chosen: _Map, count: int) -> tuple[float, float]:
        """Return the share of local fields with the least error on held-out shapes, and by how much it lowers it."""
        try:
            best = self._best_share(chosen, count, LOCAL_SHARES, 0.0)
            if best <= LOCAL_SHARES[0]:
                best = self._best_share(chosen, count, SMALLER_SHARES, best)
            ours, theirs = self._compared(chosen, count, best, 0.0)
        except (ModeError, NotPositiveDefiniteError):  # the map fails without some of the shapes
            return 0.0, 0.0
        return best, 1 - float(ours.mean() / theirs.mean())

    def _best_share(self, chosen: _Map, count: int, shares: Sequence[float], best: float) -> float:
        """Return the best of some shares and of the best so far. They end where shapes are certainly farther away."""
        for share in shares:
            ours, theirs = self._compared(chosen, count, share, best)
            if _certainly_positive(ours - theirs):
                break
            if ours.mean() < theirs.mean():
                best = share
        return best

    def _compared(self, chosen: _Map, count: int, share: float, other: float) -> tuple[FloatArray, FloatArray]:
        """Return distances (n,) of held-out shapes with two shares of local fields.

        Folds end once it is certain which is smaller.
        """
        away = np.empty((0, 2))
        for fold, index in enumerate(self._folds):
            few = max(1, min(count, self._some_related.originals - len(index) - 1))
            both = np.stack([self._part(chosen, fold).left(few, each) for each in (share, other)], axis=1)
            away = np.concatenate([away, both])
            gaps = away[:, 0] - away[:, 1]
            if len(away) >= ENOUGH and (_certainly_positive(gaps) or _certainly_positive(-gaps)):
                break
        return away[:, 0], away[:, 1]

    def _part(self, chosen: _Map, fold: int) -> _Part:
        """Return a map without the shapes of a fold."""
        if (chosen.kind, fold) not in self._parts:
            index = self._folds[fold]
            self._parts[chosen.kind, fold] = chosen.without(self._some_related.without(index), index)
        return self._parts[chosen.kind, fold]

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
            if not _certainly_positive(gaps):
                return False
    return True


def _certainly_positive(gaps: FloatArray) -> bool:
    return bool(gaps.mean() >= CERTAIN * gaps.std() / np.sqrt(len(gaps)))
