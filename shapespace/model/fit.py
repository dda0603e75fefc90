"""Fitting: the code, the placement and the size of a model's shape that explain a scan without correspondence."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.closest_points import MeshProximity, VertexFaces
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.feature_search import FeatureSearch
from shapespace.model.fit_constraints import FitConstraints
from shapespace.model.fit_result import Distances, FitState, FitStatus, Fitted, VertexDerivatives
from shapespace.model.fit_search import MIDDLE, ROUGH, SOLVED, FitSearch, SearchAccuracy
from shapespace.model.fit_settings import SETTINGS
from shapespace.model.latent_space import Bounds
from shapespace.model.options import FitOptions
from shapespace.model.placement import QUICK, THOROUGH, PlacementEffort, StartPlacement, evenly, start_placements
from shapespace.model.posterior import Posterior
from shapespace.model.scan import InvalidScanError, Scan, scan_of
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.model.shape import Shape
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

#: Number of points whose distances are computed at once.
CHUNK = 50_000
#: Shares of a fit's time, about: after the start shapes, the search with rough shapes, and the first and all steps with
#: solved shapes.
BEGUN, PLACED, NEARLY, REFINED = 0.05, 0.55, 0.7, 0.9


class Fitter:
    """Fits a model to scans; several threads may use it at once.

    The fit reduces a scan to a few thousand points and places random shapes on it in many rotations. From the best
    placements it alternates between closest points of both sides and Gauss–Newton steps of code, rotation, translation
    and scale together. The robust weights of distances (Geman and McClure) narrow as the fit improves. The first steps
    use rough shapes and the factors' derivatives, the last steps solved shapes. Where parts of both sides remain
    unmatched, a few steps pull these parts together.
    """

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder
        self._features: FeatureSearch | None = None

    def __call__(
        self,
        points: FloatArray,
        faces: IntArray,
        options: FitOptions,
        deadline: Deadline | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Fitted:
        """Fit the model to a scan.

        Args:
            points: (N, 3) points in any frame.
            faces: (F, 3) faces; F may be 0.
            options: options of the fit.
            deadline: time limit; a fit that exceeds it has FitStatus.DEADLINE.
            progress: called with the share of the work that is done, in this thread.

        Raises:
            InvalidScanError: a scan or an option that can't be used.
            LatentError: fixed coordinates that the model doesn't have, or with which numbers overflow.
            ModelFailedError: the networks failed.
        """
        return _Fit(self, points, faces, options, deadline, progress or (lambda _: None))()

    @cached_property
    def reach(self) -> dict[MeshChoice, tuple[VertexFaces, IntArray]]:
        """For each mesh, the faces around its vertices, and vertices that look for points."""
        return {
            choice: (VertexFaces(mesh.faces, len(mesh.vertices)), evenly(mesh.vertices, count))
            for choice, count in (
                (MeshChoice.COARSE, SETTINGS.coarse_vertices),
                (MeshChoice.FINE, SETTINGS.fine_vertices),
            )
            for mesh in (self.decoder.mesh(choice),)
        }

    @cached_property
    def shown(self) -> IntArray:
        """Evenly spread coarse vertices, which represent a shape in the search for placements."""
        return evenly(self.decoder.reference.vertices, SETTINGS.shape_points)

    @cached_property
    def starts(self) -> tuple[FloatArray, FloatArray]:
        """Start codes (k, m) and their shapes (k, V, 3), coarse and aligned; made at the first scan."""
        return self.shapes_of(self.codes({}))

    @cached_property
    def start_derivatives(self) -> dict[int, VertexDerivatives]:
        """Derivatives at start codes, by their index, as earlier fits have computed them."""
        return {}

    def features(self, reconstruct: Reconstructor) -> FeatureSearch:
        """Return the search for features that move around a shape; made at the first scan."""
        if self._features is None:
            self._features = FeatureSearch.of(self.decoder, reconstruct)
        return self._features

    def codes(self, fixed: Mapping[int, float]) -> FloatArray:
        """Return the mean code and codes far apart from each other, (k, m), with some coordinates fixed."""
        population = self.decoder.population
        lower, upper = self.decoder.latents.box()
        drawn = np.concatenate(
            [population.mean[None], np.clip(population.sample(SETTINGS.random_shapes, 0), lower, upper)]
        )
        for k, value in fixed.items():
            drawn[:, k] = value
        return drawn[evenly(population.scores(drawn), SETTINGS.start_shapes)]

    def shapes_of(self, codes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the codes (k, m) whose shapes are finite, with these shapes (k, V, 3)."""
        with self.decoder.solver() as reconstruct:
            rough = SearchedShapes(self.decoder, reconstruct, None, rough=True)
            raw = np.stack([rough(code) for code in codes])
        finite = np.isfinite(raw).all(axis=(1, 2))
        if not finite.any():
            raise InvalidScanError("No shape has the fixed coordinates. Send values nearer to the bounds.")
        return codes[finite], self.decoder.placed(raw[finite], MeshChoice.COARSE)


