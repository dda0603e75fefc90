"""Fitting: the code, the place and the size of a model's shape that explain a scan, without correspondence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.closest_points import MeshProximity, VertexFaces
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import Decoder, MeshChoice, Shape
from shapespace.model.latent_space import Bounds, Codes
from shapespace.model.placement import NARROW, WIDE, PlacementEffort, Start, coarse, evenly
from shapespace.model.population import Population
from shapespace.model.posterior import Posterior
from shapespace.model.scan import InvalidScanError, Scan, scan_of
from shapespace.model.search import FULL, ROUGH, Level, Options, Search, State
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

#: Start shapes: this many, chosen as far apart as possible from so many random ones; and sampled points of each.
STARTS, DRAWN, SHOWN = 16, 200, 150
#: Vertices of the model for which a nearest scan point is sought: on the coarse mesh, and on the fine mesh at the end.
LOOKING_ROUGHLY, LOOKING = 500, 2000
#: Iterations: of every start, then of the two best, then of the best one.
FIRST_STEPS, MORE_STEPS, LAST_STEPS = 4, 6, 10
#: Where a limb of the scan stays unmatched: attempts to move the model's limb there, the iterations of each, and how
#: many of these pull it by target points.
ATTEMPTS, ATTEMPT_STEPS, DRAWING = 4, 9, 4
#: A scan this many times larger or smaller than the model's shapes is taken to be in other units, unless its scale is
#: free; the second for scans of a part.
UNITS, UNITS_OF_PART = 3.0, 20.0
#: A fit is poor if a larger share of the scan than the first is far from the model, and a larger share of the model
#: than the second is far from the scan. Outliers raise only the first, holes only the second, a limb in the wrong place
#: both. The third is the limit of the first for a scan of a part.
MISSED, UNSEEN, MISSED_OF_PART = 0.015, 0.008, 0.03
#: A fit has not converged if its last step was longer than this fraction of the diagonal.
RESTLESS = 5e-3
#: A fit is ambiguous if another one differs by this mean distance, a fraction of the diagonal, and costs at most this
#: factor, plus this share, more.
ELSEWHERE, NEARLY, BESIDE = 0.05, 1.1, 3e-3
#: A scan counts as mirrored where its mirror image costs less than this share.
MIRRORED = 0.6
#: How many other fits are refined to the end if they are nearly as good as the best.
RIVALS = 2
#: Points whose distances are computed at once.
CHUNK = 50_000
#: Most landmarks.
LANDMARKS = 1000


class ScaleChoice(StrEnum):
    """Whether a scan has the size of the model's shapes, or a size that is to be found."""

    FIXED = "fixed"
    FREE = "free"


class Prior(StrEnum):
    """What codes are held to be like: those of the training shapes, or any in the bounds."""

    POPULATION = "population"
    BOX = "box"


class FitStatus(StrEnum):
    """How a fit ended: well, with another nearly as good, of no such shape, before it came to rest, too late."""

    CONVERGED = "converged"
    AMBIGUOUS = "ambiguous"
    POOR = "poor"
    STALLED = "stalled"
    DEADLINE = "deadline"


@dataclass(frozen=True)
class Landmark:
    """A vertex whose place on the scan is known.

    Attributes:
        vertex: index in the fine mesh.
        position: (3,) in the scan's units.
        sigma: standard deviation of the position there; by default a hundredth of the model's diagonal.
    """

    vertex: int
    position: Sequence[float]
    sigma: float | None = None


