"""Find latent codes: of mesh files, of edited vertices, of scans, and random ones."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, TypeVar

from shapespace.files.limits import Limits
from shapespace.model.correspondence import InvalidMeshError, limits, match
from shapespace.model.edit import require_targets
from shapespace.model.latent_space import Bounds
from shapespace.model.options import EditOptions, EncodeOptions, FitOptions, SearchOptions, Target
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.sandbox import Pieces, Sandbox
from shapespace.service.limits.sandbox_messages import (
    ClosedError,
    FailedError,
    LateError,
    NoProcessError,
    OutOfMemoryError,
    SandboxError,
)
from shapespace.service.limits.workers import Call, Caller
from shapespace.service.refusals import RefusedError
from shapespace.service.tracing import record_stages
from shapespace.service.use_cases.batch import EncodedFile, Timings, require_count
from shapespace.service.use_cases.shape_formats import dump_json, float32
from shapespace.service.use_cases.uploads import TOGETHER, UPLOAD_KINDS, UploadedMesh
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

K = TypeVar("K")

logger = logging.getLogger(__name__)
#: Memory in bytes that reading a file may take in addition to the file.
MEMORY = 64 * 2**20
#: Maximum numbers of vertices and faces of a scan; memory in bytes that reading may take in addition to the file.
SCAN_LIMITS, SCAN_MEMORY = Limits(2**21, 2**21), 256 * 2**20
#: Bytes of a reading process's answer beside the arrays.
_ANSWER = 2**16
#: Advice for a search that has no result at its deadline: for `encode` and `edit`, and for `fit`.
_LATER = "Try again when the server is less busy."
_SMALLER = f"Fit fewer points or a coarser scan. {_LATER}"


#: Members of an answer, and the time by stage.
Answered = tuple[dict[str, Any], Timings]


@dataclass(frozen=True)
class Upload:
    """An uploaded mesh file.

    Attributes:
        pieces: pieces of the file, or of the form that holds it; reading empties them.
        content_type: declared media type, or an empty string.
        format: format from the query, which has priority.
        known: names of the fields that a form may have beside the file.
    """

    pieces: Pieces
    content_type: str
    format: str | None
    known: Sequence[str] = ()


#: A function that returns the model and the options that a client asks for, given the fields of the form.
Asked = Callable[[Mapping[str, str]], tuple[ShapeModel, K]]


async def encode(
    caller: Caller,
    sandbox: Sandbox,
    asked: Asked[EncodeOptions],
    upload: Upload,
    most: int,
) -> EncodedFile:
    """Find the code of an uploaded mesh in correspondence, with at most ``most`` samples; see ShapeModel.encode.

    An archive may hold up to ``most`` meshes. The answer then has the code of each, with the name of its file.

    Raises:
        RefusedError, InvalidMeshError: the mesh can't be used, or there are more than ``most`` samples.
        LatentError: numbers overflow, the code lies outside the bounds where that is refused, or a fixed coordinate
            does not exist.
    """

    def checked(fields: Mapping[str, str]) -> tuple[ShapeModel, EncodeOptions]:
        model, options = asked(fields)
        _require_few_samples(options, most)
        model.latents.fixed(options.fixed)
        return model, options

    model, _ = checked({})  # refused before the file is read

    def make(call: Call) -> Answered:
        began = time.perf_counter()
        meshes, fields = read_upload(sandbox, upload, limits(model.decoder), call, most=most)
        chosen, options = checked(fields)
        read = time.perf_counter()
        answers = []
        for mesh in meshes:
            answers.append(_encoded(chosen, mesh, options, call))
            if len(meshes) > 1 and answers[-1]["status"] == Status.DEADLINE:
                raise call.late(f"Send fewer meshes at once. {_LATER}")
        seconds = {"read": read - began, "search": time.perf_counter() - read}
        if len(meshes) == 1:
            return answers[0], seconds
        named = [{"name": mesh.name, **answer} for mesh, answer in zip(meshes, answers, strict=True)]
        return {"meshes": named}, seconds

    return await _searched(caller, _LATER, make)


def _encoded(model: ShapeModel, mesh: UploadedMesh, options: EncodeOptions, deadline: Deadline) -> dict[str, Any]:
    """Return the answer for one mesh; raises InvalidMeshError with the name of its file, if it has one."""
    try:
        given = match(model.decoder, mesh.vertices, mesh.faces)
    except InvalidMeshError as error:
        raise InvalidMeshError(f"{mesh.name}: {error}" if mesh.name else str(error)) from None
    found = model.encode(given, options, deadline=deadline)
    return {
        "latent": found.code,
        "residual": found.residual,
        "vertex_error": {"mean": found.distances.mean(), "max": found.distances.max()},
        "vertex_errors": float32(found.distances),
        "inside_bounds": found.inside_bounds,
        "status": found.status,
        "reason": found.reason,
        "cause": found.cause,
        "misplaced": found.misplaced,
        "iterations": found.iterations,
        "mesh": found.mesh,
        "diagnostics": asdict(found.shape.diagnostics),
        "covariance": found.covariance,
        "samples": found.samples,
    }


async def edit(
    caller: Caller,
    model: ShapeModel,
    latent: Sequence[float],
    targets: Sequence[Target],
    options: EditOptions,
    most: int,
) -> EncodedFile:
    """Find the code from ``latent`` on that brings vertices to targets, with at most ``most`` samples.

    See ShapeModel.edit.

    Raises:
        InvalidTargetError: no such vertex, or too many targets.
        LatentError: a start that can't be used, or no such coordinate.
        RefusedError, too-many-codes: more than ``most`` samples.
    """
    # Refused before the call waits for a worker.
    require_targets(model.decoder, targets, options.mesh)
    _require_few_samples(options, most)
    model.latents.code(latent, Bounds.CLAMP)
    model.latents.fixed(options.fixed)

    def make(call: Call) -> Answered:
        began = time.perf_counter()
        found = model.edit(latent, targets, options, deadline=call)
        seconds = {"search": time.perf_counter() - began}
        content = {
            "latent": found.code,
            "residual": found.residual,
            "distances": found.distances,
            "status": found.status,
            "iterations": found.iterations,
            "placement": found.placement.answer(),
            "diagnostics": asdict(found.shape.diagnostics),
            "covariance": found.covariance,
            "samples": found.samples,
        }
        return content, seconds

    return await _searched(caller, _LATER, make)


async def fit(
    caller: Caller,
    sandbox: Sandbox,
    asked: Asked[FitOptions],
    upload: Upload,
    progress: Callable[[float], None] | None = None,
) -> EncodedFile:
    """Find the code, placement and size that explain an uploaded scan; see ShapeModel.fit_scan.

    ``progress`` is called in the thread that computes.

    Raises:
        RefusedError, InvalidScanError: the scan can't be used.
    """

    def make(call: Call) -> Answered:
        began = time.perf_counter()
        meshes, fields = read_upload(sandbox, upload, SCAN_LIMITS, call, points=True, memory=SCAN_MEMORY)
        model, options = asked(fields)
        read = time.perf_counter()
        found = model.fit_scan((meshes[0].vertices, meshes[0].faces), options, deadline=call, progress=progress)
        return found.answer(), {"read": read - began, "search": time.perf_counter() - read}

    return await _searched(caller, _SMALLER, make)


async def events(search: Callable[[Callable[[float], None]], Awaitable[EncodedFile]]) -> AsyncGenerator[bytes, None]:
    """Yield the progress of a search as JSON, and its answer as the last; raises the error of the search."""
    loop = asyncio.get_running_loop()
    waiting = asyncio.Queue[bytes | None]()

    def tell(share: float) -> None:
        loop.call_soon_threadsafe(waiting.put_nowait, dump_json({"progress": share}))

    work = asyncio.ensure_future(search(tell))
    work.add_done_callback(lambda _: waiting.put_nowait(None))
    try:
        while (event := await waiting.get()) is not None:
            yield event
        content = (await work).content
        assert isinstance(content, bytes)  # noqa: S101 - narrows the type
        yield content
    finally:
        work.cancel()


async def _searched(caller: Caller, advice: str, make: Callable[[Call], Answered]) -> EncodedFile:
    """Run a search, which answers its best result so far at its deadline; ``advice`` is for one without a result."""

    def search(call: Call) -> EncodedFile:
        if call.passed:
            raise call.late()
        call.searching = True
        content, seconds = make(call)
        record_stages(seconds)
        return EncodedFile(dump_json(content), seconds)

    async with replace(caller, long=True).admit(advice) as call:
        try:
            return await call.run(search)
        except asyncio.CancelledError:
            call.call_off()  # nobody reads the answer
            raise


def _require_few_samples(options: SearchOptions, most: int) -> None:
    if options.samples:
        require_count(options.samples, most, "samples")


def read_upload(
    sandbox: Sandbox,
    upload: Upload,
    limits: Limits,
    deadline: Deadline,
    *,
    points: bool = False,
    memory: int = MEMORY,
    most: int = 1,
) -> tuple[list[UploadedMesh], Mapping[str, str]]:
    """Read the meshes of an uploaded file, and the fields of the form, in a process of its own.

    Args:
        sandbox: sandbox with the task READ.
        upload: file; reading empties it.
        limits: limits of the mesh.
        deadline: time limit of the child process.
        points: whether the file may hold points without faces.
        memory: bytes that reading may take in addition to the file.
        most: largest number of meshes; only an archive has several.

    Raises:
        RefusedError: the mesh can't be used, it was not read in time, no process is available, or the server ends.
    """
    facts: dict[str, Any] = {
        "content_type": upload.content_type,
        "format": upload.format,
        "points": points,
        "most": most,
    }
    facts |= {"vertices": limits.vertices, "faces": limits.faces, "known": list(upload.known)}
    together = limits if most == 1 else TOGETHER
    size = 24 * (together.vertices + together.faces) + _ANSWER
    try:
        said, arrays = sandbox.call(facts, upload.pieces, deadline=deadline, memory=memory, most=size)
    except FailedError as error:
        if error.kind in UPLOAD_KINDS:
            raise RefusedError(error.kind, error.sentence) from None
        logger.error("the reader of an uploaded file crashed: %s", error.sentence)
        raise _unusable("it breaks its reader") from None
    except LateError:
        raise RefusedError("deadline-passed", "The file was not read in time. Send a smaller one.") from None
    except NoProcessError as error:
        logger.error("uploads can't be read: %s", error)
        raise RefusedError(
            "busy", "The server can't start a process to read the file. Try again after the time in Retry-After."
        ) from None
    except OutOfMemoryError:
        raise _unusable("reading it takes more memory than a mesh of this model needs") from None
    except ClosedError as error:
        raise RefusedError("not-ready", "The server is about to end. Send the file to another one.") from error
    except SandboxError as error:
        logger.warning("the process that reads an uploaded file ended: %s", error)
        raise _unusable("it breaks its reader") from None
    faces = [arrays.get(f"faces {k}", arrays["faces 0"]) for k in range(len(said["names"]))]
    meshes = [UploadedMesh(arrays[f"vertices {k}"], faces[k], name) for k, name in enumerate(said["names"])]
    return meshes, said["fields"]


def _unusable(why: str) -> RefusedError:
    return RefusedError("invalid-mesh", f"The mesh can't be used: {why}. Send a plain file of one mesh.")
