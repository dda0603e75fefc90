"""The search of an edit: quadratic upper bounds of its objective, minimised one after another from several starts."""

from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import wrap
from shapespace.mesh.rigid_motion import Placement, weighted_change
from shapespace.model.decoder import Decoder
from shapespace.model.derivatives import batches, nodes
from shapespace.model.latent_space import Fixed
from shapespace.model.options import EditOptions, PriorKind
from shapespace.model.pulled_vertices import PulledVertices
from shapespace.solve.deadline import Deadline
from shapespace.solve.least_squares import Box, Fit, Stopping, least_squares, shrinkable
from shapespace.solve.outcome import Status


@dataclass(frozen=True)
class EditSettings:
    """Weights and limits of an edit. Lengths are fractions of the reference's diagonal."""

    sigma: float = 5e-3  # standard deviation of a target that has none
    least_sigma: float = 1e-6  # smallest standard deviation of a target
    still: float = 3e-2  # weight of the mean movement of all vertices against the targets' distances
    # length beyond which the cost of movement grows linearly instead of quadratically, so that a limb that has to move
    # can move
    small: float = 1e-2
    # Length added to the norm of each factor's change, as a share of the bounds' width, before the factor's weight is
    # computed. Without it an unchanged factor would have an infinite weight.
    unmoved: float = 3e-3
    # rough_rounds, solved_rounds: maximum number of bounds that are minimised, with rough and with solved shapes
    rough_rounds: int = 8
    solved_rounds: int = 2
    settled: float = 2e-3  # rounds end when no coordinate moves by more than this share of the bounds' width
    starts: int = 4  # maximum number of other starts
    # rough_misfit, solved_misfit: the search tries other starts while the misfit is larger than this length, with rough
    # and with solved shapes
    rough_misfit: float = 2e-2
    solved_misfit: float = 2e-3
    # another result replaces the best one only if it leaves at most this share of the reducible cost
    promising: float = 0.9
    # maximum number of targets that take part in choosing another start; each costs three linear solves
    ranked: int = 32
    # rough_shapes, solved_shapes: maximum number of shapes in a round. A longer search rarely improves the result.
    rough_shapes: int = 3
    solved_shapes: int = 8


SETTINGS = EditSettings()


@dataclass(frozen=True, eq=False)
class QuadraticBound:
    """Weights of a quadratic upper bound of the objective that is tight at one code."""

    # (k + V,) weights of squared distances: of vertices from their targets, and of coarse vertices from their positions
    # at the start. Distances are normalised.
    points: FloatArray
    code: FloatArray  # (m,) weights of squared changes of the code


@dataclass(frozen=True, eq=False)
class EditCandidate:
    """A code at which a descent ended."""

    x: FloatArray  # (m,) code
    cost: float  # value of the objective
    misfit: float  # root mean square distance from the targets, weighted by their sigmas, as a fraction of the diagonal
    status: Status  # how the descent ended
    bound: QuadraticBound  # quadratic bound that is tight at x


