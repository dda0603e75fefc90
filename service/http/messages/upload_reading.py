"""Uploaded mesh files, read in a process of their own: whatever is in them, it can be ended."""

from __future__ import annotations

import logging
from collections import deque

from starlette.requests import Request

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.service.http.problems import ProblemError
from shapespace.service.limits.memory import MMAP_THRESHOLD
from shapespace.service.limits.sandbox import (
    ClosedError,
    FailedError,
    LateError,
    NoProcessError,
    OutOfMemoryError,
    Sandbox,
    SandboxError,
)
from shapespace.service.limits.workers import EndingError
from shapespace.solve.deadline import Deadline

logger = logging.getLogger(__name__)
#: Bytes that reading a file may take beside the file.
MEMORY = 64 * 2**20
#: Bytes in which a body is gathered, and given on: what is longer than this isn't on the heap, so that a piece that
#: has been given on takes no memory any more.
_PIECE = MMAP_THRESHOLD
_LEAST = 2**16


async def gather(request: Request) -> deque[bytearray]:
    """A request's body in pieces, however small those were in which it came."""
    pieces = deque([bytearray()])
    async for piece in request.stream():
        if len(pieces[-1]) > _PIECE:
            pieces.append(bytearray())
        pieces[-1] += piece
    return pieces


def read(
    sandbox: Sandbox,
    pieces: deque[bytearray],
    content_type: str,
    format: str | None,
    limits: Limits,
    deadline: Deadline,
) -> tuple[FloatArray, IntArray]:
    """Vertices (V, 3) and faces (F, 3) of a body, which is emptied.

    Args:
        sandbox: whose children know the task ``read``.
        pieces: of the body.
        content_type: the header.
        format: what ``?format=`` says.
        limits: of the mesh.
        deadline: after which the child is ended.

    Raises:
        ProblemError: the body holds no mesh that can be used, or no process can be had.
        EndingError: the server ends.
    """
    facts = {"content_type": content_type, "format": format, "vertices": limits.vertices, "faces": limits.faces}
    most = 24 * (limits.vertices + limits.faces) + _LEAST
    try:
        _, arrays = sandbox.call("read", facts, pieces, deadline=deadline, memory=MEMORY, most=most)
    except FailedError as error:
        if error.kind == FailedError.UNEXPECTED:
            logger.error("an uploaded file breaks its reader: %s", error.sentence)
            raise _unusable("it breaks its reader") from None
        raise ProblemError(error.kind, error.sentence) from None
    except LateError:
        raise ProblemError("deadline-passed", "The file was not read in time. Send a smaller one.") from None
    except NoProcessError as error:
        logger.error("uploads can't be read: %s", error)
        raise ProblemError("busy", "No process can be had to read the file. Try again after Retry-After.") from None
    except OutOfMemoryError:
        raise _unusable("reading it takes more memory than a mesh of this model does") from None
    except ClosedError as error:
        raise EndingError("The server is about to end. Send the file to another one.") from error
    except SandboxError as error:
        raise _unusable(str(error)) from None
    return arrays["vertices"], arrays["faces"]


def _unusable(why: str) -> ProblemError:
    return ProblemError("invalid-mesh", f"The mesh can't be used: {why}. Send a plain file of one mesh.")
