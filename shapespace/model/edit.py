"""Editing: the latent code that brings a few vertices to given positions and leaves the other vertices in place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.edit_search import SETTINGS, EditSearch
from shapespace.model.latent_space import Bounds, Codes, NotFiniteError
from shapespace.model.options import EditOptions, Target
from shapespace.model.posterior import Posterior
from shapespace.model.pulled_vertices import PulledVertices
from shapespace.model.shape import Shape
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status


class InvalidTargetError(ValueError):
    """Targets that an edit can't use, with a sentence that says what to do."""


@dataclass(frozen=True)
class Edited:
    """Result of an edit: the code whose shape comes closest to the targets.

    Attributes:
        code: (m,) code inside the bounds, except for fixed coordinates.
        status: how the iteration ended.
        iterations: number of reconstructed shapes.
        shape: shape of the code, on the mesh of choice.
        placement: rigid motion of ``shape`` into the frame of the start's shape.
        distances: (k,) distances of the placed shape's vertices from their targets.
        covariance: (m, m) covariance of codes around this code, from the population of codes and the targets' standard
            deviations, for the placement found; zero for fixed coordinates.
        samples: (n, m) random codes with this covariance around the code, not cut off at the bounds.
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


def require_targets(decoder: Decoder, targets: Sequence[Target], mesh: MeshChoice) -> None:
    """Raise InvalidTargetError if there is no target, more targets than vertices, or a target that can't be used."""
    count = len(decoder.mesh(mesh).vertices)
    if not targets:
        raise InvalidTargetError("There are no targets. Give at least one.")
    if len(targets) > count:
        raise InvalidTargetError(f"targets has {len(targets)} entries. Give {count} at most.")
    for i, target in enumerate(targets):
        if not 0 <= target.vertex < count:
            raise InvalidTargetError(
                f"targets[{i}].vertex is {target.vertex}, but the {mesh} mesh has vertices 0 to {count - 1}."
            )
        if np.shape(target.position) != (3,):
            raise InvalidTargetError(f"targets[{i}].position has another shape than (3,). Give x, y and z.")
        if target.sigma is not None and not 0 < target.sigma < np.inf:
            raise InvalidTargetError(f"targets[{i}].sigma is {target.sigma:g}. Give a number above 0, or leave it out.")


def edited(
    decoder: Decoder, start: Codes, targets: Sequence[Target], options: EditOptions, deadline: Deadline | None = None
) -> Edited:
    """Find the code inside the bounds whose shape comes closest to the targets; other vertices stay where possible.

    Minimises over codes inside the bounds, and over rigid motions of their shapes,

        ``1/k Σ_i s_i ‖x_i − p_i‖² / D² + w · 1/V Σ_v ρ(‖x_v − x_v(start)‖ / D) + prior · 1/m · P``,

    with D the reference's diagonal, ``s_i = (σ D / σ_i)²`` or 1, x_i vertices of the mesh of choice, x_v vertices of
    the coarse mesh, and σ, w, c from EditSettings. ``ρ(d) = 2 c (√(d² + c²) − c)`` is about ``d²`` up to c and grows
    linearly from there. P is ``Σ_j ((code_j − start_j) / width_j)²`` (ridge), or the squared sum over factors of the
    norms of these changes. The latter is the squared group lasso (Yuan and Lin 2006): a single factor costs as much as
    with ridge.

    Quadratic upper bounds replace P and ρ repeatedly (Hunter and Lange 2004). The best motion for each code is known
    (Kabsch), so the search is over codes alone (variable projection: Kaufman 1975). With ``anchored``, only the x_v
    determine the motion.

    The shape depends on the code through the least-squares problem of the reconstruction. By the implicit function
    theorem ``dX = (JᵀWJ)⁻¹ JᵀW dz`` where the residual of that problem is small.

    Args:
        decoder: decoder of the model.
        start: (m,) code where the search begins, and from which the prior measures changes.
        targets: at least one target.
        options: options of the edit. Fixed coordinates count as unchanged.
        deadline: time limit; a search that exceeds it has Status.DEADLINE.

    Raises:
        InvalidTargetError: see ``require_targets``.
        NotFiniteError: a target is so far away that numbers overflow, or a fixed value that no surface is there.
    """
    require_targets(decoder, targets, options.mesh)
    scale, size = decoder.manifest.scale, decoder.reference.diagonal
    positions = np.array([target.position for target in targets]) / scale
    if not (np.abs(positions) < np.finfo(np.float32).max).all():
        raise NotFiniteError("A target lies so far away that the numbers overflow. Give finite positions.")
    sigmas = np.array([SETTINGS.sigma * size if target.sigma is None else target.sigma / scale for target in targets])
    sigmas = np.maximum(sigmas, SETTINGS.least_sigma * size) / size
    fixed = decoder.latents.fixed(options.fixed)
    begin = fixed.into(start.astype(np.float64))
    # Decoded before the edit borrows a solver, because decoding needs a solver too.
    before = decoder.shape(start, True, MeshChoice.COARSE, deadline)
    searching = deadline and deadline.for_searching()
    with decoder.solver() as reconstruct:
        vertices = np.array([target.vertex for target in targets])
        rough, pulled = (
            PulledVertices(decoder, reconstruct, vertices, options.mesh, searching, rough=rough)
            for rough in (True, False)
        )
        here = pulled.placed(before.vertices / scale)
        search = EditSearch(decoder, rough, pulled, begin, here, positions, sigmas, options, fixed, searching)
        best = search.best()
        code, inside = decoder.latents.found(best.x, Bounds.CLAMP, fixed)
        changes = pulled.derivatives(best.x)[:, : len(targets)]
    found = decoder.shape(code, inside, MeshChoice.COARSE, deadline)
    points = pulled.placed(found.vertices / scale)
    placement = search.placement(points, best.bound)
    distances = scale * np.linalg.norm(placement(points)[: len(targets)] - positions, axis=1)
    slopes = changes / (size * sigmas[:, None])
    slopes = slopes.reshape(len(slopes), -1)
    posterior = Posterior.of(slopes @ slopes.T, decoder.population, fixed.mask)
    ended = (before.diagnostics.status, found.diagnostics.status)
    return Edited(
        code,
        Status.DEADLINE if Status.DEADLINE in ended else best.status,
        pulled.shapes.count + 1,
        replace(found, vertices=decoder.finish(found.vertices / scale, options.mesh)),
        Placement(placement.rotation, scale * placement.translation),
        distances,
        posterior.covariance,
        posterior.sample(decoder.latents, code, options.samples, options.seed),
    )
