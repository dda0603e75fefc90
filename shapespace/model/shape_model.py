"""One bundle at work: latent codes to lengths and angles, and those to vertices."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.bundle.geometry import FineMesh
from shapespace.bundle.reader import Bundle, BundleError
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import Reconstruction, Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.derivatives import FactorGrids
from shapespace.model.latent_space import Bounds, Codes, Distribution, LatentSpace, NotFiniteError, TrainingCodes
from shapespace.model.networks import PATIENCE, NetworkError, Session, TerminatedError
from shapespace.shell.space import ShellSpace
from shapespace.solve.deadline import Deadline
from shapespace.solve.status import Status

logger = logging.getLogger(__name__)
#: Gauss–Newton stops once no vertex moves further than this fraction of the diagonal: a fiftieth of a pixel where a
#: shape fills a screen, and less than the residual that the diagnostics tell changes by.
TOLERANCE = 2e-5
#: A model that has taken too long gets half the time from then on, but this at least: whoever asks for such codes again
#: and again should not keep the workers from the other models.
LEAST_PATIENCE, RECOVERY = 0.5, 1.1
#: Random codes at which a model is rehearsed.
REHEARSED = 2


class ModelFailedError(RuntimeError):
    """A model whose networks fail at a code, with a sentence that says what to do; the cause says which, and how."""


class NetworkTimeError(ModelFailedError):
    """A model whose networks take too long at a code."""


class MeshChoice(StrEnum):
    """Which mesh to answer; a model without a finer one answers both with the one it has."""

    FINE = "fine"
    COARSE = "coarse"


@dataclass(frozen=True)
class Diagnostics:
    """How well a shape was found.

    Attributes:
        status: how Gauss–Newton ended, see shapespace.coordinates.reconstruction.Status.
        iterations: its steps.
        residual: distance between the lengths and angles asked for and those of the shape, relative,
            weighted norm.
        flipped_faces: faces at an edge that is folded more than π/2 away from what was asked for.
        integrability: how far the lengths and angles asked for are from those of any surface: root mean square over
            vertices of ``|Q(z)|``, the sine of half the angle by which faces around a vertex fail to close.
        plausibility: distance to the nearest code of a training shape, in multiples of the distance that these
            typically have from each other; None where the model has no such codes.
        inside_bounds: whether the code lies inside the model's bounds.
        model: digest of the model.
    """

    status: Status
    iterations: int
    residual: float
    flipped_faces: int
    integrability: float
    plausibility: float | None
    inside_bounds: bool
    model: str


@dataclass(frozen=True)
class Shape:
    """A shape as it leaves: aligned to the reference, in the units of the training meshes.

    Attributes:
        vertices: (V, 3), of the mesh that was asked for.
        diagnostics: how well it was found; of the coarse mesh.
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


