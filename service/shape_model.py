"""One bundle at work: latent codes to lengths and angles, and those to vertices."""

from __future__ import annotations

import queue
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from geometry.calculus import ShellSpace
from geometry.integrability import Integrability
from geometry.mesh import FloatArray, TriangleMesh, align
from geometry.nric import nric
from geometry.reconstruction import Reconstruction, Reconstructor
from geometry.status import Status
from service.bundle import Bundle, BundleError, FineMesh
from service.derivatives import FactorGrids
from service.latent_space import Codes, LatentSpace, NotFiniteError, TrainingCodes
from service.manifest import Network

#: Gauss–Newton stops once no vertex moves further than this fraction of the diagonal: a fiftieth of a pixel where a
#: shape fills a screen, and less than the residual that the diagnostics tell changes by.
TOLERANCE = 2e-5


class MeshChoice(StrEnum):
    """Which mesh to answer; a model without a finer one answers both with the one it has."""

    FINE = "fine"
    COARSE = "coarse"


@dataclass(frozen=True)
class Diagnostics:
    """How well a shape was found.

    Attributes:
        status: how Gauss–Newton ended, see geometry.reconstruction.Status.
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
        threads: shapes that may be reconstructed at once; each gets a solver, analysed here and not in a
            request.

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
        self._factors = [
            _Session(bundle, factor, [factor.stop - factor.start], [n_nric]) for factor in manifest.factors
        ]
        self._combiner = _Session(bundle, manifest.combiner, [len(manifest.factors), n_nric], [n_nric])
        self._start = None
        if manifest.start:
            self._start = _Session(bundle, manifest.start, [manifest.latent_dimension], [manifest.vertices, 3])
        self._integrability = Integrability(self.reference.connectivity)
        #: Spaces for exact exponentials; who finds none makes one.
        self.spaces: queue.SimpleQueue[ShellSpace] = queue.SimpleQueue()
        self._solvers: queue.SimpleQueue[Reconstructor] = queue.SimpleQueue()
        first = Reconstructor(self.reference, manifest.eta_reconstruction)
        for solver in (first, *(first.another() for _ in range(threads - 1))):
            solver.guess(nric(self.reference.vertices, self.reference.connectivity))  # so that no request waits for it
            self._solvers.put(solver)

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
        deadline: float | None = None,
    ) -> Shape:
        """The shape of one code (m,), whatever Gauss–Newton's status.

        Args:
            code: checked by ``latents.codes``.
            inside_bounds: goes into the diagnostics.
            mesh: fine or coarse.
            deadline: time.monotonic() after which Gauss–Newton gives up with Status.DEADLINE.

        Raises:
            NotFiniteError: the code is so far out that the numbers overflow.
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
        return self._factors[j](parts.astype(np.float32)).astype(np.float64)

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
        parts = [
            session(codes[:, factor.start : factor.stop])
            for session, factor in zip(self._factors, self.manifest.factors, strict=True)
        ]
        factors = np.stack(parts, axis=1)
        return factors, self._combiner(factors).astype(np.float64)

    def _learned_start(self, code: Codes) -> Iterator[Callable[[], FloatArray]]:
        if network := self._start:
            yield lambda: network(code[None])[0].astype(np.float64)

    @contextmanager
    def solver(self) -> Iterator[Reconstructor]:
        """A solver for the time being; waits for one where all are in use."""
        solver = self._solvers.get()
        try:
            yield solver
        finally:
            self._solvers.put(solver)

    @property
    def _overflow(self) -> str:
        return (
            "The code lies so far outside the bounds that the model's numbers overflow. Choose one "
            f'nearer to the bounds, which the card of {self.manifest.name} lists, or send "bounds": "clamp".'
        )


class _Session:
    """One ONNX network, checked once against what the manifest says of it.

    Args:
        bundle: holds its bytes.
        network: names of file, input and output.
        inputs, outputs: expected shape of one row.
    """

    def __init__(self, bundle: Bundle, network: Network, inputs: list[int], outputs: list[int]) -> None:
        options = onnxruntime.SessionOptions()
        # The workers run side by side, a network inside one of them: a second layer of threads would only
        # get in the way. The arena keeps the memory of the largest run for ever.
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.enable_cpu_mem_arena = False
        options.log_severity_level = 3
        try:
            self._session = onnxruntime.InferenceSession(
                bundle.networks[network.file], options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # ONNX Runtime's exceptions have no common public class
            raise BundleError(f"{network.file} does not load: {str(error).splitlines()[0]}") from None
        for role, nodes, name, row in (
            ("input", self._session.get_inputs(), network.input, inputs),
            ("output", self._session.get_outputs(), network.output, outputs),
        ):
            if [node.name for node in nodes] != [name] or not _fits(nodes[0], row):
                have = ", ".join(f"{node.name} {node.type} {node.shape}" for node in nodes)
                raise BundleError(f"{network.file} must have one {role}, {name} float32 [n, {row}], but has {have}")
        # It keeps the file for a change of providers, which there is none of here: 20 MB with both bundled models.
        self._session._model_bytes = None
        self._input, self._output, self._shape = network.input, network.output, tuple(outputs)
        result = self(np.zeros((2, *inputs), np.float32))
        if result.shape != (2, *outputs) or not np.isfinite(result).all():
            raise BundleError(f"{network.file} does not give finite [n, {outputs}] for zeros")

    def __call__(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        result: Any = self._session.run([self._output], {self._input: rows})[0]
        return result


def _fits(node: Any, row: list[int]) -> bool:
    """Whether a value is float32 with a free first dimension, and the known others as wanted."""
    shape = node.shape
    return (
        node.type == "tensor(float)"
        and len(shape) == 1 + len(row)
        and not isinstance(shape[0], int)
        and all(size == want or not isinstance(size, int) for size, want in zip(shape[1:], row, strict=True))
    )
