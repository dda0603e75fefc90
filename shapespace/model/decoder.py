"""Decoding: latent codes to lengths and angles by the networks of a bundle, and those to vertices by Gauss–Newton."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.bundle.geometry import FineMesh
from shapespace.bundle.reader import Bundle, BundleError
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.latent_space import Bounds, Codes, Distribution, LatentSpace, NotFiniteError, TrainingCodes
from shapespace.model.networks import PATIENCE, NetworkError, Session, TerminatedError
from shapespace.model.population import Population
from shapespace.shell.space import ShellSpace
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

logger = logging.getLogger(__name__)
#: Gauss–Newton stops once no vertex moves further than this fraction of the diagonal: a fiftieth of a pixel where a
#: shape fills a screen.
TOLERANCE = 2e-5
#: When networks have taken too long, their limit of time is halved, down to so many seconds, and grows by that factor
#: with each answer in time. Otherwise repeated requests for such codes would keep the workers from other models.
LEAST_PATIENCE, RECOVERY = 0.5, 1.1
#: Random codes at which a model is rehearsed.
REHEARSED = 2
#: Random codes by which drafts are measured.
DRAFTED = 50


class ModelFailedError(RuntimeError):
    """Networks that fail at a code, with a sentence that says what to do; its cause names the network and the fault."""


class NetworkTimeError(ModelFailedError):
    """Networks that take too long at a code."""


class MeshChoice(StrEnum):
    """Which mesh an answer holds; a model without a finer one answers both with the one it has."""

    FINE = "fine"
    COARSE = "coarse"


class Quality(StrEnum):
    """How exactly a shape is found: by Gauss–Newton, or from face frames alone, in a fraction of the time."""

    FULL = "full"
    DRAFT = "draft"


@dataclass(frozen=True)
class Diagnostics:
    """How well a shape was found.

    Attributes:
        status: how Gauss–Newton ended, see shapespace.solve.outcome.Status; of a draft, which needs none, converged.
        iterations: its steps.
        residual: distance between the lengths and angles asked for and those of the shape, relative,
            weighted norm.
        flipped_faces: faces at an edge whose dihedral angle is more than π/2 from the one asked for.
        integrability: how far the lengths and angles asked for are from those of any surface: root mean square over
            vertices of ``|Q(z)|``, the sine of half the angle by which faces around a vertex fail to close.
        plausibility: distance to the nearest code of a training shape, in multiples of the distance that these
            typically have from each other; None where the model has no such codes.
        inside_bounds: whether the code lies inside the model's bounds.
        model: digest of the model's manifest.
        quality: whether it is a draft.
    """

    status: Status
    iterations: int
    residual: float
    flipped_faces: int
    integrability: float
    plausibility: float | None
    inside_bounds: bool
    model: str
    quality: Quality = Quality.FULL


@dataclass(frozen=True)
class Shape:
    """A shape as it is answered: aligned to the reference, in the units of the training meshes.

    Attributes:
        vertices: (V, 3), of the mesh that was asked for.
        diagnostics: how well it was found; they concern the coarse mesh.
        seconds: time spent by stage, ``network`` and ``reconstruct``.
    """

    vertices: FloatArray
    diagnostics: Diagnostics
    seconds: dict[str, float] = field(compare=False)


@dataclass(frozen=True)
class LengthsAndAngles:
    """NRIC in the units of the training meshes.

    Attributes:
        lengths, angles: (E,) each, angles in radians.
        factors: (J, 2E), the factors' own lengths and angles.
    """

    lengths: FloatArray
    angles: FloatArray
    factors: FloatArray


class Decoder:
    """The networks and the Gauss–Newton solver of a bundle, ready for any number of threads.

    Each code is decoded by itself, and Gauss–Newton starts from the same places, so that a shape does not depend on
    other codes.

    Args:
        bundle: verified.
        threads: shapes that may be reconstructed at once; each has a solver of its own. The first is made here, the
            others when they are needed, which takes about as long as a shape.

    Raises:
        BundleError: a network that doesn't load, or has other inputs or outputs than the manifest says.
    """

    def __init__(self, bundle: Bundle, threads: int = 1) -> None:
        manifest = bundle.manifest
        self.manifest, self.digest = manifest, bundle.digest
        self.latents = LatentSpace(manifest)
        self.reference, self.fine = bundle.reference, bundle.fine
        self.modes, self.file_vertices = bundle.modes, bundle.file_vertices
        self._surface = bundle.surface
        codes = self.training_codes = bundle.training_codes
        self._training = None if codes is None else TrainingCodes(self.latents, codes)
        #: What codes are like: those of the training shapes, or where there are none any inside the bounds.
        self.population = (
            Population.in_box(self.latents.lower, self.latents.upper)
            if codes is None
            else Population.of(codes, self.latents.width)
        )
        n_nric = 2 * manifest.edges
        self._factors = [Session(bundle, factor, [factor.stop - factor.start], [n_nric]) for factor in manifest.factors]
        self._combiner = Session(bundle, manifest.combiner, [len(manifest.factors), n_nric], [n_nric])
        self._start = None
        if manifest.start:
            self._start = Session(bundle, manifest.start, [manifest.latent_dimension], [manifest.vertices, 3])
        self._integrability = Integrability(self.reference.connectivity)
        #: Spaces for exact exponentials, one for each thread that computes some; made when none is free.
        self.spaces: queue.SimpleQueue[ShellSpace] = queue.SimpleQueue()
        self._solvers: queue.SimpleQueue[Reconstructor] = queue.SimpleQueue()
        self._first_solver = Reconstructor(self.reference, manifest.eta_reconstruction)
        # What it prepares at its first shape is done here, so that no request waits for it.
        self._first_solver.guess(nric(self.reference.vertices, self.reference.connectivity))
        self._solvers.put(self._first_solver)
        #: Solvers that may still be made: a server of many threads rarely needs them all.
        self._solvers_left, self._lock = threads - 1, threading.Lock()
        self._patience = PATIENCE

    def mesh(self, choice: MeshChoice) -> TriangleMesh:
        """The reference, normalised, as the fine or the coarse mesh; every shape has its faces."""
        fine = self.finer(choice)
        return fine.reference if fine else self.reference

    def surface(self, choice: MeshChoice) -> MeshAttributes | None:
        """What the user's file had on that mesh beside triangles; None for the coarse one of two."""
        return self._surface if self.fine is None or self.finer(choice) else None

    def finer(self, choice: MeshChoice) -> FineMesh | None:
        """The finer mesh, where the model has one and it is the choice; otherwise None."""
        return self.fine if choice is MeshChoice.FINE else None

    def reference_shape(self, mesh: MeshChoice = MeshChoice.FINE) -> Shape:
        """The reference itself: what is answered without a code."""
        diagnostics = Diagnostics(Status.CONVERGED, 0, 0.0, 0, 0.0, None, True, self.digest)
        vertices = self.manifest.scale * self.mesh(mesh).vertices
        return Shape(vertices, diagnostics, {"network": 0.0, "reconstruct": 0.0})

    def shape(
        self,
        code: Codes,
        inside_bounds: bool = True,
        mesh: MeshChoice = MeshChoice.FINE,
        deadline: Deadline | None = None,
        quality: Quality = Quality.FULL,
    ) -> Shape:
        """The shape of one code (m,), also where Gauss–Newton did not converge: the diagnostics say so.

        Args:
            code: checked by ``latents.codes``.
            inside_bounds: what the diagnostics say of it.
            mesh: fine or coarse.
            deadline: after which Gauss–Newton gives up with Status.DEADLINE.
            quality: a draft is from face frames; where they go astray the shape is solved after all.

        Raises:
            NotFiniteError: the code is so far outside the bounds that the numbers overflow.
            ModelFailedError: the networks failed at this code, or took too long.
        """
        began = time.perf_counter()
        _, target = self._networks(code[None])
        predicted = time.perf_counter()
        with self.solver() as reconstruct:
            draft = reconstruct.draft(target[0]) if quality is Quality.DRAFT else None
            found = draft or reconstruct.from_guess(
                target[0], *self._learned_start(code), tolerance=TOLERANCE, deadline=deadline
            )
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                vertices = self.finish(found.vertices, mesh)
            except np.linalg.LinAlgError:  # of the alignment, where vertices are not finite
                raise NotFiniteError(self._overflow) from None
            if found.status is Status.NOT_FINITE or not np.isfinite(vertices.astype(np.float32)).all():
                raise NotFiniteError(self._overflow)
        diagnostics = Diagnostics(
            found.status,
            found.iterations,
            found.residual,
            found.flipped_faces,
            float(np.sqrt((self._integrability.at_vertices(target[0]) ** 2).sum(axis=1).mean())),
            self._training.plausibility(code) if self._training else None,
            inside_bounds,
            self.digest,
            Quality.DRAFT if draft else Quality.FULL,
        )
        seconds = {"network": predicted - began, "reconstruct": time.perf_counter() - predicted}
        return Shape(vertices, diagnostics, seconds)

    def draft_error(self) -> dict[str, float]:
        """How far drafts are from full shapes: ``mean`` and ``p95`` over vertices of random codes' fine shapes.

        Shares of the diagonal of the reference; codes are uniform inside the bounds. Where frames go astray, a draft is
        the shape itself. Raises NotFiniteError or ModelFailedError.
        """
        size, away = self.manifest.scale * self.mesh(MeshChoice.FINE).diagonal, []
        for code in self.latents.sample(DRAFTED, 0, Distribution.UNIFORM):
            draft, full = (self.shape(code, quality=quality).vertices for quality in (Quality.DRAFT, Quality.FULL))
            away.append(np.linalg.norm(draft - full, axis=1) / size)
        return {"mean": float(np.mean(away)), "p95": float(np.percentile(away, 95))}

    def lengths_and_angles(self, code: Codes) -> LengthsAndAngles:
        """What the networks predict for a code (m,), before any reconstruction; raises NotFiniteError."""
        factors, z = (array[0].astype(np.float64) for array in self._networks(code[None]))
        half = self.manifest.edges
        for array in (factors, z):
            array[..., :half] *= self.manifest.scale
            with np.errstate(over="ignore"):
                if not np.isfinite(array.astype(np.float32)).all():
                    raise NotFiniteError(self._overflow)
        return LengthsAndAngles(z[:half], z[half:], factors)

    def nric(self, code: FloatArray) -> FloatArray:
        """What the networks predict for a code (m,): NRIC (2E,), normalised, not finite where they overflow."""
        return self._networks(code[None].astype(np.float32))[1][0]

    def factor(self, j: int, parts: FloatArray) -> FloatArray:
        """What the network of factor j predicts for its parts (n, m_j) of codes: NRIC (n, 2E), normalised."""
        with self._limited() as until:
            return self._factors[j](parts.astype(np.float32), until).astype(np.float64)

    def guesses(self, codes: Codes) -> FloatArray:
        """What the start network makes of codes (n, m): shapes (n, V, 3), normalised; ValueError if there is none."""
        if self._start is None:
            raise ValueError("the bundle has no start network")
        with self._limited() as until:
            return self._start(codes, until).astype(np.float64)

    def self_test(self) -> None:
        """Run every network once, at the ends of the bounds and between them, and reconstruct one shape.

        Raises:
            BundleError: something fails, so that the bundle must not be served.
        """
        for network in (*self._factors, self._combiner, *([self._start] if self._start else [])):
            network.check()
        try:
            middle, *others = self._middle_and_ends()
            for code in (*others, *self.latents.sample(REHEARSED, 0, Distribution.UNIFORM)):
                self._networks(code[None])
            for start in self._learned_start(middle):
                start()
            self.shape(middle)
        except ModelFailedError as error:
            raise BundleError(f"{error.__cause__}, at a code inside its bounds") from None
        except NotFiniteError:
            raise BundleError("the shape in the middle of its bounds is not finite") from None

    def _middle_and_ends(self) -> Codes:
        lower, upper = self.latents.lower, self.latents.upper
        return self.latents.codes([x.tolist() for x in (lower + (upper - lower) / 2, lower, upper)], Bounds.CLAMP)[0]

    def finish(self, shape: FloatArray, mesh: MeshChoice) -> FloatArray:
        """A shape (V, 3) in any pose as it is answered: on the mesh of choice, aligned, in the user's units."""
        return self.manifest.scale * self.placed(shape, mesh)

    def placed(self, shapes: FloatArray, mesh: MeshChoice, carried: FloatArray | None = None) -> FloatArray:
        """Shapes (…, V, 3) on the mesh of choice, aligned to its reference; or what is ``carried`` by that motion."""
        fine = self.finer(mesh)
        return align(fine.prolong(shapes) if fine else shapes, self.mesh(mesh).vertices, carried)

    def coarse(self, vertices: FloatArray, mesh: MeshChoice) -> FloatArray:
        """The coarse mesh's vertices, given those (V, 3) of the mesh of choice."""
        fine = self.finer(mesh)
        return vertices[fine.prolong.coarse_vertices] if fine else vertices

    def nearby(self, mesh: MeshChoice) -> FloatArray:
        """How many vertices of the mesh of choice lie nearest to each coarse one, (V,)."""
        fine = self.finer(mesh)
        return fine.nearby if fine else np.ones(len(self.reference.vertices))

    def _networks(self, codes: Codes) -> tuple[NDArray[np.float32], FloatArray]:
        """Factors (n, J, 2E) and combined NRIC (n, 2E), normalised."""
        with self._limited() as until:
            parts = [
                session(codes[:, factor.start : factor.stop], until)
                for session, factor in zip(self._factors, self.manifest.factors, strict=True)
            ]
            factors = np.stack(parts, axis=1)
            return factors, self._combiner(factors, until).astype(np.float64)

    def _learned_start(self, code: Codes) -> Iterator[Callable[[], FloatArray]]:
        if self._start:
            yield lambda: self.guesses(code[None])[0]

    @contextmanager
    def _limited(self) -> Iterator[float]:
        """Yields the moment by which networks must have answered; turns their errors into ModelFailedError."""
        patience = self._patience
        try:
            yield time.monotonic() + patience
            self._patience = min(PATIENCE, RECOVERY * self._patience)
        except NetworkError as error:
            logger.error("model %s/%s: %s", self.manifest.name, self.manifest.version, error)
            what_to_do = "Choose another code or model, and tell whoever runs the server."
            if isinstance(error, TerminatedError):
                self._patience = max(patience / 2, LEAST_PATIENCE)
                raise NetworkTimeError(
                    f"The model's networks did not answer within {patience:g} s at this code. {what_to_do}"
                ) from error
            raise ModelFailedError(f"The model's networks failed at this code. {what_to_do}") from error

    @contextmanager
    def solver(self) -> Iterator[Reconstructor]:
        """Lends a solver; waits while all are in use."""
        solver = self._spare_solver()
        try:
            yield solver
        finally:
            self._solvers.put(solver)

    def _spare_solver(self) -> Reconstructor:
        with suppress(queue.Empty):
            return self._solvers.get_nowait()
        with self._lock:
            make = self._solvers_left > 0
            self._solvers_left -= make
        return self._first_solver.another() if make else self._solvers.get()

    @property
    def _overflow(self) -> str:
        return (
            "The code lies so far outside the bounds that the model's numbers overflow. Choose one "
            f'nearer to the bounds, which the card of {self.manifest.name} lists, or send "bounds": "clamp".'
        )