@dataclass(frozen=True)
class FitOptions:
    """What is asked for.

    Attributes:
        scale: whether the scan's size is that of the model's shapes.
        partial: whether the scan shows a part of the shape only, as from one camera.
        noise: standard deviation of the scan's points in its units; by default it is estimated.
        landmarks: vertices whose places are known; three or more decide where the search begins.
        fixed: values of coordinates that keep them, by index.
        prior: what codes are like.
        samples: codes to draw from the posterior.
        points: whether the distance of each point and of each vertex is wanted.
        used: whether the points that stood for the scan are wanted, to be shown beside the shape.
        seed: of all random numbers.
    """

    scale: ScaleChoice = ScaleChoice.FIXED
    partial: bool = False
    noise: float | None = None
    landmarks: Sequence[Landmark] = ()
    fixed: Mapping[int, float] | None = None
    prior: Prior = Prior.POPULATION
    samples: int = 0
    points: bool = False
    used: bool = False
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances in the scan's units.

    Attributes:
        mean, p95, max: over the points that count.
        points: (n,) each of them, where they were asked for.
    """

    mean: float
    p95: float
    max: float
    points: FloatArray | None = None

    @classmethod
    def of(cls, distances: FloatArray, points: FloatArray | None) -> Distances:
        """Of distances (n,)."""
        return cls(float(distances.mean()), float(np.quantile(distances, 0.95)), float(distances.max()), points)


@dataclass(frozen=True, eq=False)
class Fitted:
    """What explains a scan.

    Attributes:
        code: (m,), float32, as the networks take it.
        covariance: (m, m) of its coordinates given the scan (Laplace); zero in those that were fixed.
        placement: takes positions of ``shape`` to the scan's frame.
        shape: of the code, on the fine mesh, as ``mesh`` answers it.
        scan: distances of the scan's points from the shape.
        model: distances of the shape's vertices from the scan.
        explained: share of the scan that lies at the shape.
        seen: share of the shape's area that lies at the scan.
        noise: standard deviation of the scan about the shape, normal to it, in the scan's units.
        mirrored: cost of the best fit of the scan's mirror image as a share of its own, where it was looked for: a
            small one says that the scan is mirrored.
        status: how the fit ended.
        reason: the same in words.
        samples: (n, m) codes drawn from the posterior.
        sampled: whether the scan was brought to fewer points, or points were spread over its faces.
        used: (n, 4) the points that stood for the scan, in its units, and their distances from the shape, where they
            were asked for.
        solved, rough: shapes that were solved, and roughly computed ones, of which three cost as much as one.
    """

    code: Codes
    covariance: FloatArray
    placement: Placement
    shape: Shape
    scan: Distances
    model: Distances
    explained: float
    seen: float
    noise: float
    mirrored: float | None
    status: FitStatus
    reason: str
    samples: Codes
    sampled: bool
    used: FloatArray | None
    solved: int
    rough: int


class Fitter:
    """Fits a model to scans; may be used by several threads at once.

    A scan is brought to a few thousand points. It is placed on a few random shapes, in many rotations. From the best of
    these, closest points of both sides and Gauss–Newton steps of code, rotation, translation and scale together follow
    each other, with weights of distances (Geman and McClure) that narrow as the fit improves, first with shapes of
    frames and the factors' derivatives, then with answered shapes. Where parts of both sides remain without a
    counterpart, they are drawn to each other for a few steps.
    """

    def __init__(self, model: Decoder) -> None:
        self.model = model

    def __call__(
        self, points: FloatArray, faces: IntArray, options: FitOptions, deadline: Deadline | None = None
    ) -> Fitted:
        """The fit to a scan.

        Args:
            points: (N, 3) in any frame.
            faces: (F, 3), or none.
            options: what is asked for.
            deadline: after which the status is FitStatus.DEADLINE.

        Raises:
            InvalidScanError: a scan or options that can't be used.
            ModelFailedError: the networks failed.
        """
        return _Fit(self, points, faces, options, deadline)()

    @cached_property
    def reach(self) -> dict[MeshChoice, tuple[VertexFaces, IntArray]]:
        """VertexFaces and vertices that look for points, of each mesh."""
        return {
            choice: (VertexFaces(mesh.faces, len(mesh.vertices)), evenly(mesh.vertices, count))
            for choice, count in ((MeshChoice.COARSE, LOOKING_ROUGHLY), (MeshChoice.FINE, LOOKING))
            for mesh in (self.model.mesh(choice),)
        }

    @cached_property
    def shown(self) -> IntArray:
        """Coarse vertices that show where a shape is."""
        return evenly(self.model.reference.vertices, SHOWN)

    @cached_property
    def starts(self) -> tuple[FloatArray, FloatArray]:
        """Codes (k, m) and their shapes (k, V, 3), coarse and aligned, made at the first scan."""
        return self.shapes_of(self.codes({}))

    def codes(self, fixed: Mapping[int, float]) -> FloatArray:
        """(k, m) the mean, and codes far from each other, with some coordinates fixed."""
        population = self.model.population
        lower, upper = self.model.latents.box()
        drawn = np.concatenate([population.mean[None], np.clip(population.sample(DRAWN, 0), lower, upper)])
        for k, value in fixed.items():
            drawn[:, k] = value
        return drawn[evenly(population.scores(drawn), STARTS)]

    def shapes_of(self, codes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The codes (k, m) whose shapes are finite, and these (k, V, 3)."""
        with self.model.solver() as reconstruct:
            rough = SearchedShapes(self.model, reconstruct, None, rough=True)
            raw = np.stack([rough(code) for code in codes])
        finite = np.isfinite(raw).all(axis=(1, 2))
        if not finite.any():
            raise InvalidScanError("No shape has the fixed coordinates. Send values nearer to the bounds.")
        return codes[finite], self.model.placed(raw[finite], MeshChoice.COARSE)