class EditSearch:
    """Search for the code of one edit.

    It minimises the objective twice. Rough shapes cost at most a third of solved shapes and differ from them by about
    half a percent of the diagonal. From the result with rough shapes, a few solved shapes suffice.

    The start (m,) has the fixed values inserted, and ``here`` (k + V, 3) are the positions of its shape. The targets'
    ``positions`` (k, 3) are normalised, and their ``sigmas`` (k,) are fractions of the diagonal.
    """

    def __init__(
        self,
        decoder: Decoder,
        rough: PulledVertices,
        pulled: PulledVertices,
        start: FloatArray,
        here: FloatArray,
        positions: FloatArray,
        sigmas: FloatArray,
        options: EditOptions,
        fixed: Fixed,
        deadline: Deadline | None,
    ) -> None:
        self.rough, self.pulled, self.start = rough, pulled, start
        self._decoder, self._options, self._fixed, self._deadline = decoder, options, fixed, deadline
        self._count, self._size = len(positions), decoder.reference.diagonal
        self._box = Box(*decoder.latents.box_around(fixed), decoder.latents.width)
        self._pull = (SETTINGS.sigma / sigmas) ** 2 / self._count
        self._goals = np.concatenate([positions, here[self._count :]])
        # Rough shapes differ a little from solved ones. Their goals are shifted so that the movements are the same.
        self._rough_goals = self._goals + (rough.positions(start) - here)
        self._factor_of = np.zeros(len(start), np.int64)
        for j, factor in enumerate(decoder.manifest.factors):
            self._factor_of[factor.start : factor.stop] = j

    def best(self) -> EditCandidate:
        """Return the best candidate from a few starts."""
        rough = self._search()
        best = self._refine(rough.x)
        for _ in range(SETTINGS.starts):
            if best.status is Status.DEADLINE or best.misfit < SETTINGS.solved_misfit:
                break
            other = self._search(self._another_start(best, self.pulled))
            if not other.cost < rough.cost:
                break
            found = self._refine(other.x)
            if not found.cost < _worthwhile(best.cost):
                break
            rough, best = other, found
        return best

    def placement(self, points: FloatArray, bound: QuadraticBound) -> Placement:
        """Return the rigid motion that brings points (k + V, 3) of a shape closest to their goals."""
        return Placement.between(points, self._goals, self._aligned(bound))

    def _aligned(self, bound: QuadraticBound) -> FloatArray:
        if not self._options.anchored:
            return bound.points
        return np.concatenate([np.zeros(self._count), bound.points[self._count :]])

    def _search(self, start: FloatArray | None = None) -> EditCandidate:
        """Fit rough shapes with the factors' derivatives, both cheap; try other starts while the misfit is large."""
        best = self._rough_descent(self.start if start is None else start)
        for _ in range(SETTINGS.starts):
            if best.status is Status.DEADLINE or best.misfit < SETTINGS.rough_misfit:
                break
            found = self._rough_descent(self._another_start(best, self.rough))
            if not found.cost < _worthwhile(best.cost):
                break
            best = found
        return best

    def _rough_descent(self, start: FloatArray) -> EditCandidate:
        stopping = Stopping(
            1e-3, 0.05, SETTINGS.rough_misfit, max_evaluations=SETTINGS.rough_shapes, deadline=self._deadline
        )
        return self._descend(start, self.rough, stopping, SETTINGS.rough_rounds, secant=False)

    def _refine(self, start: FloatArray) -> EditCandidate:
        """Fit solved shapes with derivatives of the whole composite, from a start nearby."""
        stopping = Stopping(
            1e-3, 0.002, SETTINGS.rough_misfit, max_evaluations=SETTINGS.solved_shapes, deadline=self._deadline
        )
        return self._descend(start, self.pulled, stopping, SETTINGS.solved_rounds, secant=True)

    def _descend(
        self, x: FloatArray, pulled: PulledVertices, stopping: Stopping, rounds: int, *, secant: bool
    ) -> EditCandidate:
        x = np.clip(x, self._box.lower, self._box.upper)
        bound = self._bound(x, pulled)
        for _ in range(rounds):
            before, fit = x, self._fit(x, pulled, bound, stopping, secant=secant)
            x, bound = fit.x, self._bound(fit.x, pulled, bound)
            moved = np.abs(self._decoder.latents.shorter(x - before)) / self._box.scale
            if moved.max() < SETTINGS.settled or fit.status is Status.DEADLINE:
                break
        return self._candidate(x, pulled, bound, fit.status)

    def _fit(
        self, x: FloatArray, pulled: PulledVertices, bound: QuadraticBound, stopping: Stopping, *, secant: bool
    ) -> Fit:
        held = np.sqrt(bound.code)

        def residuals(x: FloatArray) -> FloatArray:
            away = self._misfits(pulled.positions(x), pulled, bound)[1]
            return np.concatenate([(np.sqrt(bound.points)[:, None] * away).ravel(), held * self._change(x)])

        def jacobian(x: FloatArray, _: FloatArray) -> FloatArray:
            placement, _away = self._misfits(pulled.positions(x), pulled, bound)
            moves = pulled.derivatives(x) @ placement.rotation.T
            placed = placement(pulled.positions(x))
            changes = weighted_change(moves, placed, bound.points, self._aligned(bound))
            found = np.concatenate([changes.reshape(len(changes), -1).T, np.diag(held)])
            found[:, self._fixed.mask] = 0
            return found

        return least_squares(residuals, jacobian, x, self._box, stopping, secant=secant)

    def _candidate(self, x: FloatArray, pulled: PulledVertices, bound: QuadraticBound, status: Status) -> EditCandidate:
        away = self._misfits(pulled.positions(x), pulled, bound)[1] / self._size
        square = (away**2).sum(axis=1)
        misfit = float(self._pull @ square[: self._count])
        small = SETTINGS.small
        stayed = SETTINGS.still * float((2 * small * (np.sqrt(square[self._count :] + small**2) - small)).mean())
        change = self._change(x) / self._decoder.latents.width
        moved = float(
            change @ change if self._options.prior_kind is PriorKind.RIDGE else self._norms(change).sum() ** 2
        )
        cost = misfit + stayed + self._options.prior * moved / len(x)
        return EditCandidate(x, cost, float(np.sqrt(misfit)), status, bound)

    def _bound(self, x: FloatArray, pulled: PulledVertices, before: QuadraticBound | None = None) -> QuadraticBound:
        """Build the quadratic upper bound of the objective that is tight at a code."""
        still = np.full(len(self._goals) - self._count, SETTINGS.still / (len(self._goals) - self._count))
        prior = self._options.prior / len(x) / self._decoder.latents.width**2
        points = np.concatenate([self._pull, still]) / self._size**2
        first = QuadraticBound(points, prior)
        away = self._misfits(pulled.positions(x), pulled, before or first)[1][self._count :] / self._size
        points[self._count :] /= np.sqrt((away**2).sum(axis=1) / SETTINGS.small**2 + 1)
        if self._options.prior_kind is PriorKind.GROUPS:
            norms = np.sqrt(self._norms(self._change(x) / self._decoder.latents.width) ** 2 + SETTINGS.unmoved**2)
            prior = prior * (norms.sum() / norms)[self._factor_of]
        return QuadraticBound(points, prior)

    def _norms(self, change: FloatArray) -> FloatArray:
        """Return the norm (J,) of each factor's part of a change (m,)."""
        return np.sqrt(np.bincount(self._factor_of, change**2))

    def _change(self, x: FloatArray) -> FloatArray:
        return self._decoder.latents.shorter(x - self.start)

    def _misfits(
        self, points: FloatArray, pulled: PulledVertices, bound: QuadraticBound
    ) -> tuple[Placement, FloatArray]:
        """Return the best placement of points (k + V, 3) of a shape, and the placed points minus their goals."""
        goals = self._rough_goals if pulled is self.rough else self._goals
        if not np.isfinite(points).all():
            return Placement(np.eye(3), np.zeros(3)), np.full_like(points, np.nan)
        placement = Placement.between(points, goals, self._aligned(bound))
        return placement, placement(points) - goals

    def _another_start(self, near: EditCandidate, pulled: PulledVertices) -> FloatArray:
        """Move one factor of a candidate to the grid node where, to first order, the misfit is smallest.

        Return the reference if no such move promises enough.
        """
        decoder, fixed = self._decoder, self._fixed
        some = np.linspace(0, self._count - 1, min(self._count, SETTINGS.ranked)).astype(np.int64)
        placement, away = self._misfits(pulled.positions(near.x), pulled, near.bound)
        roots = np.sqrt(near.bound.points[some])[:, None]
        sensitivity = pulled.sensitivity(near.x, some) * np.repeat(roots, 3, axis=0)
        missing = (roots * (away[some] @ placement.rotation)).ravel()
        best, found = _worthwhile(float(missing @ missing)), np.clip(np.zeros_like(near.x), *decoder.latents.box())
        half = decoder.manifest.edges
        for j, factor in enumerate(decoder.manifest.factors):
            own = slice(factor.start, factor.stop)
            here = decoder.factor(j, near.x[None, own])
            for part in batches(nodes(decoder, j)):
                part = np.where(fixed.mask[own], fixed.values[own], part)
                changes = decoder.factor(j, part) - here
                changes[:, half:] = wrap(changes[:, half:])
                left = ((missing + changes @ sensitivity.T) ** 2).sum(axis=1)
                if left.min() < best:
                    best, found = left.min(), near.x.copy()
                    found[own] = part[left.argmin()]
        return fixed.into(found)


def _worthwhile(cost: float) -> float:
    """Return the cost below which another candidate replaces a candidate of this cost."""
    return cost - (1 - SETTINGS.promising) * shrinkable(cost, SETTINGS.rough_misfit)
