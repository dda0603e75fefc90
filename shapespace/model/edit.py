"""Editing: the latent code that brings a few vertices to given positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import wrap
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.model.decoder import Decoder, MeshChoice, Shape
from shapespace.model.derivatives import batches, derivatives, factor_derivatives, nodes
from shapespace.model.latent_space import Bounds, Codes, NotFiniteError
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.deadline import Deadline
from shapespace.solve.least_squares import Box, Fit, Stopping, least_squares, shrinkable
from shapespace.solve.outcome import Status

#: Weight of the prior where none is given: a code half the bounds away costs as much as half a percent of the diagonal.
PRIOR = 1e-4
#: Step of the difference quotients through alignment and prolongation, as a fraction of the diagonal.
DIFFERENCE = 1e-4
#: At most so many other starts are tried while the misfit is above these fractions of the diagonal (of rough shapes, of
#: answered ones). Another start or fit counts only if it leaves at most the fraction PROMISING of what can be reduced.
STARTS, GOOD_ROUGHLY, GOOD, PROMISING = 4, 2e-2, 2e-3, 0.9
#: Most targets by which another start is chosen: each costs three linear solves.
RANKED = 32
#: Most shapes of a refinement: what takes longer follows a valley that hardly descends.
REFINEMENTS = 8


class InvalidTargetError(ValueError):
    """Targets that can't be used."""


@dataclass(frozen=True)
class Target:
    """Where a vertex should be.

    Attributes:
        vertex: index in the mesh of choice.
        position: (3,) in the frame and units of answered shapes.
    """

    vertex: int
    position: Sequence[float]


@dataclass(frozen=True)
class Edited:
    """The code whose shape comes closest to the targets.

    Attributes:
        code: (m,) inside the bounds.
        status: how the iteration ended.
        iterations: shapes that were reconstructed.
        shape: of the code, on the mesh of choice.
        distances: (k,) of that shape's vertices to their targets.
    """

    code: Codes
    status: Status
    iterations: int
    shape: Shape
    distances: FloatArray

    @property
    def residual(self) -> float:
        """Root mean square of the distances."""
        return float(np.sqrt((self.distances**2).mean()))


def require_targets(model: Decoder, targets: Sequence[Target], mesh: MeshChoice) -> None:
    """Raise InvalidTargetError where there are no targets, more than vertices, or one for a vertex that isn't there."""
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


def edited(
    model: Decoder,
    start: Codes,
    targets: Sequence[Target],
    prior: float = PRIOR,
    mesh: MeshChoice = MeshChoice.FINE,
    deadline: Deadline | None = None,
) -> Edited:
    """The code inside the bounds whose shape comes closest to the targets.

    Minimises over codes inside the bounds

        ``1/k Σ_i ‖x_i(code) − p_i‖² / D² + prior · 1/m Σ_j ((code_j − start_j) / width_j)²``,

    D being the reference's diagonal. A shape depends on its code by way of the least-squares problem that the
    reconstruction solves; by the implicit function theorem ``dX = (JᵀWJ)⁻¹ JᵀW dz``, where its residual is small.

    Args:
        model: whose code it is.
        start: (m,), where the search begins and what the prior holds on to.
        targets: at least one.
        prior: weight of the distance from the start.
        mesh: which mesh the targets' vertices belong to.
        deadline: after which the status is Status.DEADLINE.

    Raises:
        InvalidTargetError: see ``require_targets``.
        NotFiniteError: a target so far away that numbers overflow.
    """
    require_targets(model, targets, mesh)
    positions = np.array([target.position for target in targets]) / model.manifest.scale
    if not (np.abs(positions) < np.finfo(np.float32).max).all():
        raise NotFiniteError("A target lies so far away that the numbers overflow. Send finite positions.")
    with model.solver() as reconstruct:
        vertices = np.array([target.vertex for target in targets])
        rough, pulled = (
            _PulledVertices(model, reconstruct, vertices, mesh, deadline, rough=rough) for rough in (True, False)
        )
        problem = _Problem(model, rough, pulled, start.astype(np.float64), positions, prior, deadline)
        fit = _best(problem)
    code, _ = model.latents.code(fit.x.tolist(), Bounds.CLAMP)
    shape = model.shape(code, True, mesh, deadline)
    found = shape.vertices[[target.vertex for target in targets]]
    distances = np.linalg.norm(found - model.manifest.scale * positions, axis=1)
    status = Status.DEADLINE if shape.diagnostics.status is Status.DEADLINE else fit.status
    return Edited(code, status, pulled.shapes.count, shape, distances)


def _best(problem: _Problem) -> Fit:
    """The best fit from a few starts."""
    rough = problem.search(problem.start)
    best = problem.refine(rough.x)
    for _ in range(STARTS):
        if best.status is Status.DEADLINE or problem.misfit(best) < GOOD:
            break
        other = problem.search(problem.another_start(best, problem.pulled))
        if not other.cost < rough.cost:
            break
        fit = problem.refine(other.x)
        if not fit.cost < _worthwhile(best.cost):
            break
        rough, best = other, fit
    return best


def _worthwhile(cost: float) -> float:
    """The cost below which another fit is taken in place of one of this cost."""
    return cost - (1 - PROMISING) * shrinkable(cost, GOOD_ROUGHLY)


