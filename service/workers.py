"""The threads that compute: as many as there are processors, with a bounded queue and a deadline."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import AsyncGenerator, Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

S = TypeVar("S")
T = TypeVar("T")


class BusyError(RuntimeError):
    """The queue is full."""


class DeadlineError(TimeoutError):
    """The time a request may take has passed."""


class DisconnectedError(ConnectionError):
    """Nobody is there to be answered any more."""


class Workers:
    """One long-lived pool of threads for everything that would block the event loop.

    Requests are admitted up to a limit. An admitted request hands over one shape after the other, never more
    at once than there are threads, so that a long animation doesn't keep a single shape waiting for its end.

    Args:
        threads: size of the pool.
        queue: requests admitted beyond those at work.
        deadline: seconds a request may take from its admission.

    Attributes:
        admitted: requests at work or waiting.
        limit: how many those may be.
    """

    def __init__(self, threads: int, queue: int, deadline: float) -> None:
        self.threads, self.deadline = threads, deadline
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="shapespace")
        self.limit = threads + queue
        self.admitted = 0  # touched from the event loop only

    @contextmanager
    def admit(self) -> Iterator[float]:
        """Count a request in for the duration; gives its deadline on the clock of ``time.monotonic``.

        Raises:
            BusyError: too many requests are being worked on or waiting.
        """
        if self.admitted >= self.limit:
            raise BusyError("All workers are busy and the queue is full. Try again after the time in Retry-After.")
        self.admitted += 1
        try:
            yield time.monotonic() + self.deadline
        finally:
            self.admitted -= 1

    async def run(self, function: Callable[[float], T], deadline: float) -> T:
        """Run work in a thread, given its deadline; raises DeadlineError where its turn comes too late."""

        def begin() -> T:
            if time.monotonic() > deadline:
                raise self.late()
            return function(deadline)

        return await asyncio.get_running_loop().run_in_executor(self._pool, begin)

    async def map(
        self, function: Callable[[S, float], T], items: Iterable[S], deadline: float | None
    ) -> AsyncGenerator[T, None]:
        """Run one piece of work for every item, side by side, and give the results in order.

        Without a deadline for all of them each piece has its own, from the moment it is handed over.
        """
        running: deque[asyncio.Task[T]] = deque()
        try:
            for item in items:
                if len(running) == self.threads:
                    yield await running.popleft()
                own = time.monotonic() + self.deadline if deadline is None else deadline
                running.append(asyncio.create_task(self.run(partial(function, item), own)))
            while running:
                yield await running.popleft()
        finally:
            for task in running:
                task.cancel()
            # What else went wrong is of no interest any more, but would be logged as never looked at.
            await asyncio.gather(*running, return_exceptions=True)

    def late(self) -> DeadlineError:
        """The error for work whose deadline has passed."""
        return DeadlineError(
            f"The answer was not ready within {self.deadline:g} s. Ask for fewer shapes at once, "
            "stream the frames as JSON lines, or try again when there is less to do."
        )

    def close(self) -> None:
        """Wait for running work and end the threads."""
        self._pool.shutdown(wait=True, cancel_futures=True)
