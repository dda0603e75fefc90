"""Editing: the latent code that brings a few vertices to given positions and leaves the others where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import wrap
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import Placement, align, weighted_change, without_rigid_motion
from shapespace.model.decoder import Decoder, MeshChoice, Shape
from shapespace.model.derivatives import batches, carried, derivatives, factor_derivatives, nodes
from shapespace.model.latent_space import Bounds, Codes, Fixed, NotFiniteError
from shapespace.model.posterior import Posterior
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.deadline import Deadline
from shapespace.solve.least_squares import Box, Fit, Stopping, least_squares, shrinkable
from shapespace.solve.outcome import Status

#: Weight of the prior where none is given: a code half the bounds away costs as much as half a percent of the diagonal.
PRIOR = 1e-4
#: Standard deviation of a target where none is given, as a fraction of the diagonal, and the smallest.
SIGMA, LEAST_SIGMA = 5e-3, 1e-6
#: Weight of the mean movement of all vertices beside the targets' distances; and the fraction of the diagonal beyond
#: which that cost grows linearly instead of with the square, so that a limb that has to move can.
STILL, SMALL = 3e-2, 1e-2
#: Share of the bounds' width that is added to each factor's change before its weight is computed: otherwise a factor at
#: rest would have an infinite weight.
UNMOVED = 3e-3
#: Rounds of reweighting, at most: with rough shapes, and with solved ones. They end once no coordinate moves by more
#: than this fraction of the bounds' width.
ROUNDS, REFINED, SETTLED = 8, 2, 2e-3
#: Other starts, at most, that are tried while the misfit is above these fractions of the diagonal (with rough shapes,
#: with solved ones). Another result is preferred only if it leaves at most PROMISING of the cost that can still be
#: reduced.
STARTS, GOOD_ROUGHLY, GOOD, PROMISING = 4, 2e-2, 2e-3, 0.9
#: Most targets that take part in choosing another start: each costs three linear solves.
RANKED = 32
#: Most shapes computed in a round, rough and solved ones: a search that takes longer hardly improves any more.
SEARCHED, REFINEMENTS = 3, 8


class InvalidTargetError(ValueError):
    """Targets that can't be used."""


class PriorKind(StrEnum):
    """Which changes of a code cost least: those of few factors, or the smallest ones."""

    GROUPS = "groups"
    RIDGE = "ridge"


@dataclass(frozen=True)
class Target:
    """Where a vertex should be.

    Attributes:
        vertex: index in the mesh of choice.
        position: (3,) in the frame of the start's shape as it is answered, and its units.
        sigma: standard deviation of each coordinate in these units; half a percent of the diagonal where there is none.
    """

    vertex: int
    position: Sequence[float]
    sigma: float | None = None


@dataclass(frozen=True)
class Edited:
    """The code whose shape comes closest to the targets.

    Attributes:
        code: (m,) inside the bounds, but for coordinates that were fixed.
        status: how the iteration ended.
        iterations: shapes that were reconstructed.
        shape: of the code, on the mesh of choice.
        placement: takes that shape into the frame of the start's.
        distances: (k,) of the placed shape's vertices to their targets.
        covariance: (m, m) of codes around this one, by the population of codes and the targets' sigmas, for shapes
            placed as this one; zero for fixed coordinates.
        samples: (n, m) random codes of that covariance around this one, not cut off at the bounds.
    """

    code: Codes
    status: Status
    iterations: int
    shape: Shape
    placement: Placement
    distances: FloatArray
    covariance: FloatArray
    samples: Codes

    @property
    def residual(self) -> float:
        """Root mean square of the distances."""
        return float(np.sqrt((self.distances**2).mean()))


def require_targets(model: Decoder, targets: Sequence[Target], mesh: MeshChoice) -> None:
    """Raise InvalidTargetError where there are no targets, more than vertices, or one that can't be used."""
    count = len(model.mesh(mesh).vertices)
    if not targets:
        raise InvalidTargetError("There are no targets. Give at least one.")
    if len(targets) > count:
        raise InvalidTargetError(f"targets has {len(targets)} entries. Send {count} at most.")
    for i, target in enumerate(targets):
        if not 0 <= target.vertex < count:
            raise InvalidTargetError(
                f"targets[{i}].vertex is {target.vertex}, but the {mesh} mesh has vertices 0 to {count - 1}."
            )
        if target.sigma is not None and not 0 < target.sigma < np.inf:
            raise InvalidTargetError(f"targets[{i}].sigma is {target.sigma:g}. Send a number above 0, or leave it out.")


