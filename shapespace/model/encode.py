"""Encoding: from a mesh to the latent code whose shape comes closest, in vertices or in lengths and angles."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import nric
from shapespace.mesh.rigid_motion import Placement, align, aligned_change
from shapespace.model.correspondence import InvalidMeshError, Matched
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.derivatives import derivatives
from shapespace.model.encode_faults import (
    THRESHOLDS,
    EncodeCause,
    EncodeFault,
    OrderCheck,
    far_from_all,
    mirror_image,
    other_size,
    patch_distance,
)
from shapespace.model.encode_search import EncodePreparation, EncodeSearch, VertexObjective
from shapespace.model.latent_space import Codes, Fixed, NotFiniteError
from shapespace.model.options import EncodeOptions, Objective
from shapespace.model.posterior import Posterior, independent_share, patches_of
from shapespace.model.shape import Shape
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

#: A mesh this many times larger or smaller than the reference is taken to be in other units.
UNITS = 3.0
#: Least standard deviation of a vertex that the posterior assumes, as a fraction of the diagonal.
LEAST_DEVIATION = 2e-5
#: Mean number of vertices, at least, of patches whose displacements are compared. Noise of a patch is much smaller.
PATCH_VERTICES = 15
#: How a search ended, in words; with any other status than these it is _STUCK.
_STUCK = "The search stalled"
_ENDS = {
    Status.CONVERGED: "The search has converged",
    Status.DEADLINE: "The time ended before the search converged",
    Status.ITERATION_LIMIT: "The search used up its number of shapes",
}


@dataclass(frozen=True)
class Encoded:
    """Result of ``encode``: the code whose shape comes closest to a mesh.

    Attributes:
        code: (m,) code, float32, as the networks take it.
        inside_bounds: whether the code lies inside the bounds.
        status: how the iteration ended; POOR if the mesh is no shape of the model, see ``cause``.
        reason: the status in words.
        cause: why the mesh is no shape of the model, None if it may be one.
        misplaced: (k,) vertices that are exchanged or far off.
        iterations: number of shapes that the search by vertices reconstructed, 0 if the first shape had nearly
            collapsed; for the objective ``nric``, the number of network evaluations.
        residual: relative misfit of lengths and angles, in the weighted norm of the reconstruction.
        shape: shape of the code, on the given mesh.
        distances: (V,) distances of the given vertices from the vertices of ``shape``, after rigid alignment.
        mesh: whether the given mesh was the fine or the coarse mesh.
        covariance: (m, m) covariance of codes around this code, from the population of codes and the distances as
            noise, where neighbouring distances are not independent; zero for fixed coordinates.
        samples: (n, m) random codes with this covariance around the code, not cut off at the bounds.
    """

    code: Codes
    inside_bounds: bool
    status: Status
    reason: str
    cause: EncodeCause | None
    misplaced: IntArray
    iterations: int
    residual: float
    shape: Shape
    distances: FloatArray
    mesh: MeshChoice
    covariance: FloatArray
    samples: Codes


class Encoder:
    """Finds codes of meshes; several threads may use it at once.

    By lengths and angles it minimises ``‖z(code) − z‖_{2,z̄}``, angles compared modulo 2π, for a mesh in any pose. The
    first round takes the sum of the factors, ``z̄ + Σ_j (ψ_j − z̄)``, which is accurate to a few percent and cheap. Where
    a factor has periodic coordinates, it begins at the best node of a grid. The second round takes the whole composite,
    and usually needs few evaluations and one Jacobian. It restarts from a training shape that is nearer.

    By vertices it continues to the minimum of ``Σ_i n_i ‖x_i(code) − x_i‖²`` over the vertices of the coarse mesh,
    after rigid alignment, where n_i given vertices lie nearest to vertex i. Small angles add up along a limb: the
    minimum by lengths and angles may be twice as far away in space. The derivatives of shapes are the same
    as in ``shapespace.model.edit``. A long search restarts from the nearest training shape.
    """

    def __init__(self, decoder: Decoder) -> None:
        self._decoder, self._prepared = decoder, EncodePreparation(decoder)

    def __call__(self, given: Matched, options: EncodeOptions, deadline: Deadline | None = None) -> Encoded:
        """Find the code of a mesh.

        Args:
            given: mesh in the model's vertex order, in the units of the training meshes and in any rigid pose.
            options: options of the search. The posterior is by vertices for either objective.
            deadline: time limit; a search that exceeds it has Status.DEADLINE.

        Raises:
            InvalidMeshError: edges without length, or another size than the training shapes', see UNITS.
            NotFiniteError: lengths so large that the numbers overflow.
            OutOfBoundsError: a code outside the bounds where ``bounds`` is ``reject``.
        """
        decoder, latents, norm = self._decoder, self._decoder.latents, self._prepared.norm
        with np.errstate(over="ignore", invalid="ignore"):
            vertices = decoder.coarse(given.vertices, given.mesh) / decoder.manifest.scale
            target = nric(vertices, decoder.reference.connectivity)
            if not np.isfinite(norm.square(target)):
                raise NotFiniteError("The mesh is so large that the numbers overflow. Give it in the model's units.")
        if not target.any():
            raise InvalidMeshError("The mesh is a single point: no edge has a length. Give a surface.")
        self._require_size(vertices)
        fixed = latents.fixed(options.fixed)
        nearby = decoder.nearby(given.mesh)
        aim = VertexObjective(vertices, nearby / nearby.sum())
        searching = deadline and deadline.for_searching()
        search = EncodeSearch(self._prepared, target, aim, fixed, options.bounds, searching)
        fit = search(options.objective)
        code, inside = latents.found(fit.x, options.bounds, fixed)
        coarse = decoder.shape(code, inside, MeshChoice.COARSE, deadline)
        posterior = self._posterior(code, coarse.vertices / decoder.manifest.scale, vertices, fixed)
        shape = replace(coarse, vertices=decoder.finish(coarse.vertices / decoder.manifest.scale, given.mesh))
        placed = align(shape.vertices, given.vertices)
        distances = np.linalg.norm(placed - given.vertices, axis=1)
        mean = float(distances.mean()) / (decoder.manifest.scale * decoder.reference.diagonal)
        z = decoder.nric(code.astype(np.float64))
        status = Status.DEADLINE if shape.diagnostics.status is Status.DEADLINE else fit.status
        fault = None
        if status is not Status.DEADLINE:
            mirrored = EncodeSearch(self._prepared, *_mirrored(target, aim), fixed, options.bounds, searching)
            fault = self._mirror_image(search, fit.x, mirrored, z, options.objective)
            fault = fault or self._order_checks[given.mesh](given.vertices, placed)
            if not fault and not fixed.mask.any() and options.objective is Objective.VERTICES:
                times = self._times_larger(target)
                resized = EncodeSearch(self._prepared, *_resized(target, aim, times), fixed, options.bounds, searching)
                misfit = align(coarse.vertices / decoder.manifest.scale, vertices) - vertices
                distance = patch_distance(misfit, self._patch_of) / decoder.reference.diagonal
                if distance > THRESHOLDS.sized:
                    fault = self._other_size(search, fit.x, resized, times, vertices)
                fault = fault or far_from_all(distance, mean)
        ended = f"{_ENDS.get(status, _STUCK)}: the vertices lie {mean:.2g} of the diagonal away on average."
        return Encoded(
            code,
            inside,
            Status.POOR if fault else status,
            fault.sentence if fault else ended,
            fault.cause if fault else None,
            fault.misplaced if fault else np.zeros(0, np.int64),
            fit.iterations,
            float(np.sqrt(norm.square(search.difference(z)) / norm.square(target))),
            shape,
            distances,
            given.mesh,
            posterior.covariance,
            posterior.sample(latents, code, options.samples, options.seed),
        )

    def _mirror_image(
        self, search: EncodeSearch, x: FloatArray, mirrored: EncodeSearch, z: FloatArray, objective: Objective
    ) -> EncodeFault | None:
        """Return the fault of a mesh that is a mirror image.

        Its mirror image is searched for too if it has angles nearer to the lengths and angles z (2E,) of the code x.
        """
        norm, diagonal = self._prepared.norm, self._decoder.reference.diagonal
        if norm.square(mirrored.difference(z)) >= norm.square(search.difference(z)):
            return None
        return mirror_image(search.away(x) / diagonal, mirrored.away(mirrored(objective).x) / diagonal)

    def _times_larger(self, target: FloatArray) -> float:
        """Return how many times as long most edges of a mesh are, by its lengths and angles (2E,), up to UNITS."""
        half = len(target) // 2
        return float(np.clip(np.median(target[:half] / self._prepared.centre[:half]), 1 / UNITS, UNITS))

    def _other_size(
        self, search: EncodeSearch, x: FloatArray, resized: EncodeSearch, times: float, vertices: FloatArray
    ) -> EncodeFault | None:
        """Return the fault of a mesh (V, 3) of another size than the shape of the code x, see `other_size`."""
        decoder, diagonal = self._decoder, self._decoder.reference.diagonal
        found = resized(Objective.VERTICES).x
        shape = decoder.shape(decoder.latents.code(found.tolist())[0], mesh=MeshChoice.COARSE).vertices
        scale = Placement.between(shape / decoder.manifest.scale, vertices, scaled=True).scale
        return other_size(search.away(x) / (diagonal * times), resized.away(found) / diagonal, scale)

    @cached_property
    def _order_checks(self) -> dict[MeshChoice, OrderCheck]:
        diagonal = self._decoder.manifest.scale * self._decoder.reference.diagonal
        return {choice: OrderCheck(self._decoder.mesh(choice).connectivity, diagonal) for choice in MeshChoice}

    def _require_size(self, vertices: FloatArray) -> None:
        """Raise InvalidMeshError if the size of a mesh (V, 3) suggests other units."""
        times = _extent(vertices) / _extent(self._decoder.reference.vertices)
        if not 1 / UNITS <= times <= UNITS:
            raise InvalidMeshError(
                f"The mesh is about {times:.3g} times as large as the training shapes. Give it in the units of the "
                "training meshes."
            )

    def _posterior(self, code: Codes, shape: FloatArray, target: FloatArray, fixed: Fixed) -> Posterior:
        """Return the posterior at a code (m,), from its shape (V, 3) and the mesh (V, 3), coarse and normalised."""
        decoder, count = self._decoder, len(target)
        misfit = align(shape, target) - target
        share = independent_share(misfit, self._patches)
        # The fit uses up some of the observations. No shape is known better than it is solved.
        observed = 3 * count * share
        left = max(observed - 6 - int((~fixed.mask).sum()), 1.0)
        variance = max(float((misfit**2).mean()) * observed / left, (LEAST_DEVIATION * decoder.reference.diagonal) ** 2)
        try:
            with decoder.solver() as reconstruct:
                fields = reconstruct.differential(shape, derivatives(decoder, code.astype(np.float64)).T)
        except NotPositiveDefiniteError:  # a nearly collapsed shape has no derivative
            fields = np.zeros((len(code), *shape.shape))
        changes = aligned_change(shape, fields, target).reshape(len(code), -1)
        return Posterior.of(share / variance * changes @ changes.T, decoder.population, fixed.mask)

    @cached_property
    def _patches(self) -> list[IntArray]:
        """Patches of the coarse mesh; made once, because they take as long as a shape."""
        return patches_of(self._decoder.reference.vertices)

    @cached_property
    def _patch_of(self) -> IntArray:
        """The patch (V,) of each vertex. Patches have PATCH_VERTICES vertices or more, or are the whole mesh."""
        vertices = len(self._decoder.reference.vertices)
        large = [patch for patch in self._patches if (int(patch.max()) + 1) * PATCH_VERTICES <= vertices]
        return large[-1] if large else np.zeros(vertices, np.int64)


def _mirrored(target: FloatArray, aim: VertexObjective) -> tuple[FloatArray, VertexObjective]:
    """Return the lengths and angles (2E,) and the vertices of the mirror image of a mesh."""
    half = len(target) // 2
    return np.concatenate([target[:half], -target[half:]]), replace(aim, vertices=aim.vertices * [-1, 1, 1])


def _resized(target: FloatArray, aim: VertexObjective, times: float) -> tuple[FloatArray, VertexObjective]:
    """Return the lengths and angles (2E,) and the vertices of a mesh with coordinates divided by ``times``."""
    half = len(target) // 2
    return np.concatenate([target[:half] / times, target[half:]]), replace(aim, vertices=aim.vertices / times)


def _extent(vertices: FloatArray) -> float:
    """Return the root mean square distance from the centroid, which varies little between poses."""
    return float(np.sqrt(((vertices - vertices.mean(axis=0)) ** 2).sum(axis=1).mean()))
