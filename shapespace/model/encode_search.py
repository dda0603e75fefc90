"""The search of ``encode``: first by lengths and angles, then by vertices, with restarts from training shapes."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.nric import WeightedNorm, nric, wrap
from shapespace.mesh.rigid_motion import Placement, weighted_change
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.derivatives import FactorGrids, derivatives, factor_derivatives, nodes
from shapespace.model.latent_space import Bounds, Fixed, NotFiniteError
from shapespace.model.options import Objective
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.least_squares import Box, Fit, Stopping, least_squares
from shapespace.solve.outcome import Status


@dataclass(frozen=True)
class EncodeSettings:
    """Limits of the search of ``encode``. Changes of a code are shares of the bounds' width."""

    sweeps: int = 4  # maximum number of sweeps over the factors; a sweep moves one factor at a time on its grid
    promising: float = 1.2  # a move must explain this many times as much of the misfit as the present place
    tolerance: float = 1e-4  # the search by vertices ends when no coordinate would move by more than this,
    gain: float = 1e-4  # or when the sum of squares would fall by less than this share,
    shapes: int = 25  # or after this number of shapes
    # a search that takes this many shapes, or meets a nearly collapsed shape, restarts from a training shape,
    long: int = 10
    fewest: int = 3  # if at least this many shapes remain,
    different: float = 0.01  # and the code there differs by more than this
    reach: float = 2.5  # a short search is repeated from a training shape at most this many times as far as its result
    known: int = 512  # maximum number of training shapes for restarts
    candidates: int = 5  # number of nearest training shapes whose lengths and angles are compared
    margin: float = 0.5  # how far outside the bounds a code may lie where ``bounds`` allows it,
    few: float = 20  # or this number divided by the number of training shapes: few shapes say little about the range,
    far: float = 4.0  # or this number for straight lines, which are as exact there as inside
    inside: int = 3  # additional shapes for finding a code inside the bounds that is as near
    as_near: float = 1.02  # a code inside the bounds is preferred if its distance is at most this many times as large


SETTINGS = EncodeSettings()


@dataclass(frozen=True)
class VertexObjective:
    """Weighted vertex distances from a mesh, after rigid alignment."""

    vertices: FloatArray  # (V, 3) vertices of the mesh, coarse and normalised
    shares: FloatArray  # (V,) weights with sum 1

    def place(self, shape: FloatArray) -> Placement:
        """Return the rigid motion that brings a shape (V, 3) closest to the mesh."""
        return Placement.between(shape, self.vertices, self.shares)

    def misfit(self, shape: FloatArray) -> FloatArray:
        """Return weighted differences (V, 3) of the placed shape; their sum of squares is the mean square distance."""
        return np.sqrt(self.shares)[:, None] * (self.place(shape)(shape) - self.vertices)

    def change(self, shape: FloatArray, fields: FloatArray) -> FloatArray:
        """Return the changes (n, V, 3) of the misfit for changes (n, V, 3) of the shape."""
        place = self.place(shape)
        return weighted_change(fields @ place.rotation.T, place(shape), self.shares)


class EncodePreparation:
    """Quantities that the search needs for every mesh of a model; made once."""

    def __init__(self, decoder: Decoder) -> None:
        self.decoder = decoder
        self.norm = WeightedNorm.of(decoder.reference, decoder.manifest.eta_reconstruction)
        self.root = np.sqrt(self.norm.squared)
        self.centre = nric(decoder.reference.vertices, decoder.reference.connectivity)  # z̄

    @property
    def margin(self) -> float:
        """How far outside the bounds a code may lie, as a share of their width."""
        codes, auto = self.decoder.training_codes, self.decoder.auto
        if auto is not None and auto.tolerance is None:  # drafts are exact: straight lines without Gauss–Newton
            return SETTINGS.far
        return SETTINGS.margin if codes is None else max(SETTINGS.margin, SETTINGS.few / len(codes))

    @cached_property
    def grids(self) -> FactorGrids:
        """Grids of the periodic factors, from which starts are chosen."""
        return FactorGrids.of(self.decoder, self.centre, self.root)

    @cached_property
    def known(self) -> tuple[FloatArray, FloatArray] | None:
        """Codes (n, m) of training shapes and the start network's guesses (n, V, 3), which take little time."""
        codes = self.decoder.training_codes
        if codes is None or self.decoder.manifest.start is None:
            return None
        codes = codes[np.linspace(0, len(codes) - 1, min(len(codes), SETTINGS.known)).round().astype(int)]
        return codes, self.decoder.guesses(codes.astype(np.float32))


