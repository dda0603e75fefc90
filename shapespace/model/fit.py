"""Fitting: the code, the placement and the size of a model's shape that explain a scan without correspondence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.closest_points import MeshProximity
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.fit_constraints import FitConstraints
from shapespace.model.fit_preparation import FitPreparation, StartShapes
from shapespace.model.fit_result import Distances, FitState, Fitted
from shapespace.model.fit_search import MIDDLE, ROUGH, SOLVED, FitSearch, SearchAccuracy
from shapespace.model.fit_settings import SETTINGS, Attempt
from shapespace.model.fit_uncertainty import Doubt, posterior_of
from shapespace.model.fit_verdict import FitVerdict, is_poor
from shapespace.model.latent_space import Bounds
from shapespace.model.options import FitOptions
from shapespace.model.part_exchange import SHORT, ShapeJudge
from shapespace.model.placement import MORE, QUICK, THOROUGH, PlacementEffort, StartPlacement, start_placements
from shapespace.model.posterior import Posterior
from shapespace.model.scan import InvalidScanError, Scan, scan_of
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
    use rough shapes and the factors' derivatives, the last steps solved shapes.

    For a scan of a part, some steps then look from the model to the scan too.

    While the result is poor, the fit makes further attempts (SETTINGS.attempts). A few steps pull unmatched parts of
    both sides together. Factors get the parts of other codes. Or the fit begins again with more rotations and with the
    training shapes. A scan of a part may hide a limb, so there training shapes are compared with every result.
    """

    def __init__(self, decoder: Decoder) -> None:
        self._prepared = FitPreparation(decoder)

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
        return _Fit(self._prepared, points, faces, options, deadline, progress or (lambda _: None))()


