"""Finding latent codes: of mesh files, of vertices pulled elsewhere, at random."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.mesh.rigid_motion import Placement
from shapespace.model.correspondence import limits, match
from shapespace.model.decoder import MeshChoice
from shapespace.model.edit import PriorKind, Target, edited, require_targets
from shapespace.model.encode import Objective
from shapespace.model.latent_space import Bounds, Codes, Distribution
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.sandbox import Pieces, Sandbox
from shapespace.service.limits.sandbox_errors import (
    ClosedError,
    FailedError,
    LateError,
    NoProcessError,
    OutOfMemoryError,
    SandboxError,
)
from shapespace.service.limits.workers import BusyError, Caller, DeadlineError, EndingError, Workers
from shapespace.service.use_cases.batch import Timings, require_count
from shapespace.service.use_cases.shape_formats import dump_json, float32
from shapespace.service.use_cases.uploads import UPLOAD_ERRORS, UnusableMeshError
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

logger = logging.getLogger(__name__)
#: Bytes that reading a file may take beside the file.
MEMORY = 64 * 2**20
_LEAST = 2**16


@dataclass(frozen=True)
class Found:
    """What a search found.

    Attributes:
        content: as JSON.
        seconds: time by stage.
    """

    content: bytes
    seconds: Timings


@dataclass(frozen=True)
class Upload:
    """A mesh file that somebody has sent.

    Attributes:
        pieces: of the file, or of the form that holds it; emptied while it is read.
        content_type: as it was declared, or nothing.
        format: as it was asked for, which wins.
    """

    pieces: Pieces
    content_type: str
    format: str | None


@dataclass(frozen=True)
class SearchOptions:
    """What may be asked of any search for a code.

    Attributes:
        fixed: value by coordinate that the code keeps.
        samples: codes to draw from the posterior.
        seed: of these.
        most: samples that are answered at once.
    """

    fixed: Mapping[int, float]
    samples: int
    seed: int
    most: int

    def require_few(self) -> None:
        """Raise TooManyCodesError where there are to be more samples than that."""
        if self.samples:
            require_count(self.samples, self.most, "samples")


async def encode(
    workers: Workers,
    sandbox: Sandbox,
    caller: Caller,
    model: ShapeModel,
    upload: Upload,
    bounds: Bounds,
    objective: Objective,
    wishes: SearchOptions,
) -> Found:
    """The code whose shape comes closest to a mesh in correspondence, in any rigid pose; see ShapeModel.encode.

    Raises:
        UploadError, InvalidMeshError: no mesh that can be used.
        LatentError: numbers that overflow, a code outside the bounds where that is refused, or no such coordinate.
        TooManyCodesError: more samples than codes are answered at once.
        BusyError, DeadlineError, DisconnectedError, EndingError: no place, or the call ended before.
    """
    wishes.require_few()
    model.latents.fixed(wishes.fixed)  # refused before the file is read

    def make(deadline: Deadline) -> Found:
        began = time.perf_counter()
        given = match(model, *read_mesh(sandbox, upload, limits(model), deadline))
        read = time.perf_counter()
        found = model.encode(given, bounds, deadline, objective, wishes.fixed, wishes.samples, wishes.seed)
        if found.status is Status.DEADLINE:
            raise workers.late()
        seconds = {"read": read - began, "search": time.perf_counter() - read}
        content = {
            "latent": found.code,
            "residual": found.residual,
            "vertex_error": {"mean": found.distances.mean(), "max": found.distances.max()},
            "vertex_errors": float32(found.distances),
            "inside_bounds": found.inside_bounds,
            "status": found.status,
            "iterations": found.iterations,
            "mesh": found.mesh,
            "diagnostics": asdict(found.shape.diagnostics),
            "covariance": found.covariance,
            "samples": found.samples,
        }
        return Found(dump_json(content), seconds)

    async with workers.admit(caller) as call:
        return await workers.run(make, call)


async def edit(
    workers: Workers,
    caller: Caller,
    model: ShapeModel,
    latent: Sequence[float],
    targets: Sequence[Target],
    prior: float,
    prior_kind: PriorKind,
    mesh: MeshChoice,
    wishes: SearchOptions,
    anchored: bool = False,
) -> Found:
    """The code inside the bounds whose shape comes closest to having some vertices at some places.

    Args:
        workers: that compute.
        caller: who waits.
        model: whose code it is.
        latent: (m,) to start from, clamped to the bounds.
        targets: vertices of the mesh, and where they should be.
        prior: weight of the change of the code.
        prior_kind: what of the change costs.
        mesh: that the targets' vertices belong to.
        wishes: of the code and around it.
        anchored: whether the whole stays where it is.

    Raises:
        InvalidTargetError: no such vertex, or too many targets.
        LatentError: a start that can't be used, or no such coordinate.
        TooManyCodesError: more samples than codes are answered at once.
        BusyError, DeadlineError, DisconnectedError, EndingError: no place, or the call ended before.
    """
    require_targets(model, targets, mesh)
    wishes.require_few()
    start, _ = model.latents.code(latent, Bounds.CLAMP)
    fixed = model.latents.fixed(wishes.fixed)

    def make(deadline: Deadline) -> Found:
        began = time.perf_counter()
        found = edited(
            model, start, targets, prior, mesh, deadline, prior_kind, fixed, wishes.samples, wishes.seed, anchored
        )
        if found.status is Status.DEADLINE:
            raise workers.late()
        seconds = {"search": time.perf_counter() - began}
        content = {
            "latent": found.code,
            "residual": found.residual,
            "distances": found.distances,
            "status": found.status,
            "iterations": found.iterations,
            "placement": placement(found.placement),
            "diagnostics": asdict(found.shape.diagnostics),
            "covariance": found.covariance,
            "samples": found.samples,
        }
        return Found(dump_json(content), seconds)

    async with workers.admit(caller) as call:
        return await workers.run(make, call)


def sample(
    model: ShapeModel, count: int, seed: int, distribution: Distribution, temperature: float, most: int
) -> Codes:
    """Random codes (count, m), at most so many; see ShapeModel.sample.

    Raises:
        NoCodesError, TooManyCodesError: not between 1 and so many.
        LatentError: a temperature at which the numbers overflow.
    """
    require_count(count, most, "count")
    return model.sample(count, seed, distribution, temperature)


def placement(found: Placement) -> dict[str, Any]:
    """A placement as it is answered."""
    rotation = np.ascontiguousarray(found.rotation)  # as JSON takes it
    return {"rotation": rotation, "translation": found.translation, "scale": found.scale}


def read_mesh(sandbox: Sandbox, upload: Upload, limits: Limits, deadline: Deadline) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) and faces (F, 3) of an uploaded file; raises as ``read_upload``."""
    vertices, faces, _ = read_upload(sandbox, upload, limits, deadline)
    return vertices, faces