def edited(
    model: Decoder,
    start: Codes,
    targets: Sequence[Target],
    prior: float = PRIOR,
    mesh: MeshChoice = MeshChoice.FINE,
    deadline: Deadline | None = None,
    kind: PriorKind = PriorKind.GROUPS,
    fixed: Fixed | None = None,
    samples: int = 0,
    seed: int = 0,
    anchored: bool = False,
) -> Edited:
    """The code inside the bounds whose shape comes closest to the targets, and what is not asked to move stays.

    Minimises over codes inside the bounds, and over rigid motions of their shapes,

        ``1/k Σ_i s_i ‖x_i − p_i‖² / D² + STILL · 1/V Σ_v ρ(‖x_v − x_v(start)‖ / D) + prior · 1/m · P``,

    D being the reference's diagonal, ``s_i = (SIGMA · D / σ_i)²`` or 1, x_i vertices of the mesh of choice and x_v of
    the coarse one. ``ρ(d) = 2 c (√(d² + c²) − c)`` is about ``d²`` up to c = SMALL and grows like d from there. P is
    ``Σ_j ((code_j − start_j) / width_j)²`` (ridge), or the square of the sum over factors of the norms that these
    changes have (groups: the group lasso of Yuan and Lin 2006, squared, so that one factor alone costs what it costs
    with ridge). This P and ρ are replaced by quadratic functions that touch them from above, again and again (Hunter
    and Lange 2004); the best motion of each code is known (Kabsch), so that the search is over codes alone (variable
    projection: Kaufman 1975). Anchored, the motion is that by which the x_v alone come closest, so that targets out of
    reach don't carry the whole shape along.

    A shape depends on its code by way of the least-squares problem that the reconstruction solves; by the implicit
    function theorem ``dX = (JᵀWJ)⁻¹ JᵀW dz``, where its residual is small.

    Args:
        model: whose code it is.
        start: (m,), where the search begins and what the prior holds on to.
        targets: at least one.
        prior: weight of the change of the code.
        mesh: which mesh the targets' vertices belong to.
        deadline: after which the status is Status.DEADLINE.
        kind: what of the change costs.
        fixed: coordinates that keep their value; they count as unchanged.
        samples: codes to draw.
        seed: of these.
        anchored: whether targets have no say in where the shape lies as a whole.

    Raises:
        InvalidTargetError: see ``require_targets``.
        NotFiniteError: a target or a fixed value so far away that numbers overflow.
    """
    require_targets(model, targets, mesh)
    scale, size = model.manifest.scale, model.reference.diagonal
    positions = np.array([target.position for target in targets]) / scale
    if not (np.abs(positions) < np.finfo(np.float32).max).all():
        raise NotFiniteError("A target lies so far away that the numbers overflow. Send finite positions.")
    sigmas = np.array([SIGMA * size if target.sigma is None else target.sigma / scale for target in targets])
    wanted = _Wanted(positions, np.maximum(sigmas, LEAST_SIGMA * size) / size, prior, kind, anchored)
    fixed = model.latents.fixed() if fixed is None else fixed
    begin = fixed.into(start.astype(np.float64))
    # Before a solver is lent: this shape needs one too.
    before = model.shape(start, True, MeshChoice.COARSE, deadline)
    with model.solver() as reconstruct:
        vertices = np.array([target.vertex for target in targets])
        rough, pulled = (
            _PulledVertices(model, reconstruct, vertices, mesh, deadline, rough=rough) for rough in (True, False)
        )
        here = pulled.placed(before.vertices / scale)
        problem = _EditProblem(model, rough, pulled, begin, here, wanted, fixed, deadline)
        try:
            best = _best(problem)
            code, inside = model.latents.found(best.x, Bounds.CLAMP, fixed)
            changes = pulled.derivatives(best.x)[:, : len(targets)]
        except np.linalg.LinAlgError:  # of an alignment, where vertices are not finite
            raise NotFiniteError(
                "Fixed values lie so far outside the bounds that the model's numbers overflow. Send nearer ones."
            ) from None
    found = model.shape(code, inside, MeshChoice.COARSE, deadline)
    points = pulled.placed(found.vertices / scale)
    placement = problem.placement(points, best.weights)
    distances = scale * np.linalg.norm(placement(points)[: len(targets)] - positions, axis=1)
    slopes = changes / (size * wanted.sigmas[:, None])
    slopes = slopes.reshape(len(slopes), -1)
    posterior = Posterior.of(slopes @ slopes.T, model.population, fixed.mask)
    ended = (before.diagnostics.status, found.diagnostics.status)
    return Edited(
        code,
        Status.DEADLINE if Status.DEADLINE in ended else best.status,
        pulled.shapes.count + 1,
        replace(found, vertices=model.finish(found.vertices / scale, mesh)),
        Placement(placement.rotation, scale * placement.translation),
        distances,
        posterior.covariance,
        posterior.sample(model.latents, code, samples, seed),
    )


