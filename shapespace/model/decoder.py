"""Decoding: networks turn latent codes into lengths and angles, and Gauss–Newton turns these into vertices."""

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray
from shapespace.bundle.geometry import FineMesh
from shapespace.bundle.reader import Bundle, BundleError
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import MAX_ITERATIONS, Reconstruction, Reconstructor
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.choice import Choice
from shapespace.model.latent_space import Bounds, Codes, Distribution, LatentSpace, NotFiniteError, TrainingCodes
from shapespace.model.memory import FACTOR, Examples, Fade, on_segment, switched
from shapespace.model.networks import ModelFailedError, Patience, Session
from shapespace.model.population import Population
from shapespace.model.shape import Diagnostics, Quality, Shape
from shapespace.shell.space import ShellSpace
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

#: Gauss–Newton stops when no vertex moves by more than this fraction of the diagonal: a fiftieth of a pixel if a shape
#: fills a screen.
TOLERANCE = 2e-5
#: Number of random codes in the self-test.
TESTED_CODES = 2
#: Networks run for several codes at once, with at most this number of edges together. More take longer for each code,
#: because the numbers no longer fit into the processor's cache.
BATCH_EDGES = 24_000
#: Most iterations for ``auto`` where frames are inconsistent, to its own tolerance. If that fails or leaves folded
#: faces, the shape is solved to TOLERANCE. For the 1 % of the codes of Freaky Torus that are so solved, this takes half
#: of the time of solving all to TOLERANCE, and raises the error by a sixth.
QUICK_ITERATIONS = 12
#: Most iterations of that solve outside the bounds, so that an answer takes less than a second.
ITERATIONS_OUTSIDE = 30
#: Largest share of triangles whose predicted sides can't form a triangle. Inside the bounds of the bundled models there
#: are none. Beyond a tenth, a third of the faces of the solved shape are flipped.
BROKEN_TRIANGLES = 0.1


class MeshChoice(Choice):
    """Mesh of a shape; a model without a finer mesh returns its only mesh for both."""

    FINE = "fine"
    COARSE = "coarse"