def read_upload(
    sandbox: Sandbox,
    upload: Upload,
    limits: Limits,
    deadline: Deadline,
    *,
    points: bool = False,
    memory: int = MEMORY,
) -> tuple[FloatArray, IntArray, str]:
    """Vertices (V, 3), faces (F, 3) and the form's ``options`` of an uploaded file, read in a process of its own.

    Args:
        sandbox: whose children know the task ``read``.
        upload: which is emptied.
        limits: of the mesh.
        deadline: after which the child is ended.
        points: whether points without faces will do.
        memory: bytes that reading may take beside the file.

    Raises:
        UploadError: no mesh that can be used.
        DeadlineError: the file was not read in time.
        BusyError: no process can be had.
        EndingError: the server ends.
    """
    facts = {"content_type": upload.content_type, "format": upload.format, "points": points}
    bounds = {"vertices": limits.vertices, "faces": limits.faces}
    most = 24 * (limits.vertices + limits.faces) + _LEAST
    try:
        said, arrays = sandbox.call("read", facts | bounds, upload.pieces, deadline=deadline, memory=memory, most=most)
    except FailedError as error:
        if error.kind in UPLOAD_ERRORS:
            raise UPLOAD_ERRORS[error.kind](error.sentence) from None
        logger.error("an uploaded file breaks its reader: %s", error.sentence)
        raise _unusable("it breaks its reader") from None
    except LateError:
        raise DeadlineError("The file was not read in time. Send a smaller one.") from None
    except NoProcessError as error:
        logger.error("uploads can't be read: %s", error)
        raise BusyError("No process can be had to read the file. Try again after Retry-After.") from None
    except OutOfMemoryError:
        raise _unusable("reading it takes more memory than a mesh of this model does") from None
    except ClosedError as error:
        raise EndingError("The server is about to end. Send the file to another one.") from error
    except SandboxError as error:
        raise _unusable(str(error)) from None
    return arrays["vertices"], arrays["faces"], str(said["options"])


def _unusable(why: str) -> UnusableMeshError:
    return UnusableMeshError(f"The mesh can't be used: {why}. Send a plain file of one mesh.")
