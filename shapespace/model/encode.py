"""Encoding: from a mesh to the latent code whose shape comes closest, in vertices or in lengths and angles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import WeightedNorm, nric, wrap
from shapespace.mesh.rigid_motion import Placement, align, aligned_change, weighted_change
from shapespace.model.correspondence import InvalidMeshError, Matched
from shapespace.model.decoder import Decoder, MeshChoice, Shape
from shapespace.model.derivatives import FactorGrids, derivatives, factor_derivatives, nodes
from shapespace.model.latent_space import Bounds, Codes, Fixed, NotFiniteError
from shapespace.model.posterior import Posterior, independent_share, patches_of
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.least_squares import Box, Fit, Stopping, least_squares
from shapespace.solve.outcome import Status

#: Sweeps over the factors, in which one at a time is moved on its grid while the others stay; and the factor by which a
#: move has to explain more of the misfit than the present place.
SWEEPS, PROMISING = 4, 1.2
#: The search by vertices ends when no coordinate would move by more than this fraction of the bounds' width, when the
#: sum of squares would fall by less than this share, or after so many shapes.
TOLERANCE, GAIN, SHAPES = 1e-4, 1e-4, 25
#: A search that took so many shapes, or met one that had all but collapsed, is begun once more from a training shape,
#: one of at most so many, if at least so many shapes are left, and the code there differs by more than this fraction of
#: the bounds' width.
LONG, KNOWN, FEWEST, DIFFERENT = 10, 512, 3, 0.01
#: Of so many training shapes, the nearest by guesses, lengths and angles are compared.
CANDIDATES = 5
#: Where codes outside the bounds are allowed: by how much, a fraction of the bounds' width.
MARGIN = 0.5
#: A code inside is preferred if so many more shapes, and those that the search left over, find one whose distance is at
#: most this many times as large.
INSIDE, AS_NEAR = 3, 1.02
#: A mesh this many times larger or smaller than the reference is taken to be in other units.
UNITS = 3.0
#: Least standard deviation of a vertex that the posterior assumes, as a fraction of the diagonal.
TOLERANCE_OF_SHAPES = 2e-5


class Objective(StrEnum):
    """What the shape of a code should have in common with a mesh."""

    VERTICES = "vertices"
    NRIC = "nric"


@dataclass(frozen=True)
class Encoded:
    """The code whose shape comes closest to a mesh.

    Attributes:
        code: (m,), float32, as the networks take it.
        inside_bounds: whether it lies inside the bounds.
        status: how the iteration ended.
        iterations: shapes that the search by vertices went through, 0 where the first had all but collapsed; or
            evaluations of the networks where it was by lengths and angles.
        residual: relative misfit of lengths and angles, in the weighted norm of the reconstruction.
        shape: of the code, on the mesh that was given.
        distances: (V,) from the given vertices to those of that shape, after rigid alignment.
        mesh: whether the fine or the coarse mesh was given.
        covariance: (m, m) of codes around this one, by the population of codes and the distances as noise, of which
            neighbouring ones are not independent; zero for fixed coordinates.
        samples: (n, m) random codes of that covariance around this one, not cut off at the bounds.
    """

    code: Codes
    inside_bounds: bool
    status: Status
    iterations: int
    residual: float
    shape: Shape
    distances: FloatArray
    mesh: MeshChoice
    covariance: FloatArray
    samples: Codes


@dataclass(frozen=True)
class Aim:
    """Vertices (V, 3) of the coarse mesh that a shape should come close to, and how much each counts (V,), in all 1."""

    vertices: FloatArray
    shares: FloatArray

    def place(self, shape: FloatArray) -> Placement:
        """What brings a shape (V, 3) closest."""
        return Placement.between(shape, self.vertices, self.shares)

    def misfit(self, shape: FloatArray) -> FloatArray:
        """Of a shape (V, 3), there: weighted (V, 3), the sum of squares is the weighted mean of square distances."""
        return np.sqrt(self.shares)[:, None] * (self.place(shape)(shape) - self.vertices)

    def change(self, shape: FloatArray, fields: FloatArray) -> FloatArray:
        """Of the misfit (n, V, 3) where the shape changes by fields (n, V, 3)."""
        place = self.place(shape)
        return weighted_change(fields @ place.rotation.T, place(shape), self.shares)


class Encoder:
    """Finds codes of meshes; may be used by several threads at once.

    By lengths and angles it minimises ``‖z(code) − z‖_{2,z̄}``, angles compared modulo 2π, in two rounds, whatever the
    pose. The first takes the factors alone, ``z̄ + Σ_j (ψ_j − z̄)``, which come within a few percent and cost little;
    where a factor has periodic coordinates it begins at the best of a grid. The second takes the whole composite, and
    rarely needs more than a handful of evaluations beside one Jacobian; it begins once more from a training
    shape that is nearer.

    By vertices it goes on from there to the minimum of ``Σ_i n_i ‖x_i(code) − x_i‖²`` over the vertices of the coarse
    mesh, after rigid alignment, where n_i of the vertices that are given lie nearest to vertex i: small angles add up
    along a limb, and what is smallest in lengths and angles may be twice as far in space. The shapes' derivatives are
    those of ``shapespace.model.edit``. A search that takes long begins once more from the nearest training shape.
    """

    def __init__(self, model: Decoder) -> None:
        self.model = model
        self._norm = WeightedNorm.of(model.reference, model.manifest.eta_reconstruction)
        self._root = np.sqrt(self._norm.squared)
        self._centre = nric(model.reference.vertices, model.reference.connectivity)

    def __call__(
        self,
        given: Matched,
        bounds: Bounds = Bounds.ALLOW,
        deadline: Deadline | None = None,
        objective: Objective = Objective.VERTICES,
        fixed: Fixed | None = None,
        samples: int = 0,
        seed: int = 0,
    ) -> Encoded:
        """The code of a mesh.

        Args:
            given: in the model's order, in the units of the training meshes and in any rigid pose.
            bounds: REJECT refuses a code outside the bounds, CLAMP looks for one inside only.
            deadline: after which the status is Status.DEADLINE.
            objective: what is compared.
            fixed: coordinates that keep their value.
            samples: codes to draw from the posterior, which is by vertices whatever the objective.
            seed: of these.

        Raises:
            InvalidMeshError: edges without any length, or a mesh of another size than the training shapes, see UNITS.
            NotFiniteError: lengths so large that the numbers overflow.
            OutOfBoundsError: as ``bounds`` asks for.
        """
        model, latents = self.model, self.model.latents
        with np.errstate(over="ignore", invalid="ignore"):
            vertices = model.coarse(given.vertices, given.mesh) / model.manifest.scale
            target = nric(vertices, model.reference.connectivity)
            if not np.isfinite(self._norm.square(target)):
                raise NotFiniteError("The mesh is so large that the numbers overflow. Send it in the model's units.")
        if not target.any():
            raise InvalidMeshError("The mesh is a single point: no edge has a length. Send a surface.")
        self._require_size(vertices)
        fixed = latents.fixed() if fixed is None else fixed
        lower, upper = latents.box_around(fixed, MARGIN if bounds is not Bounds.CLAMP else 0.0)
        box = Box(lower, upper, latents.width)
        nearby = model.nearby(given.mesh)
        aim = Aim(vertices, nearby / nearby.sum())
        fit = self._by_nric(target, box, fixed, deadline)
        known = self._training_codes(aim, deadline)
        fit = self._at_training_shape_if_nearer(known, target, fit, box, fixed, deadline)
        if objective is Objective.VERTICES and fit.status is not Status.DEADLINE:
            near, fit = fit, self._by_vertices(aim, fit, box, fixed, deadline)
            if bounds is not Bounds.CLAMP:
                fit = self._inside_if_as_near(aim, fit, fixed, deadline)
            fit = self._from_training_shape_if_nearer(known, aim, target, near, fit, fixed, deadline)
        code, inside = latents.found(fit.x, bounds, fixed)
        coarse = model.shape(code, inside, MeshChoice.COARSE, deadline)
        posterior = self._posterior(code, coarse.vertices / model.manifest.scale, vertices, fixed)
        shape = replace(coarse, vertices=model.finish(coarse.vertices / model.manifest.scale, given.mesh))
        distances = np.linalg.norm(align(shape.vertices, given.vertices) - given.vertices, axis=1)
        left = self._difference(model.nric(code.astype(np.float64)), target)
        residual = float(np.sqrt(self._norm.square(left) / self._norm.square(target)))
        status = Status.DEADLINE if shape.diagnostics.status is Status.DEADLINE else fit.status
        return Encoded(
            code,
            inside,
            status,
            fit.iterations,
            residual,
            shape,
            distances,
            given.mesh,
            posterior.covariance,
            posterior.sample(latents, code, samples, seed),
        )

    @cached_property
    def grids(self) -> FactorGrids:
        """What starts are chosen from; made once, at the first mesh."""
        return FactorGrids.of(self.model, self._centre, self._root)

    def _require_size(self, vertices: FloatArray) -> None:
        """Raise InvalidMeshError where a mesh (V, 3) is as large or small as if it were in other units."""
        times = _extent(vertices) / _extent(self.model.reference.vertices)
        if not 1 / UNITS <= times <= UNITS:
            raise InvalidMeshError(
                f"The mesh is about {times:.3g} times as large as the training shapes: send it in the training meshes' "
                "units."
            )

    def _posterior(self, code: Codes, shape: FloatArray, target: FloatArray, fixed: Fixed) -> Posterior:
        """Around a code (m,), given its shape (V, 3) and that of the mesh (V, 3), both coarse and normalised."""
        model, count = self.model, len(target)
        misfit = align(shape, target) - target
        share = independent_share(misfit, self._patches)
        # What is fitted takes up some of the observations; and no shape is known better than it is solved for.
        observed = 3 * count * share
        left = max(observed - 6 - int((~fixed.mask).sum()), 1.0)
        variance = max(
            float((misfit**2).mean()) * observed / left, (TOLERANCE_OF_SHAPES * model.reference.diagonal) ** 2
        )
        try:
            with model.solver() as reconstruct:
                fields = reconstruct.differential(shape, derivatives(model, code.astype(np.float64)).T)
        except NotPositiveDefiniteError:  # of a shape that has all but collapsed nothing is known
            fields = np.zeros((len(code), *shape.shape))
        changes = aligned_change(shape, fields, target).reshape(len(code), -1)
        return Posterior.of(share / variance * changes @ changes.T, model.population, fixed.mask)

    @cached_property
    def _patches(self) -> list[IntArray]:
        """Of the coarse mesh; made once, as they take as long as a shape."""
        return patches_of(self.model.reference.vertices)

    def _at_training_shape_if_nearer(
        self, known: FloatArray, target: FloatArray, fit: Fit, box: Box, fixed: Fixed, deadline: Deadline | None
    ) -> Fit:
        """The fit to lengths and angles, or one that begins at a training shape where it is nearer there.

        What a bundle remembers of a training shape reaches only so far around its code, and a search may pass it by.
        """
        if fit.status is Status.DEADLINE:
            return fit
        nearest, least = fit.x, np.sqrt(fit.cost)
        for code in known[:CANDIDATES]:
            x = np.clip(fixed.into(code), box.lower, box.upper)
            misfit = np.linalg.norm(self._root * self._difference(self.model.nric(x), target))
            if misfit < least:
                nearest, least = x, misfit
        return fit if nearest is fit.x else self._from(nearest, target, box, fixed, deadline)

    def _training_codes(self, aim: Aim, deadline: Deadline | None) -> FloatArray:
        """Codes (n, m) of training shapes, by guesses the nearest first; none where guesses or time are missing."""
        if self._known is None or (deadline is not None and deadline.passed):
            return np.zeros((0, self.model.latents.dimension))
        codes, shapes = self._known
        return codes[np.argsort([np.linalg.norm(aim.misfit(shape)) for shape in shapes])]

    def _from_training_shape_if_nearer(
        self,
        known: FloatArray,
        aim: Aim,
        target: FloatArray,
        near: Fit,
        fit: Fit,
        fixed: Fixed,
        deadline: Deadline | None,
    ) -> Fit:
        """The fit to vertices, or one from the training shape that is nearest, with the shapes that are left.

        Where faces have all but collapsed, the fit to lengths and angles that the search began with may be far away. A
        search takes long there; elsewhere it ends at once.
        """
        left = SHAPES + INSIDE - fit.iterations
        if 0 < fit.iterations < LONG or left < FEWEST or fit.status is Status.DEADLINE or not len(known):
            return fit
        box = Box(*self.model.latents.box_around(fixed, 0.0), self.model.latents.width)
        start = np.clip(fixed.into(known[0]), box.lower, box.upper)
        other = self._from(start, target, box, fixed, deadline)
        if np.abs(self.model.latents.shorter(other.x - near.x) / box.scale).max() < DIFFERENT:
            return fit
        other = self._by_vertices(aim, other, box, fixed, deadline, most=left)
        nearer = min((fit, other), key=lambda each: self._away(each.x, aim, deadline))
        return replace(nearer, iterations=fit.iterations + other.iterations)

    @cached_property
    def _known(self) -> tuple[FloatArray, FloatArray] | None:
        """Codes (n, m) of training shapes and guesses (n, V, 3) of these, which take a thousandth of the time."""
        codes = self.model.training_codes
        if codes is None or self.model.manifest.start is None:
            return None
        codes = codes[np.linspace(0, len(codes) - 1, min(len(codes), KNOWN)).round().astype(int)]
        return codes, self.model.guesses(codes.astype(np.float32))

    def _by_vertices(
        self, aim: Aim, near: Fit, box: Box, fixed: Fixed, deadline: Deadline | None, most: int = SHAPES
    ) -> Fit:
        """The fit to vertices, from one nearby, which stands, after 0 steps, where its shape has all but collapsed."""
        model, size = self.model, self.model.reference.diagonal
        with model.solver() as reconstruct:
            if deadline is not None and deadline.passed:  # while waiting for the solver
                return replace(near, status=Status.DEADLINE)
            shapes = SearchedShapes(model, reconstruct, deadline)

            def residuals(x: FloatArray) -> FloatArray:
                shape = shapes(x)
                if not np.isfinite(shape).all():
                    return np.full(shape.size, np.nan)
                return aim.misfit(shape).ravel() / size

            def jacobian(x: FloatArray, _: FloatArray) -> FloatArray:
                changes = aim.change(shapes(x), shapes.derivatives(x, derivatives(model, x)))
                return np.where(fixed.mask, 0.0, changes.reshape(len(changes), -1).T / size)

            stopping = Stopping(TOLERANCE, GAIN, max_evaluations=most, deadline=deadline)
            stuck = replace(near, status=Status.STALLED, iterations=0)
            try:
                fit = least_squares(residuals, jacobian, near.x, box, stopping)
            except NotPositiveDefiniteError:
                return stuck
            return stuck if fit.status is Status.NOT_FINITE else fit

    def _inside_if_as_near(self, aim: Aim, fit: Fit, fixed: Fixed, deadline: Deadline | None) -> Fit:
        """The fit to vertices, or one inside the bounds that is as near: networks know shapes best there."""
        lower, upper = self.model.latents.box_around(fixed, 0.0)
        moved = replace(fit, x=np.clip(fit.x, lower, upper))
        if np.array_equal(moved.x, fit.x) or fit.status is Status.DEADLINE:
            return fit
        box = Box(lower, upper, self.model.latents.width)
        other = self._by_vertices(aim, moved, box, fixed, deadline, most=SHAPES + INSIDE - fit.iterations)
        near = other.status is not Status.DEADLINE and (
            self._away(other.x, aim, deadline) <= AS_NEAR * self._away(fit.x, aim, deadline)
        )
        return replace(other if near else fit, iterations=fit.iterations + other.iterations)

    def _away(self, x: FloatArray, aim: Aim, deadline: Deadline | None) -> float:
        """Root mean square distance of the vertices from those of a code (m,) as it is served.

        A search goes from shape to shape, and far outside the bounds it may come to another one.
        """
        try:
            shape = self.model.shape(self.model.latents.code(x.tolist())[0], mesh=MeshChoice.COARSE, deadline=deadline)
        except NotFiniteError:
            return np.inf
        return float(np.linalg.norm(aim.misfit(shape.vertices / self.model.manifest.scale)))

    def _by_nric(self, target: FloatArray, box: Box, fixed: Fixed, deadline: Deadline | None) -> Fit:
        """The fit to lengths and angles (2E,)."""
        latents, root = self.model.latents, self._root

        def affine(x: FloatArray) -> FloatArray:
            return root * self._difference(self._affine(x), target)

        x = fixed.into((latents.lower + latents.upper) / 2)
        for _ in range(SWEEPS * len(self.grids.images)):
            moved = self._another_start(x, affine(x), fixed)
            if moved is None:
                break
            x = moved
        rough = least_squares(
            affine,
            lambda x, _: np.where(fixed.mask, 0.0, root[:, None] * factor_derivatives(self.model, x)),
            x,
            box,
            Stopping(tolerance=1e-3, deadline=deadline),
            secant=False,
        )
        best = self._from(rough.x, target, box, fixed, deadline)
        for _ in range(SWEEPS):
            moved = self._another_start(best.x, best.residuals, fixed)
            if moved is None or best.status is Status.DEADLINE:
                break
            other = self._from(moved, target, box, fixed, deadline)
            if other.cost >= best.cost:
                break
            best = other
        return best

    def _from(self, start: FloatArray, target: FloatArray, box: Box, fixed: Fixed, deadline: Deadline | None) -> Fit:
        """The composite's fit to lengths and angles (2E,), from a code (m,)."""
        return least_squares(
            lambda x: self._root * self._difference(self.model.nric(x), target),
            lambda x, _: np.where(fixed.mask, 0.0, self._root[:, None] * derivatives(self.model, x)),
            start,
            box,
            Stopping(deadline=deadline),
        )

    def _another_start(self, x: FloatArray, residuals: FloatArray, fixed: Fixed) -> FloatArray | None:
        """A code with one factor moved to the node that fits best, where that promises to be better than x.

        What counts is the direction of a factor's shape from z̄, not its size, because the factors add up in direction
        only roughly in size: a bump on the inner side of a torus is not as large as on the outer one. Factors with a
        fixed coordinate stay.
        """
        grids = self.grids
        missing = -grids.sketch(residuals)
        best, found = 0.0, None
        for j, images in grids.images.items():
            factor = self.model.manifest.factors[j]
            own = slice(factor.start, factor.stop)
            if fixed.mask[own].any():
                continue
            here = grids.sketch(self._root * (self.model.factor(j, x[None, own])[0] - self._centre))
            explained = _explained(missing + here, images)
            gain = explained.max() - PROMISING * _explained(missing + here, here[None])[0]
            if gain > best:
                best, found = float(gain), x.copy()
                found[own] = nodes(self.model, j)[explained.argmax()]
        return found

    def _difference(self, z: FloatArray, target: FloatArray) -> FloatArray:
        difference = z - target
        half = len(z) // 2
        difference[half:] = wrap(difference[half:])
        return difference

    def _affine(self, x: FloatArray) -> FloatArray:
        z = self._centre.copy()
        for j, factor in enumerate(self.model.manifest.factors):
            z += self.model.factor(j, x[None, factor.start : factor.stop])[0] - self._centre
        return z


def _extent(vertices: FloatArray) -> float:
    """Root mean square distance from the centroid, which a pose changes little."""
    return float(np.sqrt(((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _explained(missing: FloatArray, images: FloatArray) -> FloatArray:
    """(n,) how much of the square of ``missing`` (k,) multiples of images (n, k) take away."""
    along = np.maximum(images @ missing, 0)
    return along**2 / np.maximum((images**2).sum(axis=1), np.finfo(float).tiny)
