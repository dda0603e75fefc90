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
from contextlib import ExitStack, asynccontextmanager, contextmanager
from contextvars import copy_context
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from shapespace.service.limits.quota import Quota, QuotaError
from shapespace.service.limits.turns import Turns
from shapespace.solve.deadline import Deadline

S = TypeVar("S")
T = TypeVar("T")
#: Seconds after its deadline in which a search may complete its best result.
SEARCH_GRACE_SECONDS = 5.0
#: Bytes that all answers with many shapes may use together.
MEMORY = 384 * 2**20
#: What a client can do whose request was not answered by its deadline.
ADVICE = "Ask for fewer shapes at once, stream the frames as JSON lines, or try again when the server is less busy."


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
    """The client of a request.

    Attributes:
        client: its name for quotas, empty if it is unknown.
        gone: waits until it has left, and returns the error for its work.
        long: whether its request may take seconds, so that it has to leave some threads to short ones.
    """

    client: str
    gone: Callable[[], Awaitable[Exception]]
    long: bool = False


class Call(Deadline):
    """A deadline that also ends the waiting of a request on the event loop, with the error ``late``.

    Attributes:
        searching: whether the work is a search, for whose result the event loop waits SEARCH_GRACE_SECONDS more.
    """

    def __init__(self, caller: Caller, seconds: float, late: Exception) -> None:
        super().__init__(seconds)
        self.caller = caller
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
            if not task.done():  # as the turn of most requests is; waiting would take one round of the event loop
                await asyncio.wait((task, self._over), return_when=asyncio.FIRST_COMPLETED)
            if self._over.done():  # even if the work is done too
                self._over.result()
            return task.result()
        finally:
            task.cancel()  # without effect where it is done


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
    """

    def __init__(self, threads: int, queue: int, deadline: float) -> None:
        self.threads, self.deadline = max(2, threads), deadline
        self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="shapespace")
        self._turns = Turns(self.threads)
        self.places, self.streams = Quota(threads + queue), Quota(threads + queue)
        self.memory = Quota(MEMORY)
        self._calls: set[Call] = set()
        self._ending = False

    @asynccontextmanager
    async def admit(self, caller: Caller, advice: str = ADVICE) -> AsyncIterator[Call]:
        """Admit a request for the duration of the block, and yield its deadline; raises BusyError.

        The DeadlineError of a late request ends with the advice.
        """
        with self._place(self.places, caller), self._call(caller, advice) as call:
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
        turn = self._turns.ask(call.caller.client, call.caller.long)
        try:
            await call.first(turn.begun)
            work = self._pool.submit(copy_context().run, function, call)
        except BaseException:
            self._turns.end(turn)
            raise
        loop = asyncio.get_running_loop()
        # The turn ends with the work, which may go on for a while after the call has ended.
        work.add_done_callback(lambda _: None if loop.is_closed() else loop.call_soon_threadsafe(self._turns.end, turn))
        try:
            return await call.first(asyncio.wrap_future(work))
        finally:
            work.cancel()

    async def map(
        self, function: Callable[[S, Call], T], items: Iterable[S], whose: Call | Caller
    ) -> AsyncGenerator[T, None]:
        """Run a function for every item in parallel, and yield the results in order.

        Without a common call each item has its own deadline, which starts when the item is submitted.
        """
        running: deque[asyncio.Task[T]] = deque()
        try:
            for item in items:
                if len(running) == self.threads:
                    yield await running.popleft()
                running.append(asyncio.create_task(self.piece(partial(function, item), whose)))
            while running:
                yield await running.popleft()
        finally:
            for task in running:
                task.cancel()
            # asyncio would log other errors as never retrieved.
            await asyncio.gather(*running, return_exceptions=True)

    async def piece(self, function: Callable[[Call], T], whose: Call | Caller) -> T:
        """Run a function as `run` does, within a call or in a new one."""
        if isinstance(whose, Call):
            return await self.run(function, whose)
        with self._call(whose) as own:
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
    def _call(self, caller: Caller, advice: str = ADVICE) -> Iterator[Call]:
        call = Call(caller, self.deadline, self.late(advice))
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


def _ending() -> EndingError:
    return EndingError("The server is about to end. Send the request to another one, or again in a moment.")
