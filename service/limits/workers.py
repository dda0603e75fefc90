"""Threads that compute, with a bounded queue and a deadline for each request.

The event loop answers a request by its deadline, when its client leaves, or when the server ends, whatever its thread
does. Work checks its deadline itself and ends soon after. A thread that does not is abandoned, and a new one takes its
place. A search may answer its best result a little later than its deadline.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager, contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from shapespace.service.limits.quota import Quota, QuotaError
from shapespace.solve.deadline import Deadline

logger = logging.getLogger(__name__)
S = TypeVar("S")
T = TypeVar("T")
#: Seconds in which a thread has to stop after the end of its call. Otherwise it is abandoned.
GRACE_SECONDS = 2.0
#: Seconds after its deadline in which a search may complete its best result.
SEARCH_GRACE_SECONDS = 5.0
#: Largest number of abandoned threads.
MOST_ABANDONED = 16
#: Bytes that all answers with many shapes may use together.
MEMORY = 384 * 2**20
#: What a client can do whose request was not answered by its deadline.
ADVICE = "Ask for fewer shapes at once, stream the frames as JSON lines, or try again when there is less to do."


class BusyError(RuntimeError):
    """The queue is full."""


class DeadlineError(TimeoutError):
    """The deadline of a request has passed."""


class DisconnectedError(ConnectionError):
    """The client has left."""


class EndingError(RuntimeError):
    """The server ends before the answer is ready."""


@dataclass(frozen=True)
class Caller:
    """The client of a request: its name for quotas, empty if it is unknown.

    ``gone`` waits until it has left, and returns the error for its work.
    """

    client: str
    gone: Callable[[], Awaitable[Exception]]


class Call(Deadline):
    """A deadline that also ends the waiting of a request on the event loop, with the error ``late``.

    Attributes:
        searching: whether the work is a search, for whose result the event loop waits SEARCH_GRACE_SECONDS more.
    """

    def __init__(self, seconds: float, late: Exception) -> None:
        super().__init__(seconds)
        loop = asyncio.get_running_loop()
        self._over: asyncio.Future[None] = loop.create_future()
        self._over.add_done_callback(lambda end: end.cancelled() or end.exception())  # or asyncio complains
        self._timer = loop.call_later(seconds, self._expire, late)
        self.searching = False

    def give_up(self, error: Exception) -> None:
        """End the call with an error."""
        self.call_off()
        if not self._over.done():
            self._over.set_exception(error)

    def _expire(self, late: Exception) -> None:
        if self.searching:
            self._timer = asyncio.get_running_loop().call_later(SEARCH_GRACE_SECONDS, self.give_up, late)
        else:
            self.give_up(late)

    def close(self) -> None:
        """Stop the timer, because the work is done."""
        self._timer.cancel()

    async def first(self, work: Awaitable[T]) -> T:
        """Return the result of some work, or raise the error of this call if the call ends first."""
        task = asyncio.ensure_future(work)
        try:
            await asyncio.wait((task, self._over), return_when=asyncio.FIRST_COMPLETED)
            if self._over.done():  # even if the work is done too
                self._over.result()
            return task.result()
        finally:
            task.cancel()  # without effect where it is done


class Workers:
    """A pool of threads for everything that would block the event loop.

    Requests are admitted up to a limit. A request submits its shapes one by one, at most as many at once as there are
    threads. So a single shape doesn't wait for the end of a long animation. Streams have their own limit: most of the
    time they wait for their clients, and then use no thread. ``queue`` requests can wait for one of the ``threads``.
    A request has ``deadline`` seconds after it is admitted.

    Attributes:
        places, streams: quotas of requests that are admitted, and of answers that are read while they are computed.
        memory: quota of bytes for answers with many shapes.
        lost: number of abandoned threads that still run.
    """

    def __init__(self, threads: int, queue: int, deadline: float) -> None:
        self.threads, self.deadline = threads, deadline
        self._pool = self._threads()
        self._free = asyncio.Semaphore(threads)
        self.places, self.streams = Quota(threads + queue), Quota(threads + queue)
        self.memory = Quota(MEMORY)
        self.lost = 0
        self._calls: set[Call] = set()
        self._ending = False

    def _threads(self) -> ThreadPoolExecutor:
        return ThreadPoolExecutor(self.threads, thread_name_prefix="shapespace")

    @asynccontextmanager
    async def admit(self, caller: Caller, advice: str = ADVICE) -> AsyncIterator[Call]:
        """Admit a request for the duration of the block, and yield its deadline; raises BusyError.

        The DeadlineError of a late request ends with the advice.
        """
        with self._place(self.places, caller), self._call(advice) as call:
            watching = asyncio.create_task(self._watch(caller, call))
            try:
                yield call
            finally:
                watching.cancel()

    @contextmanager
    def stream(self, caller: Caller) -> Iterator[None]:
        """Admit a streamed answer for the duration of the block; raises BusyError."""
        with self._place(self.streams, caller):
            yield

    @contextmanager
    def holding(self, caller: Caller, size: int) -> Iterator[ExitStack]:
        """Reserve bytes for an answer until the block ends or a new owner of the stack closes it; raises BusyError."""
        with ExitStack() as held:
            held.enter_context(self._place(self.memory, caller, size))
            yield held

    async def run(self, function: Callable[[Call], T], call: Call) -> T:
        """Run a function of the call in a thread; raises the error of the call if it ends first."""
        turn = asyncio.ensure_future(self._free.acquire())
        try:
            await call.first(turn)
        except BaseException:
            if turn.done() and not turn.cancelled():
                self._free.release()
            raise
        work: Future[T] = self._pool.submit(copy_context().run, function, call)
        try:
            return await call.first(asyncio.wrap_future(work))
        finally:
            if work.done() or work.cancel():
                self._free.release()
            else:
                self._abandon(work)

    async def map(
        self, function: Callable[[S, Call], T], items: Iterable[S], call: Call | None
    ) -> AsyncGenerator[T, None]:
        """Run a function for every item in parallel, and yield the results in order.

        Without a common deadline each item has its own, which starts when the item is submitted.
        """
        running: deque[asyncio.Task[T]] = deque()
        try:
            for item in items:
                if len(running) == self.threads:
                    yield await running.popleft()
                running.append(asyncio.create_task(self.piece(partial(function, item), call)))
            while running:
                yield await running.popleft()
        finally:
            for task in running:
                task.cancel()
            # asyncio would log other errors as never retrieved.
            await asyncio.gather(*running, return_exceptions=True)

    async def piece(self, function: Callable[[Call], T], call: Call | None) -> T:
        """Run a function as `run` does, with this deadline or a new one."""
        if call is not None:
            return await self.run(function, call)
        with self._call() as own:
            return await self.run(function, own)

    def late(self, advice: str = ADVICE) -> DeadlineError:
        """Return the error for work whose deadline has passed."""
        return DeadlineError(f"The answer was not ready within {self.deadline:g} s. {advice}")

    def end(self) -> None:
        """End every call, because the server ends."""
        self._ending = True
        for call in tuple(self._calls):
            call.give_up(_ending())

    def close(self) -> None:
        """End idle threads; busy threads finish their work."""
        self._pool.shutdown(wait=False, cancel_futures=True)

    @contextmanager
    def _place(self, quota: Quota, caller: Caller, amount: int = 1) -> Iterator[None]:
        try:
            quota.take(caller.client, amount)
        except QuotaError:
            whose = "" if quota.used + amount > quota.limit else " for this client"
            raise BusyError(
                f"All workers are busy and the queue is full{whose}. Try again after the time in Retry-After."
            ) from None
        try:
            yield
        finally:
            quota.give_back(caller.client, amount)

    @contextmanager
    def _call(self, advice: str = ADVICE) -> Iterator[Call]:
        call = Call(self.deadline, self.late(advice))
        self._calls.add(call)
        if self._ending:
            call.give_up(_ending())
        try:
            yield call
        finally:
            self._calls.discard(call)
            call.close()

    async def _watch(self, caller: Caller, call: Call) -> None:
        call.give_up(await caller.gone())

    def _abandon(self, work: Future[T]) -> None:
        """Wait for a thread whose call has ended; replace the thread if it doesn't stop."""
        loop, free = asyncio.get_running_loop(), True

        def lose() -> None:
            nonlocal free
            if self.lost < MOST_ABANDONED:
                free = False
                self.lost += 1
                self._pool.shutdown(wait=False)  # running work goes on
                self._pool = self._threads()
                self._free.release()
                text = "a thread is still at work %g s after its deadline, and another takes its place"
                logger.error(text, GRACE_SECONDS)

        def find() -> None:
            timer.cancel()
            if free:
                self._free.release()
            else:
                self.lost -= 1

        timer = loop.call_later(GRACE_SECONDS, lose)
        work.add_done_callback(lambda _: None if loop.is_closed() else loop.call_soon_threadsafe(find))


def _ending() -> EndingError:
    return EndingError("The server is about to end. Send the request to another one, or again in a moment.")
