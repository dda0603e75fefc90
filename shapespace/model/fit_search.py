"""The search of a fit: robust weights, and joint Gauss–Newton steps of code, motion and size."""

from dataclasses import dataclass, replace
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.closest_points import MeshProximity, VertexFaces
from shapespace.mesh.rigid_motion import Placement, align
from shapespace.mesh.triangle_mesh import vertex_areas
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.derivatives import carried, derivatives, factor_derivatives
from shapespace.model.feature_search import FeatureSearch
from shapespace.model.fit_constraints import PLAUSIBLE, FitConstraints
from shapespace.model.fit_result import FitState, VertexDerivatives
from shapespace.model.pairing import Pairing, Pairs
from shapespace.model.scan import Scan, independent_points, neighbours
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline


@dataclass(frozen=True)
class SearchSettings:
    """Weights and limits of the search. Lengths are fractions of the reference's diagonal."""

    # the robust weight of a pair is one half at this distance, in standard deviations of the distances
    width: float = 3.0
    farthest: float = 0.95  # quantile of all distances that is the first such distance
    shrinking: float = 0.7  # factor by which this distance shrinks in each iteration
    # sliding, last_sliding: weight of the point-to-point distance against the point-to-plane distance, at first and
    # later. It keeps a shape from sliding along its own surface.
    sliding: float = 0.3
    last_sliding: float = 0.01
    longest: float = 1.5  # longest step, in standard deviations of the population
    turn: float = 0.5  # largest rotation in a step, in radians
    shortest: float = 0.01  # a shorter step ends the search, in standard deviations of the population
    tolerance: float = 1e-4  # solved shapes have converged if no vertex moves further
    landmark: float = 0.01  # default standard deviation of a landmark
    # points within this distance of the model count as explained; at most twice this distance with noise
    near: float = 0.01
    compared: float = 0.02  # where fits are compared, a point at this distance counts as half explained


SETTINGS = SearchSettings()


@dataclass(frozen=True)
class SearchAccuracy:
    """How accurately a search computes shapes."""

    # the fine mesh takes derivatives of the composite, the coarse mesh derivatives of the factors
    mesh: MeshChoice
    rough: bool  # shapes from face frames instead of solved shapes
    points: int  # number of points of the scan that count
    still: float  # a movement of the shape by less than this length ends the search, as a fraction of the diagonal
    floor: float  # smallest standard deviation of points, as a fraction of the diagonal: the error of such shapes
    independent: float | None  # share of the points that count as independent observations; None measures it
    # derivatives are used again until the code has moved this far, in standard deviations of the population
    kept: float


ROUGH = SearchAccuracy(MeshChoice.COARSE, True, 500, 2e-4, 5e-3, 0.1, 0.8)
MIDDLE = SearchAccuracy(MeshChoice.COARSE, False, 1000, 5e-4, 3e-4, 0.5, 0.8)
SOLVED = SearchAccuracy(MeshChoice.FINE, False, 4000, 2e-4, 3e-4, None, 2.0)


