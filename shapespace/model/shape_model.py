"""A model as a library: codes to vertices, meshes and pulled vertices back to codes, random codes."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from shapespace.arrays import FloatArray, IntArray
from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import MANIFEST, VERSION_PATTERN
from shapespace.files.formats import read_arrays
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.blend_shapes import BlendShapes, blend_shapes
from shapespace.model.correspondence import InvalidMeshError, Matched, match
from shapespace.model.decoder import Decoder, MeshChoice, Quality
from shapespace.model.edit import PRIOR, Edited, PriorKind, Target, edited
from shapespace.model.encode import Encoded, Encoder, Objective
from shapespace.model.fit import FitOptions, Fitted, Fitter, Landmark, Prior, ScaleChoice
from shapespace.model.latent_space import Bounds, Codes, Distribution, NotFiniteError, WrongLengthError
from shapespace.model.vertex_uncertainty import require_covariance, vertex_uncertainty
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

#: The values of the enumerations, so that callers may write plain strings.
MeshName = MeshChoice | Literal["fine", "coarse"]
BoundsName = Bounds | Literal["allow", "clamp", "reject"]
QualityName = Quality | Literal["full", "draft"]
ObjectiveName = Objective | Literal["vertices", "nric"]
DistributionName = Distribution | Literal["uniform", "gaussian", "population"]
PriorName = PriorKind | Literal["groups", "ridge"]
ScaleName = ScaleChoice | Literal["fixed", "free"]
ExpectedName = Prior | Literal["population", "box"]


def load(folder: str | os.PathLike[str], threads: int = 1) -> ShapeModel:
    """Read a bundle, check every file against its manifest, and make a model of it.

    Args:
        folder: NAME/VERSION, or NAME for the highest version there.
        threads: shapes that may be computed at once, see Decoder.

    Raises:
        BundleError: no bundle, or one that is not exactly as its manifest says.

    >>> import shapespace
    >>> shapespace.load("models/figure")
    <ShapeModel figure/3: 20 coordinates, 10 factors, 4601 vertices>
    """
    path = Path(os.path.abspath(folder))  # the names of the last two folders count, also of "."
    if not (path / MANIFEST).exists():
        try:
            versions = [int(entry.name) for entry in path.iterdir() if re.fullmatch(VERSION_PATTERN, entry.name)]
        except OSError as error:
            raise BundleError(f"{path} can't be read: {error.strerror}") from None
        if not versions:
            raise BundleError(f"{path} holds no bundle: give a folder NAME/VERSION, or NAME with versions in it")
        path /= str(max(versions))
    return ShapeModel(read_bundle(path), threads)


class ShapeModel(Decoder):
    """A bundle at work, with the calls that the HTTP interface has.

    Codes are (m,) numbers, one for each coordinate; positions are in the units of the training meshes, aligned to the
    reference. Every method may be called from several threads at once.

    >>> import shapespace
    >>> model = shapespace.load("models/figure")
    >>> model.dimension, model.names[0], model.period[0]
    (20, 'left hip, 1', None)
    >>> model.vertices.shape, model.faces.shape
    ((4601, 3), (9198, 3))
    >>> model.manifest.factors[0].name
    'left hip'
    """

    def __repr__(self) -> str:
        facts = self.manifest
        return (
            f"<ShapeModel {facts.name}/{facts.version}: {self.dimension} coordinates, {len(facts.factors)} factors, "
            f"{len(self.vertices)} vertices>"
        )

    @property
    def dimension(self) -> int:
        """Number m of coordinates of a code."""
        return self.latents.dimension

    @property
    def names(self) -> list[str]:
        """Name of each coordinate."""
        return self.latents.names

    @property
    def lower(self) -> FloatArray:
        """(m,) lower bound of each coordinate, the smallest that was trained."""
        return self.latents.lower

    @property
    def upper(self) -> FloatArray:
        """(m,) upper bound of each coordinate."""
        return self.latents.upper

    @property
    def period(self) -> list[float | None]:
        """Period of each coordinate; None for those that are no angles."""
        return self.manifest.period

    @property
    def faces(self) -> IntArray:
        """(F, 3) faces of the fine mesh; ``model.mesh(MeshChoice.COARSE)`` has those of the coarse one."""
        return self.mesh(MeshChoice.FINE).faces

    @property
    def vertices(self) -> FloatArray:
        """(V, 3) the reference shape on the fine mesh, in the units of the training meshes."""
        return self.reference_shape().vertices

    def decode(
        self, codes: ArrayLike, mesh: MeshName = "fine", bounds: BoundsName = "allow", quality: QualityName = "full"
    ) -> FloatArray:
        """The shapes of codes.

        Warns with RuntimeWarning where Gauss–Newton did not converge; ``shape`` gives the diagnostics of one code.

        Args:
            codes: (n, m), or one code (m,).
            mesh: "fine" or "coarse"; a model without a finer mesh answers both with the one it has.
            bounds: "allow" extrapolates outside the bounds, "clamp" moves to the nearest bound, "reject" refuses.
            quality: "full", or "draft", which leaves Gauss–Newton out where the first guess is near enough.

        Returns:
            Positions (n, V, 3), or (V, 3) of one code.

        Raises:
            LatentError: a code of the wrong length, not finite, or out of bounds where that is refused.
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
        for k, code in enumerate(checked):
            shape = self.shape(code, bool(inside[k]), choice, quality=Quality(quality))
            positions[k] = shape.vertices
            ended.append(shape.diagnostics.status)
        missed = [k for k, status in enumerate(ended) if status is not Status.CONVERGED]
        if missed:
            warnings.warn(
                f"{len(missed)} of {len(ended)} shapes did not converge; the first is that of code {missed[0]}: "
                f"{ended[missed[0]]}",
                RuntimeWarning,
                stacklevel=2,
            )
        return positions if values.ndim == 2 else positions[0]

    def blend_shapes(self, mesh: MeshName = "fine") -> BlendShapes:
        """The model as linear blend shapes: code 0, and both ends of each coordinate; with how far that is from it.

        Args:
            mesh: "fine" or "coarse".

        Raises:
            PeriodicError: there are angles among the coordinates, which have no ends.
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
        return blend_shapes(self, choice, lambda code: self.shape(code, mesh=choice))

    def encode(
        self,
        mesh: ArrayLike | TriangleMesh | Matched | str | os.PathLike[str],
        bounds: BoundsName = "allow",
        deadline: Deadline | None = None,
        objective: ObjectiveName = "vertices",
        fixed: Mapping[int, float] | None = None,
        samples: int = 0,
        seed: int = 0,
    ) -> Encoded:
        """The code whose shape comes closest to a mesh in correspondence, in any rigid pose.

        Args:
            mesh: the fine or the coarse mesh of the model, as vertices (V, 3) in its order, as a mesh, or as the path
                of an OBJ, PLY, STL, OFF, glTF or NPZ file; in the units of the training meshes.
            bounds: "allow" lets the code lie up to half the bounds' width outside, "clamp" searches inside only,
                "reject" refuses a code outside.
            deadline: after which the status is Status.DEADLINE.
            objective: what comes closest, "vertices" after rigid alignment, or "nric", lengths and angles, in their
                weighted norm.
            fixed: value by coordinate that the code keeps, in the bounds or not.
            samples: codes to draw from the posterior.
            seed: of these.

        Raises:
            MeshError: a file that can't be read.
            InvalidMeshError: none of the model's meshes, or not in their units: less than a third or more than three
                times as large.
            LatentError: numbers that overflow, a code out of bounds where that is refused, or no such coordinate.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> code = np.linspace(-0.5, 0.5, 20)
        >>> found = model.encode(model.decode(code))
        >>> bool(np.abs(found.code - code).max() < 1e-2), found.mesh, found.shape.vertices.shape
        (True, <MeshChoice.FINE: 'fine'>, (4601, 3))
        """
        given = mesh if isinstance(mesh, Matched) else self._matched(mesh)
        return self._encoder(
            given, Bounds(bounds), deadline, Objective(objective), self.latents.fixed(fixed), samples, seed
        )

    def edit(
        self,
        code: ArrayLike,
        targets: Mapping[int, ArrayLike],
        prior: float = PRIOR,
        mesh: MeshName = "fine",
        deadline: Deadline | None = None,
        prior_kind: PriorName = "groups",
        sigma: float | Mapping[int, float] | None = None,
        fixed: Mapping[int, float] | None = None,
        samples: int = 0,
        seed: int = 0,
        anchored: bool = False,
    ) -> Edited:
        """The code inside the bounds whose shape comes closest to having some vertices at some places.

        What is not asked to move stays where it is, as far as it can: ``placement`` takes what ``decode`` answers for
        the new code into the frame of the start's shape, in which ``distances`` and ``residual`` are measured.

        Args:
            code: (m,) to start from; moved to the nearest bounds first.
            targets: position (3,) by vertex, at least one, in the frame of what ``decode`` answers for ``code``.
            prior: weight of the mean square change of the code, in widths of the bounds, against the mean square
                distance from the targets, in diagonals of the bounding box.
            mesh: whose vertices are meant, "fine" or "coarse".
            deadline: after which the status is Status.DEADLINE.
            prior_kind: "groups" changes few factors, "ridge" all of them a little.
            sigma: standard deviation of targets, of all or by vertex; half a percent of the diagonal where there is
                none.
            fixed: value by coordinate that the code keeps, in the bounds or not.
            samples: codes to draw from the posterior.
            seed: of these.
            anchored: whether the place of the whole is by what is not pulled alone, so that targets out of reach do not
                carry it along.

        Raises:
            LatentError: a code of the wrong length, numbers that are not finite, or no such coordinate.
            InvalidTargetError: no targets, a vertex that the mesh does not have, or a sigma that is not above 0.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> wanted = model.decode(np.full(20, 0.2))
        >>> found = model.edit(np.zeros(20), {vertex: wanted[vertex] for vertex in (10, 2000, 4600)})
        >>> size = np.linalg.norm(np.ptp(wanted, axis=0))
        >>> found.code.shape, bool(found.residual < 0.01 * size)
        ((20,), True)
        """
        start, _ = self.latents.code(np.asarray(code, dtype=np.float64).tolist(), Bounds.CLAMP)
        sigmas = sigma if isinstance(sigma, Mapping) else dict.fromkeys(targets, sigma)
        pulled = [
            Target(int(v), np.asarray(place, dtype=np.float64).tolist(), sigmas.get(v)) for v, place in targets.items()
        ]
        held = self.latents.fixed(fixed)
        return edited(
            self, start, pulled, prior, MeshChoice(mesh), deadline, PriorKind(prior_kind), held, samples, seed, anchored
        )

    def fit(
        self,
        scan: ArrayLike | TriangleMesh | tuple[ArrayLike, ArrayLike] | str | os.PathLike[str],
        *,
        scale: ScaleName = "fixed",
        partial: bool = False,
        noise: float | None = None,
        landmarks: Sequence[Landmark] = (),
        fixed: Mapping[int, float] | None = None,
        distribution: ExpectedName = "population",
        samples: int = 0,
        points: bool = False,
        used: bool = False,
        seed: int = 0,
        deadline: Deadline | None = None,
    ) -> Fitted:
        """The code of a scan: points or a mesh of any connectivity, whole or in part, in any pose, with noise.

        Args:
            scan: points (N, 3); or these and faces (F, 3); or a mesh; or the path of an OBJ, PLY, STL, OFF, glTF, NPZ
                or XYZ file. In the units of the training meshes unless the scale is free.
            scale: "fixed", or "free": the scan's size is found too.
            partial: whether the scan shows a part of the shape only, as from one camera.
            noise: standard deviation of the scan's points, in its units; by default it is estimated.
            landmarks: vertices of the fine mesh whose places are known; three or more decide where the search begins.
            fixed: values of coordinates that keep them, by index.
            distribution: what codes are held to be like: "population", the Gaussian of the training codes, or "box",
                any inside the bounds.
            samples: codes to draw from the posterior.
            points: whether the distance of each point and of each vertex is wanted.
            used: whether the points that stood for the scan are wanted.
            seed: of all random numbers; one seed gives the same answer.
            deadline: after which the status is "deadline".

        Returns:
            Code, covariance, placement, distances and how the fit ended: look at ``status`` and ``reason``.

        Raises:
            MeshError: a file that can't be read.
            InvalidScanError: a scan or an option that can't be used.
            LatentError: fixed coordinates that the model doesn't have, or with which its numbers overflow.
            ModelFailedError: the networks failed, or took too long.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> code = np.linspace(-0.5, 0.5, 20)
        >>> points = np.random.default_rng(0).permutation(model.decode(code))[:3000] + [3, 0, 1]
        >>> found = model.fit(points)
        >>> found.status, found.covariance.shape
        (<FitStatus.CONVERGED: 'converged'>, (20, 20))
        >>> there = found.placement(found.shape.vertices)
        >>> bool(np.abs(there - model.decode(code) - [3, 0, 1]).max() < 0.01)
        True
        """
        options = FitOptions(
            scale=ScaleChoice(scale),
            partial=partial,
            noise=noise,
            landmarks=landmarks,
            fixed=fixed,
            prior=Prior(distribution),
            samples=samples,
            points=points,
            used=used,
            seed=seed,
        )
        return self.fitter(*_points_and_faces(scan), options, deadline)

    def sample(
        self, count: int, seed: int = 0, distribution: DistributionName = "uniform", temperature: float = 1.0
    ) -> Codes:
        """Random codes (count, m); one seed gives the same on every machine.

        Args:
            count: how many.
            seed: of the random numbers.
            distribution: "uniform" in the bounds, or "gaussian": around their middle with a standard deviation of a
                quarter of their width, cut off at them. Or "population": the Gaussian with shrinkage fitted to the
                codes of the training shapes (without any: with mean and variances of uniform ones), not cut off.
            temperature: factor of the differences from the mean of the population; the others have none.

        Raises:
            LatentError: a temperature that is negative, not finite, or so large that the numbers overflow.

        >>> import shapespace
        >>> model = shapespace.load("models/figure")
        >>> codes = model.sample(3, seed=1)
        >>> codes.shape, bool((codes >= model.lower.astype("f4")).all() and (codes <= model.upper.astype("f4")).all())
        ((3, 20), True)
        """
        if Distribution(distribution) is not Distribution.POPULATION:
            return self.latents.sample(count, seed, Distribution(distribution))
        if not 0 <= temperature < np.inf:
            raise NotFiniteError(f"temperature is {temperature:g}. Give a finite number of at least 0.")
        return self.latents.codes(self.population.sample(count, seed, temperature))[0]

    def vertex_uncertainty(self, code: ArrayLike, covariance: ArrayLike, mesh: MeshName = "fine") -> FloatArray:
        """Standard deviation (V,) of where the vertices of a code's shape are, as ``decode`` answers them.

        Args:
            code: (m,).
            covariance: (m, m) of codes around it, as ``edit`` and ``encode`` find it.
            mesh: "fine" or "coarse".

        Raises:
            LatentError: a code of the wrong length, or numbers that are not finite, or no covariance.

        >>> import numpy as np, shapespace
        >>> model = shapespace.load("models/figure")
        >>> model.spread(np.zeros(20), model.population.covariance).shape
        (4601,)
        """
        checked, _ = self.latents.code(np.asarray(code, dtype=np.float64).tolist())
        return vertex_uncertainty(self, checked, require_covariance(self, covariance), MeshChoice(mesh))

    @cached_property
    def _encoder(self) -> Encoder:
        return Encoder(self)

    @cached_property
    def fitter(self) -> Fitter:
        """What fits scans, with all options in one; made at the first scan."""
        return Fitter(self)

    def _matched(self, mesh: ArrayLike | TriangleMesh | str | os.PathLike[str]) -> Matched:
        if isinstance(mesh, TriangleMesh):
            return match(self, mesh.vertices, mesh.faces)
        if isinstance(mesh, str | os.PathLike):
            return match(self, *read_arrays(Path(mesh)))
        vertices = np.asarray(mesh, dtype=np.float64)
        if vertices.ndim != 2 or vertices.shape[1] != 3:
            raise InvalidMeshError(f"vertices must be (V, 3), not {vertices.shape}")
        return match(self, vertices, np.empty((0, 3), np.int64))


def _points_and_faces(
    scan: ArrayLike | TriangleMesh | tuple[ArrayLike, ArrayLike] | str | os.PathLike[str],
) -> tuple[FloatArray, IntArray]:
    """Of what ``fit`` takes; no faces where there are none."""
    if isinstance(scan, TriangleMesh):
        return scan.vertices, scan.faces
    if isinstance(scan, str | os.PathLike):
        points, faces = read_arrays(Path(scan), points=True)
    elif isinstance(scan, tuple):
        points, faces = (np.asarray(part) for part in scan)
    else:
        points, faces = np.asarray(scan), np.empty((0, 3))
    return points.astype(np.float64), faces.reshape(-1, 3).astype(np.int64)