@dataclass(frozen=True, eq=False)
class _Wanted:
    """What is asked of the shape: positions (k, 3), normalised, sigmas (k,) in diagonals; of its code and its place."""

    positions: FloatArray
    sigmas: FloatArray
    prior: float
    kind: PriorKind
    anchored: bool


@dataclass(frozen=True, eq=False)
class _Weights:
    """Of a quadratic function that touches the objective from above at one code.

    Attributes:
        points: (k + V,) of squared distances of pulled vertices from their targets and of the others from where they
            were, normalised.
        code: (m,) of squared changes.
    """

    points: FloatArray
    code: FloatArray


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A code that a search ended at.

    Attributes:
        x: (m,).
        cost: of the objective.
        misfit: root mean square distance from the targets, by their sigmas, as a fraction of the diagonal.
        status: how the search ended.
        weights: at x.
    """

    x: FloatArray
    cost: float
    misfit: float
    status: Status
    weights: _Weights


def _best(problem: _EditProblem) -> _Candidate:
    """The best candidate from a few starts."""
    rough = problem.search(problem.start)
    best = problem.refine(rough.x)
    for _ in range(STARTS):
        if best.status is Status.DEADLINE or best.misfit < GOOD:
            break
        other = problem.search(problem.another_start(best, problem.pulled))
        if not other.cost < rough.cost:
            break
        found = problem.refine(other.x)
        if not found.cost < _worthwhile(best.cost):
            break
        rough, best = other, found
    return best


def _worthwhile(cost: float) -> float:
    """The cost below which another candidate is taken in place of one of this cost."""
    return cost - (1 - PROMISING) * shrinkable(cost, GOOD_ROUGHLY)


class _EditProblem:
    """The problem of one edit.

    It is solved twice: with rough shapes, which cost at most a third of answered ones and lie about half a percent of
    the diagonal from them, and from there with answered ones, of which a few suffice.

    Args:
        model: whose code it is.
        rough, pulled: points of rough shapes, and of answered ones.
        start: (m,), with what is fixed.
        here: (k + V, 3) points of the start's shape.
        wanted: of the targets and the code.
        fixed: coordinates that keep their value.
        deadline: after which searches end.
    """

    def __init__(
        self,
        model: Decoder,
        rough: _PulledVertices,
        pulled: _PulledVertices,
        start: FloatArray,
        here: FloatArray,
        wanted: _Wanted,
        fixed: Fixed,
        deadline: Deadline | None,
    ) -> None:
        self.rough, self.pulled, self.start = rough, pulled, start
        self._model, self._wanted, self._fixed, self._deadline = model, wanted, fixed, deadline
        self._count, self._size = len(wanted.positions), model.reference.diagonal
        self._box = Box(*model.latents.box_around(fixed), model.latents.width)
        self._goals = np.concatenate([wanted.positions, here[self._count :]])
        # Rough shapes lie a little beside answered ones, and there all is to move as far.
        self._rough_goals = self._goals + (rough.positions(start) - here)
        self._factor_of = np.zeros(len(start), np.int64)
        for j, factor in enumerate(model.manifest.factors):
            self._factor_of[factor.start : factor.stop] = j

    def placement(self, points: FloatArray, weights: _Weights) -> Placement:
        """Of points (k + V, 3) of a shape where they are wanted."""
        return Placement.between(points, self._goals, self._aligned(weights))

    def _aligned(self, weights: _Weights) -> FloatArray:
        """Weights (k + V,) by which a shape is placed."""
        if not self._wanted.anchored:
            return weights.points
        return np.concatenate([np.zeros(self._count), weights.points[self._count :]])

    def search(self, start: FloatArray) -> _Candidate:
        """Fit rough shapes by the factors' derivatives, both cheap; tries other starts where the misfit stays large."""
        best = self._search(start)
        for _ in range(STARTS):
            if best.status is Status.DEADLINE or best.misfit < GOOD_ROUGHLY:
                break
            found = self._search(self.another_start(best, self.rough))
            if not found.cost < _worthwhile(best.cost):
                break
            best = found
        return best

    def _search(self, start: FloatArray) -> _Candidate:
        stopping = Stopping(1e-3, 0.05, GOOD_ROUGHLY, max_evaluations=SEARCHED, deadline=self._deadline)
        return self._descend(start, self.rough, stopping, ROUNDS, secant=False)

    def refine(self, start: FloatArray) -> _Candidate:
        """Fit answered shapes by the whole composite's derivatives, from a start nearby."""
        stopping = Stopping(1e-3, 0.002, GOOD_ROUGHLY, max_evaluations=REFINEMENTS, deadline=self._deadline)
        return self._descend(start, self.pulled, stopping, REFINED, secant=True)

    def _descend(
        self,
        x: FloatArray,
        pulled: _PulledVertices,
        stopping: Stopping,
        rounds: int,
        *,
        secant: bool,
    ) -> _Candidate:
        """Minimise one quadratic bound after the other, each from where the last one led."""
        x = np.clip(x, self._box.lower, self._box.upper)
        weights = self._weights(x, pulled)
        for _ in range(rounds):
            before, fit = x, self._fit(x, pulled, weights, stopping, secant=secant)
            x, weights = fit.x, self._weights(fit.x, pulled, weights)
            moved = np.abs(self._model.latents.shorter(x - before)) / self._box.scale
            if moved.max() < SETTLED or fit.status is Status.DEADLINE:
                break
        return self._candidate(x, pulled, weights, fit.status)

    def _fit(
        self,
        x: FloatArray,
        pulled: _PulledVertices,
        weights: _Weights,
        stopping: Stopping,
        *,
        secant: bool,
    ) -> Fit:
        held = np.sqrt(weights.code)

        def residuals(x: FloatArray) -> FloatArray:
            away = self._misfits(pulled.positions(x), pulled, weights)[1]
            return np.concatenate([(np.sqrt(weights.points)[:, None] * away).ravel(), held * self._change(x)])

        def jacobian(x: FloatArray, _: FloatArray) -> FloatArray:
            placement, _away = self._misfits(pulled.positions(x), pulled, weights)
            moves = pulled.derivatives(x) @ placement.rotation.T
            placed = placement(pulled.positions(x))
            changes = weighted_change(moves, placed, weights.points, self._aligned(weights))
            found = np.concatenate([changes.reshape(len(changes), -1).T, np.diag(held)])
            found[:, self._fixed.mask] = 0
            return found

        return least_squares(residuals, jacobian, x, self._box, stopping, secant=secant)

    def _candidate(self, x: FloatArray, pulled: _PulledVertices, weights: _Weights, status: Status) -> _Candidate:
        """A code with what the objective is there."""
        away = self._misfits(pulled.positions(x), pulled, weights)[1] / self._size
        square = (away**2).sum(axis=1)
        pull = (SIGMA / self._wanted.sigmas) ** 2 / self._count
        misfit = float(pull @ square[: self._count])
        stayed = STILL * float((2 * SMALL * (np.sqrt(square[self._count :] + SMALL**2) - SMALL)).mean())
        change = self._change(x) / self._model.latents.width
        if self._wanted.kind is PriorKind.RIDGE:
            moved = float(change @ change)
        else:
            moved = float(self._norms(change).sum() ** 2)
        cost = misfit + stayed + self._wanted.prior * moved / len(x)
        return _Candidate(x, cost, float(np.sqrt(misfit)), status, weights)

    def _weights(self, x: FloatArray, pulled: _PulledVertices, before: _Weights | None = None) -> _Weights:
        """Of the bound that touches the objective at a code."""
        pull = (SIGMA / self._wanted.sigmas) ** 2 / self._count
        still = np.full(len(self._goals) - self._count, STILL / (len(self._goals) - self._count))
        prior = self._wanted.prior / len(x) / self._model.latents.width**2
        points = np.concatenate([pull, still]) / self._size**2
        first = _Weights(points, prior)
        away = self._misfits(pulled.positions(x), pulled, before or first)[1][self._count :] / self._size
        points[self._count :] /= np.sqrt((away**2).sum(axis=1) / SMALL**2 + 1)
        if self._wanted.kind is PriorKind.GROUPS:
            norms = np.sqrt(self._norms(self._change(x) / self._model.latents.width) ** 2 + UNMOVED**2)
            prior = prior * (norms.sum() / norms)[self._factor_of]
        return _Weights(points, prior)

    def _norms(self, change: FloatArray) -> FloatArray:
        """(J,) of the factors' parts of a change (m,)."""
        return np.sqrt(np.bincount(self._factor_of, change**2))

    def _change(self, x: FloatArray) -> FloatArray:
        return self._model.latents.shorter(x - self.start)

    def _misfits(self, points: FloatArray, pulled: _PulledVertices, weights: _Weights) -> tuple[Placement, FloatArray]:
        """Where a shape lies best, given its points (k + V, 3), and from there what each misses (k + V, 3)."""
        goals = self._rough_goals if pulled is self.rough else self._goals
        if not np.isfinite(points).all():
            return Placement(np.eye(3), np.zeros(3)), np.full_like(points, np.nan)
        placement = Placement.between(points, goals, self._aligned(weights))
        return placement, placement(points) - goals

    def another_start(self, near: _Candidate, pulled: _PulledVertices) -> FloatArray:
        """Another start: a candidate with one factor moved to the node where, to first order, the misfit is smallest.

        The reference where no such move promises enough.
        """
        model, fixed = self._model, self._fixed
        some = np.linspace(0, self._count - 1, min(self._count, RANKED)).astype(np.int64)
        placement, away = self._misfits(pulled.positions(near.x), pulled, near.weights)
        roots = np.sqrt(near.weights.points[some])[:, None]
        sensitivity = pulled.sensitivity(near.x, some) * np.repeat(roots, 3, axis=0)
        missing = (roots * (away[some] @ placement.rotation)).ravel()
        best, found = _worthwhile(float(missing @ missing)), np.clip(np.zeros_like(near.x), *model.latents.box())
        half = model.manifest.edges
        for j, factor in enumerate(model.manifest.factors):
            own = slice(factor.start, factor.stop)
            here = model.factor(j, near.x[None, own])
            for part in batches(nodes(model, j)):
                part = np.where(fixed.mask[own], fixed.values[own], part)
                changes = model.factor(j, part) - here
                changes[:, half:] = wrap(changes[:, half:])
                left = ((missing + changes @ sensitivity.T) ** 2).sum(axis=1)
                if left.min() < best:
                    best, found = left.min(), near.x.copy()
                    found[own] = part[left.argmin()]
        return fixed.into(found)


