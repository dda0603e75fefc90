"""The model that library users load, with all its operations; most lines are documentation and tested examples."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from shapespace.arrays import FloatArray, IntArray
from shapespace.bundle.finding import find_bundle
from shapespace.bundle.reader import Bundle, BundleError, manifest_digest, read_bundle
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.blend_shapes import BlendShapes, blend_shapes
from shapespace.model.correspondence import Matched
from shapespace.model.decoder import Decoder, MeshChoice
from shapespace.model.edit import Edited, edited
from shapespace.model.encode import Encoded, Encoder
from shapespace.model.fit import Fitter
from shapespace.model.fit_result import Fitted
from shapespace.model.inputs import MeshLike, ScanLike, listed_targets, matched, points_and_faces
from shapespace.model.jacobian import NetworkDerivatives, shape_jacobian
from shapespace.model.latent_space import Bounds, Codes, Distribution, LatentError, NotFiniteError, WrongLengthError
from shapespace.model.options import EditOptions, EncodeOptions, FitOptions, Target
from shapespace.model.shape import Quality, Shape
from shapespace.model.vertex_uncertainty import require_covariance, vertex_uncertainty
from shapespace.solve.blas_threads import OneBlasThread
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

# Enumerations with their values, so that callers may write plain strings.
MeshName = MeshChoice | Literal["fine", "coarse"]
BoundsName = Bounds | Literal["allow", "clamp", "reject"]
QualityName = Quality | Literal["auto", "full", "draft"]
DistributionName = Distribution | Literal["uniform", "gaussian", "population"]


def load(folder: str | os.PathLike[str], threads: int = 1) -> ShapeModel:
    """Read a bundle, check every file against its manifest, and make a model of it.

    Args:
        folder: folder NAME/VERSION; folder NAME, for the highest version in it; or a name that ``shapespace.models``
            lists.
        threads: number of shapes that may be computed at once, see Decoder.

    Raises:
        BundleError: there is no such model, or its files differ from its manifest.

    >>> import shapespace
    >>> shapespace.load("figure")
    <ShapeModel figure/4: 20 coordinates, 10 factors, 4601 vertices>
    """
    return ShapeModel(read_bundle(find_bundle(folder)), threads)


def _load_unchanged(folder: Path, threads: int, digest: str) -> ShapeModel:
    if manifest_digest(find_bundle(folder)) != digest:
        raise BundleError(f"{folder} has changed since the model was pickled: load the model again, then pickle it")
    return ShapeModel(read_bundle(folder, digest), threads)


class ShapeModel:
    """A trained model, with the same operations as the HTTP interface.

    Codes are (m,) numbers, one for each coordinate. Positions are in the units of the training meshes, aligned to
    the reference. Several threads may call every method at once. A pickled model holds the folder of its bundle, and
    reads it again in the process that unpickles it.

    Args:
        bundle: verified bundle.
        threads: number of shapes that may be computed at once, see Decoder.

    Attributes:
        decoder: networks and solver of the model.
        folder: folder NAME/VERSION of the bundle.
        manifest, digest: manifest of the bundle, and its SHA-256.
        latents: latent coordinates with their names, bounds and periods.
        population: Gaussian of the training codes, or of uniform codes where the model has no training codes.
        reference: reference mesh, coarse and normalised.
        dimension: number m of coordinates of a code.
        names: name of each coordinate.
        lower, upper: bounds (m,) of the coordinates: the smallest and largest values in training. Both are read-only.
        period: period of each coordinate; None for a coordinate that is no angle.

    >>> import shapespace
    >>> model = shapespace.load("models/figure")
    >>> model.dimension, model.names[0], model.period[0]
    (20, 'left hip, 1', None)
    >>> model.vertices.shape, model.faces.shape
    ((4601, 3), (9198, 3))
    >>> model.manifest.factors[0].name
    'left hip'
    """

    @OneBlasThread()
    def __init__(self, bundle: Bundle, threads: int = 1) -> None:
        self.decoder = decoder = Decoder(bundle, threads)
        self.folder, self._threads = bundle.folder, threads
        self.manifest, self.digest, self.reference = decoder.manifest, decoder.digest, decoder.reference
        self.latents, self.population = decoder.latents, decoder.population
        self.dimension, self.names = self.latents.dimension, self.latents.names
        self.lower, self.upper, self.period = self.latents.lower, self.latents.upper, self.manifest.period

    def __repr__(self) -> str:
        facts = self.manifest
        return (
            f"<ShapeModel {facts.name}/{facts.version}: {self.dimension} coordinates, {len(facts.factors)} factors, "
            f"{len(self.vertices)} vertices>"
        )

    def __reduce__(self) -> tuple[object, ...]:
        return _load_unchanged, (self.folder, self._threads, self.digest)

    @property
    def faces(self) -> IntArray:
        """Faces (F, 3) of the fine mesh; ``model.mesh("coarse").faces`` are the faces of the coarse mesh."""
        return self.mesh().faces

    @property
    def vertices(self) -> FloatArray:
        """Vertices (V, 3) of the reference on the fine mesh, in the units of the training meshes."""
        return self.decoder.reference_shape().vertices

    def mesh(self, mesh: MeshName = "fine") -> TriangleMesh:
        """Return the normalised reference on the fine or the coarse mesh; every shape has its faces.

        >>> import shapespace
        >>> model = shapespace.load("models/figure")
        >>> model.mesh("coarse").vertices.shape
        (1000, 3)
        """
        return self.decoder.mesh(MeshChoice(mesh))

    @OneBlasThread()
    def shape(
        self,
        code: ArrayLike,
        inside_bounds: bool = True,
        mesh: MeshName = "fine",
        deadline: Deadline | float | None = None,
        quality: QualityName = "auto",
        examples: bool = True,
    ) -> Shape:
        """Return the shape of one checked code (m,) with its diagnostics, even if Gauss–Newton did not converge.

        Args:
            code: code from ``model.latents.codes`` or ``model.sample``.
            inside_bounds: whether the code lies inside the bounds, for the diagnostics.
            mesh: "fine" or "coarse".
            deadline: time limit, or seconds, after which Gauss–Newton stops with Status.DEADLINE.
            quality: "auto"; "full" for the converged solution; or "draft", which leaves Gauss–Newton out. See Quality.
            examples: False leaves out what the model remembers of training shapes.

        Raises:
            LatentError: the code is so far outside the bounds that it has no shape.
            ModelFailedError: the networks failed at this code, or took too long.

        >>> import shapespace
        >>> model = shapespace.load("models/figure")
        >>> shape = model.shape(model.sample(1)[0])
        >>> shape.vertices.shape, shape.diagnostics.status
        ((4601, 3), <Status.CONVERGED: 'converged'>)
        """
        given = np.asarray(code, dtype=np.float32)
        return self.decoder.shape(
            given, inside_bounds, MeshChoice(mesh), Deadline.of(deadline), Quality(quality), examples
        )

    @OneBlasThread()
    def decode(
        self,
        codes: ArrayLike,
        mesh: MeshName = "fine",
        bounds: BoundsName = "allow",
        quality: QualityName = "auto",
        examples: bool = True,
    ) -> FloatArray:
        """Return the shapes of codes.

        Warns with RuntimeWarning if Gauss–Newton did not converge; ``shape`` gives the diagnostics of one code.

        Args:
            codes: codes (n, m), or one code (m,).
            mesh: "fine" or "coarse"; a model without a finer mesh returns its only mesh for both.
            bounds: "allow" extrapolates outside the bounds, "clamp" moves to the nearest bound, "reject" refuses.
            quality: "auto"; "full" for the converged solution; or "draft", which leaves Gauss–Newton out. See Quality.
            examples: False leaves out what the model remembers of training shapes.

        Returns:
            Positions (n, V, 3), or (V, 3) for one code.

        Raises:
            LatentError: a code has the wrong length, is not finite, lies outside the bounds with "reject", or is so
                far outside the bounds that it has no shape.
            ModelFailedError: the networks failed at a code, or took too long.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> model.decode(np.zeros((2, 20))).shape
        (2, 4601, 3)
        >>> model.decode(np.zeros(20), mesh="coarse").shape
        (1000, 3)
        """
        values, choice = np.asarray(codes, dtype=np.float64), MeshChoice(mesh)
        if values.ndim not in (1, 2):
            raise WrongLengthError(f"codes must be (n, m) or (m,), not {values.shape}")
        checked, inside = self.latents.codes(np.atleast_2d(values), Bounds(bounds))
        positions = np.empty((len(checked), *self.mesh(choice).vertices.shape))
        ended = []
        solved = self.decoder.shapes(checked, inside, choice, quality=Quality(quality), examples=examples)
        for k, shape in enumerate(solved):
            positions[k] = shape.vertices
            ended.append(shape.diagnostics.status)
        missed = [k for k, status in enumerate(ended) if status is not Status.CONVERGED]
        if missed:
            warnings.warn(
                f"{len(missed)} of {len(ended)} shapes did not converge; the first is that of code {missed[0]}: "
                f"{ended[missed[0]]}",
                RuntimeWarning,
                stacklevel=3,  # the decorator's frame lies between,
            )
        return positions if values.ndim == 2 else positions[0]

    @OneBlasThread()
    def jacobian(self, code: ArrayLike, mesh: MeshName = "fine") -> FloatArray:
        """Return the derivatives of a shape's positions by its code.

        They are exact for the full shape: derivatives of the networks, and of the minimum that Gauss–Newton finds. The
        first call reads the networks again.

        Args:
            code: code (m,); inside or outside the bounds.
            mesh: "fine" or "coarse".

        Returns:
            Derivatives (V, 3, m), in the units of the training meshes for each unit of a coordinate.

        Raises:
            LatentError: the code has the wrong length or is not finite, or its shape has no derivative.
            BundleError: a network has operators whose derivatives are not known.
            ModelFailedError: the networks failed at the code, or took too long.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> model.jacobian(np.zeros(20)).shape
        (4601, 3, 20)
        """
        checked, _ = self.latents.code(np.asarray(code, dtype=np.float64).tolist())
        return shape_jacobian(self.decoder, self._network_derivatives, checked, MeshChoice(mesh))

    @cached_property
    def _network_derivatives(self) -> NetworkDerivatives:
        return NetworkDerivatives(self.decoder, read_bundle(self.folder, self.digest).networks)

    @OneBlasThread()
    def blend_shapes(self, mesh: MeshName = "fine") -> BlendShapes:
        """Return linear blend shapes: code 0, both ends of each coordinate, and the error against the model.

        Args:
            mesh: "fine" or "coarse".

        Raises:
            PeriodicError: some coordinates are angles, which have no ends.
            LatentError: the model has no finite shape at an end.
            ModelFailedError: the networks failed, or took too long.

        >>> import shapespace
        >>> model = shapespace.load("models/figure")
        >>> blend = model.blend_shapes("coarse")
        >>> blend.names[:2], blend.ends.shape, 0.001 < blend.error["mean"] < 0.05
        (['left hip, 1 +', 'left hip, 1 -'], (40, 1000, 3), True)
        >>> blend.glb()[:4]
        b'glTF'
        """
        choice = MeshChoice(mesh)
        return blend_shapes(self.decoder, choice, lambda code: self.shape(code, mesh=choice, quality=Quality.FULL))

    @OneBlasThread()
    def encode(
        self,
        mesh: MeshLike | Matched,
        options: EncodeOptions | None = None,
        *,
        deadline: Deadline | float | None = None,
        **changes: Any,
    ) -> Encoded:
        """Find the code whose shape comes closest to a mesh in correspondence, in any rigid pose.

        Args:
            mesh: the fine or the coarse mesh of the model in the units of the training meshes: vertices (V, 3) in the
                model's order, a mesh, or the path of an OBJ, PLY, STL, OFF, glTF or NPZ file.
            options: options of the search.
            deadline: time limit, or seconds, after which the status is Status.DEADLINE.
            changes: single options by name, for example ``objective="nric"``; see EncodeOptions.

        Raises:
            MeshError: the file can't be read.
            InvalidMeshError: the mesh is none of the model's meshes, or its size suggests other units: less than a
                third or more than three times the size of the training meshes.
            LatentError: numbers overflow, the code lies outside the bounds with "reject", or a fixed coordinate does
                not exist.
            ModelFailedError: the networks failed, or took too long.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> code = np.linspace(-0.5, 0.5, 20)
        >>> found = model.encode(model.decode(code))
        >>> bool(np.abs(found.code - code).max() < 1e-2), found.mesh, found.shape.vertices.shape
        (True, <MeshChoice.FINE: 'fine'>, (4601, 3))
        """
        given = mesh if isinstance(mesh, Matched) else matched(self.decoder, mesh)
        return self._encoder(given, EncodeOptions.of(options, changes), Deadline.of(deadline))

    @OneBlasThread()
    def edit(
        self,
        code: ArrayLike,
        targets: Mapping[int, ArrayLike] | Sequence[Target],
        options: EditOptions | None = None,
        *,
        deadline: Deadline | float | None = None,
        **changes: Any,
    ) -> Edited:
        """Find the code inside the bounds whose shape comes closest to having some vertices at given positions.

        Vertices without a target stay in place as far as possible. ``placement`` moves the new code's shape, as
        ``decode`` returns it, into the frame of the start's shape. ``distances`` and ``residual`` are measured there.

        Args:
            code: code (m,) to start from; it is first moved to the nearest bounds.
            targets: at least one target: positions (3,) by vertex, or Targets; in the frame of the shape that
                ``decode`` returns for ``code``.
            options: options of the edit.
            deadline: time limit, or seconds, after which the status is Status.DEADLINE.
            changes: single options by name, for example ``prior=1e-3``; see EditOptions.

        Raises:
            LatentError: the code has the wrong length, numbers are not finite, or a fixed coordinate does not exist.
            InvalidTargetError: there is no target, the mesh does not have a vertex, or a sigma is not above 0.
            ModelFailedError: the networks failed, or took too long.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> wanted = model.decode(np.full(20, 0.2))
        >>> found = model.edit(np.zeros(20), {vertex: wanted[vertex] for vertex in (10, 2000, 4600)})
        >>> size = np.linalg.norm(np.ptp(wanted, axis=0))
        >>> found.code.shape, bool(found.residual < 0.01 * size)
        ((20,), True)
        """
        chosen = EditOptions.of(options, changes)
        start, _ = self.latents.code(np.asarray(code, dtype=np.float64).tolist(), Bounds.CLAMP)
        return edited(self.decoder, start, listed_targets(targets, chosen.sigma), chosen, Deadline.of(deadline))

    @OneBlasThread()
    def fit_scan(
        self,
        scan: ScanLike,
        options: FitOptions | None = None,
        *,
        deadline: Deadline | float | None = None,
        progress: Callable[[float], None] | None = None,
        **changes: Any,
    ) -> Fitted:
        """Find the code of a scan: points or a mesh without correspondence, whole or in part, in any pose, with noise.

        Args:
            scan: points (N, 3); points and faces (F, 3); a mesh; or the path of an OBJ, PLY, STL, OFF, glTF, NPZ or XYZ
                file. In the units of the training meshes unless the scale is free.
            options: options of the fit.
            deadline: time limit, or seconds, after which the status is "deadline".
            progress: called from time to time with the share of the work that is done.
            changes: single options by name, for example ``partial=True``; see FitOptions.

        Returns:
            Code, covariance, placement and distances. ``status`` and ``reason`` say how the fit ended.

        Raises:
            MeshError: the file can't be read.
            InvalidScanError: the scan or an option can't be used.
            LatentError: a fixed coordinate does not exist, or numbers overflow.
            ModelFailedError: the networks failed, or took too long.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> code = np.linspace(-0.5, 0.5, 20)
        >>> points = np.random.default_rng(0).permutation(model.decode(code))[:3000] + [3, 0, 1]
        >>> found = model.fit_scan(points)
        >>> found.status, found.covariance.shape
        (<FitStatus.CONVERGED: 'converged'>, (20, 20))
        >>> there = found.placement(found.shape.vertices)
        >>> bool(np.abs(there - model.decode(code) - [3, 0, 1]).max() < 0.01)
        True
        """
        return self._fitter(*points_and_faces(scan), FitOptions.of(options, changes), Deadline.of(deadline), progress)

    fit = fit_scan  # The old name remains for one release.

    def sample(
        self, count: int, seed: int = 0, distribution: DistributionName = "uniform", temperature: float = 1.0
    ) -> Codes:
        """Return random codes (count, m); one seed gives the same codes on every machine.

        Args:
            count: number of codes.
            seed: seed of the random numbers.
            distribution: "uniform" in the bounds. "gaussian": around the middle of the bounds with a standard deviation
                of a quarter of their width, cut off at the bounds. "population": the Gaussian with shrinkage of the
                training codes, not cut off; without training codes, mean and variances of uniform codes.
            temperature: factor of the differences from the mean of the population; only for "population".

        Raises:
            LatentError: the count or the seed is negative; the temperature is negative, not finite, so large that the
                numbers overflow, or for another distribution.

        >>> import shapespace
        >>> model = shapespace.load("models/figure")
        >>> codes = model.sample(3, seed=1)
        >>> codes.shape, bool((codes >= model.lower.astype("f4")).all() and (codes <= model.upper.astype("f4")).all())
        ((3, 20), True)
        """
        if count < 0 or seed < 0:
            raise LatentError(f"count is {count} and seed is {seed}: neither may be negative.")
        if Distribution(distribution) is not Distribution.POPULATION:
            if temperature != 1:
                raise LatentError('temperature is only for the distribution "population".')
            return self.latents.sample(count, seed, Distribution(distribution))
        if not 0 <= temperature < np.inf:
            raise NotFiniteError(f"temperature is {temperature:g}. Give a finite number of at least 0.")
        return self.latents.codes(self.population.sample(count, seed, temperature))[0]

    @OneBlasThread()
    def vertex_uncertainty(self, code: ArrayLike, covariance: ArrayLike, mesh: MeshName = "fine") -> FloatArray:
        """Return the standard deviation (V,) of the vertices of a code's shape, as ``decode`` returns them.

        Args:
            code: code (m,).
            covariance: covariance (m, m) of codes around it, from ``edit``, ``encode`` or ``fit_scan``.
            mesh: "fine" or "coarse".

        Raises:
            LatentError: the code has the wrong length, numbers are not finite, or the matrix is no covariance.
            ModelFailedError: the networks failed, or took too long.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> model.vertex_uncertainty(np.zeros(20), model.population.covariance).shape
        (4601,)
        """
        checked, _ = self.latents.code(np.asarray(code, dtype=np.float64).tolist())
        return vertex_uncertainty(self.decoder, checked, require_covariance(self.decoder, covariance), MeshChoice(mesh))

    spread = vertex_uncertainty  # The old name remains for one release.

    @cached_property
    def _encoder(self) -> Encoder:
        return Encoder(self.decoder)

    @cached_property
    def _fitter(self) -> Fitter:
        return Fitter(self.decoder)