class _Problem:
    """The least-squares problem of one edit.

    It is solved twice: with rough shapes, which cost at most a third of answered ones and lie about half a percent of
    the diagonal from them, and from there with answered ones, of which a few suffice.
    """

    def __init__(
        self,
        model: Decoder,
        rough: _PulledVertices,
        pulled: _PulledVertices,
        start: FloatArray,
        positions: FloatArray,
        prior: float,
        deadline: Deadline | None,
    ) -> None:
        self.rough, self.pulled, self.start = rough, pulled, start
        self._model, self._positions, self._deadline = model, positions, deadline
        self._box = Box(*model.latents.box(), model.latents.width)
        self._weight = 1 / (model.reference.diagonal * np.sqrt(len(positions)))
        self._held = np.sqrt(prior / len(start)) / model.latents.width

    def misfit(self, fit: Fit) -> float:
        """Root mean square distance from the targets, as a fraction of the diagonal."""
        return float(np.linalg.norm(fit.residuals[: self._positions.size]))

    def search(self, start: FloatArray) -> Fit:
        """Fit rough shapes by the factors' derivatives, both cheap; tries other starts where the misfit stays large."""
        best = self._search(start)
        for _ in range(STARTS):
            if best.status is Status.DEADLINE or self.misfit(best) < GOOD_ROUGHLY:
                break
            fit = self._search(self.another_start(best, self.rough))
            if not fit.cost < _worthwhile(best.cost):
                break
            best = fit
        return best

    def _search(self, start: FloatArray) -> Fit:
        pulled = self.rough
        return least_squares(
            lambda x: self._residual(x, pulled),
            lambda x, _: self._jacobian(pulled.derivatives(x, factor_derivatives(self._model, x))),
            start,
            self._box,
            Stopping(1e-3, 0.05, GOOD_ROUGHLY, max_evaluations=20, deadline=self._deadline),
            secant=False,
        )

    def refine(self, start: FloatArray) -> Fit:
        """Fit answered shapes by the whole composite's derivatives, from a start nearby."""
        pulled = self.pulled
        return least_squares(
            lambda x: self._residual(x, pulled),
            lambda x, _: self._jacobian(pulled.derivatives(x, derivatives(self._model, x))),
            start,
            self._box,
            Stopping(1e-3, 0.002, GOOD_ROUGHLY, max_evaluations=REFINEMENTS, deadline=self._deadline),
        )

    def another_start(self, fit: Fit, pulled: _PulledVertices) -> FloatArray:
        """Another start: the fit with one factor moved to the node where, to first order, the misfit is smallest.

        The reference where no such move promises enough.
        """
        model = self._model
        count = len(self._positions)
        some = np.linspace(0, count - 1, min(count, RANKED)).astype(np.int64)
        sensitivity = pulled.sensitivity(fit.x, some) * self._weight
        missing = fit.residuals[: self._positions.size].reshape(-1, 3)[some].ravel()
        best, found = _worthwhile(float(missing @ missing)), np.clip(np.zeros_like(fit.x), *model.latents.box())
        half = model.manifest.edges
        for j, factor in enumerate(model.manifest.factors):
            own = slice(factor.start, factor.stop)
            here = model.factor(j, fit.x[None, own])
            for part in batches(nodes(model, j)):
                changes = model.factor(j, part) - here
                changes[:, half:] = wrap(changes[:, half:])
                left = ((missing + changes @ sensitivity.T) ** 2).sum(axis=1)
                if left.min() < best:
                    best, found = left.min(), fit.x.copy()
                    found[own] = part[left.argmin()]
        return found

    def _residual(self, x: FloatArray, pulled: _PulledVertices) -> FloatArray:
        away = self._held * self._model.latents.shorter(x - self.start)
        return np.concatenate([self._weight * (pulled.positions(x) - self._positions).ravel(), away])

    def _jacobian(self, moves: FloatArray) -> FloatArray:
        return np.concatenate([self._weight * moves.reshape(len(moves), -1).T, np.diag(self._held)])


class _PulledVertices:
    """Positions of a few vertices of answered shapes, normalised, as functions of the code."""

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
        self.shapes = SearchedShapes(model, reconstruct, deadline, rough=rough)

    def positions(self, x: FloatArray) -> FloatArray:
        """(k, 3) at a code (m,); not finite where the networks overflow."""
        return self._places(self.shapes(x))

    def derivatives(self, x: FloatArray, changes: FloatArray) -> FloatArray:
        """(m, k, 3) at a code (m,), given those of lengths and angles (2E, m)."""
        shape, fields = self.shapes(x), self.shapes.derivatives(x, changes)
        h = DIFFERENCE * self._model.reference.diagonal / max(np.abs(fields).max(), np.finfo(float).tiny)
        here, *there = self._places(np.concatenate([shape[None], shape + h * fields]))
        return np.stack([(places - here) / h for places in there])

    def sensitivity(self, x: FloatArray, some: IntArray) -> FloatArray:
        """(3k, 2E) derivatives of some positions (k,) by lengths and angles at a code (m,), without normals'."""
        model, shape = self._model, self.shapes(x)
        count, fine = len(shape), model.finer(self._mesh)
        weights = fine.prolong.weights if fine else sparse.eye_array(count, format="csr")
        rows = weights[self._vertices[some]][:, :count]
        fields = np.einsum("kv,xy->kxvy", rows.toarray(), np.eye(3)).reshape(-1, count, 3)
        aligned = model.placed(shape, self._mesh, carried=shape)
        return self._reconstruct.sensitivity(aligned, without_rigid_motion(fields, aligned))

    def _places(self, shapes: FloatArray) -> FloatArray:
        """(…, k, 3) of shapes (…, V, 3)."""
        return self._model.placed(shapes, self._mesh)[..., self._vertices, :]