class Decoder:
    """Networks and Gauss–Newton solvers of a bundle; any number of threads may use it.

    Gauss–Newton begins at fixed starts, so a shape does not depend on earlier ones. If several codes are decoded at
    once, their networks run together, except for full shapes. This changes the last digits.

    Up to ``threads`` shapes may be reconstructed at once, each with its own solver. The first solver is made here,
    others when they are needed, which takes about as long as a shape. Raises BundleError if a network doesn't load, or
    its inputs or outputs differ from the manifest.
    """

    def __init__(self, bundle: Bundle, threads: int = 1) -> None:
        manifest = bundle.manifest
        self.manifest, self.digest = manifest, bundle.digest
        self.latents = LatentSpace(manifest)
        self.reference, self.fine = bundle.reference, bundle.fine
        self.modes, self.file_vertices = bundle.modes, bundle.file_vertices
        self._surface = bundle.surface
        self._nearer = (
            f"Choose a code nearer to the bounds, which the card of {manifest.name} lists, or set bounds to clamp."
        )
        self._overflow = f"The code lies so far outside the bounds that the model's numbers overflow. {self._nearer}"
        #: Tolerance of the quality ``auto``, and its measured error; None if ``auto`` answers full shapes.
        self.auto = manifest.auto_error
        codes = self.training_codes = bundle.training_codes
        self._training = None if codes is None else TrainingCodes(self.latents, codes)
        #: Distribution of codes: of the training codes, or of uniform codes if there are no training codes.
        self.population = (
            Population.in_box(self.latents.lower, self.latents.upper)
            if codes is None
            else Population.of(codes, self.latents.width)
        )
        n_nric = 2 * manifest.edges
        self._factors = [Session(bundle, factor, [factor.stop - factor.start], [n_nric]) for factor in manifest.factors]
        with_switch = switched(bundle.networks[manifest.combiner.file])
        #: Whether the combiner has a memory of training shapes.
        self.remembers = with_switch is not None
        self._combiner = Session(bundle, manifest.combiner, [len(manifest.factors), n_nric], [n_nric], with_switch)
        self._start = None
        if manifest.start:
            self._start = Session(bundle, manifest.start, [manifest.latent_dimension], [manifest.vertices, 3])
        self._integrability = Integrability(self.reference.connectivity)
        #: Spaces for exact exponentials, one for each thread that computes them; made when no space is free.
        self.spaces: queue.SimpleQueue[ShellSpace] = queue.SimpleQueue()
        self._solvers: queue.SimpleQueue[Reconstructor] = queue.SimpleQueue()
        self._first_solver = Reconstructor(self.reference, manifest.eta_reconstruction)
        # The preparation at the first shape is done here, so that no request waits for it.
        self._first_solver.guess(nric(self.reference.vertices, self.reference.connectivity))
        self._solvers.put(self._first_solver)
        #: Number of solvers that may still be made. A server with many threads rarely needs all of them.
        self._solvers_left, self._lock = threads - 1, threading.Lock()
        self._patience = Patience(f"{manifest.name}/{manifest.version}")

    def mesh(self, choice: MeshChoice) -> TriangleMesh:
        """Return the normalised reference as the fine or the coarse mesh; every shape has its faces."""
        fine = self.finer(choice)
        return fine.reference if fine else self.reference

    def surface(self, choice: MeshChoice) -> MeshAttributes | None:
        """Return the training file's attributes of a mesh beside triangles; None for the coarse one of two meshes."""
        return self._surface if self.fine is None or self.finer(choice) else None

    def finer(self, choice: MeshChoice) -> FineMesh | None:
        """Return the finer mesh if the model has one and the choice is fine; otherwise None."""
        return self.fine if choice is MeshChoice.FINE else None

    def reference_shape(self, mesh: MeshChoice = MeshChoice.FINE) -> Shape:
        """Return the reference as a shape, for requests without a code."""
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
        examples: Examples = True,
    ) -> Shape:
        """Decode one code (m,), even if Gauss–Newton does not converge: the diagnostics say so.

        A draft comes from face frames. Where these are inconsistent, the shape is solved nevertheless, for ``auto``
        with few iterations if they suffice. After the deadline Gauss–Newton stops with Status.DEADLINE.

        Raises NotFiniteError if the code is far outside the bounds: numbers overflow, or no surface has the predicted
        lengths. Raises ModelFailedError if the networks failed at this code, or took too long.
        """
        return next(self.shapes(code[None], [inside_bounds], mesh, deadline, quality, examples))

    def batches(self, codes: Codes, quality: Quality) -> Iterator[slice]:
        """Yield ranges of codes (n, m) for which networks run at once: in a third to all of the time of single codes.

        Sums in another order change the last digits, so full shapes are computed one by one.
        """
        full = self._answered(quality) is Quality.FULL
        size = 1 if full else max(1, BATCH_EDGES // self.manifest.edges)
        return (slice(k, k + size) for k in range(0, len(codes), size))

    def frames(self, codes: Codes, quality: Quality, memory: Examples) -> Iterator[slice]:
        """Yield ranges of frames with codes (n, m) for which networks run at once. A frame alone has the same bytes:
        its run has as many rows, and it has the same row. Without a memory, each frame has a run of its own.
        """
        if isinstance(memory, Fade) and self.remembers and self._answered(quality) is not Quality.FULL:
            return memory.runs()
        return (slice(k, k + 1) for k in range(len(codes)))

    def _answered(self, quality: Quality) -> Quality:
        """Return the quality that is computed first: ``full`` for ``auto`` if the bundle has no tolerance."""
        return Quality.FULL if quality is Quality.AUTO and self.auto is None else quality

    def shapes(
        self,
        codes: Codes,
        inside_bounds: Sequence[bool] | NDArray[np.bool_],
        mesh: MeshChoice = MeshChoice.FINE,
        deadline: Deadline | None = None,
        quality: Quality = Quality.FULL,
        examples: Examples = True,
    ) -> Iterator[Shape]:
        """Decode codes (n, m) one after another; see `shape`, `batches`, and `Examples`."""
        quality = self._answered(quality)
        whole = isinstance(examples, bool)
        for some in self.batches(codes, quality) if whole else self.frames(codes, quality, examples):
            began = time.perf_counter()
            memory = examples if isinstance(examples, bool) else examples[some]
            targets = self.targets(codes[some], memory, quality)
            seconds = (time.perf_counter() - began) / len(targets)
            for code, target, inside in zip(codes[some], targets, inside_bounds[some], strict=True):
                yield self._solved(code, target, bool(inside), mesh, deadline, quality, seconds)

    def _solved(
        self,
        code: Codes,
        target: FloatArray,
        inside_bounds: bool,
        mesh: MeshChoice,
        deadline: Deadline | None,
        quality: Quality,
        predicting: float,
    ) -> Shape:
        """Solve for the shape of one code (m,), whose lengths and angles (2E,) took ``predicting`` seconds."""
        began = time.perf_counter()
        self._require_triangles(target)
        found = None
        with self.solver() as reconstruct:
            if quality is not Quality.FULL:
                auto = self.auto if quality is Quality.AUTO else None
                tolerance, good_misfit = (auto.tolerance, auto.draft_misfit) if auto else (None, 0.0)
                found = reconstruct.draft(target, tolerance, good_misfit, deadline)
            if found is None:
                quality = Quality.FULL if quality is Quality.DRAFT else quality
                found = self._from_guess(reconstruct, code, target, quality, inside_bounds, deadline)
        with np.errstate(over="ignore", invalid="ignore"):
            try:
                vertices = self.finish(found.vertices, mesh)
            except np.linalg.LinAlgError:  # an alignment of vertices that are not finite
                raise NotFiniteError(self._overflow) from None
            if found.status is Status.NOT_FINITE or not np.isfinite(vertices.astype(np.float32)).all():
                raise NotFiniteError(self._overflow)
        diagnostics = Diagnostics(
            found.status,
            found.iterations,
            found.residual,
            found.flipped_faces,
            float(np.sqrt((self._integrability.at_vertices(target) ** 2).sum(axis=1).mean())),
            self._training.plausibility(code) if self._training else None,
            inside_bounds,
            self.digest,
            quality,
        )
        seconds = {"network": predicting, "reconstruct": time.perf_counter() - began}
        return Shape(vertices, diagnostics, seconds)

    def _from_guess(
        self,
        reconstruct: Reconstructor,
        code: Codes,
        target: FloatArray,
        quality: Quality,
        inside_bounds: bool,
        deadline: Deadline | None,
    ) -> Reconstruction:
        """Reconstruct a shape without a draft; for ``auto`` in few iterations, and in more where faces are folded."""
        efforts = [(TOLERANCE, MAX_ITERATIONS)]
        if quality is Quality.AUTO and self.auto is not None:
            most = MAX_ITERATIONS if inside_bounds else ITERATIONS_OUTSIDE
            efforts = [(self.auto.tolerance or TOLERANCE, QUICK_ITERATIONS), (TOLERANCE, most)]
        for tolerance, limit in efforts:
            starts = self._learned_start(code)
            found = reconstruct.from_guess(
                target, *starts, tolerance=tolerance, max_iterations=limit, deadline=deadline
            )
            if found.converged and not found.flipped_faces:
                break
        return found

    def lengths_and_angles(self, code: Codes) -> tuple[FloatArray, FloatArray]:
        """Return edge lengths and dihedral angles in radians (2E,) that the networks predict for a code (m,).

        Also return each factor's lengths and angles (J, 2E). Lengths are in the user's units. Raises NotFiniteError.
        """
        factors, z = (array[0].astype(np.float64) for array in self._networks(code[None]))
        half = self.manifest.edges
        for array in (factors, z):
            array[..., :half] *= self.manifest.scale
            with np.errstate(over="ignore"):
                if not np.isfinite(array.astype(np.float32)).all():
                    raise NotFiniteError(self._overflow)
        return z, factors

    def nric(self, code: FloatArray) -> FloatArray:
        """Return the predicted NRIC (2E,) of a code (m,), normalised; not finite where the networks overflow."""
        return self._networks(code[None].astype(np.float32))[1][0]

    def nric_nearby(self, code: FloatArray, steps: FloatArray) -> Iterator[FloatArray]:
        """Yield the predicted NRIC (2E,) of a code (m,), then of m codes that each differ by one coordinate's step."""
        factors, z = self._networks(code[None].astype(np.float32))
        yield z[0]
        for j, factor in enumerate(self.manifest.factors):
            for k in range(factor.start, factor.stop):
                with self._patience.limited() as until:
                    part, others = code[None, factor.start : factor.stop].copy(), factors.copy()
                    part[0, k - factor.start] += steps[k]
                    others[:, j] = self._factors[j](part.astype(np.float32), until)
                    z = self._combiner(others, until).astype(np.float64)
                yield z[0]

    def exchanged(self, code: FloatArray, j: int, parts: FloatArray) -> FloatArray:
        """Return the predicted NRIC (n, 2E) of a code (m,) whose part of factor j is each of parts (n, m_j)."""
        factors, _ = self._networks(code[None].astype(np.float32))
        size = max(1, BATCH_EDGES // self.manifest.edges)
        found = []
        for k in range(0, len(parts), size):
            with self._patience.limited() as until:
                own = self._factors[j](parts[k : k + size].astype(np.float32), until)
                others = np.repeat(factors, len(own), axis=0)
                others[:, j] = own
                found.append(self._combiner(others, until).astype(np.float64))
        return np.concatenate(found)

    def factor(self, j: int, parts: FloatArray) -> FloatArray:
        """Return the NRIC (n, 2E) of factor j for its parts (n, m_j) of codes, normalised."""
        with self._patience.limited() as until:
            return self._factors[j](parts.astype(np.float32), until).astype(np.float64)

    def guesses(self, codes: Codes) -> FloatArray:
        """Return the start network's normalised shapes (n, V, 3) of codes (n, m); ValueError if there is none."""
        if self._start is None:
            raise ValueError("the bundle has no start network")
        with self._patience.limited() as until:
            return self._start(codes, until).astype(np.float64)

    def self_test(self) -> None:
        """Run every network at the ends of the bounds and between them, and reconstruct one shape. Raises BundleError
        if something fails, so the bundle must not be served.
        """
        for network in (*self._factors, self._combiner, *([self._start] if self._start else [])):
            network.check()
        try:
            lower, upper = self.latents.lower, self.latents.upper
            ends = [x.tolist() for x in (lower + (upper - lower) / 2, lower, upper)]
            middle, *others = self.latents.codes(ends, Bounds.CLAMP)[0]
            for code in (*others, *self.latents.sample(TESTED_CODES, 0, Distribution.UNIFORM)):
                self._networks(code[None])
            for start in self._learned_start(middle):
                start()
            self.shape(middle)
        except ModelFailedError as error:
            raise BundleError(f"{error.__cause__}, at a code inside its bounds") from None
        except NotFiniteError:
            raise BundleError("the shape in the middle of its bounds is not finite") from None

    def finish(self, shape: FloatArray, mesh: MeshChoice) -> FloatArray:
        """Bring a shape (V, 3) in any pose to the mesh of choice, aligned, in the user's units."""
        return self.manifest.scale * self.placed(shape, mesh)

    def placed(self, shapes: FloatArray, mesh: MeshChoice, carried: FloatArray | None = None) -> FloatArray:
        """Return shapes (…, V, 3) on the mesh of choice, aligned to the reference; or ``carried`` points so moved."""
        fine = self.finer(mesh)
        return align(fine.prolong(shapes) if fine else shapes, self.mesh(mesh).vertices, carried)

    def coarse(self, vertices: FloatArray, mesh: MeshChoice) -> FloatArray:
        """Return the coarse vertices among the vertices (V, 3) of the mesh of choice."""
        fine = self.finer(mesh)
        return vertices[fine.prolong.coarse_vertices] if fine else vertices

    def nearby(self, mesh: MeshChoice) -> FloatArray:
        """Return for each coarse vertex the number (V,) of vertices of the mesh of choice that lie nearest to it."""
        fine = self.finer(mesh)
        return fine.nearby if fine else np.ones(len(self.reference.vertices))

    def targets(self, codes: Codes, examples: Examples, quality: Quality = Quality.FULL) -> FloatArray:
        """Return combined NRIC (n, 2E), with the memory of training shapes as wanted."""
        if isinstance(examples, Fade):
            if self.remembers:
                run, several = lambda *rows: self._networks(*rows)[1], self._answered(quality) is not Quality.FULL
                ranges = self.frames(codes, quality, examples)
                return np.concatenate([on_segment(run, codes[some], examples[some], several) for some in ranges])
            examples = True
        factor = None if examples or not self.remembers else np.zeros((1, 1), np.float32)
        return self._networks(codes, factor)[1]

    def _networks(
        self, codes: Codes, memory: NDArray[np.float32] | None = None
    ) -> tuple[NDArray[np.float32], FloatArray]:
        """Return factors (n, J, 2E) and combined NRIC (n, 2E), normalised. ``memory`` are factors of the memory."""
        with self._patience.limited() as until:
            parts = [
                session(codes[:, factor.start : factor.stop], until)
                for session, factor in zip(self._factors, self.manifest.factors, strict=True)
            ]
            factors = np.stack(parts, axis=1)
            options = None if memory is None else {FACTOR: memory}
            return factors, self._combiner(factors, until, options).astype(np.float64)

    def _require_triangles(self, target: FloatArray) -> None:
        """Raise NotFiniteError if too many triangles of a prediction (2E,) can't exist, see BROKEN_TRIANGLES."""
        a, b, c = target.take(self.reference.connectivity.face_sides)
        # Also false for NaN, which Gauss–Newton reports.
        broken = (a + b <= c) | (b + c <= a) | (c + a <= b)
        if broken.mean() > BROKEN_TRIANGLES:
            raise NotFiniteError(
                f"The code lies so far outside the bounds that no surface has the predicted lengths: "
                f"{broken.mean():.0%} of the triangles would have a side longer than the other two together. "
                f"{self._nearer}"
            )

    def _learned_start(self, code: Codes) -> Iterator[Callable[[], FloatArray]]:
        if self._start:
            yield lambda: self.guesses(code[None])[0]

    @contextmanager
    def solver(self) -> Iterator[Reconstructor]:
        """Lend a solver; wait while all solvers are in use."""
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