class ShapeModel:
    """The networks and the Gauss–Newton solver of a bundle, ready for any number of threads.

    Every code goes through the networks on its own and starts from the same place, so that a shape doesn't
    depend on what it was asked for together with.

    Args:
        bundle: verified.
        threads: shapes that may be reconstructed at once; each gets a solver, the first one here and the others when
            they are first needed, which takes about as long as a shape.

    Raises:
        BundleError: a network that doesn't load, or has other inputs or outputs than the manifest says.
    """

    def __init__(self, bundle: Bundle, threads: int = 1) -> None:
        manifest = bundle.manifest
        self.manifest, self.digest = manifest, bundle.digest
        self.latents = LatentSpace(manifest)
        self.reference, self.fine = bundle.reference, bundle.fine
        self.modes, self.file_vertices = bundle.modes, bundle.file_vertices
        codes = bundle.training_codes
        self._training = None if codes is None else TrainingCodes(self.latents, codes)
        n_nric = 2 * manifest.edges
        self._factors = [Session(bundle, factor, [factor.stop - factor.start], [n_nric]) for factor in manifest.factors]
        self._combiner = Session(bundle, manifest.combiner, [len(manifest.factors), n_nric], [n_nric])
        self._start = None
        if manifest.start:
            self._start = Session(bundle, manifest.start, [manifest.latent_dimension], [manifest.vertices, 3])
        self._integrability = Integrability(self.reference.connectivity)
        #: Spaces for exact exponentials; who finds none makes one.
        self.spaces: queue.SimpleQueue[ShellSpace] = queue.SimpleQueue()
        self._solvers: queue.SimpleQueue[Reconstructor] = queue.SimpleQueue()
        self._first = Reconstructor(self.reference, manifest.eta_reconstruction)
        self._first.guess(nric(self.reference.vertices, self.reference.connectivity))  # so that no request waits for it
        self._solvers.put(self._first)
        #: Solvers that may still be made: a server of many threads rarely needs them all.
        self._more, self._counting = threads - 1, threading.Lock()
        self._patience = PATIENCE

    @cached_property
    def grids(self) -> FactorGrids:
        """What ``encode`` looks for starts on."""
        return FactorGrids.of(self)

    def mesh(self, choice: MeshChoice) -> TriangleMesh:
        """The reference, normalised, on the mesh of choice; its faces are those of every shape."""
        fine = self.finer(choice)
        return fine.reference if fine else self.reference

    def finer(self, choice: MeshChoice) -> FineMesh | None:
        """The finer mesh, where there is one and it is the choice."""
        return self.fine if choice is MeshChoice.FINE else None

    def reference_shape(self, mesh: MeshChoice = MeshChoice.FINE) -> Shape:
        """The reference itself: the answer where there is no code."""
        diagnostics = Diagnostics(Status.CONVERGED, 0, 0.0, 0, 0.0, None, True, self.digest)
        vertices = self.manifest.scale * self.mesh(mesh).vertices
        return Shape(vertices, diagnostics, {"network": 0.0, "reconstruct": 0.0})

    def shape(
        self,
        code: Codes,
        inside_bounds: bool = True,
        mesh: MeshChoice = MeshChoice.FINE,
        deadline: Deadline | None = None,
    ) -> Shape:
        """The shape of one code (m,), whatever Gauss–Newton's status.

        Args:
            code: checked by ``latents.codes``.
            inside_bounds: goes into the diagnostics.
            mesh: fine or coarse.
            deadline: after which Gauss–Newton gives up with Status.DEADLINE.

        Raises:
            NotFiniteError: the code is so far out that the numbers overflow.
            ModelFailedError: the networks failed at this code, or took too long.
            DeadlineError: the deadline passed while they were at work.
        """
        began = time.perf_counter()
        _, target = self._networks(code[None])
        predicted = time.perf_counter()
        with self.solver() as reconstruct:
            found: Reconstruction = reconstruct.from_guess(
                target[0], *self._learned_start(code), tolerance=TOLERANCE, deadline=deadline
            )
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                vertices = self.finish(found.vertices, mesh)
            except np.linalg.LinAlgError:  # aligned, what isn't finite
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
        )
        seconds = {"network": predicted - began, "reconstruct": time.perf_counter() - predicted}
        return Shape(vertices, diagnostics, seconds)

    def lengths_and_angles(self, code: Codes) -> LengthsAndAngles:
        """What the networks say to a code (m,), before any reconstruction; raises NotFiniteError."""
        factors, z = (array[0].astype(np.float64) for array in self._networks(code[None]))
        half = self.manifest.edges
        for array in (factors, z):
            array[..., :half] *= self.manifest.scale
            with np.errstate(over="ignore"):
                if not np.isfinite(array.astype(np.float32)).all():
                    raise NotFiniteError(self._overflow)
        return LengthsAndAngles(z[:half], z[half:], factors)

    def nric(self, code: FloatArray) -> FloatArray:
        """What the networks say to a code (m,): (2E,), normalised, not finite where they overflow."""
        return self._networks(code[None].astype(np.float32))[1][0]

    def factor(self, j: int, parts: FloatArray) -> FloatArray:
        """What factor j's network alone says to parts (n, m_j) of codes: (n, 2E), normalised."""
        with self._limited() as until:
            return self._factors[j](parts.astype(np.float32), until).astype(np.float64)

    def rehearse(self) -> None:
        """Do once what serving does: every network, at the ends of its bounds and elsewhere, and one shape.

        Raises:
            BundleError: it must not be served.
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
        """A shape (V, 3) in any pose as it leaves: on the mesh of choice, aligned, in the training meshes' units."""
        return self.manifest.scale * self.placed(shape, mesh)

    def placed(self, shapes: FloatArray, mesh: MeshChoice, carried: FloatArray | None = None) -> FloatArray:
        """Shapes (…, V, 3) on the mesh of choice, aligned to its reference; instead of them what is carried along."""
        fine = self.finer(mesh)
        return align(fine.prolong(shapes) if fine else shapes, self.mesh(mesh).vertices, carried)

    def coarse(self, vertices: FloatArray, mesh: MeshChoice) -> FloatArray:
        """The vertices (V, 3) of the coarse mesh among those of a mesh of choice."""
        fine = self.finer(mesh)
        return vertices[fine.prolong.coarse_vertices] if fine else vertices

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
        if network := self._start:

            def start() -> FloatArray:
                with self._limited() as until:
                    return network(code[None], until)[0].astype(np.float64)

            yield start

    @contextmanager
    def _limited(self) -> Iterator[float]:
        """The moment by which networks must have answered; what they raise becomes what callers know."""
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
        """A solver for the time being; waits for one where all are in use."""
        solver = self._spare_solver()
        try:
            yield solver
        finally:
            self._solvers.put(solver)

    def _spare_solver(self) -> Reconstructor:
        with suppress(queue.Empty):
            return self._solvers.get_nowait()
        with self._counting:
            make = self._more > 0
            self._more -= make
        return self._first.another() if make else self._solvers.get()

    @property
    def _overflow(self) -> str:
        return (
            "The code lies so far outside the bounds that the model's numbers overflow. Choose one "
            f'nearer to the bounds, which the card of {self.manifest.name} lists, or send "bounds": "clamp".'
        )