class _Fit:
    """One fit."""

    def __init__(
        self, fitter: Fitter, points: FloatArray, faces: IntArray, options: FitOptions, deadline: Deadline | None
    ) -> None:
        self.model, self.fitter, self.asked, self.deadline = fitter.model, fitter, options, deadline
        self.points, self.unit = points, fitter.model.manifest.scale
        self.scan = scan_of(np.asarray(points, np.float64) / self.unit, faces, np.random.default_rng(options.seed))
        self.options = self._checked()
        self.free = options.scale is ScaleChoice.FREE

    def __call__(self) -> Fitted:
        fixed = self.asked.fixed or {}
        self.codes, self.shapes = self.fitter.shapes_of(self.fitter.codes(fixed)) if fixed else self.fitter.starts
        if not self.free:
            self._require_units()
        with self.model.solver() as reconstruct:
            rough = self._search(reconstruct, self.scan, self.options, ROUGH)
            best, others = self._roughly(rough, NARROW, *([WIDE] if self.options.partial else []))
            full = self._search(reconstruct, self.scan, self.options, FULL)
            final, rival = self._fully(full, best, others)
            ratio = None
            posterior = self._posterior(full, final)
            explained, seen = full.shares(final)
            if self._is_poor(explained, seen) and not self._late:
                flip = np.array([-1, 1, 1])
                scan = replace(self.scan, points=self.scan.points * flip, normals=self.scan.normals * flip)
                options = replace(self.options, places=self.options.places * flip)
                twin, _ = self._roughly(self._search(reconstruct, scan, options, ROUGH), NARROW)
                ratio = twin.cost / best.cost
        # The model lends its solver again for the shape that is answered.
        return self._answer(full, final, posterior, explained, seen, ratio, rival, rough.count)

    @property
    def _late(self) -> bool:
        return self.deadline is not None and self.deadline.passed

    def _checked(self) -> Options:
        """The options as a search takes them."""
        asked, latents, model = self.asked, self.model.latents, self.model
        count = len(model.mesh(MeshChoice.FINE).vertices)
        movable = ~latents.fixed(asked.fixed).mask
        if not movable.any():
            raise InvalidScanError("fixed names all coordinates. Leave at least one to be found.")
        if asked.noise is not None and not 0 < asked.noise < float(np.finfo(np.float32).max):
            raise InvalidScanError("noise must be a positive number, the standard deviation in the scan's units.")
        if len(asked.landmarks) > LANDMARKS:
            raise InvalidScanError(f"There are {len(asked.landmarks)} landmarks. Send {LANDMARKS} at most.")
        for i, landmark in enumerate(asked.landmarks):
            if not 0 <= landmark.vertex < count:
                raise InvalidScanError(
                    f"landmarks[{i}].vertex is {landmark.vertex}, but the fine mesh has vertices 0 to {count - 1}."
                )
            if not (len(landmark.position) == 3 and np.abs(landmark.position).max() < np.finfo(np.float32).max):
                raise InvalidScanError(f"landmarks[{i}].position must be three finite numbers.")
            if landmark.sigma is not None and not 0 < landmark.sigma < np.inf:
                raise InvalidScanError(f"landmarks[{i}].sigma must be a positive number.")
        boxed = asked.prior is Prior.BOX
        lower, upper = latents.box(0.0 if boxed else 0.5)
        return Options(
            partial=asked.partial,
            free=asked.scale is ScaleChoice.FREE,
            noise=None if asked.noise is None else asked.noise / self.unit,
            landmarks=np.array([landmark.vertex for landmark in asked.landmarks], np.int64),
            places=np.array([landmark.position for landmark in asked.landmarks]).reshape(-1, 3) / self.unit,
            sigmas=np.array([(landmark.sigma or np.inf) / self.unit for landmark in asked.landmarks]),
            movable=movable,
            prior=Population.in_box(latents.lower, latents.upper) if boxed else model.population,
            lower=lower,
            upper=upper,
        )

    def _require_units(self) -> None:
        sizes = np.sqrt(self.shapes.var(axis=1).sum(axis=1))
        ratio = self.scan.size / float(np.median(sizes))
        if not 1 / (UNITS_OF_PART if self.asked.partial else UNITS) <= ratio <= UNITS:
            raise InvalidScanError(
                f"The scan is about {ratio:.3g} times as large as the shapes of {self.model.manifest.name}. "
                f"Send scale=free, or multiply its coordinates by about {1 / ratio:.3g}."
            )

    def _search(self, reconstruct: Reconstructor, scan: Scan, options: Options, level: Level) -> Search:
        fans, looking = self.fitter.reach[level.mesh]
        return Search(self.model, reconstruct, scan, options, level, fans, looking, self.deadline)

    def _placed(self, search: Search, breadth: PlacementEffort) -> list[Start]:
        """Where a search begins."""
        options = search.options
        if len(options.landmarks) < 3:
            shown = self.shapes[:, self.fitter.shown]
            return coarse(search.scan, shown, partial=options.partial, free=self.free, breadth=breadth)
        rows, starts = search.landmark_rows(), list[Start]()
        for k, shape in enumerate(self.shapes):
            own = rows @ shape
            placement = Placement.between(own, options.places, scaled=self.free)
            if placement.scale > 0:
                starts.append(Start(k, placement, float(np.linalg.norm(placement(own) - options.places))))
        if not starts:
            raise InvalidScanError("All landmarks lie at one place, which tells no size. Send others, or scale=fixed.")
        return sorted(starts, key=lambda start: start.score)[: breadth.count]

    def _roughly(self, search: Search, *breadths: PlacementEffort) -> tuple[State, list[State]]:
        """The best fit of rough shapes, and others; from more places where those of the first breadth give none."""
        states: list[State] = []
        for breadth in breadths:
            states = sorted([*states, *self._followed(search, breadth)], key=lambda state: state.cost)
            for k in range(ATTEMPTS):
                if self._late or not self._is_poor(*search.shares(states[0])):
                    return states[0], states[1:]
                # The best once more, what came of that, and then the others.
                base = states[0] if k < 2 or k - 1 >= len(states) else states[k - 1]
                again = search.run(base, ATTEMPT_STEPS, first=False, drawn=DRAWING)
                if again.cost < states[0].cost:
                    states[0] = again
        return states[0], states[1:]

    def _followed(self, search: Search, breadth: PlacementEffort) -> list[State]:
        """Fits of rough shapes from so many places, the best first."""
        begun = [
            search.start(self.codes[start.shape], start.placement, self.shapes[start.shape])
            for start in self._placed(search, breadth)
        ]
        states = [search.run(state, FIRST_STEPS, first=True) for state in begun if state is not None]
        states.sort(key=lambda state: state.cost)
        states[:2] = [search.run(state, MORE_STEPS, first=True) for state in states[:2]]
        return sorted(states, key=lambda state: state.cost)

    def _fully(self, search: Search, best: State, others: list[State]) -> tuple[State, State | None]:
        """The best fit of answered shapes, and another that is nearly as good, if there is one."""
        begun = search.start(best.code, best.placement, best.shape)
        if begun is None:
            return best, None
        final = search.run(begun, LAST_STEPS, first=False)
        if not self._late and self._is_poor(*search.shares(final)):
            again = search.run(final, LAST_STEPS, first=False, drawn=DRAWING)
            final = again if again.cost < final.cost else final
        for other in others[:RIVALS]:
            if self._late or self._apart(other, best) < ELSEWHERE or other.cost > 1.5 * best.cost + BESIDE:
                continue
            begun = search.start(other.code, other.placement, other.shape)
            if begun is None:
                continue
            rival = search.run(begun, LAST_STEPS // 2, first=False)
            if self._apart(rival, final) > ELSEWHERE and rival.cost <= NEARLY * final.cost + BESIDE:
                return (rival, final) if rival.cost < final.cost else (final, rival)
        return final, None

    def _apart(self, one: State, other: State) -> float:
        """Mean distance of vertices, as a fraction of the diagonal."""
        away = one.placement(one.shape) - other.placement(other.shape)
        return float(np.linalg.norm(away, axis=1).mean() / one.placement.scale / self.model.reference.diagonal)

    def _posterior(self, search: Search, state: State) -> Posterior:
        prior, fixed = self.options.prior, ~self.options.movable
        try:
            return Posterior.of(search.normal(state), prior, fixed)
        except (NotPositiveDefiniteError, ValueError):  # LinAlgError too
            # Without derivatives nothing but the prior is known.
            return Posterior.of(np.zeros_like(prior.covariance), prior, fixed)

    def _is_poor(self, explained: float, seen: float) -> bool:
        if self.options.partial:
            return 1 - explained > MISSED_OF_PART
        return 1 - explained > MISSED and 1 - seen > UNSEEN

    def _answer(
        self,
        search: Search,
        state: State,
        posterior: Posterior,
        explained: float,
        seen: float,
        mirrored: float | None,
        rival: State | None,
        rough: int,
    ) -> Fitted:
        model, asked = self.model, self.asked
        code, inside = model.latents.code(state.code.tolist(), Bounds.ALLOW)
        shape = model.shape(code, inside, MeshChoice.FINE, self.deadline)
        there = state.placement(search.surface(state.shape).vertices)
        # The size is the search's own; between two shapes of one size only the motion is to be found.
        scale = state.placement.scale
        placed = Placement.between(scale * shape.vertices, self.unit * there)
        placement = Placement(placed.rotation, placed.translation, scale)
        surface = MeshProximity(placement(shape.vertices), search.surface(state.shape).fans)
        to_model = surface.closest(self.unit * self.scan.points).distances
        to_scan = self.unit * self.scan.distances(surface.vertices / self.unit)
        parts = np.array_split(self.points, -(-len(self.points) // CHUNK)) if asked.points else []
        found = [surface.closest(part).distances for part in parts if not self._late]
        every = np.concatenate(found) if found and len(found) == len(parts) else None
        status, reason = self._status(state, explained, seen, mirrored, rival, shape)
        return Fitted(
            code=code,
            covariance=posterior.covariance,
            placement=placement,
            shape=shape,
            scan=Distances.of(to_model, every),
            model=Distances.of(to_scan, to_scan if asked.points else None),
            explained=explained,
            seen=seen,
            noise=self.unit * scale * state.sigma,
            mirrored=mirrored,
            status=status,
            reason=reason,
            samples=posterior.sample(model.latents, code, asked.samples, asked.seed),
            sampled=self.scan.sampled,
            used=np.column_stack([self.unit * self.scan.points, to_model]) if asked.used else None,
            solved=search.count + 1,
            rough=rough,
        )

    def _status(
        self, state: State, explained: float, seen: float, mirrored: float | None, rival: State | None, shape: Shape
    ) -> tuple[FitStatus, str]:
        """How the fit ended, and the same in words."""
        shares = f"{explained:.0%} of the scan lie at the model, {seen:.0%} of the model at the scan"
        if self._late or shape.diagnostics.status is Status.DEADLINE:
            status, reason = FitStatus.DEADLINE, f"The time was over before the fit was done: {shares} so far."
        elif self._is_poor(explained, seen):
            status, reason = FitStatus.POOR, f"Only {shares}: the scan is no such shape, or the search went astray."
            if mirrored is not None and mirrored < MIRRORED:
                reason += " Its mirror image fits much better: change the sign of one coordinate."
            elif not self.options.partial:
                reason += " Send partial=true if it shows a part only, or three landmarks."
        elif rival is not None:
            status = FitStatus.AMBIGUOUS
            apart = self._apart(rival, state)
            reason = f"{shares}, but another fit, {apart:.0%} of the diagonal away on average, is nearly as good."
        elif state.moved > RESTLESS:
            status = FitStatus.STALLED
            reason = f"{shares}, but the last step still moved the model by {state.moved:.1%} of the diagonal."
        else:
            status, reason = FitStatus.CONVERGED, f"{shares}."
        if self.scan.sampled:
            reason += f" Of {self.scan.given} points, {len(self.scan.points)} spread evenly over the scan were used."
        return status, reason
