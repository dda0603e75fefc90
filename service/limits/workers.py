"""Threads that compute, with a bounded queue and a deadline for each request.

The event loop answers a request by its deadline, when its client leaves, or when the server ends, whatever its thread
does. Work checks its deadline itself and ends soon after. A search may answer its best result a little later than its
deadline.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, asynccontextmanager, contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from shapespace.service.limits.quota import Quota
from shapespace.service.limits.turns import Turns
from shapespace.service.refusals import RefusedError
from shapespace.solve.deadline import Deadline

S = TypeVar("S")
T = TypeVar("T")
#: Seconds after its deadline in which a search may complete its best result.
SEARCH_GRACE_SECONDS = 5.0
#: Bytes that all answers with many shapes may use together.
MEMORY = 384 * 2**20
_FULL = "All workers are busy and the queue is full"
#: What a client can do whose request was not answered by its deadline.
ADVICE = "Ask for fewer shapes at once, stream the frames as JSON lines, or try again when the server is less busy."


class Workers:
    """A pool of threads for everything that would block the event loop.

    Requests are admitted up to a limit. A request submits its shapes one by one, at most as many at once as there are
    threads. Which shape is next, Turns decides. Streams have their own limit: most of the time they wait for their
    clients, and then use no thread. ``queue`` requests can wait for one of the ``threads``. A request has ``deadline``
    seconds after it is admitted.

    Attributes:
        threads: number of threads. Two at least, so that a short call never waits for the end of a long one.
        places, streams: quotas of requests that are admitted, and of answers that are read while they are computed.
        memory: quota of bytes for answers with many shapes.
        turns, pool: the order of work, and the threads.
        calls: requests at work.
        ending: whether the server ends.
    """

    def __init__(self, threads: int, queue: int, deadline: float) -> None:
        self.threads, self.deadline = max(2, threads), deadline
        self.pool = ThreadPoolExecutor(self.threads, thread_name_prefix="shapespace")
        self.turns = Turns(self.threads)
        self.places, self.streams, self.memory = (Quota(n, _FULL) for n in (threads + queue, threads + queue, MEMORY))
        self.calls: set[Call] = set()
        self.ending = False

    def end(self) -> None:
        """End every call, because the server ends."""
        self.ending = True
        for call in tuple(self.calls):
            call.give_up(_ending())

    def close(self) -> None:
        """End idle threads; busy threads finish their work."""
        self.pool.shutdown(wait=False, cancel_futures=True)


@dataclass(frozen=True)
class Caller:
    """The client of a request, and what it may use.

    Attributes:
        workers: threads that work for it.
        client: its name for quotas, empty if it is unknown.
        gone: waits until it has left, and returns the error for its work.
        long: whether its request may take seconds, so that it has to leave some threads to short ones.
    """

    workers: Workers
    client: str
    gone: Callable[[], Awaitable[Exception]]
    long: bool = False

    @asynccontextmanager
    async def admit(self, advice: str = ADVICE) -> AsyncIterator[Call]:
        """Admit a request for the duration of the block, and yield it; raises RefusedError, busy.

        The error of a late request ends with the advice.
        """
        with self.workers.places.held(self.client), self._call(advice) as call:
            watching = asyncio.create_task(self._watch(call))
            try:
                yield call
            finally:
                watching.cancel()

    def stream(self) -> AbstractContextManager[None]:
        """Admit a streamed answer for the duration of the block; raises RefusedError, busy."""
        return self.workers.streams.held(self.client)

    @contextmanager
    def holding(self, size: int) -> Iterator[ExitStack]:
        """Reserve bytes until the block ends, or a new owner closes the stack; raises RefusedError, busy."""
        with ExitStack() as stack:
            stack.enter_context(self.workers.memory.held(self.client, size))
            yield stack

    async def run(self, function: Callable[[Call], T]) -> T:
        """Run a function in a thread, within a deadline of its own; raises as `Call.run`."""
        with self._call() as call:
            return await call.run(function)

    @contextmanager
    def _call(self, advice: str = ADVICE) -> Iterator[Call]:
        call = Call(self, advice)
        self.workers.calls.add(call)
        if self.workers.ending:
            call.give_up(_ending())
        try:
            yield call
        finally:
            self.workers.calls.discard(call)
            call.close()

    async def _watch(self, call: Call) -> None:
        call.give_up(await self.gone())


class Call(Deadline):
    """A request at work: a deadline that also ends the waiting of the request on the event loop.

    Attributes:
        searching: whether the work is a search, for whose result the event loop waits SEARCH_GRACE_SECONDS more.
    """

    def __init__(self, caller: Caller, advice: str) -> None:
        super().__init__(caller.workers.deadline)
        self.caller, self._advice, self.searching = caller, advice, False
        loop = asyncio.get_running_loop()
        self._over: asyncio.Future[None] = loop.create_future()
        self._over.add_done_callback(lambda end: end.cancelled() or end.exception())  # or asyncio complains
        self._timer = loop.call_later(caller.workers.deadline, self._expire)

    def give_up(self, error: Exception) -> None:
        """End the call with an error."""
        self.call_off()
        if not self._over.done():
            self._over.set_exception(error)

    def late(self, advice: str = "") -> RefusedError:
        """Return the error of this call if its deadline has passed."""
        seconds = self.caller.workers.deadline
        return RefusedError(
            "deadline-passed", f"The answer was not ready within {seconds:g} s. {advice or self._advice}"
        )

    def close(self) -> None:
        """Stop the timer, because the work is done."""
        self._timer.cancel()

    async def run(self, function: Callable[[Call], T]) -> T:
        """Run a function in a thread; raises the error of the call if the call ends first."""
        workers = self.caller.workers
        turn = workers.turns.ask(self.caller.client, self.caller.long)
        try:
            await self._first(turn.begun)
            work = workers.pool.submit(copy_context().run, function, self)
        except BaseException:
            workers.turns.end(turn)
            raise
        loop = asyncio.get_running_loop()
        # The turn ends with the work, which may go on for a while after the call has ended.
        work.add_done_callback(
            lambda _: None if loop.is_closed() else loop.call_soon_threadsafe(workers.turns.end, turn)
        )
        try:
            return await self._first(asyncio.wrap_future(work))
        finally:
            work.cancel()

    def _expire(self) -> None:
        if self.searching:
            self._timer = asyncio.get_running_loop().call_later(SEARCH_GRACE_SECONDS, self.give_up, self.late())
        else:
            self.give_up(self.late())

    async def _first(self, work: Awaitable[T]) -> T:
        """Return the result of some work, or raise the error of this call if the call ends first."""
        task = asyncio.ensure_future(work)
        try:
            if not task.done():  # as the turn of most requests is; waiting would take one round of the event loop
                await asyncio.wait((task, self._over), return_when=asyncio.FIRST_COMPLETED)
            if self._over.done():  # even if the work is done too
                self._over.result()
            return task.result()
        finally:
            task.cancel()  # without effect where it is done


async def in_parallel(
    whose: Call | Caller, function: Callable[[S, Call], T], items: Iterable[S]
) -> AsyncGenerator[T, None]:
    """Run a function for every item in parallel, and yield the results in order.

    For a caller each item has its own deadline, which starts when the item is submitted.
    """
    workers = (whose.caller if isinstance(whose, Call) else whose).workers
    running: deque[asyncio.Task[T]] = deque()
    try:
        for item in items:
            if len(running) == workers.threads:
                yield await running.popleft()
            running.append(asyncio.create_task(whose.run(partial(function, item))))
        while running:
            yield await running.popleft()
    finally:
        for task in running:
            task.cancel()
        # asyncio would log other errors as never retrieved.
        await asyncio.gather(*running, return_exceptions=True)


def _ending() -> RefusedError:
    return RefusedError(
        "not-ready", "The server is about to end. Send the request to another one, or again in a moment."
    )