class _Fit:
    """Fit to one scan; arguments as for Fitter."""

    def __init__(
        self,
        fitter: Fitter,
        points: FloatArray,
        faces: IntArray,
        options: FitOptions,
        deadline: Deadline | None,
        progress: Callable[[float], None],
    ) -> None:
        self.progress, self.done = progress, 0.0
        self.decoder, self.fitter, self.options, self.deadline = fitter.decoder, fitter, options, deadline
        self.searching = deadline and deadline.for_searching()
        self.points, self.unit = points, fitter.decoder.manifest.scale
        self.scan = scan_of(np.asarray(points, np.float64) / self.unit, faces, np.random.default_rng(options.seed))
        self.constraints = FitConstraints.of(options, fitter.decoder)

    def __call__(self) -> Fitted:
        fixed = self.options.fixed
        self.codes, self.shapes = self.fitter.shapes_of(self.fitter.codes(fixed)) if fixed else self.fitter.starts
        if not self.constraints.free:
            self._require_units()
        self._reach(BEGUN)
        with self.decoder.solver() as reconstruct:
            rough = self._search(reconstruct, self.scan, self.constraints, ROUGH)
            self.features = self.fitter.features(reconstruct)
            best, others = self._roughly(rough, QUICK, *([THOROUGH] if self.constraints.partial else []))
            full = self._search(reconstruct, self.scan, self.constraints, SOLVED)
            middle = self._search(reconstruct, self.scan, self.constraints, MIDDLE)
            final, rival = self._fully(middle, full, best, others)
            self._reach(REFINED)
            self.ended = self._late
            ratio = None
            posterior = self._posterior(full, final)
            explained, seen = full.shares(final)
            if self._is_poor(explained, seen) and not self._late:
                flip = np.array([-1, 1, 1])
                scan = replace(self.scan, points=self.scan.points * flip, normals=self.scan.normals * flip)
                constraints = replace(self.constraints, places=self.constraints.places * flip)
                twin, _ = self._roughly(self._search(reconstruct, scan, constraints, ROUGH), QUICK, limit=best.cost)
                ratio = twin.cost / best.cost
        # The solver is returned first: decoding the result needs a solver too.
        counts = full.count + middle.count, rough.count
        return self._answer(full, final, posterior, explained, seen, ratio, rival, counts)

    def _reach(self, share: float) -> None:
        """Tell that a share of the work is done; further attempts at a poor fit do not lower it."""
        if share > self.done:
            self.done = share
            self.progress(share)

    @property
    def _late(self) -> bool:
        return self.searching is not None and self.searching.passed

    def _require_units(self) -> None:
        sizes = np.sqrt(self.shapes.var(axis=1).sum(axis=1))
        ratio = self.scan.size / float(np.median(sizes))
        if not 1 / (SETTINGS.units_of_part if self.options.partial else SETTINGS.units) <= ratio <= SETTINGS.units:
            raise InvalidScanError(
                f"The scan is about {ratio:.3g} times as large as the shapes of {self.decoder.manifest.name}. "
                f"Send scale=free, or multiply its coordinates by about {1 / ratio:.3g}."
            )

    def _search(
        self, reconstruct: Reconstructor, scan: Scan, constraints: FitConstraints, accuracy: SearchAccuracy
    ) -> FitSearch:
        vertex_faces, looking = self.fitter.reach[accuracy.mesh]
        return FitSearch(self.decoder, reconstruct, scan, constraints, accuracy, vertex_faces, looking, self.searching)

    def _placed(self, search: FitSearch, effort: PlacementEffort) -> list[StartPlacement]:
        """Return the placements at which a search begins, the best first."""
        constraints = search.constraints
        if len(constraints.landmarks) < 3:
            shown = self.shapes[:, self.fitter.shown]
            return start_placements(
                search.scan, shown, partial=constraints.partial, free=constraints.free, effort=effort
            )
        rows, starts = search.landmark_rows(), list[StartPlacement]()
        for k, shape in enumerate(self.shapes):
            own = rows @ shape
            placement = Placement.between(own, constraints.places, scaled=constraints.free)
            if placement.scale > 0:
                starts.append(StartPlacement(k, placement, float(np.linalg.norm(placement(own) - constraints.places))))
        if not starts:
            raise InvalidScanError(
                "All landmarks lie at one place, so the size is unknown. Send landmarks at "
                "different places, or scale=fixed."
            )
        return sorted(starts, key=lambda start: start.score)[: effort.count]

    def _roughly(
        self, search: FitSearch, *efforts: PlacementEffort, limit: float = np.inf
    ) -> tuple[FitState, list[FitState]]:
        """Return the best fit with rough shapes, and other fits.

        The next effort follows only if all fits are poor. A best fit that costs more than ``limit`` gets no attempts.
        """
        states: list[FitState] = []
        base: FitState | None = None
        for effort in efforts:
            states = sorted([*states, *self._followed(search, effort)], key=lambda state: state.cost)
            states[0] = search.with_moved_feature(states[0], self.features, SETTINGS.attempt_steps)
            for k in range(SETTINGS.attempts):
                if self._late or states[0].cost > limit or not self._is_poor(*search.shares(states[0])):
                    return states[0], states[1:]
                # Continue twice from the best fit, then from the other fits.
                before, base = base, states[0] if k < 2 or k - 1 >= len(states) else states[k - 1]
                if base is not before:  # otherwise it would end in the same place
                    again = search.run(base, SETTINGS.attempt_steps, first=False, drawn=SETTINGS.drawn_steps)
                    again = search.with_moved_feature(again, self.features, SETTINGS.attempt_steps)
                    states[0] = min(states[0], again, key=lambda state: state.cost)
        return states[0], states[1:]

    def _followed(self, search: FitSearch, effort: PlacementEffort) -> list[FitState]:
        """Return fits with rough shapes from the start placements, the best first."""
        states = [self._start(search, start) for start in self._placed(search, effort)]
        done, most = 0, sum(max(2, round(part * len(states))) * steps for part, steps in SETTINGS.rounds)
        for part, steps in SETTINGS.rounds:
            some = states[: max(2, round(part * len(states)))]
            if part == 0 and some[-1].cost > SETTINGS.behind * some[0].cost:
                some.pop()
            for k, state in enumerate(some):
                states[k] = search.run(state, steps, first=True)
                done += steps
                self._reach(BEGUN + (PLACED - BEGUN) * done / most)
            states.sort(key=lambda state: state.cost)
        return states

    def _start(self, search: FitSearch, start: StartPlacement) -> FitState:
        """Return the state at a start placement, with derivatives that an earlier fit may have computed."""
        k = start.shape
        state = FitState(self.codes[k], self.shapes[k], start.placement)
        known = {} if self.options.fixed else self.fitter.start_derivatives
        if k not in known:
            try:
                known[k] = search.derivatives(state)
            except NotPositiveDefiniteError:
                return state
        return replace(state, derivatives=known[k])

    def _fully(
        self, middle: FitSearch, search: FitSearch, best: FitState, others: list[FitState]
    ) -> tuple[FitState, FitState | None]:
        """Return the best fit with solved shapes, and another fit that is nearly as good, if there is one."""
        begun = middle.start(best.code, best.placement, best.shape)
        if begun is None:
            return best, None
        self._reach(PLACED)
        nearly = middle.run(begun, SETTINGS.middle_steps, first=False)
        self._reach(NEARLY)
        final = search.run(nearly, SETTINGS.last_steps, first=False)
        if not self._late and self._is_poor(*search.shares(final)):
            again = middle.with_moved_feature(middle.run(final, 0, first=False), self.features, SETTINGS.again_steps)
            if self._is_poor(*middle.shares(again)):
                again = middle.run(again, SETTINGS.again_steps, first=False, drawn=SETTINGS.drawn_steps)
            again = search.run(again, SETTINGS.last_steps, first=False)
            final = again if again.cost < final.cost else final
        for other in others[: SETTINGS.rivals]:
            if (
                self._late
                or self._apart(other, best) < SETTINGS.elsewhere
                or other.cost > 1.5 * best.cost + SETTINGS.beside
            ):
                continue
            begun = search.start(other.code, other.placement, other.shape)
            if begun is None:
                continue
            rival = search.run(begun, SETTINGS.last_steps - 1, first=False)
            as_good = rival.cost <= SETTINGS.nearly * final.cost + SETTINGS.beside
            if as_good and self._apart(rival, final) > SETTINGS.elsewhere:
                return (rival, final) if rival.cost < final.cost else (final, rival)
        return final, None

    def _apart(self, one: FitState, other: FitState) -> float:
        """Return the mean distance of vertices, as a fraction of the diagonal."""
        away = one.placement(one.shape) - other.placement(other.shape)
        return float(np.linalg.norm(away, axis=1).mean() / one.placement.scale / self.decoder.reference.diagonal)

    def _posterior(self, search: FitSearch, state: FitState) -> Posterior:
        prior, fixed = self.constraints.prior, ~self.constraints.movable
        try:
            return Posterior.of(search.normal(state), prior, fixed)
        except (NotPositiveDefiniteError, ValueError):  # ValueError includes LinAlgError
            # Without derivatives only the prior is known.
            return Posterior.of(np.zeros_like(prior.covariance), prior, fixed)

    def _is_poor(self, explained: float, seen: float) -> bool:
        if self.constraints.partial:
            return 1 - explained > SETTINGS.missed_of_part
        return 1 - explained > SETTINGS.missed and 1 - seen > SETTINGS.unseen

    def _answer(
        self,
        search: FitSearch,
        state: FitState,
        posterior: Posterior,
        explained: float,
        seen: float,
        mirrored: float | None,
        rival: FitState | None,
        counts: tuple[int, int],
    ) -> Fitted:
        decoder, options = self.decoder, self.options
        code, inside = decoder.latents.code(state.code.tolist(), Bounds.ALLOW)
        shape = decoder.shape(code, inside, MeshChoice.FINE, self.deadline)
        there = state.placement(search.surface(state.shape).vertices)
        # The scale is the search's. Only the rigid motion between the two shapes remains to be found.
        scale = state.placement.scale
        placed = Placement.between(scale * shape.vertices, self.unit * there)
        placement = Placement(placed.rotation, placed.translation, scale)
        surface = MeshProximity(placement(shape.vertices), search.surface(state.shape).vertex_faces)
        to_model = surface.closest(self.unit * self.scan.points).distances
        to_scan = self.unit * self.scan.distances(surface.vertices / self.unit)
        parts = np.array_split(self.points, -(-len(self.points) // CHUNK)) if options.points else []
        found = [surface.closest(part).distances for part in parts if not (self.deadline and self.deadline.passed)]
        every = np.concatenate(found) if found and len(found) == len(parts) else None
        status, reason = self._status(state, explained, seen, mirrored, rival, shape)
        return Fitted(
            code=code,
            covariance=posterior.covariance,
            placement=placement,
            shape=shape,
            scan=Distances.of(to_model, every),
            model=Distances.of(to_scan, to_scan if options.points else None),
            explained=explained,
            seen=seen,
            noise=self.unit * scale * state.sigma,
            mirrored=mirrored,
            status=status,
            reason=reason,
            samples=posterior.sample(decoder.latents, code, options.samples, options.seed),
            sampled=self.scan.sampled,
            used=np.column_stack([self.unit * self.scan.points, to_model]) if options.used else None,
            solved=counts[0] + 1,
            rough=counts[1],
        )

    def _status(
        self,
        state: FitState,
        explained: float,
        seen: float,
        mirrored: float | None,
        rival: FitState | None,
        shape: Shape,
    ) -> tuple[FitStatus, str]:
        """Return how the fit ended, and the reason in words."""
        shares = f"{explained:.0%} of the scan lie at the model, {seen:.0%} of the model at the scan"
        if self.ended or shape.diagnostics.status is Status.DEADLINE:
            status = FitStatus.DEADLINE
            reason = f"The time ended before the fit converged: {shares} so far. Send fewer points or a coarser scan."
        elif self._is_poor(explained, seen):
            status = FitStatus.POOR
            reason = f"Only {shares}: the scan is not a shape of this model, or the search failed."
            if mirrored is not None and mirrored < SETTINGS.mirrored:
                reason += " Its mirror image fits much better: change the sign of one coordinate."
            elif not self.constraints.partial:
                reason += " Send partial=true if it shows a part only, or three landmarks."
        elif rival is not None:
            status = FitStatus.AMBIGUOUS
            apart = self._apart(rival, state)
            reason = f"{shares}, but another fit, {apart:.0%} of the diagonal away on average, is nearly as good."
        elif state.moved > SETTINGS.restless:
            status = FitStatus.STALLED
            reason = f"{shares}, but the last step still moved the model by {state.moved:.1%} of the diagonal."
        else:
            status, reason = FitStatus.CONVERGED, f"{shares}."
        if self.scan.sampled:
            reason += f" {self.scan.replaced}"
        return status, reason