class _PulledVertices:
    """Positions of a few vertices of answered shapes and of all coarse ones, normalised, as functions of the code."""

    def __init__(
        self,
        model: Decoder,
        reconstruct: Reconstructor,
        vertices: IntArray,
        mesh: MeshChoice,
        deadline: Deadline | None,
        *,
        rough: bool,
    ) -> None:
        self._model, self._reconstruct, self._vertices, self._mesh = model, reconstruct, vertices, mesh
        self.shapes, self._rough = SearchedShapes(model, reconstruct, deadline, rough=rough), rough
        # What was asked for last, which bounds of the objective share.
        self._here = self._moved = (np.full(0, np.nan), np.zeros(0))

    def positions(self, x: FloatArray) -> FloatArray:
        """(k + V, 3) at a code (m,); not finite where the networks overflow."""
        if not np.array_equal(x, self._here[0]):
            self._here = x.copy(), self.placed(self.shapes(x))
        return self._here[1]

    def derivatives(self, x: FloatArray) -> FloatArray:
        """(m, k + V, 3) of positions at a code (m,): of rough shapes by the sum of the factors."""
        if not np.array_equal(x, self._moved[0]):
            slopes = factor_derivatives if self._rough else derivatives
            shape, fields = self.shapes(x), self.shapes.derivatives(x, slopes(self._model, x))
            self._moved = x.copy(), carried(self._model, self.placed, shape, fields)
        return self._moved[1]

    def sensitivity(self, x: FloatArray, some: IntArray) -> FloatArray:
        """(3k, 2E) derivatives of some positions (k,) by lengths and angles at a code (m,), without normals'."""
        model, shape = self._model, self.shapes(x)
        count, fine = len(shape), model.finer(self._mesh)
        weights = fine.prolong.weights if fine else sparse.eye_array(count, format="csr")
        rows = weights[self._vertices[some]][:, :count]
        fields = np.einsum("kv,xy->kxvy", rows.toarray(), np.eye(3)).reshape(-1, count, 3)
        aligned = model.placed(shape, self._mesh, carried=shape)
        return self._reconstruct.sensitivity(aligned, without_rigid_motion(fields, aligned))

    def placed(self, shapes: FloatArray) -> FloatArray:
        """(…, k + V, 3) of shapes (…, V, 3) in any pose."""
        fine = self._model.finer(self._mesh)
        whole = fine.prolong(shapes) if fine else shapes
        points = np.concatenate([whole[..., self._vertices, :], shapes], axis=-2)
        return align(whole, self._model.mesh(self._mesh).vertices, carried=points)