class FitSearch:
    """Search for the code and the placement of a shape near a start, with the derivatives of ``encode`` and ``edit``.

    The decoder has lent the solver. The scan is in the units of ``constraints``. Some evenly spread ``vertices`` of the
    mesh of this accuracy look for points of the scan. No step begins after the deadline.
    """

    def __init__(
        self,
        decoder: Decoder,
        reconstruct: Reconstructor,
        scan: Scan,
        constraints: FitConstraints,
        accuracy: SearchAccuracy,
        vertex_faces: VertexFaces,
        vertices: IntArray,
        deadline: Deadline | None,
    ) -> None:
        self._decoder, self.constraints, self._accuracy, self._deadline = decoder, constraints, accuracy, deadline
        self.scan, self._vertex_faces = scan, vertex_faces
        self._pairing = Pairing(
            scan, accuracy.points, vertices, both=not constraints.partial, blended=not accuracy.rough
        )
        self._diagonal = decoder.reference.diagonal
        self._whiten = constraints.whiten
        self.reconstruct = reconstruct
        self._changes = derivatives if accuracy.mesh is MeshChoice.FINE else factor_derivatives
        self._shapes = SearchedShapes(decoder, reconstruct, deadline, SETTINGS.tolerance, rough=accuracy.rough)
        self.count = 0  # number of shapes computed so far
        self._last: VertexDerivatives | None = None
        self._paired = WeakKeyDictionary[Placement, Pairs]()
        self._shared: tuple[FitState, tuple[float, float]] | None = None

    def start(self, code: FloatArray, placement: Placement, like: FloatArray) -> FitState | None:
        """Return the state of a code that is placed like a shape (V, 3), or None where the networks overflow."""
        shape = self._shape(code)
        return None if shape is None else FitState(code, align(shape, like), placement)

    def run(self, state: FitState, steps: int, *, first: bool, drawn: int = 0) -> FitState:
        """Take steps from a state.

        With ``first``, the first steps also consider distant points. In the first ``drawn`` steps, unmatched parts of
        both sides attract each other.
        """
        width, self._last = np.inf if first else 0.0, state.derivatives
        for k in range(steps):
            if self._deadline is not None and self._deadline.passed:
                break
            pairs = self._pairs(state)
            if k == 0 and first:
                width = float(np.quantile(pairs.distances, SETTINGS.farthest))
            sigma = self._sigma(pairs, state)
            if k < drawn:
                pairs = self._pairing.drawn(pairs, self.surface(state.shape), state.placement, self.tolerance(sigma))
            moved = self._step(
                state,
                pairs,
                max(SETTINGS.width * sigma, width),
                sigma,
                SETTINGS.sliding if first else SETTINGS.last_sliding,
            )
            width *= SETTINGS.shrinking
            if moved is None:
                break
            state = moved
            if state.settled and k >= drawn and width <= SETTINGS.width * sigma:
                break
        pairs = self._pairs(state)
        sigma, cost = self._sigma(pairs, state), self._cost(state, pairs)
        return replace(state, sigma=sigma, cost=cost, derivatives=self._last)

    def with_moved_feature(self, state: FitState, features: FeatureSearch, steps: int) -> FitState:
        """Move a feature to its most promising place in the scan and take steps, as long as this improves the fit."""
        for _ in features.images:
            code = features.another(self.reconstruct, state.code, self._pairs(state), self.constraints.movable)
            begun = None if code is None else self.start(code, state.placement, state.shape)
            if begun is None or (moved := self.run(begun, steps, first=False)).cost >= state.cost:
                break
            state = moved
        return state

    def normal(self, state: FitState, shown: NDArray[np.bool_] | None = None) -> FloatArray:
        """Return the information matrix (m, m) of scan and landmarks about the code, half a Hessian; 0 where fixed.

        Residuals of neighbouring points are correlated, so only the independent share of them counts. The scan tells
        nothing of coordinates that are not ``shown`` (m,).
        """
        pairs = self._pairs(state)
        sigma, n = self._sigma(pairs, state), pairs.of_scan
        weights = self._weights(pairs, sigma)
        share = self._independent(pairs, weights)
        A = self._motions(pairs, state)
        normal = np.einsum("nxp,nx->np", A[:n], pairs.normals[:n])
        if shown is not None:
            normal[:, np.flatnonzero(~shown[self.constraints.movable])] = 0
        H = share / sigma**2 * normal.T @ (weights[:, None] * normal)
        H += self._landmarks(state, self.derivatives_at(state))[0]
        count = int(self.constraints.movable.sum())
        # Eliminate motion and size, which are optimal for each code.
        rest = H[count:, count:] + 1e-9 * np.eye(len(H) - count) * H.diagonal().max()
        movable = self.constraints.movable
        found = np.zeros((len(movable), len(movable)))
        found[np.ix_(movable, movable)] = H[:count, :count] - H[:count, count:] @ np.linalg.solve(
            rest, H[count:, :count]
        )
        return found

    def surface(self, shape: FloatArray) -> MeshProximity:
        """Return the surface of a coarse shape (V, 3), on the mesh of this accuracy."""
        return MeshProximity(self._fine(shape), self._vertex_faces)

    def _fine(self, shapes: FloatArray) -> FloatArray:
        fine = self._decoder.finer(self._accuracy.mesh)
        return fine.prolong(shapes) if fine else shapes

    def _shape(self, code: FloatArray, near: FloatArray | None = None) -> FloatArray | None:
        self.count += 1
        shape = self._shapes(code, near)
        return shape if np.isfinite(shape).all() else None

    def _pairs(self, state: FitState) -> Pairs:
        """Return pairs of a state, kept as long as its placement; each state has its own placement."""
        if state.placement not in self._paired:
            self._paired[state.placement] = self._pairing.closest(self.surface(state.shape), state.placement)
        return self._paired[state.placement]

    def tolerance(self, sigma: float) -> float:
        """Return the largest distance from the surface at which a point counts as explained."""
        least = SETTINGS.near * self._diagonal
        return least + (min(3 * sigma, least) if self.constraints.noise is None else 3 * sigma)

    def shares(self, state: FitState) -> tuple[float, float]:
        """Return the share of the scan that is explained and the share of the model's area that is seen."""
        if self._shared is not None and self._shared[0] is state:
            return self._shared[1]
        surface = self.surface(state.shape)
        away = surface.closest(state.placement.back(self.scan.points)).distances
        explained = float((away <= self.tolerance(state.sigma)).mean())
        near, areas = self.at_scan(state)
        self._shared = state, (explained, float(areas @ near / areas.sum()))
        return self._shared[1]

    def at_scan(self, state: FitState) -> tuple[NDArray[np.bool_], FloatArray]:
        """Return whether vertices (V,) of the model lie at the scan, and the vertices' areas (V,)."""
        surface = self.surface(state.shape)
        away = self.scan.distances(state.placement(surface.vertices)) / state.placement.scale
        return away <= self.tolerance(state.sigma), vertex_areas(surface.vertices, surface.vertex_faces.faces)

    def _sigma(self, pairs: Pairs, state: FitState) -> float:
        """Return the standard deviation of the heights, from their median, which outliers do not affect."""
        floor = self._accuracy.floor * self._diagonal
        if self.constraints.noise is not None:
            return max(floor, self.constraints.noise / state.placement.scale)
        heights = np.abs(pairs.heights[: pairs.of_scan])
        alike = pairs.agree[: pairs.of_scan] > 0.5
        return max(floor, 1.4826 * float(np.median(heights[alike] if alike.any() else pairs.distances)))

    def _weights(self, pairs: Pairs, sigma: float) -> FloatArray:
        """Return robust weights (n,) of the scan's points."""
        n = pairs.of_scan
        return _robust(pairs.distances[:n], SETTINGS.width * sigma) * pairs.agree[:n]

    def _independent(self, pairs: Pairs, weights: FloatArray) -> float:
        """Return the share of the scan's points, with weights (n,), that count as independent observations.

        Where the model can't make the shape, it misses neighbouring points alike.
        """
        return independent_points(self._beside, pairs.heights[: pairs.of_scan], weights)

    @cached_property
    def _beside(self) -> IntArray:
        return neighbours(self._pairing.some.points)

    def _cost(self, state: FitState, pairs: Pairs) -> float:
        squares = pairs.distances**2
        missed = squares / (squares + (SETTINGS.compared * self._diagonal) ** 2)
        away = self.constraints.scores(state.code, self._decoder.latents)
        return float((pairs.mass * missed).sum() / pairs.mass.sum() + PLAUSIBLE * away @ away)

    def derivatives(self, state: FitState) -> VertexDerivatives:
        """Compute derivatives at a state. Raises NotPositiveDefiniteError."""
        moved = self._changes(self._decoder, state.code)[:, self.constraints.movable]
        fields = self.reconstruct.differential(state.shape, moved.T)
        moves = carried(self._decoder, self._fine, state.shape, fields)
        return VertexDerivatives(state.code, np.ascontiguousarray(np.moveaxis(moves, 0, -1)), self._accuracy.mesh)

    def derivatives_at(self, state: FitState) -> FloatArray:
        """Return derivatives (V, 3, f) of vertices by movable coordinates; cached while the code changes little."""
        last = self._last
        if (
            last is None
            or last.mesh is not self._accuracy.mesh
            or np.abs(self._whiten @ (state.code - last.code)).max() > self._accuracy.kept
        ):
            last = self._last = self.derivatives(state)
        return last.fields

    def _motions(self, pairs: Pairs, state: FitState) -> FloatArray:
        """Return derivatives (n, 3, f + 6 or 7) of the model's points by code, rotation, translation and size."""
        return np.concatenate([pairs.carried(self.derivatives_at(state)), self._rigid(pairs.places)], axis=2)

    def _rigid(self, places: FloatArray) -> FloatArray:
        """Return derivatives (n, 3, 6 or 7) of points (n, 3) by rotation, translation and size."""
        x, y, z = places.T
        o = np.zeros_like(x)
        turns = np.array([[o, z, -y], [-z, o, x], [y, -x, o]]).transpose(2, 0, 1)
        shifts = np.broadcast_to(np.eye(3), (len(places), 3, 3))
        return np.concatenate([turns, shifts, *([places[:, :, None]] if self.constraints.free else [])], axis=2)

    def _landmarks(self, state: FitState, fields: FloatArray) -> tuple[FloatArray, FloatArray]:
        constraints = self.constraints
        size = fields.shape[-1] + (7 if constraints.free else 6)
        if not len(constraints.landmarks):
            return np.zeros((size, size)), np.zeros(size)
        rows = self.landmark_rows()
        places = rows @ self._fine(state.shape)
        by_code = (rows @ fields.reshape(len(fields), -1)).reshape(len(places), 3, -1)
        A = np.concatenate([by_code, self._rigid(places)], axis=2).reshape(-1, size)
        gaps = (state.placement.back(constraints.places) - places).ravel()
        usual = SETTINGS.landmark * self._diagonal
        sigmas = np.where(np.isfinite(constraints.sigmas), constraints.sigmas / state.placement.scale, usual)
        weights = np.repeat(sigmas**-2.0, 3)
        return A.T @ (weights[:, None] * A), A.T @ (weights * gaps)

    def landmark_rows(self) -> sparse.csr_array:
        """Return the matrix (l, V) that computes landmarks as means of the mesh's vertices."""
        fine, vertices = self._decoder.finer(MeshChoice.FINE), self.constraints.landmarks
        count = len(self._vertex_faces.around)
        if fine and self._accuracy.mesh is MeshChoice.COARSE:
            return sparse.csr_array(fine.prolong.weights[vertices][:, :count])
        own = np.arange(len(vertices))
        return sparse.csr_array((np.ones(len(vertices)), (own, vertices)), shape=(len(vertices), count))

    def _step(self, state: FitState, pairs: Pairs, width: float, sigma: float, sliding: float) -> FitState | None:
        try:
            fields = self.derivatives_at(state)
        except NotPositiveDefiniteError:
            return None
        weights = _robust(pairs.distances, width) * pairs.agree * pairs.mass
        independent = self._accuracy.independent or self._independent(pairs, self._weights(pairs, sigma))
        weights *= independent * pairs.of_scan / sigma**2
        A = self._motions(pairs, state)
        size = A.shape[2]
        normal, flat = np.einsum("nxp,nx->np", A, pairs.normals), A.reshape(-1, size)
        share = np.where(pairs.drawn, 1.0, sliding)
        above, beside = (1 - share) * weights, share * weights
        H = normal.T @ (above[:, None] * normal) + flat.T @ (np.repeat(beside, 3)[:, None] * flat)
        g = normal.T @ (above * pairs.heights) + flat.T @ (beside[:, None] * pairs.gaps).ravel()
        for own, part in zip((H, g), self._landmarks(state, fields), strict=True):
            own += part
        prior, count = self._whiten[:, self.constraints.movable], fields.shape[-1]
        H[:count, :count] += prior.T @ prior
        g[:count] -= prior.T @ self.constraints.scores(state.code, self._decoder.latents)
        if not (np.isfinite(H).all() and np.isfinite(g).all()):  # networks overflow far outside the bounds
            return None
        try:
            step = self._inside(H, g, state.code)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        change = np.zeros(len(state.code))
        change[self.constraints.movable] = step[:count]
        score = self._whiten @ change
        longest = max(
            np.abs(score).max() / SETTINGS.longest, np.linalg.norm(step[count : count + 3]) / SETTINGS.turn, 1.0
        )
        step, change = step / longest, change / longest
        code = state.code + change
        predicted = state.shape + self._coarse_move(state, change)
        shape = self._shape(code, predicted)
        if shape is None:
            return None
        # The new shape is moved to where the derivatives have led: it was solved in another frame.
        led = align(shape, predicted)
        turn, shift = Rotation.from_rotvec(step[count : count + 3]).as_matrix(), step[count + 3 : count + 6]
        motion = Placement(turn, shift, float(np.exp(step[count + 6])) if self.constraints.free else 1.0)
        moved = float(np.abs(np.einsum("nxp,p->nx", A, step)).max()) / self._diagonal
        settled = bool(np.abs(score).max() <= SETTINGS.shortest or moved <= self._accuracy.still)
        return FitState(code, led, state.placement.after(motion), settled=settled, moved=moved)

    def _coarse_move(self, state: FitState, change: FloatArray) -> FloatArray:
        moves = self.derivatives_at(state) @ change[self.constraints.movable]
        fine = self._decoder.finer(self._accuracy.mesh)
        if fine is None:
            return moves
        known = fine.prolong.coarse_vertices
        return moves[known] if (known >= 0).all() else np.zeros_like(state.shape)

    def _inside(self, H: FloatArray, g: FloatArray, code: FloatArray) -> FloatArray:
        """Return the step ``H⁻¹ g``, with coordinates that would leave the box held at its sides."""
        constraints = self.constraints
        low, high = (
            side[constraints.movable] - code[constraints.movable] for side in (constraints.lower, constraints.upper)
        )
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
    """Return robust weights (n,) of distances (Geman and McClure 1987)."""
    return 1 / (1 + (distances / width) ** 2) ** 2
