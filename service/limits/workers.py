"""The threads that compute: as many as there are processors, with a bounded queue and a deadline.

Whatever a thread does, the request that waits for it is answered from the event loop: by its deadline, once its client
has left, or when the server ends. Work looks at its deadline by itself and ends soon after; a thread that doesn't is
given up, and another one takes its place.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from shapespace.service.limits.quota import Quota, QuotaError
from shapespace.solve.deadline import Deadline

logger = logging.getLogger(__name__)
S = TypeVar("S")
T = TypeVar("T")
#: Seconds after its deadline within which a thread should stop, and how many threads may be abandoned because they
#: don't.
PATIENCE, SPARE = 2.0, 16
#: Memory, in bytes, that all answers with many shapes may take together.
MEMORY = 384 * 2**20


class BusyError(RuntimeError):
    """The queue is full."""


class DeadlineError(TimeoutError):
    """The time a request may take has passed."""


class DisconnectedError(ConnectionError):
    """Nobody waits for the answer any more."""


class EndingError(RuntimeError):
    """The server ends before the answer is ready."""


@dataclass(frozen=True)
class Caller:
    """Who waits for an answer.

    Attributes:
        client: the address that it counts for, see ``client_name``; empty where it is unknown.
        gone: waits until nobody waits for the answer any more, and gives the error to end the work with.
    """

    client: str
    gone: Callable[[], Awaitable[Exception]]


class Call(Deadline):
    """A deadline that also ends the waiting of a request on the event loop.

    Args:
        seconds: from now.
        late: the error to end with once they have passed.
    """

    def __init__(self, seconds: float, late: Exception) -> None:
        super().__init__(seconds)
        loop = asyncio.get_running_loop()
        self._over: asyncio.Future[None] = loop.create_future()
        self._over.add_done_callback(lambda end: end.cancelled() or end.exception())  # or asyncio complains
        self._timer = loop.call_later(seconds, self.give_up, late)

    def give_up(self, error: Exception) -> None:
        """End the call with an error."""
        self.call_off()
        if not self._over.done():
            self._over.set_exception(error)

    def close(self) -> None:
        """The work is done, and the deadline doesn't matter any more."""
        self._timer.cancel()

    async def first(self, work: Awaitable[T]) -> T:
        """The result of some work, or the error with which this call ends before it is there."""
        task = asyncio.ensure_future(work)
        try:
            await asyncio.wait((task, self._over), return_when=asyncio.FIRST_COMPLETED)
            if self._over.done():  # even if the work is done too
                self._over.result()
            return task.result()
        finally:
            task.cancel()  # without effect where it is done


class Workers:
    """One long-lived pool of threads for everything that would block the event loop.

    Requests are admitted up to a limit. An admitted request hands over one shape after the other, never more
    at once than there are threads, so that a long animation doesn't keep a single shape waiting for its end.
    Streams have a limit of their own: they wait for their readers most of the time, and then hold no thread.

    Args:
        threads: size of the pool.
        queue: requests admitted beyond those at work.
        deadline: seconds a request may take from its admission.

    Attributes:
        places: requests at work or waiting.
        streams: answers that are read while they are computed.
        memory: bytes of answers in which many shapes are gathered.
        lost: threads given up, and still running.
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
    async def admit(self, caller: Caller) -> AsyncIterator[Call]:
        """Admit a request for the block's duration; yields its deadline.

        Raises:
            BusyError: too many requests are being worked on or waiting, of all clients or of this one.
        """
        with self._place(self.places, caller), self._call() as call:
            watching = asyncio.create_task(self._watch(caller, call))
            try:
                yield call
            finally:
                watching.cancel()

    @contextmanager
    def stream(self, caller: Caller) -> Iterator[None]:
        """Admit, for the block's duration, a request whose answer is read while it is computed; raises BusyError."""
        with self._place(self.streams, caller):
            yield

    @contextmanager
    def holding(self, caller: Caller, size: int) -> Iterator[ExitStack]:
        """Reserve bytes for an answer until the block ends, or until the stack is closed by whoever has taken it over.

        Raises:
            BusyError: all requests together hold too much, or those of one client.
        """
        with ExitStack() as held:
            held.enter_context(self._place(self.memory, caller, size))
            yield held

    async def run(self, function: Callable[[Call], T], call: Call) -> T:
        """Run work in a thread, given its deadline.

        Raises:
            DeadlineError, DisconnectedError, EndingError: the call has ended before.
        """
        turn = asyncio.ensure_future(self._free.acquire())
        try:
            await call.first(turn)
        except BaseException:
            if turn.done() and not turn.cancelled():
                self._free.release()
            raise
        work: Future[T] = self._pool.submit(function, call)
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
        """Run one piece of work for every item, side by side, and give the results in order.

        Without a deadline for all of them each piece has its own, from the moment it is handed over.
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
            # What else went wrong doesn't matter any more, but asyncio would log it as never looked at.
            await asyncio.gather(*running, return_exceptions=True)

    async def piece(self, function: Callable[[Call], T], call: Call | None) -> T:
        """``run`` with this deadline, or without one with a deadline of its own; raises as ``run`` does."""
        if call is not None:
            return await self.run(function, call)
        with self._call() as own:
            return await self.run(function, own)

    def late(self) -> DeadlineError:
        """The error for work whose deadline has passed."""
        return DeadlineError(
            f"The answer was not ready within {self.deadline:g} s. Ask for fewer shapes at once, "
            "stream the frames as JSON lines, or try again when there is less to do."
        )

    def end(self) -> None:
        """Answer everything that waits: nothing more will be computed."""
        self._ending = True
        for call in tuple(self._calls):
            call.give_up(_ending())

    def close(self) -> None:
        """End the threads that have nothing to do; those that have are left alone."""
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
    def _call(self) -> Iterator[Call]:
        call = Call(self.deadline, self.late())
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
        """Wait for a thread whose result nobody wants; if it goes on, another one takes its place."""
        loop, free = asyncio.get_running_loop(), True

        def lose() -> None:
            nonlocal free
            if self.lost < SPARE:
                free = False
                self.lost += 1
                self._pool.shutdown(wait=False)  # what runs in it goes on
                self._pool = self._threads()
                self._free.release()
                logger.error("a thread is still at work %g s after its deadline, and another takes its place", PATIENCE)

        def find() -> None:
            timer.cancel()
            if free:
                self._free.release()
            else:
                self.lost -= 1

        timer = loop.call_later(PATIENCE, lose)
        work.add_done_callback(lambda _: None if loop.is_closed() else loop.call_soon_threadsafe(find))


def _ending() -> EndingError:
    return EndingError("The server is about to end. Send the request to another one, or again in a moment.")
