"""Work on many codes for one answer: in parallel, within a limit of memory, and written piece by piece."""

from __future__ import annotations

import time
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, aclosing, asynccontextmanager
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from shapespace.files.archives import Buffer
from shapespace.model.decoder import MeshChoice
from shapespace.model.latent_space import CheckedCode, Codes
from shapespace.model.memory import Examples
from shapespace.model.shape import Quality, Shape
from shapespace.model.shape_model import ShapeModel
from shapespace.service.limits.workers import Call, Caller, in_parallel
from shapespace.service.refusals import RefusedError
from shapespace.service.tracing import record_stages
from shapespace.solve.blas_threads import OneBlasThread
from shapespace.solve.outcome import Status

#: Seconds by stage. ``network``: inference; ``reconstruct``: Gauss–Newton; ``encode``: writing the file;
#: ``read``: reading an uploaded file; ``search``: searching for a code.
Timings = dict[str, float]
#: Largest size in bytes of the arrays of an answer that is written in one piece.
WHOLE_FILE_BYTES = 2**22
S = TypeVar("S")
T = TypeVar("T")


class PiecewiseFile:
    """A file that a worker thread writes piece by piece, as fast as the client reads it.

    It is a context manager; ``held``, its reservation of memory, lasts until the context ends.
    """

    def __init__(self, pieces: Iterator[Buffer], caller: Caller, held: ExitStack) -> None:
        self._pieces, self._caller, self._held = pieces, caller, held

    async def __aiter__(self) -> AsyncGenerator[bytes | memoryview, None]:
        while (piece := await self._caller.run(lambda _: next(self._pieces, None))) is not None:
            yield piece if isinstance(piece, bytes) else memoryview(piece)

    def __enter__(self) -> PiecewiseFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._held.close()


@dataclass(frozen=True)
class EncodedFile:
    """The answer of a use case as a file.

    Attributes:
        content: the bytes of a small file, the pieces of a large one.
        seconds: time by stage; ``encode`` ends with the first piece.
        diagnostics: of the shape, or a summary over all shapes; None if no shape was reconstructed.
        facts: what the writer of the format reports about the file.
        legend: of its colours; empty without colours.
    """

    content: bytes | PiecewiseFile
    seconds: Timings
    diagnostics: Mapping[str, Any] | None = None
    facts: Mapping[str, Any] = field(default_factory=dict)
    legend: Mapping[str, Any] = field(default_factory=dict)


class Batch:
    """An admitted request for many codes, whose answer has arrays of ``size`` bytes, reserved by ``held``."""

    def __init__(self, call: Call, size: int, held: ExitStack) -> None:
        self._call, self._size, self._held = call, size, held

    async def map(self, work: Callable[[S, Call], T], items: Iterable[S]) -> list[T]:
        """Return the results of work on every item, computed in parallel; raises as ``Call.run``."""
        async with aclosing(in_parallel(self._call, work, items)) as results:
            return [result async for result in results]

    async def write(
        self,
        encode: Callable[[], tuple[Iterator[Buffer], Mapping[str, Any]]],
        seconds: Timings,
        diagnostics: Mapping[str, Any] | None = None,
    ) -> EncodedFile:
        """Write the file; of a large one only the first piece. ``encode`` returns its pieces, and facts about it."""
        began = time.perf_counter()

        def start(_: Call) -> tuple[bytes | Buffer, Iterator[Buffer], Mapping[str, Any]]:
            pieces, facts = encode()
            first = next(pieces) if self._size > WHOLE_FILE_BYTES else b"".join(pieces)
            record_stages({"encode": time.perf_counter() - began})
            return first, pieces, facts

        first, rest, facts = await self._call.run(start)
        seconds = {**seconds, "encode": time.perf_counter() - began}
        if isinstance(first, bytes) and self._size <= WHOLE_FILE_BYTES:
            return EncodedFile(first, seconds, diagnostics, facts)
        pieces = PiecewiseFile(chain([first], rest), self._call.caller, self._held.pop_all())
        return EncodedFile(pieces, seconds, diagnostics, facts)


@asynccontextmanager
async def batch(caller: Caller, size: int) -> AsyncIterator[Batch]:
    """Admit a request for many codes, and reserve bytes for the arrays of its answer; raises RefusedError, busy."""
    with caller.holding(size) as held:
        async with caller.admit() as call:
            yield Batch(call, size, held)


def solve(
    call: Call, model: ShapeModel, mesh: MeshChoice, quality: Quality, code: CheckedCode, examples: Examples = True
) -> Shape:
    """Return the shape of a code; raises RefusedError, deadline-passed."""
    return next(solve_all(call, model, mesh, quality, (code[0][None], np.array([code[1]])), examples))


def solve_all(
    call: Call,
    model: ShapeModel,
    mesh: MeshChoice,
    quality: Quality,
    codes: tuple[Codes, NDArray[np.bool_]],
    examples: Examples = True,
) -> Iterator[Shape]:
    """Yield the shapes of codes (n, m), with (n,) whether each is inside the bounds; raises as ``solve``."""
    found = model.decoder.shapes(*codes, mesh, call, quality, examples)
    while True:
        with OneBlasThread():
            shape = next(found, None)
        if shape is None:
            return
        if shape.diagnostics.status is Status.DEADLINE:
            raise call.late()
        record_stages(shape.seconds)
        yield shape


def total_seconds(seconds: Iterable[Timings]) -> Timings:
    """Return the total time of several shapes by stage."""
    each = list(seconds)
    return {stage: sum(one[stage] for one in each) for stage in ("network", "reconstruct")}


def require_count(count: int, most: int, field: str = "latents") -> None:
    """Raise RefusedError for a request for no code, or for more than ``most``."""
    if count > most:
        raise RefusedError(
            "too-many-codes", f"{field} asks for {count} codes; the limit is {most}. Send several requests."
        )
    if count == 0:
        raise RefusedError("invalid-request", f"{field} asks for no code. Send at least one code.")
