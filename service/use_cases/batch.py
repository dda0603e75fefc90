"""Work on many codes for one answer: side by side, within the memory it may hold, and written piece by piece."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, aclosing, asynccontextmanager
from dataclasses import dataclass
from itertools import chain
from types import TracebackType
from typing import Any, TypeVar

from shapespace.files.archives import Buffer
from shapespace.model.decoder import MeshChoice, Quality, Shape
from shapespace.model.latent_space import CheckedCode
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Call, Caller, Workers
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status

#: Seconds by stage. ``network``: inference; ``reconstruct``: Gauss–Newton; ``encode``: writing the file;
#: ``read``: reading an uploaded file; ``search``: looking for a code.
Timings = dict[str, float]
#: An answer whose arrays take at most this many bytes is made in one piece.
WHOLE = 2**22
S = TypeVar("S")
T = TypeVar("T")


class NoCodesError(ValueError):
    """A request for no code at all."""


class TooManyCodesError(ValueError):
    """A request for more codes than one answer may hold."""


class PiecewiseFile:
    """A file that is written piece by piece, in a worker's thread, as fast as it is read.

    It is a context manager, and holds the memory that it is made from until the context ends.

    Args:
        pieces: of the file.
        workers: whose threads make them.
        held: released at the end.
    """

    def __init__(self, pieces: Iterator[Buffer], workers: Workers, held: ExitStack) -> None:
        self._pieces, self._workers, self._held = pieces, workers, held

    async def __aiter__(self) -> AsyncGenerator[bytes | memoryview, None]:
        while (piece := await self._workers.piece(lambda _: next(self._pieces, None), None)) is not None:
            yield piece if isinstance(piece, bytes) else memoryview(piece)

    def __enter__(self) -> PiecewiseFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._held.close()


@dataclass(frozen=True)
class Written:
    """A file made from many codes.

    Attributes:
        content: all of it, or its pieces where it is large.
        seconds: time by stage; ``encode`` ends with the first piece.
        diagnostics: one summary of all shapes, or nothing where none was reconstructed.
        facts: what the format says about the file.
    """

    content: bytes | PiecewiseFile
    seconds: Timings
    diagnostics: Mapping[str, Any] | None
    facts: Mapping[str, Any]


class Batch:
    """An admitted request for many codes.

    Args:
        workers: that compute.
        call: the request's deadline.
        size: bytes of what the answer is made from.
        held: that memory.
    """

    def __init__(self, workers: Workers, call: Call, size: int, held: ExitStack) -> None:
        self._workers, self._call, self._size, self._held = workers, call, size, held

    async def map(self, work: Callable[[S, Call], T], items: Iterable[S]) -> list[T]:
        """Results of work on every item, side by side; raises as ``Workers.run``."""
        async with aclosing(self._workers.map(work, items, self._call)) as results:
            return [result async for result in results]

    def solve(
        self, model: ShapeModel, mesh: MeshChoice, quality: Quality, code: CheckedCode, deadline: Deadline
    ) -> Shape:
        """A code to its shape, in a worker's thread; raises DeadlineError."""
        return solve(self._workers, model, mesh, quality, code, deadline)

    async def write(
        self,
        encode: Callable[[], tuple[Iterator[Buffer], Mapping[str, Any]]],
        seconds: Timings,
        diagnostics: Mapping[str, Any] | None = None,
    ) -> Written:
        """Write the file, or begin to where it is large.

        Args:
            encode: gives the pieces of the file, and facts about it.
            seconds: time so far.
            diagnostics: of all shapes.
        """
        began = time.perf_counter()

        def start(_: Call) -> tuple[bytes | Buffer, Iterator[Buffer], Mapping[str, Any]]:
            pieces, facts = encode()
            return (next(pieces) if self._size > WHOLE else b"".join(pieces)), pieces, facts

        first, rest, facts = await self._workers.run(start, self._call)
        seconds = {**seconds, "encode": time.perf_counter() - began}
        if isinstance(first, bytes) and self._size <= WHOLE:
            return Written(first, seconds, diagnostics, facts)
        return Written(
            PiecewiseFile(chain([first], rest), self._workers, self._held.pop_all()), seconds, diagnostics, facts
        )


@asynccontextmanager
async def batch(workers: Workers, caller: Caller, size: int) -> AsyncIterator[Batch]:
    """Count a request for many codes in, with the bytes that its answer is made from; raises BusyError."""
    with workers.holding(caller, size) as held:
        async with workers.admit(caller) as call:
            yield Batch(workers, call, size, held)


def solve(
    workers: Workers, model: ShapeModel, mesh: MeshChoice, quality: Quality, code: CheckedCode, deadline: Deadline
) -> Shape:
    """A code to its shape; raises DeadlineError."""
    shape = model.shape(*code, mesh, deadline, quality)
    if shape.diagnostics.status is Status.DEADLINE:
        raise workers.late()
    return shape


def total_seconds(seconds: Iterable[Timings]) -> Timings:
    """Time of several shapes by stage."""
    each = list(seconds)
    return {stage: sum(one[stage] for one in each) for stage in ("network", "reconstruct")}


def require_count(count: int, most: int, field: str = "latents") -> None:
    """Refuse requests for no code or more than allowed; raises NoCodesError or TooManyCodesError."""
    if count > most:
        raise TooManyCodesError(f"{field} asks for {count} codes; the limit is {most}. Send several requests.")
    if count == 0:
        raise NoCodesError(f"{field} asks for no code. Send at least one code.")