class _Fit:
    """Fit to one scan; other arguments as for Fitter."""

    def __init__(
        self,
        prepared: FitPreparation,
        points: FloatArray,
        faces: IntArray,
        options: FitOptions,
        deadline: Deadline | None,
        progress: Callable[[float], None],
    ) -> None:
        self.progress, self.done = progress, 0.0
        self.decoder, self.prepared, self.options, self.deadline = prepared.decoder, prepared, options, deadline
        self.searching = deadline and deadline.for_searching()
        self.points, self.unit = points, self.decoder.manifest.scale
        self.scan = scan_of(np.asarray(points, np.float64) / self.unit, faces, np.random.default_rng(options.seed))
        self.constraints = FitConstraints.of(options, self.decoder)
        if self.constraints.free:
            # In the search a scan in any units has about the size of a shape.
            stretch = self.scan.size / prepared.starts.size
            self.scan, self.unit = replace(self.scan, points=self.scan.points / stretch), self.unit * stretch
            self.constraints = self.constraints.in_units(stretch)

    def __call__(self) -> Fitted:
        fixed = self.options.fixed
        self.starts = self.prepared.shapes_of(self.prepared.codes(fixed)) if fixed else self.prepared.starts
        self.remembered = None if fixed else self.prepared.remembered
        if not self.constraints.free:
            self._require_units()
        self._reach(BEGUN)  # a scan that is refused has told nothing
        with self.decoder.solver() as reconstruct:
            rough, middle, full = (
                self._search(reconstruct, self.scan, self.constraints, accuracy) for accuracy in (ROUGH, MIDDLE, SOLVED)
            )
            self.features = self.prepared.features(reconstruct)
            best, others = self._roughly(rough, QUICK)
            self._reach(PLACED)
            near = self._solved(middle, best)
            if self.constraints.partial and not self._late:
                near = self._from_both_sides(rough, middle, near)
            near = self._insistently(rough, middle, near)
            if self.constraints.partial and not self._late:
                near, others = self._with_memory(middle, near, others)
            self._reach(NEARLY)
            final, rival = self._against_rivals(full, full.run(near, SETTINGS.last_steps, first=False), best, others)
            self._reach(REFINED)
            self.ended = self._late
            ratio = None
            doubt = Doubt.about(full, final, self.decoder)
            if doubt and not self._late:
                final, doubt = doubt.tested(middle, full, final, self.decoder)
                self.ended = self._late
            posterior = posterior_of(full, final)
            explained, seen = full.shares(final)
            if self._is_poor(explained, seen) and not self._late:
                flip = np.array([-1, 1, 1])
                scan = replace(self.scan, points=self.scan.points * flip, normals=self.scan.normals * flip)
                constraints = replace(self.constraints, places=self.constraints.places * flip)
                twin, _ = self._roughly(self._search(reconstruct, scan, constraints, ROUGH), QUICK)
                ratio = twin.cost / best.cost
            verdict = FitVerdict(
                explained=explained,
                seen=seen,
                moved=final.moved,
                mirrored=ratio,
                apart=None if rival is None else self._apart(rival, final),
                doubt=doubt,
                partial=self.constraints.partial,
                free=self.constraints.free,
            )
            counts = full.count + middle.count, rough.count
        # The solver is returned first: decoding the result needs a solver too.
        return self._answer(full, final, posterior, verdict, counts)

    @property
    def _late(self) -> bool:
        return self.searching is not None and self.searching.passed

    def _reach(self, share: float) -> None:
        """Tell that a share of the work is done; further attempts at a poor fit do not lower it."""
        if share > self.done:
            self.done = share
            self.progress(share)

    def _require_units(self) -> None:
        ratio = self.scan.size / self.starts.size
        if not 1 / (SETTINGS.units_of_part if self.options.partial else SETTINGS.units) <= ratio <= SETTINGS.units:
            raise InvalidScanError(
                f"The scan is about {ratio:.3g} times as large as the shapes of {self.decoder.manifest.name}. "
                f"Set scale=free, or multiply its coordinates by about {1 / ratio:.3g}."
            )

    def _search(
        self, reconstruct: Reconstructor, scan: Scan, constraints: FitConstraints, accuracy: SearchAccuracy
    ) -> FitSearch:
        vertex_faces, looking = self.prepared.reach[accuracy.mesh]
        return FitSearch(self.decoder, reconstruct, scan, constraints, accuracy, vertex_faces, looking, self.searching)

    def _placed(self, search: FitSearch, effort: PlacementEffort, shapes: FloatArray) -> list[StartPlacement]:
        """Return the placements of shapes (k, V, 3) at which a search begins, the best first."""
        constraints = search.constraints
        if len(constraints.landmarks) < 3:
            shown = shapes[:, self.prepared.shown[: effort.shape_points]]
            return start_placements(
                search.scan,
                shown,
                partial=constraints.partial,
                free=constraints.free,
                effort=effort,
                deadline=self.searching,
            )
        rows, starts = search.landmark_rows(), list[StartPlacement]()
        for k, shape in enumerate(shapes):
            own = rows @ shape
            placement = Placement.between(own, constraints.places, scaled=constraints.free)
            if placement.scale > 0:
                starts.append(StartPlacement(k, placement, float(np.linalg.norm(placement(own) - constraints.places))))
        if not starts:
            raise InvalidScanError(
                "All landmarks lie at one place, so the size is unknown. Give landmarks at "
                "different places, or scale=fixed."
            )
        return sorted(starts, key=lambda start: start.score)[: effort.count]

    def _roughly(
        self, search: FitSearch, effort: PlacementEffort, more: StartShapes | None = None
    ) -> tuple[FitState, list[FitState]]:
        """Return the best fit with rough shapes, from the start shapes and ``more``; and other fits."""
        both = [self.starts, *([more] if more else [])]
        starts = StartShapes(*(np.concatenate(each) for each in zip(*both, strict=True)))
        states = [self._start(search, starts, start) for start in self._placed(search, effort, starts.shapes)]
        done, most = 0, sum(max(2, round(part * len(states))) * steps for part, steps in effort.rounds)
        for part, steps in effort.rounds:
            some = states[: max(2, round(part * len(states)))]
            if part == 0 and some[-1].cost > SETTINGS.behind * some[0].cost:
                some.pop()
            for k, state in enumerate(some):
                states[k] = search.run(state, steps, first=True)
                done += steps
                self._reach(BEGUN + (PLACED - BEGUN) * done / most)
            states.sort(key=lambda state: state.cost)
        return search.with_moved_feature(states[0], self.features, SETTINGS.attempt_steps), states[1:]

    def _start(self, search: FitSearch, starts: StartShapes, start: StartPlacement) -> FitState:
        """Return the state at a start placement, with derivatives that an earlier fit may have computed."""
        k = start.shape
        state = FitState(starts.codes[k], starts.shapes[k], start.placement)
        known = {} if self.options.fixed or k >= len(self.starts.codes) else self.prepared.start_derivatives
        if k not in known:
            try:
                known[k] = search.derivatives(state)
            except NotPositiveDefiniteError:
                return state
        return replace(state, derivatives=known[k])

    def _solved(self, middle: FitSearch, state: FitState) -> FitState:
        """Return a fit with solved shapes that begins at a fit with rough shapes."""
        begun = middle.start(state.code, state.placement, state.shape)
        if begun is None:
            return state
        found = middle.run(begun, SETTINGS.middle_steps, first=False)
        if not self._late and self._is_poor(*middle.shares(found)):
            found = middle.with_moved_feature(found, self.features, SETTINGS.again_steps)
        return found

    def _from_both_sides(self, rough: FitSearch, middle: FitSearch, state: FitState) -> FitState:
        """Return the better of a fit to a part and of one whose shape also looked for the scan.

        A part shows where the surface is, but not where it ends. A limb that is turned wrongly may come to rest where
        all points are near it, although the rest of it sticks out. The scan pulls that rest back.
        """
        both = self._search(rough.reconstruct, self.scan, replace(self.constraints, partial=False), ROUGH)
        begun = both.start(state.code, state.placement, state.shape)
        if begun is None:
            return state
        moved = both.run(begun, SETTINGS.both_steps, first=True)
        rough.count += both.count
        here = rough.start(moved.code, moved.placement, moved.shape)  # its cost counts the points alone
        if here is None:
            return state
        return min(state, self._solved(middle, rough.run(here, 0, first=False)), key=lambda each: each.cost)

    def _insistently(self, rough: FitSearch, middle: FitSearch, state: FitState) -> FitState:
        """Return the best fit with solved shapes, after further attempts while it is poor."""
        tried: dict[Attempt, FitState] = {}
        for attempt in SETTINGS.attempts_of_part if self.constraints.partial else SETTINGS.attempts:
            if self._late or not self._is_poor(*middle.shares(state)):
                break
            if tried.get(attempt) is state:  # it would end in the same place
                continue
            tried[attempt] = state
            here = rough.start(state.code, state.placement, state.shape)
            if here is None:
                break
            here = rough.run(here, 0, first=False)
            better = [each for each in self._attempted(rough, attempt, here) if each.cost < here.cost]
            state = min([state, *(self._solved(middle, each) for each in better)], key=lambda each: each.cost)
        return state

    def _attempted(self, rough: FitSearch, attempt: Attempt, state: FitState) -> list[FitState]:
        """Return fits with rough shapes that an attempt finds, beginning at a poor fit."""
        if attempt is Attempt.RESTART:
            best, others = self._roughly(rough, THOROUGH if self.constraints.partial else MORE, self.remembered)
            apart = [each for each in others[: SETTINGS.rivals] if self._apart(each, best) > SETTINGS.elsewhere]
            return [best, *apart]
        if attempt is Attempt.PULL:
            found = rough.run(state, SETTINGS.attempt_steps, first=False, drawn=SETTINGS.drawn_steps)
        else:
            code = self.prepared.exchange(rough.reconstruct, self._judge, state)
            begun = None if code is state.code else rough.start(code, state.placement, state.shape)
            if begun is None:
                return []
            found = rough.run(begun, SETTINGS.attempt_steps, first=True)
        return [rough.with_moved_feature(found, self.features, SETTINGS.attempt_steps)]

    @cached_property
    def _judge(self) -> ShapeJudge:
        return ShapeJudge(self.decoder, self.scan, self.constraints)

    def _with_memory(
        self, middle: FitSearch, state: FitState, others: list[FitState]
    ) -> tuple[FitState, list[FitState]]:
        """Return the better of a fit and of one that begins at the likeliest training shape, and the other fits.

        What a camera does not see may be explained by several shapes.
        """
        if self.remembered is None:
            return state, others
        codes, shapes = self.remembered
        costs = [self._judge(state, *each, SHORT) for each in zip(codes, shapes, strict=True)]
        k = int(np.argmin(costs))
        if costs[k] > SETTINGS.behind * self._judge(state, state.code, state.shape, SHORT):
            return state, others
        begun = middle.start(codes[k], state.placement, state.shape)
        if begun is None or self._apart(begun, state) < SETTINGS.alike:
            return state, others
        found = middle.run(begun, SETTINGS.middle_steps, first=False)
        better, worse = (found, state) if found.cost < state.cost else (state, found)
        return better, [worse, *others]

    def _against_rivals(
        self, search: FitSearch, final: FitState, best: FitState, others: list[FitState]
    ) -> tuple[FitState, FitState | None]:
        """Return the best fit with solved shapes, and another fit that is nearly as good, if there is one."""
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

    def _is_poor(self, explained: float, seen: float) -> bool:
        return is_poor(explained, seen, partial=self.constraints.partial)

    def _answer(
        self,
        search: FitSearch,
        state: FitState,
        posterior: Posterior,
        verdict: FitVerdict,
        counts: tuple[int, int],
    ) -> Fitted:
        decoder, options = self.decoder, self.options
        code, inside = decoder.latents.code(state.code.tolist(), Bounds.ALLOW)
        shape = decoder.shape(code, inside, MeshChoice.FINE, self.deadline)
        there = state.placement(search.surface(state.shape).vertices)
        # The scale is the search's. Only the rigid motion between the two shapes remains to be found.
        scale = self.unit / decoder.manifest.scale * state.placement.scale
        placed = Placement.between(scale * shape.vertices, self.unit * there)
        placement = Placement(placed.rotation, placed.translation, scale)
        surface = MeshProximity(placement(shape.vertices), search.surface(state.shape).vertex_faces)
        to_model = surface.closest(self.unit * self.scan.points).distances
        to_scan = self.unit * self.scan.distances(surface.vertices / self.unit)
        parts = np.array_split(self.points, -(-len(self.points) // CHUNK)) if options.points else []
        found = [surface.closest(part).distances for part in parts if not (self.deadline and self.deadline.passed)]
        every = np.concatenate(found) if found and len(found) == len(parts) else None
        status, reason = verdict.status(late=self.ended or shape.diagnostics.status is Status.DEADLINE)
        if self.scan.sampled:
            reason += f" {self.scan.replaced}"
        return Fitted(
            code=code,
            covariance=posterior.covariance,
            placement=placement,
            shape=shape,
            scan=Distances.of(to_model, every),
            model=Distances.of(to_scan, to_scan if options.points else None),
            explained=verdict.explained,
            seen=verdict.seen,
            noise=self.unit * state.placement.scale * state.sigma,
            mirrored=verdict.mirrored,
            status=status,
            reason=reason,
            samples=posterior.sample(decoder.latents, code, options.samples, options.seed),
            sampled=self.scan.sampled,
            used=np.column_stack([self.unit * self.scan.points, to_model]) if options.used else None,
            solved=counts[0] + 1,
            rough=counts[1],
        )
