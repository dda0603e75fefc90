"""The search of a fit: robust weights, and Gauss–Newton steps of code, motion and size together."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.closest_points import MeshProximity, VertexFaces
from shapespace.mesh.rigid_motion import Placement, align
from shapespace.mesh.triangle_mesh import vertex_areas
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.derivatives import carried, derivatives, factor_derivatives
from shapespace.model.pairing import Pairing, Pairs
from shapespace.model.population import Population
from shapespace.model.scan import Scan, near
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline

#: The robust weight of a pair is one half at this distance, in standard deviations of the present distances. The first
#: such distance is the quantile FARTHEST of all; it shrinks by a factor in each iteration.
WIDTH, FARTHEST, SHRINKING = 3.0, 0.95, 0.7
#: Weight of the point-to-point distance beside the point-to-plane distance, at first and later. It keeps a shape from
#: sliding along its own surface.
SLIDING, SLIDING_AT_LAST = 0.3, 0.01
#: Longest step, in standard deviations of the population, and largest rotation, in radians; a step shorter than the
#: third ends the search.
LONGEST, TURN, SHORTEST = 1.5, 0.5, 0.01
#: So does a movement of the shape by less than this fraction of the diagonal.
STILL = 2e-4
#: Derivatives are used again until the code has moved this far from where they were computed, in standard deviations.
KEPT = 0.3
#: Usual standard deviation of a landmark, as a fraction of the diagonal.
LANDMARK = 0.01
#: Points within this fraction of the diagonal count as explained; up to as much again is added for the scan's noise.
NEAR = 0.01
#: Where fits are compared, a point at this distance, a fraction of the diagonal, counts as half explained.
COMPARED = 0.02
#: Weight of the code's plausibility in that comparison: being four standard deviations off costs as much as leaving
#: this share of the scan unexplained.
PLAUSIBLE = 0.001


@dataclass(frozen=True)
class Level:
    """How exactly shapes are computed in a search.

    Attributes:
        rough: shapes of frames on the coarse mesh, with the factors' derivatives; or answered ones on the fine mesh.
        points: of the scan, and vertices of the model, that count.
        floor: standard deviation that is always assumed, as a fraction of the diagonal: what such shapes are wrong by.
        independent: share of the points that count as independent observations.
    """

    rough: bool
    points: int
    floor: float
    independent: float

    @property
    def mesh(self) -> MeshChoice:
        """The mesh that is looked at."""
        return MeshChoice.COARSE if self.rough else MeshChoice.FINE


ROUGH = Level(True, 500, 5e-3, 0.1)
FULL = Level(False, 4000, 3e-4, 0.5)


@dataclass(frozen=True, eq=False)
class Options:
    """What is known beside the scan; lengths in the model's normalised units.

    Attributes:
        partial: whether the scan shows a part of the shape only.
        free: whether its size is to be found.
        noise: standard deviation of the scan's points; None: is estimated.
        landmarks: (l,) vertices of the fine mesh.
        places: (l, 3) where they are.
        sigmas: (l,) standard deviations; infinite ones stand for the usual share of the diagonal, whatever the scale.
        movable: (m,) coordinates that may change.
        prior: of codes.
        lower, upper: (m,) where they are looked for.
    """

    partial: bool
    free: bool
    noise: float | None
    landmarks: IntArray
    places: FloatArray
    sigmas: FloatArray
    movable: NDArray[np.bool_]
    prior: Population
    lower: FloatArray
    upper: FloatArray


@dataclass(frozen=True, eq=False)
class State:
    """A fit on its way.

    Attributes:
        code: (m,).
        shape: (V, 3) of it, coarse, in the frame that ``placement`` takes to the scan's.
        placement: of the shape.
        sigma: standard deviation of what is left of the pairs that count, normal to the surface.
        cost: share of scan and model that is not explained, softly, and what the code costs.
        settled: whether the last step was short enough to be the last.
        moved: how far it moved what of the shape it moved most, as a fraction of the diagonal.
    """

    code: FloatArray
    shape: FloatArray
    placement: Placement
    sigma: float = np.inf
    cost: float = np.inf
    settled: bool = False
    moved: float = np.inf


class Search:
    """Looks for the code and the place of a shape near a start; the derivatives are those of ``encode`` and ``edit``.

    Args:
        model: whose codes.
        reconstruct: a solver that the model has lent.
        scan: in the model's normalised units.
        options: what is known beside.
        level: how exactly shapes are computed.
        fans: of the mesh of that level.
        vertices: those of the mesh that look for points of the scan, evenly spread.
        deadline: after which no step begins.
    """

    def __init__(
        self,
        model: Decoder,
        reconstruct: Reconstructor,
        scan: Scan,
        options: Options,
        level: Level,
        fans: VertexFaces,
        vertices: IntArray,
        deadline: Deadline | None,
    ) -> None:
        self._model, self.options, self._level, self._deadline = model, options, level, deadline
        self.scan, self._fans = scan, fans
        self._pairing = Pairing(scan, level.points, vertices, both=not options.partial, blended=not level.rough)
        self._diagonal = model.reference.diagonal
        self._whiten: FloatArray = np.asarray(np.linalg.inv(options.prior.root), np.float64)
        self.shapes = SearchedShapes(model, reconstruct, deadline, rough=level.rough)
        self._changes: Callable[[Decoder, FloatArray], FloatArray] = factor_derivatives if level.rough else derivatives
        self.count = 0
        self._fields: tuple[FloatArray, FloatArray] | None = None

    def start(self, code: FloatArray, placement: Placement, like: FloatArray) -> State | None:
        """A code where a shape ``like`` (V, 3) its own is placed; None where the networks overflow."""
        shape = self._shape(code)
        return None if shape is None else State(code, align(shape, like), placement)

    def run(self, state: State, steps: int, *, first: bool, drawn: int = 0) -> State:
        """So many steps at most from a state.

        Args:
            state: to begin at.
            steps: most of them.
            first: whether the first ones also heed what is far away.
            drawn: first steps in which what is left over on both sides is drawn to each other.
        """
        width, self._fields = np.inf if first else 0.0, None
        for k in range(steps):
            if self._deadline is not None and self._deadline.passed:
                break
            pairs = self._pairs(state)
            if k == 0 and first:
                width = float(np.quantile(pairs.distances, FARTHEST))
            sigma = self._sigma(pairs, state)
            if k < drawn:
                pairs = self._pairing.drawn(pairs, self.surface(state.shape), state.placement, self.tolerance(sigma))
            moved = self._step(state, pairs, max(WIDTH * sigma, width), sigma, SLIDING if first else SLIDING_AT_LAST)
            width *= SHRINKING
            if moved is None:
                break
            state = moved
            if state.settled and k >= drawn and width <= WIDTH * sigma:
                break
        pairs = self._pairs(state)
        return replace(state, sigma=self._sigma(pairs, state), cost=self._cost(state, pairs))

    def normal(self, state: State) -> FloatArray:
        """(m, m) what the scan and landmarks say of the code at a fit, zero where it may not change: half a Hessian.

        Residuals of neighbouring points are alike, so each counts only as far as it is independent.
        """
        pairs = self._pairs(state)
        sigma, n = self._sigma(pairs, state), pairs.of_scan
        weights = _robust(pairs.distances[:n], WIDTH * sigma) * pairs.agree[:n]
        share = independent(self._pairing.some.points, pairs.heights[:n], weights)
        A = self._motions(pairs, state)
        normal = np.einsum("nxp,nx->np", A[:n], pairs.normals[:n])
        H = share / sigma**2 * normal.T @ (weights[:, None] * normal)
        H += self._landmarks(state, self._derivatives(state))[0]
        count = int(self.options.movable.sum())
        # What is left once motion and size are chosen best for each code.
        rest = H[count:, count:] + 1e-9 * np.eye(len(H) - count) * H.diagonal().max()
        movable = self.options.movable
        found = np.zeros((len(movable), len(movable)))
        found[np.ix_(movable, movable)] = H[:count, :count] - H[:count, count:] @ np.linalg.solve(
            rest, H[count:, :count]
        )
        return found

    def surface(self, shape: FloatArray) -> MeshProximity:
        """Of a coarse shape (V, 3), on the mesh of this level."""
        return MeshProximity(self._fine(shape), self._fans)

    def _fine(self, shapes: FloatArray) -> FloatArray:
        fine = self._model.finer(self._level.mesh)
        return fine.prolong(shapes) if fine else shapes

    def _shape(self, code: FloatArray) -> FloatArray | None:
        self.count += 1
        shape = self.shapes(code)
        return shape if np.isfinite(shape).all() else None

    def _pairs(self, state: State) -> Pairs:
        return self._pairing.closest(self.surface(state.shape), state.placement)

    def tolerance(self, sigma: float) -> float:
        """How far a point may be from the surface and still count as explained, given what is left of the others."""
        least = NEAR * self._diagonal
        return least + (min(3 * sigma, least) if self.options.noise is None else 3 * sigma)

    def shares(self, state: State) -> tuple[float, float]:
        """How much of the scan is explained, and how much of the model's area is seen."""
        most, surface = self.tolerance(state.sigma), self.surface(state.shape)
        explained = surface.closest(state.placement.back(self.scan.points)).distances <= most
        away = self.scan.distances(state.placement(surface.vertices)) / state.placement.scale
        areas = vertex_areas(surface.vertices, surface.fans.faces)
        return float(explained.mean()), float(areas @ (away <= most) / areas.sum())

    def _sigma(self, pairs: Pairs, state: State) -> float:
        """Standard deviation of the heights, from their median: what doesn't belong has no say."""
        floor = self._level.floor * self._diagonal
        if self.options.noise is not None:
            return max(floor, self.options.noise / state.placement.scale)
        heights = np.abs(pairs.heights[: pairs.of_scan])
        alike = pairs.agree[: pairs.of_scan] > 0.5
        return max(floor, 1.4826 * float(np.median(heights[alike] if alike.any() else pairs.distances)))

    def _cost(self, state: State, pairs: Pairs) -> float:
        squares = pairs.distances**2
        missed = squares / (squares + (COMPARED * self._diagonal) ** 2)
        away = self._away(state.code)
        return float((pairs.mass * missed).sum() / pairs.mass.sum() + PLAUSIBLE * away @ away)

    def _away(self, code: FloatArray) -> FloatArray:
        """(m,) scores of a code, an angle's the shorter way."""
        scores: FloatArray = self._whiten @ self._model.latents.shorter(code - self.options.prior.mean)
        return scores

    def _prior(self) -> FloatArray:
        """(m, f) derivative of the scores by the coordinates that may change."""
        return self._whiten[:, self.options.movable]

    def _derivatives(self, state: State) -> FloatArray:
        """(V, 3, f) of the mesh's vertices by the coordinates that may change; kept as long as the code hardly does."""
        if self._fields is not None and np.abs(self._whiten @ (state.code - self._fields[0])).max() <= KEPT:
            return self._fields[1]
        changes = self._changes(self._model, state.code)[:, self.options.movable]
        raw = self.shapes(state.code)
        fields = self.shapes.derivatives(state.code, changes)
        turned = align(raw, state.shape, carried=raw + fields) - state.shape
        moves = carried(self._model, self._fine, state.shape, turned)
        found = np.ascontiguousarray(np.moveaxis(moves, 0, -1))
        self._fields = state.code, found
        return found

    def _motions(self, pairs: Pairs, state: State) -> FloatArray:
        """(n, 3, f + 6 or 7) how the model's points move with the code, a turn, a shift and the size."""
        fields = self._derivatives(state)
        by_code = (pairs.rows @ fields.reshape(len(fields), -1)).reshape(len(pairs.gaps), 3, -1)
        return np.concatenate([by_code, self._rigid(pairs.places)], axis=2)

    def _rigid(self, places: FloatArray) -> FloatArray:
        """(n, 3, 6 or 7)."""
        x, y, z = places.T
        o = np.zeros_like(x)
        turns = np.array([[o, z, -y], [-z, o, x], [y, -x, o]]).transpose(2, 0, 1)
        shifts = np.broadcast_to(np.eye(3), (len(places), 3, 3))
        return np.concatenate([turns, shifts, *([places[:, :, None]] if self.options.free else [])], axis=2)

    def _landmarks(self, state: State, fields: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal matrix and right-hand side of the landmarks."""
        options = self.options
        size = fields.shape[-1] + (7 if options.free else 6)
        if not len(options.landmarks):
            return np.zeros((size, size)), np.zeros(size)
        rows = self.landmark_rows()
        places = rows @ self._fine(state.shape)
        by_code = (rows @ fields.reshape(len(fields), -1)).reshape(len(places), 3, -1)
        A = np.concatenate([by_code, self._rigid(places)], axis=2).reshape(-1, size)
        gaps = (state.placement.back(options.places) - places).ravel()
        usual = LANDMARK * self._diagonal
        sigmas = np.where(np.isfinite(options.sigmas), options.sigmas / state.placement.scale, usual)
        weights = np.repeat(sigmas**-2.0, 3)
        return A.T @ (weights[:, None] * A), A.T @ (weights * gaps)

    def landmark_rows(self) -> sparse.csr_array:
        """(l, V) landmarks as means of the mesh's vertices."""
        fine, vertices = self._model.finer(MeshChoice.FINE), self.options.landmarks
        count = len(self._fans.around)
        if fine and self._level.rough:
            return sparse.csr_array(fine.prolong.weights[vertices][:, :count])
        own = np.arange(len(vertices))
        return sparse.csr_array((np.ones(len(vertices)), (own, vertices)), shape=(len(vertices), count))

    def _step(self, state: State, pairs: Pairs, width: float, sigma: float, sliding: float) -> State | None:
        """A Gauss–Newton step; None where there is none that can be taken."""
        try:
            fields = self._derivatives(state)
        except NotPositiveDefiniteError:
            return None
        weights = _robust(pairs.distances, width) * pairs.agree * pairs.mass
        weights *= self._level.independent * pairs.of_scan / sigma**2
        A = self._motions(pairs, state)
        size = A.shape[2]
        normal, flat = np.einsum("nxp,nx->np", A, pairs.normals), A.reshape(-1, size)
        share = np.where(pairs.drawn, 1.0, sliding)
        above, beside = (1 - share) * weights, share * weights
        H = normal.T @ (above[:, None] * normal) + flat.T @ (np.repeat(beside, 3)[:, None] * flat)
        g = normal.T @ (above * pairs.heights) + flat.T @ (beside[:, None] * pairs.gaps).ravel()
        for own, part in zip((H, g), self._landmarks(state, fields), strict=True):
            own += part
        prior, count = self._prior(), fields.shape[-1]
        H[:count, :count] += prior.T @ prior
        g[:count] -= prior.T @ self._away(state.code)
        if not (np.isfinite(H).all() and np.isfinite(g).all()):  # far outside the bounds networks overflow
            return None
        try:
            step = self._inside(H, g, state.code)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        change = np.zeros(len(state.code))
        change[self.options.movable] = step[:count]
        score = self._whiten @ change
        longest = max(np.abs(score).max() / LONGEST, np.linalg.norm(step[count : count + 3]) / TURN, 1.0)
        step, change = step / longest, change / longest
        code = state.code + change
        shape = self._shape(code)
        if shape is None:
            return None
        # The new shape lies where the derivatives have led, whatever frame it was solved in.
        led = align(shape, state.shape + self._coarse_move(state, change))
        turn, shift = Rotation.from_rotvec(step[count : count + 3]).as_matrix(), step[count + 3 : count + 6]
        motion = Placement(turn, shift, float(np.exp(step[count + 6])) if self.options.free else 1.0)
        moved = float(np.abs(np.einsum("nxp,p->nx", A, step)).max()) / self._diagonal
        settled = bool(np.abs(score).max() <= SHORTEST or moved <= STILL)
        return State(code, led, state.placement.after(motion), settled=settled, moved=moved)

    def _coarse_move(self, state: State, change: FloatArray) -> FloatArray:
        moves = self._derivatives(state) @ change[self.options.movable]
        fine = self._model.finer(self._level.mesh)
        if fine is None:
            return moves
        known = fine.prolong.coarse_vertices
        return moves[known] if (known >= 0).all() else np.zeros_like(state.shape)

    def _inside(self, H: FloatArray, g: FloatArray, code: FloatArray) -> FloatArray:
        """The step ``H⁻¹ g``, coordinates that would leave the box held at its sides."""
        options = self.options
        low, high = (side[options.movable] - code[options.movable] for side in (options.lower, options.upper))
        free, step = np.ones(len(g), bool), np.zeros(len(g))
        for _ in range(3):
            rest = g[free] - H[np.ix_(free, ~free)] @ step[~free]
            damped = H[np.ix_(free, free)] + 1e-9 * H.diagonal().max() * np.eye(int(free.sum()))
            step[free] = cho_solve(cho_factor(damped), rest)
            clipped = np.clip(step[: len(low)], np.minimum(low, 0), np.maximum(high, 0))
            out = clipped != step[: len(low)]
            if not out.any():
                break
            step[: len(low)] = clipped
            free[: len(low)] &= ~out
        return step


def _robust(distances: FloatArray, width: float) -> FloatArray:
    """(n,) weights (Geman and McClure 1987)."""
    weights: FloatArray = 1 / (1 + (distances / width) ** 2) ** 2
    return weights


def independent(points: FloatArray, residuals: FloatArray, weights: FloatArray) -> float:
    """Share of residuals (n,) at points (n, 3) that are worth an observation of their own.

    ``1 / (1 + Σ ρ_k)``, ρ_k being the correlation of a residual with that of its k-th neighbour, up to where it ends.
    """
    used = weights > 0.25
    points, residuals = points[used], residuals[used]
    if len(points) < 50:
        return 1.0
    residuals = np.clip(residuals, *(np.quantile(residuals, [0.01, 0.99])))
    _, beside = near(cKDTree(points), points, min(len(points) // 4, 200))
    products = (residuals[:, None] * residuals[beside[:, 1:]]).mean(axis=0) / (residuals**2).mean()
    # Averages over shells, as single neighbours are noisy.
    smooth = np.convolve(products, np.ones(5) / 5, mode="valid")
    below = np.flatnonzero(smooth < 0.05)
    end = int(below[0]) if len(below) else len(smooth)
    return float(1 / (1 + max(0.0, smooth[:end].sum())))