class EncodeSearch:
    """Search for the code of one mesh. The target (2E,) has its lengths and angles, normalised, and the aim its
    vertices.
    """

    def __init__(
        self,
        prepared: EncodePreparation,
        target: FloatArray,
        aim: VertexObjective,
        fixed: Fixed,
        bounds: Bounds,
        deadline: Deadline | None,
    ) -> None:
        self._prepared, self._decoder, self._root = prepared, prepared.decoder, prepared.root
        self._target, self._aim, self._fixed, self._bounds, self._deadline = target, aim, fixed, bounds, deadline
        self._box = self._box_with(prepared.margin if bounds is not Bounds.CLAMP else 0.0)

    def __call__(self, objective: Objective) -> Fit:
        """Return the best fit by an objective."""
        fit = self._by_nric()
        known = self._training_codes()
        fit = self._at_training_shape_if_nearer(known, fit)
        if objective is Objective.VERTICES and fit.status is not Status.DEADLINE:
            near, fit = fit, self._by_vertices(fit, self._box)
            if self._bounds is not Bounds.CLAMP:
                fit = self._inside_if_as_near(fit)
            fit = self._from_training_shape_if_nearer(known, near, fit)
        return fit

    def difference(self, z: FloatArray) -> FloatArray:
        """Return lengths and angles (2E,) minus the mesh's, angles the shorter way round."""
        difference = z - self._target
        half = len(z) // 2
        difference[half:] = wrap(difference[half:])
        return difference

    def _box_with(self, margin: float) -> Box:
        latents = self._decoder.latents
        return Box(*latents.box_around(self._fixed, margin), latents.width)

    def _by_nric(self) -> Fit:
        """Fit lengths and angles: first with the sum of the factors, then with the whole composite."""
        latents, root, prepared = self._decoder.latents, self._root, self._prepared

        def affine(x: FloatArray) -> FloatArray:
            return root * self.difference(self._affine(x))

        x = self._fixed.into((latents.lower + latents.upper) / 2)
        for _ in range(SETTINGS.sweeps * len(prepared.grids.images)):
            moved = self._another_start(x, affine(x))
            if moved is None:
                break
            x = moved
        rough = least_squares(
            affine,
            lambda x, _: np.where(self._fixed.mask, 0.0, root[:, None] * factor_derivatives(self._decoder, x)),
            x,
            self._box,
            Stopping(tolerance=1e-3, deadline=self._deadline),
            secant=False,
        )
        best = self._from(rough.x, self._box)
        for _ in range(SETTINGS.sweeps):
            moved = self._another_start(best.x, best.residuals)
            if moved is None or best.status is Status.DEADLINE:
                break
            other = self._from(moved, self._box)
            if other.cost >= best.cost:
                break
            best = other
        return best

    def _from(self, start: FloatArray, box: Box) -> Fit:
        """Fit lengths and angles with the composite, from a code (m,)."""
        return least_squares(
            lambda x: self._root * self.difference(self._decoder.nric(x)),
            lambda x, _: np.where(self._fixed.mask, 0.0, self._root[:, None] * derivatives(self._decoder, x)),
            start,
            box,
            Stopping(deadline=self._deadline),
        )

    def _affine(self, x: FloatArray) -> FloatArray:
        """Return ``z̄ + Σ_j (ψ_j − z̄)`` (2E,) at a code (m,)."""
        centre = self._prepared.centre
        z = centre.copy()
        for j, factor in enumerate(self._decoder.manifest.factors):
            z += self._decoder.factor(j, x[None, factor.start : factor.stop])[0] - centre
        return z

    def _another_start(self, x: FloatArray, residuals: FloatArray) -> FloatArray | None:
        """Move one factor of a code to the grid node that fits best, or return None if no move promises enough.

        The criterion is the direction of a factor's shape from z̄, not its size. The sum of the factors has the right
        direction but only roughly the right size: a bump is smaller on the inner side of a torus than on the outer.
        Factors with a fixed coordinate stay.
        """
        decoder, grids = self._decoder, self._prepared.grids
        missing = -grids.sketch(residuals)
        best, found = 0.0, None
        for j, images in grids.images.items():
            factor = decoder.manifest.factors[j]
            own = slice(factor.start, factor.stop)
            if self._fixed.mask[own].any():
                continue
            here = grids.sketch(self._root * (decoder.factor(j, x[None, own])[0] - self._prepared.centre))
            explained = _explained(missing + here, images)
            gain = explained.max() - SETTINGS.promising * _explained(missing + here, here[None])[0]
            if gain > best:
                best, found = float(gain), x.copy()
                found[own] = nodes(decoder, j)[explained.argmax()]
        return found

    def _training_codes(self) -> FloatArray:
        """Return codes (n, m) of training shapes, the nearest guess first; none without guesses or without time."""
        known = self._prepared.known
        if known is None or self._late:
            return np.zeros((0, self._decoder.latents.dimension))
        codes, shapes = known
        return codes[np.argsort([np.linalg.norm(self._aim.misfit(shape)) for shape in shapes])]

    @property
    def _late(self) -> bool:
        return self._deadline is not None and self._deadline.passed

    def _at_training_shape_if_nearer(self, known: FloatArray, fit: Fit) -> Fit:
        """Return the fit to lengths and angles, or a fit from a training shape that is nearer.

        The effect of a stored training shape ends at some distance from its code, so a search may miss it.
        """
        if fit.status is Status.DEADLINE:
            return fit
        nearest, least = fit.x, np.sqrt(fit.cost)
        for code in known[: SETTINGS.candidates]:
            x = np.clip(self._fixed.into(code), self._box.lower, self._box.upper)
            misfit = np.linalg.norm(self._root * self.difference(self._decoder.nric(x)))
            if misfit < least:
                nearest, least = x, misfit
        return fit if nearest is fit.x else self._from(nearest, self._box)

    def _by_vertices(self, near: Fit, box: Box, most: int = SETTINGS.shapes) -> Fit:
        """Fit vertices, from a fit nearby; return that fit with 0 iterations where its shape has nearly collapsed."""
        decoder, size, aim = self._decoder, self._decoder.reference.diagonal, self._aim
        with decoder.solver() as reconstruct:
            if self._late:  # while waiting for the solver
                return replace(near, status=Status.DEADLINE)
            shapes = SearchedShapes(decoder, reconstruct, self._deadline)

            def residuals(x: FloatArray) -> FloatArray:
                shape = shapes(x)
                if not np.isfinite(shape).all():
                    return np.full(shape.size, np.nan)
                return aim.misfit(shape).ravel() / size

            def jacobian(x: FloatArray, _: FloatArray) -> FloatArray:
                changes = aim.change(shapes(x), shapes.derivatives(x, derivatives(decoder, x)))
                return np.where(self._fixed.mask, 0.0, changes.reshape(len(changes), -1).T / size)

            stopping = Stopping(SETTINGS.tolerance, SETTINGS.gain, max_evaluations=most, deadline=self._deadline)
            stuck = replace(near, status=Status.STALLED, iterations=0)
            try:
                fit = least_squares(residuals, jacobian, near.x, box, stopping)
            except NotPositiveDefiniteError:
                return stuck
            return stuck if fit.status is Status.NOT_FINITE else fit

    def _inside_if_as_near(self, fit: Fit) -> Fit:
        """Return the fit to vertices, or an equally near fit inside the bounds, where networks are most accurate."""
        box = self._box_with(0.0)
        moved = replace(fit, x=np.clip(fit.x, box.lower, box.upper))
        if np.array_equal(moved.x, fit.x) or fit.status is Status.DEADLINE:
            return fit
        other = self._by_vertices(moved, box, most=SETTINGS.shapes + SETTINGS.inside - fit.iterations)
        near = other.status is not Status.DEADLINE and self.away(other.x) <= SETTINGS.as_near * self.away(fit.x)
        return replace(other if near else fit, iterations=fit.iterations + other.iterations)

    def _from_training_shape_if_nearer(self, known: FloatArray, near: Fit, fit: Fit) -> Fit:
        """Return the fit to vertices, or a fit from the nearest training shape, with the number of shapes that remain.

        Where faces have nearly collapsed, the fit to lengths and angles that the search began with may be far away. A
        search from there is long. A short search may miss the effect of a stored training shape, which is nearer. From
        a training shape that is nearer than the fit itself, a search always follows.
        """
        if fit.status is Status.DEADLINE or not len(known):
            return fit
        box = self._box_with(0.0)
        start = np.clip(self._fixed.into(known[0]), box.lower, box.upper)
        there, here = self.away(start), self.away(fit.x)
        left = SETTINGS.shapes + SETTINGS.inside - fit.iterations
        short = 0 < fit.iterations < SETTINGS.long
        if there < here:
            left, other = max(left, SETTINGS.long), replace(near, x=start)
        elif left < SETTINGS.fewest or (short and there > SETTINGS.reach * here):
            return fit
        else:
            other = replace(near, x=start) if short else self._from(start, box)
        if np.abs(self._decoder.latents.shorter(other.x - near.x) / box.scale).max() < SETTINGS.different:
            return fit
        other = self._by_vertices(other, box, most=left)
        nearer = other if self.away(other.x) < here else fit
        return replace(nearer, iterations=fit.iterations + other.iterations)

    def away(self, x: FloatArray) -> float:
        """Return the root mean square distance from the vertices of a code (m,) as the model answers it.

        The search solves each shape from the last one, and far outside the bounds it may reach another solution.
        """
        decoder = self._decoder
        try:
            code, _ = decoder.latents.code(x.tolist())
            shape = decoder.shape(code, mesh=MeshChoice.COARSE, deadline=self._deadline)
        except NotFiniteError:
            return np.inf
        return float(np.linalg.norm(self._aim.misfit(shape.vertices / decoder.manifest.scale)))


def _explained(missing: FloatArray, images: FloatArray) -> FloatArray:
    """Return how much of ``‖missing‖²`` (k,) the best multiple of each image (n, k) removes, (n,)."""
    along = np.maximum(images @ missing, 0)
    return along**2 / np.maximum((images**2).sum(axis=1), np.finfo(float).tiny)
